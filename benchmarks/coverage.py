"""Calibration of the intervals: bias, coverage and spread of staged and joint fits over simulated sessions.

    python benchmarks/coverage.py [--sessions 200] [--joints 1|3] [--joint] [--no-repeats]

Every session has new noise, new offsets and new errors of CAD. With `--no-repeats` its trials do not say which of them
repeat one motion, so that the noise of moved joints is estimated from residuals. `z` is (estimate − truth) over the
stated standard deviation. Coverage is the share of |z| < 1.96. Spread is the standard deviation of the estimates over
the mean of the stated ones, which is the Cramér–Rao bound of the stage if the noise model is right.
"""

import argparse
from dataclasses import replace

import numpy as np

from jaxfinger.identify import identify, refine
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.synthetic import (
    SHORT,
    SpecimenPlant,
    clean_session,
    measure,
    recipe_from,
    study_finger,
    true_model,
)


def study(sessions: int, joints: int = 1, joint: bool = False, repeats: bool = True):
    """Values of z (sessions, p), ratios of spread to stated standard deviation (p,), and names of the parameters.

    The sessions are seeded and of one polynomial specimen.
    """
    specimen = study_finger(joints)
    recipe = recipe_from({"trials": SHORT, "cad": {"mass": 0.02, "com": 3e-4}})
    clean = clean_session(recipe, SpecimenPlant(specimen), specimen.description)
    model = true_model(specimen)
    truth = np.asarray(ravel(model))
    z, spread, stated = [], [], []
    for seed in range(sessions):
        session = measure(clean, seed)
        if not repeats:
            session = replace(session, trials={t.name: replace(t, motion=None) for t in session})
        fit = identify(session)
        fit = refine(session, fit) if joint else fit
        free, values = fit.estimated, np.asarray(ravel(fit.model))
        z.append((values - truth)[free] / fit.std[free])
        spread.append(values[free])
        stated.append(fit.std[free])
    names = [describe(model)[i].name for i in free]
    return np.array(z), np.std(spread, axis=0, ddof=1) / np.mean(stated, axis=0), names


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sessions", type=int, default=200)
    parser.add_argument("--joints", type=int, default=1, choices=(1, 3))
    parser.add_argument("--joint", action="store_true", help="refine jointly after the stages")
    parser.add_argument("--no-repeats", action="store_true", help="no trial says that it repeats a motion")
    options = parser.parse_args()
    z, ratio, names = study(options.sessions, options.joints, options.joint, not options.no_repeats)
    print(f"{'parameter':34} {'bias in σ':>10} {'coverage':>9} {'spread/σ':>9}")
    for k, name in enumerate(names):
        print(f"{name:34} {z[:, k].mean():10.2f} {np.mean(np.abs(z[:, k]) < 1.96):9.3f} {ratio[k]:9.2f}")
    print(
        f"all {len(names)} parameters, {len(z)} sessions: coverage {np.mean(np.abs(z) < 1.96):.3f}, "
        f"spread/σ {np.sqrt(np.mean(ratio**2)):.3f}, largest bias {np.abs(z.mean(axis=0)).max():.2f} σ "
        f"(chance: {3 / np.sqrt(len(z)):.2f})"
    )


if __name__ == "__main__":
    main()
