"""Other ways to the uncertainty of a fit than its Laplace covariance: they trust the trials, not the noise model.

Trials are the units: samples of one trial share its friction, its posture and its noise. Strata are the trials of one
experiment, joint and tendon.

* `bootstrap`: n − 1 trials are drawn from the n of each stratum and weighted n/(n − 1), which makes the variance
  unbiased for small n (Rao & Wu 1988); a stratum of one trial keeps it, and so tells nothing of its own scatter.
* `sandwich`: refits without one trial at a time, the cluster-robust covariance in its conservative form CR3
  (MacKinnon & White 1985; Cameron & Miller 2015).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.identifiability import Direction, directions
from jaxfinger.identify.parameters import describe
from jaxfinger.identify.resample import Batching, Compressed, compress, refit


@dataclass(frozen=True)
class Samples:
    """Flat vectors drawn by resampling or from a posterior."""

    values: Float[np.ndarray, "R P"]  # NaN where a member failed
    failed: Bool[np.ndarray, " R"]
    estimated: np.ndarray  # positions that vary

    @property
    def covariance(self) -> Float[np.ndarray, "P P"]:
        """Over the members that did not fail."""
        return np.cov(self.values[~self.failed], rowvar=False)

    def interval(self, level: float = 0.95) -> Float[np.ndarray, "2 P"]:
        """Lower and upper percentile of every parameter."""
        tail = 50 * (1 - level)
        return np.percentile(self.values[~self.failed], [tail, 100 - tail], axis=0)


def bootstrap(
    session: Session,
    fit: Fit,
    resamples: int = 1000,
    seed: int = 0,
    batching: Batching | None = None,
    compressed: Compressed | None = None,
) -> Samples:
    """Refits to resampled trials of the session that the fit was made from; the samples are read once.

    What CAD gives and no stage estimates is drawn from its own distribution: no trial shows its error.
    """
    compressed = compressed or compress(session, fit)
    rng = np.random.default_rng(seed)
    weights = draw_weights(compressed.strata, resamples, rng)
    given = rng.standard_normal((resamples, compressed.sizes[0]))
    return Samples(*refit(compressed, weights, given, batching), fit.estimated)


def draw_weights(strata: tuple[tuple, ...], resamples: int, rng: np.random.Generator) -> Float[np.ndarray, "R K"]:
    """Weights of the trials in each resample: mean one, and the variance of a mean unbiased in every stratum."""
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
    """Covariance of the flat vector from the scatter between trials.

    Raises:
        UserError: without one of its trials the session no longer shows every parameter.
    """
    compressed = compressed or compress(session, fit)
    rows, factors = [], []
    for members in _members(compressed.strata):
        n = len(members)
        for k in members if n > 1 else []:
            weights = np.ones(len(compressed.strata))
            # The others take over its weight, so that the stratum counts as before beside the other strata.
            weights[members] = n / (n - 1)
            weights[k] = 0.0
            rows.append(weights)
            factors.append((n - 1) / n)
    theta, failed = refit(compressed, np.array(rows).reshape(len(rows), len(compressed.strata)))
    if failed.any():
        lost = compressed.trials[int(np.argmin(rows[int(np.argmax(failed))]))]
        raise UserError(f"without trial {lost} the session no longer shows every parameter; record another like it")
    # What CAD leaves open comes on top: one standard deviation of each at a time, all trials as they are.
    k = compressed.sizes[0]
    inherited, _ = refit(compressed, np.ones((k, len(compressed.strata))), np.eye(k))
    delta = np.concatenate([(theta - compressed.theta) * np.sqrt(factors)[:, None], inherited - compressed.theta])
    return delta.T @ delta


def robust(session: Session, fit: Fit) -> Fit:
    """The fit with a covariance that neither the noise model nor the scatter between trials contradicts.

    Where trials scatter more than the noise explains, the standard deviation is the sandwich's; where a stratum has too
    few trials to tell, Laplace's stays.
    """
    wide = np.sqrt(np.diag(sandwich(session, fit)))
    std = fit.std
    grow = np.where((std > 0) & np.isfinite(std), np.maximum(1.0, wide / np.where(std > 0, std, 1.0)), 1.0)
    return replace(fit, covariance=fit.covariance * np.outer(grow, grow))


def identifiability(session: Session, fit: Fit, compressed: Compressed | None = None) -> list[Direction]:
    """How well the session's trials see each combination of the parameters that the fit estimated, weakest first."""
    compressed = compressed or compress(session, fit)
    return directions(describe(fit.model), fit.estimated, compressed.information)
