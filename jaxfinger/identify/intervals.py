"""Laplace's covariance, with intervals that neither slow noise nor a wrong model makes too narrow.

(JᵀJ + Λ)⁻¹ holds where white residuals are noise of unit variance. They are larger where the noise was estimated too
small, and they keep their sign for a whole movement where its slow part was missed or the model is wrong. Trials are
therefore cut into stretches, each about one movement long. With the score g_b = J_bᵀ r_b of stretch b, the sandwich
(Huber 1967; White 1982; by clusters, Liang and Zeger 1986)

    V = (JᵀJ)⁻¹ (Σ_b g_b g_bᵀ) (JᵀJ)⁻¹

is the covariance of the estimate over other recordings of similar motions, however residuals are correlated within a
stretch. Its ratio to Laplace's is well known for all parameters together that a column of a channel tells of: `laplace`
divides the information of each column by that. V of a single parameter may be larger still, by more than chance
explains: `growth`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.identify.linearise import robust_residuals, robust_share

STRETCH_DURATION = 1.0  # s, at the protocol's pace: about the duration of one movement
# Standard deviations of V's ratio to Laplace's variance that chance may explain, and that are taken off the ratio. At 4
# chance widens fewer than 1 % of intervals where the model is right (tests/identify/test_intervals.py).
MIN_EXCESS = 4.0


def stretches(trial: Int[np.ndarray, " N"], time: Float[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """Number the stretches: index of the stretch of each row, from its trial's index and its time in s."""
    number = np.floor(time / STRETCH_DURATION).astype(int)
    return np.unique(trial * (number.max(initial=0) + 1) + number, return_inverse=True)[1]


class Evidence(NamedTuple):
    """What the white rows of C columns, such as the torques of joints, tell of p parameters in b stretches."""

    information: Float[np.ndarray, "C p p"]  # J_cᵀ J_c
    scores: Float[np.ndarray, "C b p"]  # J_cᵀ r_c of each stretch; their sign does not matter
    chi2: Float[np.ndarray, " C"]
    rows: Int[np.ndarray, " C"]


def evidence(
    r: Float[np.ndarray, " N"],
    J: Float[np.ndarray, "N p"],
    column: Int[np.ndarray, " N"],
    stretch: Int[np.ndarray, " N"],
    huber: float = 0.0,
) -> Evidence:
    """Evidence of white residuals r and their Jacobian J, before Huber's cost, whose limit is `huber` (0 for none)."""
    columns, b, p = column.max(initial=-1) + 1, stretch.max(initial=-1) + 1, J.shape[1]
    out = Evidence(np.zeros((columns, p, p)), np.zeros((columns, b, p)), np.zeros(columns), np.zeros(columns, int))
    limit = huber or np.inf
    for c in range(columns):
        at = np.flatnonzero(column == c)
        at = at[np.argsort(stretch[at], kind="stable")]
        first = np.flatnonzero(np.diff(stretch[at], prepend=-1))
        if not at.size:
            continue
        robust = J[at] * robust_share(r[at], huber)[:, None]
        out.information[c] = robust.T @ robust
        pulls = J[at] * np.clip(r[at], -limit, limit)[:, None]
        out.scores[c, stretch[at[first]]] = np.add.reduceat(pulls, first)
        out.chi2[c], out.rows[c] = np.sum(robust_residuals(r[at], huber) ** 2), at.size
    return out


class Laplace(NamedTuple):
    """Covariance of p parameters from the noise."""

    inverse: Float[np.ndarray, "p p"]  # pseudo-inverse of Σ_c J_cᵀ J_c / β_c + Λ
    ratios: list[Float[np.ndarray, " C"]]  # β_c of the columns of each part of the evidence
    growth: Float[np.ndarray, " p"]  # factor on each standard deviation

    @property
    def covariance(self) -> Float[np.ndarray, "p p"]:
        """`inverse` with its growth."""
        return self.inverse * np.outer(self.growth, self.growth)


def laplace(parts: Sequence[Evidence], root: Float[np.ndarray, "k p"]) -> Laplace:
    """Covariance from the evidence of each experiment, and a square root `root` of the prior's precision Λ.

    β_c is the largest of 1, χ² per degree of freedom (Birge's ratio, the square of the scale factor S of the Particle
    Data Group; Review of Particle Physics, §5.2.2), and the scatter of the scores over that which noise explains,
    Σ_b g_bᵀ C g_b / tr(C J_cᵀ J_c) with C = (JᵀJ + Λ)⁻¹: the dispersion of quasi-likelihood (Wedderburn 1974) with a
    stretch as its unit.
    """
    first = _inverse(np.sum([e.information.sum(axis=0) for e in parts], axis=0), root)
    ratios = [_ratios(e, first) for e in parts]
    weighted = [np.tensordot(1.0 / beta, e.information, 1) for e, beta in zip(parts, ratios, strict=True)]
    inverse = _inverse(np.sum(weighted, axis=0), root)
    scores = [np.tensordot(1.0 / beta, e.scores, 1) for e, beta in zip(parts, ratios, strict=True)]
    return Laplace(inverse, ratios, growth(inverse, np.concatenate(scores), root))


def _ratios(e: Evidence, covariance: Float[np.ndarray, "p p"]) -> Float[np.ndarray, " C"]:
    told = np.einsum("cij,ij->c", e.information, covariance)  # parameters that the column determines, in all
    scatter = np.array([np.sum((g @ covariance) * g) for g in map(_unbiased, e.scores)])
    chi2 = e.chi2 / np.maximum(e.rows - told, 1.0)
    return np.maximum(1.0, np.maximum(chi2, scatter / np.where(told > 0, told, np.inf)))


def _inverse(information: Float[np.ndarray, "p p"], root: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "p p"]:
    """Pseudo-inverse of JᵀJ + Λ, of the matrix scaled to a unit diagonal."""
    N = information + root.T @ root
    diagonal = np.diag(N)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return np.linalg.pinv(N * np.outer(scale, scale), rcond=1e-14, hermitian=True) * np.outer(scale, scale)


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
    return np.sqrt(np.maximum(1.0, ratio - MIN_EXCESS * chance))
