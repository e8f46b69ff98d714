"""Cluster-robust intervals, which a wrong model does not make too narrow: the sandwich (Huber 1967; White 1982).

Laplace's covariance (JᵀJ)⁻¹ holds where white residuals are noise. Residuals of a wrong model are not noise: their sign
stays the same for a whole movement. The sandwich treats each stretch of a trial as one cluster (Liang and Zeger 1986).
With the score g_b = J_bᵀ r_b of stretch b,

    V = (JᵀJ)⁻¹ (Σ_b g_b g_bᵀ) (JᵀJ)⁻¹

is the covariance of the estimate over other recordings of similar motions, however residuals are correlated within a
stretch. V of a single parameter replaces Laplace's variance where it is larger by more than chance explains. The ratio
of both, pooled over all parameters, is known better: `dispersion`.
"""

import numpy as np
from jaxtyping import Float, Int

STRETCH_DURATION = 1.0  # s, at the protocol's pace: about the duration of one movement
# V replaces Laplace's variance only where it exceeds it by so many of its own standard deviations. At 4, chance widens
# fewer than 1 % of intervals where the model is right (tests/identify/test_cluster_robust.py).
MIN_EXCESS = 4.0


def stretches(trial: Int[np.ndarray, " N"], time: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Number the stretches: index of the stretch of each row, from its trial's index and its time in s."""
    number = np.floor(time / STRETCH_DURATION).astype(int)
    return np.unique(trial * (number.max(initial=0) + 1) + number, return_inverse=True)[1]


def stretch_scores(
    r: Float[np.ndarray, " N"], J: Float[np.ndarray, "N p"], stretch: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "b p"]:
    """Score g_b = J_bᵀ r_b of each stretch, from white residuals r and their Jacobian J; its sign does not matter."""
    order = np.argsort(stretch, kind="stable")
    first = np.flatnonzero(np.diff(stretch[order], prepend=-1))
    return np.add.reduceat((J * r[:, None])[order], first) if order.size else np.zeros((0, J.shape[1]))


def dispersion(
    covariance: Float[np.ndarray, "p p"], g: Float[np.ndarray, "b p"], information: Float[np.ndarray, "p p"]
) -> float:
    """Scatter of the scores over that which the noise explains: Σ_b g_bᵀ C g_b / tr(C JᵀJ), about 1 where it is white.

    `covariance` is C, Laplace's with the prior; `information` is JᵀJ. It is the dispersion of quasi-likelihood
    (Wedderburn 1974) with a stretch as its unit. Noise that was estimated from residuals lacks its slow part, which the
    scores of whole stretches show.
    """
    explained = float(np.sum(covariance * information))
    return float(np.sum((_unbiased(g) @ covariance) * _unbiased(g))) / explained if explained > 0 else 1.0


def _unbiased(g: Float[np.ndarray, "b p"]) -> Float[np.ndarray, "b p"]:
    """Scores scaled for their sum, which is zero at the optimum: by √(b/(b − 1)) of the b stretches that count."""
    seen = np.count_nonzero(g, axis=0)
    return g * np.sqrt(seen / np.maximum(seen - 1.0, 1.0))


def growth(
    covariance: Float[np.ndarray, "p p"], g: Float[np.ndarray, "b p"], root: Float[np.ndarray, "k p"]
) -> Float[np.ndarray, " p"]:
    """Factor, at least 1, on each standard deviation of Laplace's `covariance`.

    `root` holds the prior's rows. They enter with unit variance, since no residuals tell their scatter.
    """
    sides = _unbiased(g) @ covariance
    squares, fourth = np.sum(sides**2, axis=0), np.sum(sides**4, axis=0)
    laplace = np.diag(covariance)
    ratio = (squares + np.sum((root @ covariance) ** 2, axis=0)) / np.where(laplace > 0, laplace, np.inf)
    # A sum of b squares of Gaussians has the relative standard deviation √(2/b). Their fourth powers sum to 3/b of the
    # square of that sum, which gives b also where the scores are of unequal size.
    chance = np.sqrt(2.0 / 3.0 * fourth) / np.where(squares > 0, squares, np.inf)
    return np.where(ratio > 1.0 + MIN_EXCESS * chance, np.sqrt(np.maximum(ratio, 1.0)), 1.0)
