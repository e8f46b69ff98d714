"""Uncertainty of a fit from the scatter between trials, without the noise model of Laplace's covariance.

The unit is the trial, since its samples share friction, posture and noise. A stratum holds the trials of one
experiment, joint and tendon.

* `bootstrap`: n − 1 trials are drawn from the n of each stratum and weighted n/(n − 1), which makes the variance
  unbiased for small n (Rao & Wu 1988). A stratum of a single trial always keeps it and adds no variance.
* `sandwich`: refits without one trial at a time, the cluster-robust covariance in its conservative form CR3
  (MacKinnon & White 1985; Cameron & Miller 2015).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.compilation import one_blas_thread
from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.identifiability import Direction, directions
from jaxfinger.identify.parameters import describe
from jaxfinger.identify.resample import Batching, Compressed, compress, refit


@dataclass(frozen=True)
class Samples:
    """R flat vectors drawn by resampling or from a posterior, in SI units."""

    values: Float[np.ndarray, "R P"]  # NaN where a member failed
    failed: Bool[np.ndarray, " R"]
    estimated: Int[np.ndarray, " p"]  # positions of the estimated parameters

    @property
    def covariance(self) -> Float[np.ndarray, "P P"]:
        """Sample covariance of the members that did not fail, in SI units."""
        return np.cov(self.values[~self.failed], rowvar=False)

    def interval(self, level: float = 0.95) -> Float[np.ndarray, "2 P"]:
        """Lower and upper bound of the central interval of every parameter, as percentiles, in SI units."""
        tail = 50 * (1 - level)
        return np.percentile(self.values[~self.failed], [tail, 100 - tail], axis=0)


@one_blas_thread
def bootstrap(
    session: Session,
    fit: Fit,
    resamples: int = 1000,
    seed: int = 0,
    batching: Batching | None = None,
    compressed: Compressed | None = None,
) -> Samples:
    """Refit to resampled trials of the session that the fit was made from; no sample is read or linearised again.

    Parameters that CAD gives and no stage estimates are drawn from their own distribution, since trials do not show
    their errors. `batching`: as in `resample.refit`. `compressed`: the result of `compress(session, fit)`, where it is
    known.

    Returns:
        The flat vectors of the resamples, in SI units, in the order of `parameters.describe`.

    Raises:
        UserError: the session lacks the trials of the fit, or the fit was refined with `ahead`.
    """
    compressed = compressed or compress(session, fit)
    rng = np.random.default_rng(seed)
    weights = draw_weights(compressed.strata, resamples, rng)
    given = rng.standard_normal((resamples, compressed.sizes[0]))
    return Samples(*refit(compressed, weights, given, batching), fit.estimated)


def draw_weights(strata: tuple[tuple, ...], resamples: int, rng: np.random.Generator) -> Float[np.ndarray, "R K"]:
    """Weights of the K trials in each of R resamples (Rao & Wu 1988): their mean is 1 in every stratum."""
    weights = np.ones((resamples, len(strata)))
    for members in _members(strata):
        n = len(members)
        if n > 1:
            counts = rng.multinomial(n - 1, np.full(n, 1 / n), size=resamples)
            weights[:, members] = counts * n / (n - 1)
    return weights


def _members(strata: tuple[tuple, ...]) -> list[np.ndarray]:
    return [np.flatnonzero([s == stratum for s in strata]) for stratum in dict.fromkeys(strata)]


def sandwich(session: Session, fit: Fit, compressed: Compressed | None = None) -> Float[np.ndarray, "P P"]:
    """Cluster-robust covariance CR3 of the flat vector, from refits without one trial at a time.

    Raises:
        UserError: without one of its trials the session no longer shows every parameter.
    """
    compressed = compressed or compress(session, fit)
    rows, factors = [], []
    for members in _members(compressed.strata):
        n = len(members)
        for k in members if n > 1 else []:
            weights = np.ones(len(compressed.strata))
            # The other trials take over its weight, so that the stratum keeps its total weight.
            weights[members] = n / (n - 1)
            weights[k] = 0.0
            rows.append(weights)
            factors.append((n - 1) / n)
    theta, failed = refit(compressed, np.array(rows).reshape(len(rows), len(compressed.strata)))
    if failed.any():
        lost = compressed.trials[int(np.argmin(rows[int(np.argmax(failed))]))]
        raise UserError(f"without trial {lost} the session no longer shows every parameter; record another like it")
    # Errors of CAD are added: one standard deviation of each given parameter at a time, with all trials.
    k = compressed.sizes[0]
    inherited, _ = refit(compressed, np.ones((k, len(compressed.strata))), np.eye(k))
    delta = np.concatenate([(theta - compressed.theta) * np.sqrt(factors)[:, None], inherited - compressed.theta])
    return delta.T @ delta


def robust(session: Session, fit: Fit) -> Fit:
    """Copy of the fit whose standard deviations are the larger of Laplace's and the sandwich's; correlations are kept.

    Raises:
        UserError: without one of its trials the session no longer shows every parameter.
    """
    wide = np.sqrt(np.diag(sandwich(session, fit)))
    std = fit.std
    grow = np.where((std > 0) & np.isfinite(std), np.maximum(1.0, wide / np.where(std > 0, std, 1.0)), 1.0)
    return replace(fit, covariance=fit.covariance * np.outer(grow, grow))


def identifiability(session: Session, fit: Fit, compressed: Compressed | None = None) -> list[Direction]:
    """Singular directions of the estimated parameters on the session's trials, weakest first."""
    compressed = compressed or compress(session, fit)
    return directions(describe(fit.model), fit.estimated, compressed.information)
