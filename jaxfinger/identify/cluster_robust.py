"""Intervals that a wrong model does not make too narrow: the sandwich (Huber 1967; White 1982), by stretches of time.

Laplace's covariance (JᵀJ)⁻¹ holds where white residuals are noise. What a model misses is none: it pulls an estimate
the same way for a whole movement, and the other way in the next. With g_b = J_bᵀ r_b, the pull of the residuals of one
stretch of a trial,

    V = (JᵀJ)⁻¹ (Σ_b g_b g_bᵀ) (JᵀJ)⁻¹

takes that scatter as it is, correlated within a stretch as it may be (Liang and Zeger 1986): how far the estimate would
move with another record of the like motions. It takes Laplace's place where it is wider by more than chance makes it.
"""

import numpy as np
from jaxtyping import Float, Int

STRETCH = 1.0  # s, at the protocol's pace: about one movement
SURE = 4.0  # standard deviations of V by which it must exceed Laplace's


def stretches(trial: Int[np.ndarray, " N"], time: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Running number of the stretch of every row."""
    number = np.floor(time / STRETCH).astype(int)
    return np.unique(trial * (number.max(initial=0) + 1) + number, return_inverse=True)[1]


def pulls(
    r: Float[np.ndarray, " N"], J: Float[np.ndarray, "N p"], stretch: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "b p"]:
    """g_b of every stretch: white residuals r, J their derivatives, up to a sign."""
    order = np.argsort(stretch, kind="stable")
    first = np.flatnonzero(np.diff(stretch[order], prepend=-1))
    return np.add.reduceat((J * r[:, None])[order], first) if order.size else np.zeros((0, J.shape[1]))


def growth(
    covariance: Float[np.ndarray, "p p"], g: Float[np.ndarray, "b p"], root: Float[np.ndarray, "k p"]
) -> Float[np.ndarray, " p"]:
    """By how much each standard deviation is larger than Laplace's `covariance` says, at least 1; prior rows `root` are
    as they say.
    """
    seen = np.count_nonzero(g, axis=0)
    sides = (g * np.sqrt(seen / np.maximum(seen - 1.0, 1.0))) @ covariance
    squares, fourth = np.sum(sides**2, axis=0), np.sum(sides**4, axis=0)
    laplace = np.diag(covariance)
    ratio = (squares + np.sum((root @ covariance) ** 2, axis=0)) / np.where(laplace > 0, laplace, np.inf)
    # A sum of b equal squares scatters by √(2/b), and its fourth powers are 3/b of its square.
    chance = np.sqrt(2.0 / 3.0 * fourth) / np.where(squares > 0, squares, np.inf)
    return np.where(ratio > 1.0 + SURE * chance, np.sqrt(np.maximum(ratio, 1.0)), 1.0)
