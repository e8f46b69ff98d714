"""NUTS beside Laplace's covariance on a joint fit of one specimen, over all parameters of the nonlinear model.

    python benchmarks/posterior.py [--draws 500] [--warmup 300]

Prints standard deviations and means of the draws relative to those of the fit.
"""

import argparse
import time

import numpy as np

from jaxfinger.identify import identify, refine
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.posterior import sampled_posterior
from jaxfinger.synthetic import SHORT, clean_session, measure, recipe_from

RECIPE = {"specimen": {"kind": "polynomial"}, "trials": SHORT}


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--warmup", type=int, default=300)
    options = parser.parse_args()
    session = measure(clean_session(recipe_from(RECIPE)), 0)
    fit = refine(session, identify(session))
    start = time.perf_counter()
    found = sampled_posterior(session, fit, options.draws, options.warmup)
    seconds = time.perf_counter() - start
    seen = np.flatnonzero(np.isfinite(fit.std) & (fit.std > 0))
    ratio = np.sqrt(np.diag(found.samples.covariance))[seen] / fit.std[seen]
    shift = (found.samples.values.mean(axis=0) - np.asarray(ravel(fit.model)))[seen] / fit.std[seen]
    print(f"{options.draws} draws of {seen.size} parameters after {options.warmup}: {seconds:.0f} s with compilation")
    print(f"divergences {found.divergences}, least effective sample size {found.effective.min():.0f}")
    print(
        f"standard deviations, NUTS over Laplace: {ratio.min():.2f} to {ratio.max():.2f}, median {np.median(ratio):.3f}"
    )
    print(f"means, NUTS less fit, in standard deviations: {shift.min():+.2f} to {shift.max():+.2f}")
    names = [p.name for p in describe(fit.model)]
    for k in np.argsort(-np.abs(np.log(ratio)))[:3]:
        print(f"  furthest: {names[seen[k]]}: {ratio[k]:.2f} of Laplace's, mean {shift[k]:+.2f}")


if __name__ == "__main__":
    main()
