"""Local Wiener filter for the regressors of a fit, whose noise would bias it."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from scipy.special import gammaincinv

from jaxfinger.data.signals.noise import robust_std

PASSED = 0.003  # share of the windows of noise alone that pass, as beyond three standard deviations of a Gaussian


def shrink(
    x: Float[np.ndarray, "N k"], window: int, dof: float, most: Float[np.ndarray, " k"] | float = np.inf
) -> Float[np.ndarray, "N k"]:
    """Shrink the deviation of each column from its running mean by the share that noise explains.

    x̂ = x̄ + (1 − σ²/s²) (x − x̄), with x̄ and s² the mean and variance within `window` samples; x̂ = x̄ where s² is within
    what noise alone reaches. Of noise s²/σ² is distributed as χ²/`dof`, where `dof` are a window's degrees of freedom.
    σ comes from the median of |x − x̄| over the trial. It is at most `most`, the largest noise of the sensor, since a
    trial may move most of the time. As a regressor x̂ has most of the attenuation bias of its coefficient removed
    (regression calibration; Carroll et al., Measurement Error in Nonlinear Models, 2nd ed., ch. 4). Unlike here,
    `scipy.signal.wiener` takes the signal as zero beyond its ends, which biases the mean there.
    """
    out = np.array(x, np.float64)
    reached = 2.0 / dof * gammaincinv(0.5 * dof, 1.0 - PASSED)  # quantile of χ²/dof
    window = 2 * (max(window, 2) // 2) + 1
    for column, limit in zip(out.T, np.broadcast_to(most, out.shape[1]), strict=True):
        mean = uniform_filter1d(column, window)
        variance = np.maximum(uniform_filter1d(column**2, window) - mean**2, 1e-300)
        noise = min(robust_std(column - mean), limit) ** 2
        share = np.where(variance > reached * noise, 1.0 - noise / variance, 0.0)
        column[:] = mean + share * (column - mean)
    return out
