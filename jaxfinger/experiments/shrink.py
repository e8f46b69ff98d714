"""Local Wiener filter for the regressors of a fit, whose noise would bias it."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from jaxfinger.data.filtering import robust_std

# s²/σ² of a window, which noise alone exceeds in two of a thousand. A window has as few as two independent samples of q̈
# (`driven.ACCELERATION_WINDOW`), so that s² scatters widely.
MAX_NOISE_VARIANCE = 4.0


def shrink(
    x: Float[np.ndarray, "N k"], window: int, most: Float[np.ndarray, " k"] | float = np.inf
) -> Float[np.ndarray, "N k"]:
    """Shrink the deviation of each column from its running mean by the share that noise explains.

    x̂ = x̄ + (1 − σ²/s²) (x − x̄), with x̄ and s² the mean and variance within `window` samples; x̂ = x̄ where s² is within
    what noise alone reaches. σ comes from the median of |x − x̄| over the trial. It is at most `most`, the largest noise
    of the sensor, since a trial may move most of the time. As a regressor x̂ has most of the attenuation bias of its
    coefficient removed (regression calibration; Carroll et al., Measurement Error in Nonlinear Models, 2nd ed., ch. 4).
    Unlike here, `scipy.signal.wiener` takes the signal as zero beyond its ends, which biases the mean there.
    """
    out = np.array(x, np.float64)
    window = 2 * (max(window, 2) // 2) + 1
    for column, limit in zip(out.T, np.broadcast_to(most, out.shape[1]), strict=True):
        mean = uniform_filter1d(column, window)
        variance = np.maximum(uniform_filter1d(column**2, window) - mean**2, 1e-300)
        noise = min(robust_std(column - mean), limit) ** 2
        share = np.where(variance > MAX_NOISE_VARIANCE * noise, 1.0 - noise / variance, 0.0)
        column[:] = mean + share * (column - mean)
    return out
