"""From an optimum to intervals, stage after stage.

With J_F the white Jacobian of a stage's own parameters, P the prior's precision, and J_O the Jacobian of the others,
whose covariance is Σ_OO,

    K = (J_Fᵀ J_F + P)⁻¹ J_Fᵀ J_O,   Σ_FF = (J_Fᵀ J_F + P)⁻¹ + K Σ_OO Kᵀ,   Σ_FO = −K Σ_OO.
"""

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.identify.cluster_robust import growth, pulls, stretches
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import Solution, Source


def laplace(
    information: Float[np.ndarray, "p p"], root: Float[np.ndarray, "k p"], pulled: Float[np.ndarray, "b p"]
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """(JᵀJ + P)⁻¹ along what is seen, and by how much each standard deviation is larger than it says (`misfit`)."""
    N = information + root.T @ root
    diagonal = np.diag(N)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    inverse = np.linalg.pinv(N * np.outer(scale, scale), rcond=1e-14, hermitian=True) * np.outer(scale, scale)
    return inverse, growth(inverse, pulled, root)


def propagate(
    covariance: Float[np.ndarray, "P P"],
    solution: Solution,
    sources: dict[str, Source],
    free: Int[np.ndarray, " p"],
    prior: Prior | None,
    huber: float,
) -> Float[np.ndarray, "P P"]:
    """Covariance of the flat vector after a stage (see the module's equation); infinite where nothing is seen.

    Residuals larger than the noise say that the model misses something: intervals then widen with them (Birge's ratio,
    as the Particle Data Group's scale factor S; Review of Particle Physics, §5.2.2), and by as much more as the
    residuals pull a parameter to and fro from one stretch of the trials to the next (`misfit`).
    """
    birge = max(1.0, solution.chi2_per_row(free.size))
    information = solution.information / birge
    variance = np.diag(covariance)
    others = np.setdiff1d(np.flatnonzero((variance > 0) & np.isfinite(variance)), free)
    unknown = np.setdiff1d(np.flatnonzero(np.isinf(variance)), free)
    root = np.zeros((0, free.size)) if prior is None else prior.root
    pulled = _pulls(solution, sources, len(covariance), huber or np.inf)[:, free] / birge
    inverse, grow = laplace(information[np.ix_(free, free)], root, pulled)
    out = covariance.copy()
    out[free, :] = out[:, free] = 0.0
    cross = inverse @ information[np.ix_(free, others)]
    inherited = covariance[np.ix_(others, others)]
    out[np.ix_(free, free)] = inverse * np.outer(grow, grow) + cross @ inherited @ cross.T
    out[np.ix_(free, others)] = -cross @ inherited
    out[np.ix_(others, free)] = out[np.ix_(free, others)].T
    blind = np.any(np.abs(solution.invisible) > 1e-3, axis=0)
    # What leans on something unknown is no better known.
    leans = inverse @ information[np.ix_(free, unknown)] * np.sqrt(np.diag(information)[unknown])
    blind |= np.any(np.abs(leans) > 1e-3 * np.sqrt(np.diag(inverse))[:, None], axis=1)
    out[free[blind], free[blind]] = np.inf
    return out


def _pulls(solution: Solution, sources: dict[str, Source], size: int, limit: float) -> Float[np.ndarray, "b P"]:
    """Of every stretch of the trials on the flat vector (`misfit`); outliers pull with the limit."""
    out = []
    for name, lin in solution.linearised.items():
        B, wide, k = lin.jacobian.shape
        time = np.asarray(sources[name].batch.x.time) / sources[name].pace
        time = np.broadcast_to(time[:, None], (B, wide // time.shape[1], time.shape[1])).reshape(B, wide)
        counts = np.flatnonzero(lin.white)
        stretch = stretches(np.repeat(np.arange(B), wide)[counts], time.reshape(-1)[counts])
        r, J = lin.white.reshape(-1)[counts], lin.jacobian.reshape(-1, k)[counts]
        block = np.zeros((stretch.max(initial=-1) + 1, size))
        block[:, sources[name].positions] = pulls(np.clip(r, -limit, limit), J, stretch)
        out.append(block)
    return np.concatenate(out)
