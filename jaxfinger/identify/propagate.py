"""Covariance of the parameters after each stage of a fit, with the errors of earlier stages propagated.

With J_F the white Jacobian of a stage's free parameters, Λ the prior's precision, J_O the Jacobian of the other
parameters, and Σ_OO their covariance,

    K = (J_Fᵀ J_F + Λ)⁻¹ J_Fᵀ J_O,   Σ_FF = G (J_Fᵀ J_F + Λ)⁻¹ G + K Σ_OO Kᵀ,   Σ_FO = −K Σ_OO.

The products of J are sums over the columns of channels, each divided by its ratio β_c; G is diagonal (`intervals`).
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.identify.intervals import Evidence, evidence, laplace, stretches
from jaxfinger.identify.linearise import Linearised
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import Solution, with_all_slopes
from jaxfinger.identify.sources import Source
from jaxfinger.model import Model

# A parameter is undetermined where its entry in an undetermined combination exceeds this. Rounding changes entries by
# about 1e-9 only (machine precision over the least relative singular value, 1e-7).
MIN_SHARE = 1e-3
# An estimate depends on another parameter if it moves by more than this, in standard deviations, where that parameter
# moves by the unit of its own column. It is small, since an undetermined parameter may be off by many units; rounding
# gives 1e-9 at most, as above.
MIN_DEPENDENCE = 1e-6


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
    depends on another parameter of infinite variance. Intervals widen where residuals are larger than the noise, or
    keep their sign for longer (`intervals`).
    """
    linearised = with_all_slopes(solution.linearised, model, free, sources, huber)
    told = {e: _evidence(lin, sources[e], huber) for e, lin in linearised.items()}
    variance = np.diag(covariance)
    others = np.setdiff1d(np.flatnonzero((variance > 0) & np.isfinite(variance)), free)
    unknown = np.setdiff1d(np.flatnonzero(np.isinf(variance)), free)
    root = np.zeros((0, free.size)) if prior is None else prior.root
    parts = [_of(x, sources[e].positions, free) for e, x in told.items()]
    found = laplace(parts, root)
    information = np.zeros_like(covariance)
    for (e, x), beta in zip(told.items(), found.ratios, strict=True):
        at = sources[e].positions
        information[np.ix_(at, at)] += np.tensordot(1.0 / beta, x.information, 1)
    out = covariance.copy()
    out[free, :] = out[:, free] = 0.0
    cross = found.inverse @ information[np.ix_(free, others)]
    inherited = covariance[np.ix_(others, others)]
    out[np.ix_(free, free)] = found.covariance + cross @ inherited @ cross.T
    out[np.ix_(free, others)] = -cross @ inherited
    out[np.ix_(others, free)] = out[np.ix_(free, others)].T
    undetermined = np.any(np.abs(solution.invisible) > MIN_SHARE, axis=0)
    # An estimate that depends on an undetermined parameter is undetermined, too.
    undetermined |= depends(found.inverse, information[np.ix_(free, unknown)], np.diag(information)[unknown])
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


def _evidence(lin: Linearised, source: Source, huber: float) -> Evidence:
    """Evidence of an experiment on the parameters that it depends on."""
    time = np.asarray(source.batch.x.time) / source.pace  # (B, T)
    columns = lin.white.shape[1] // time.shape[1]
    counts = np.flatnonzero(lin.white)
    trial, column, sample = np.unravel_index(counts, (len(time), columns, time.shape[1]))
    r, J = lin.white.reshape(-1)[counts], lin.jacobian.reshape(-1, lin.jacobian.shape[-1])[counts]
    return evidence(r, J, column, stretches(trial, time[trial, sample]), huber)


def _of(told: Evidence, positions: Int[np.ndarray, " k"], free: Int[np.ndarray, " p"]) -> Evidence:
    """The same evidence on the free parameters: zero on those that the experiment does not depend on."""
    mine, at = np.flatnonzero(np.isin(free, positions)), np.searchsorted(positions, free[np.isin(free, positions)])
    C, b, _ = told.scores.shape
    information, scores = np.zeros((C, free.size, free.size)), np.zeros((C, b, free.size))
    information[:, mine[:, None], mine], scores[..., mine] = told.information[:, at[:, None], at], told.scores[..., at]
    return told._replace(information=information, scores=scores)
