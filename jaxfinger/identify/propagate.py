"""Covariance of the parameters after each stage of a fit, with the errors of earlier stages propagated.

With J_F the white Jacobian of a stage's free parameters, Λ the prior's precision, J_O the Jacobian of the other
parameters, and Σ_OO their covariance,

    K = (J_Fᵀ J_F + Λ)⁻¹ J_Fᵀ J_O,   Σ_FF = G (J_Fᵀ J_F + Λ)⁻¹ G + K Σ_OO Kᵀ,   Σ_FO = −K Σ_OO.

Where residuals or the scores of stretches scatter more than the noise explains, J_F and J_O are taken over the square
root of that ratio. G is diagonal: the factors of `cluster_robust.growth`.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.identify.cluster_robust import dispersion, growth, stretch_scores, stretches
from jaxfinger.identify.linearise import Linearised
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import Solution, Source, stacked, with_all_slopes
from jaxfinger.model import Model

# A parameter is undetermined where its entry in an undetermined combination exceeds this. Rounding changes entries by
# about 1e-9 only (machine precision over the least relative singular value, 1e-7).
MIN_SHARE = 1e-3
# An estimate depends on another parameter if it moves by more than this, in standard deviations, where that parameter
# moves by the unit of its own column. It is small, since an undetermined parameter may be off by many units; rounding
# gives 1e-9 at most, as above.
MIN_DEPENDENCE = 1e-6


def laplace(
    information: Float[np.ndarray, "p p"],
    root: Float[np.ndarray, "k p"],
    scores: Float[np.ndarray, "b p"],
    chi2_per_row: float = 1.0,
) -> tuple[Float[np.ndarray, "p p"], float, Float[np.ndarray, " p"]]:
    """Pseudo-inverse of JᵀJ/β + Λ, the ratio β, and the factor on each standard deviation (`cluster_robust.growth`).

    `information` is JᵀJ, `root` a square root of Λ, `scores` those of the stretches. β is the largest of 1, χ² per row
    (Birge's ratio, the square of the scale factor S of the Particle Data Group; Review of Particle Physics, §5.2.2) and
    `cluster_robust.dispersion`.
    """
    beta = max(1.0, chi2_per_row, dispersion(_inverse(information, root), scores, information))
    inverse = _inverse(information / beta, root)
    return inverse, beta, growth(inverse, scores / beta, root)


def _inverse(information: Float[np.ndarray, "p p"], root: Float[np.ndarray, "k p"]) -> Float[np.ndarray, "p p"]:
    """Pseudo-inverse of JᵀJ + Λ, of the matrix scaled to a unit diagonal."""
    N = information + root.T @ root
    diagonal = np.diag(N)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    return np.linalg.pinv(N * np.outer(scale, scale), rcond=1e-14, hermitian=True) * np.outer(scale, scale)


def propagate(
    covariance: Float[np.ndarray, "P P"],
    model: Model,
    solution: Solution,
    sources: dict[str, Source],
    free: Int[np.ndarray, " p"],
    prior: Prior | None,
    huber: float,
) -> Float[np.ndarray, "P P"]:
    """Covariance of the flat vector after a stage whose optimum is `model`, by the module's equation.

    The variance of a free parameter is infinite where trials and prior do not determine it, or where its estimate
    depends on another parameter of infinite variance. Intervals widen as `laplace` says where residuals are larger than
    the noise, or keep their sign for longer.
    """
    linearised = with_all_slopes(solution.linearised, model, free, sources, huber)
    factor = stacked(linearised, sources, len(covariance))[:, :-1]
    information = factor.T @ factor
    variance = np.diag(covariance)
    others = np.setdiff1d(np.flatnonzero((variance > 0) & np.isfinite(variance)), free)
    unknown = np.setdiff1d(np.flatnonzero(np.isinf(variance)), free)
    root = np.zeros((0, free.size)) if prior is None else prior.root
    scores = _scores(linearised, sources, len(covariance), huber or np.inf)[:, free]
    chi2 = solution.chi2_per_row(free.size)
    inverse, beta, grow = laplace(information[np.ix_(free, free)], root, scores, chi2)
    information = information / beta
    out = covariance.copy()
    out[free, :] = out[:, free] = 0.0
    cross = inverse @ information[np.ix_(free, others)]
    inherited = covariance[np.ix_(others, others)]
    out[np.ix_(free, free)] = inverse * np.outer(grow, grow) + cross @ inherited @ cross.T
    out[np.ix_(free, others)] = -cross @ inherited
    out[np.ix_(others, free)] = out[np.ix_(free, others)].T
    undetermined = np.any(np.abs(solution.invisible) > MIN_SHARE, axis=0)
    # An estimate that depends on an undetermined parameter is undetermined, too.
    undetermined |= depends(inverse, information[np.ix_(free, unknown)], np.diag(information)[unknown])
    out[free[undetermined], free[undetermined]] = np.inf
    return out


def depends(
    inverse: Float[np.ndarray, "p p"], cross: Float[np.ndarray, "p u"], own: Float[np.ndarray, " u"]
) -> Bool[np.ndarray, " p"]:
    """Whether each of p estimates depends on any of u other parameters, whatever their units.

    `inverse`: covariance of the estimates. `cross`: information on both, J_FᵀJ_O. `own`: diagonal of J_OᵀJ_O.
    """
    unit = 1.0 / np.sqrt(np.where(own > 0.0, own, np.inf))
    moves = np.abs(inverse @ cross) * unit
    return np.any(moves > MIN_DEPENDENCE * np.sqrt(np.diag(inverse))[:, None], axis=1)


def _scores(
    linearised: dict[str, Linearised], sources: dict[str, Source], size: int, limit: float
) -> Float[np.ndarray, "b P"]:
    """Scores of all stretches by the flat vector; residuals beyond Huber's limit enter with the limit."""
    out = []
    for name, lin in linearised.items():
        B, wide, k = lin.jacobian.shape
        time = np.asarray(sources[name].batch.x.time) / sources[name].pace
        time = np.broadcast_to(time[:, None], (B, wide // time.shape[1], time.shape[1])).reshape(B, wide)
        counts = np.flatnonzero(lin.white)
        stretch = stretches(np.repeat(np.arange(B), wide)[counts], time.reshape(-1)[counts])
        r, J = lin.white.reshape(-1)[counts], lin.jacobian.reshape(-1, k)[counts]
        block = np.zeros((stretch.max(initial=-1) + 1, size))
        block[:, sources[name].positions] = stretch_scores(np.clip(r, -limit, limit), J, stretch)
        out.append(block)
    return np.concatenate(out)
