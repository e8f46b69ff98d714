"""The local Wiener filter, for what a fit takes as given: noise there would bias it."""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d

from jaxfinger.data.filtering import robust_std


def shrink(
    x: Float[np.ndarray, "N k"], window: int, most: Float[np.ndarray, " k"] | float = np.inf
) -> Float[np.ndarray, "N k"]:
    """The local Wiener filter: of each column's deviation from its running mean, the share that is more than noise.

    x̂ = x̄ + max(0, 1 − σ²/s²) (x − x̄), s² the variance within the window, σ from the median of |x − x̄|: the noise of
    most of the trial, unless that is motion, too: no sensor has more noise than `most`. As a regressor x̂ is rid of most
    of the bias of its coefficient towards zero (regression calibration; Carroll et al., Measurement Error in Nonlinear
    Models, 2nd ed., ch. 4). `scipy.signal.wiener` takes the signal to be zero beyond its ends, and would pull the mean
    there towards it.
    """
    out = np.array(x, np.float64)
    window = 2 * (max(window, 2) // 2) + 1
    for column, limit in zip(out.T, np.broadcast_to(most, out.shape[1]), strict=True):
        mean = uniform_filter1d(column, window)
        variance = np.maximum(uniform_filter1d(column**2, window) - mean**2, 1e-300)
        noise = min(robust_std(column - mean), limit) ** 2
        column[:] = mean + np.maximum(0.0, 1.0 - noise / variance) * (column - mean)
    return out
