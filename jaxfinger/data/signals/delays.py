"""Delays between channels: the shift in time with which a law fits best."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxfinger.data.signals.filtering import fourier_length, uniform_grid

_PER_PERIOD = 8  # samples in a period of the cut-off: the filter passes 0.4 % at half of that rate.
MIN_SAMPLES = 100  # ten for each regressor
LONGEST_SHARE = 0.1  # of the trial, of a delay that is looked for: a longer one leaves too little to compare.
# In times that a tenth of the travel takes: a quarter of the period of a sine. Where all strokes are alike, longer
# shifts are ambiguous.
UNIQUE_TRAVELS = 8.0
MIN_DELAY = 0.05  # of the cut-off's period, 5 ms at the protocol's pace: a shorter one changes damping by a third.
MIN_GAIN = 2.0  # factor by which a shift shrinks the residual: a delay explains three quarters of its variance.
MIN_SHARE = 1e-8  # of the channel's square, in a residual: a ten-thousandth is below any sensor's noise.
MAX_CHANGE = 0.2  # of a delay: what is hysteresis loses its delay, or turns it round, where hysteresis is allowed for.


class Shift(NamedTuple):
    """The shift in time with which a law fits best."""

    samples: float
    gain: float  # factor by which it shrinks what the law leaves
    left: float  # what the law then leaves, of the channel's rms


def even(cutoff: float, time: np.ndarray, *channels: np.ndarray) -> list[np.ndarray]:
    """Time and channels at even steps, as means over as many samples as a filter at the cut-off, Hz, allows."""
    grid = uniform_grid(time)
    size = max(1, int(1.0 / (_PER_PERIOD * cutoff * (grid[1] - grid[0]))))
    out = []
    for x in (grid, *channels):
        if grid is not time and x is not grid:
            columns = [np.interp(grid, time, column) for column in x.reshape(len(time), -1).T]
            x = np.reshape(np.transpose(columns), (len(grid), *x.shape[1:]))
        out.append(means(x, size))
    return out


def means(x: np.ndarray, size: int) -> np.ndarray:
    """Means over `size` samples each."""
    count = len(x) // size
    return x[: count * size].reshape(count, size, *x.shape[1:]).mean(axis=1)


def best_shifts(y: np.ndarray, X: np.ndarray, where: np.ndarray, longest: int) -> list[Shift]:
    """Best shift of each row of y.

    y(t + L) is regressed on X(t) for L from -longest to longest. With an orthonormal basis Q of X the square of the
    residual is |y|² − |Qᵀy|². Over all shifts both terms are circular correlations, of which negative shifts are at the
    end. Up to `longest` they do not wrap, since `where` leaves out as many samples at either end.
    """
    Q, R = np.linalg.qr(X[where])
    size, length = np.abs(np.diag(R)), fourier_length(len(X))
    left = np.zeros((X.shape[1] + 1, len(X)))
    left[:-1, where] = (Q * (size > 1e-9 * size.max())).T  # A column of X that adds nothing has an arbitrary Q.
    left[-1, where] = 1.0
    turned = np.fft.rfft(left, length).conj()
    explained = np.fft.irfft(turned[:-1] * np.fft.rfft(y, length)[:, None], length)
    square = np.fft.irfft(turned[-1] * np.fft.rfft(y * y, length), length)
    out = []
    for share in (1.0 - (explained**2).sum(axis=1) / square)[:, np.arange(-longest, longest + 1)]:
        k = int(np.argmin(share))
        if not 0 < k < 2 * longest:
            out.append(Shift(0.0, 1.0, 1.0))  # The best shift is further away, or there is none.
            continue
        before, least, after = share[k - 1 : k + 2]
        between = 0.5 * (before - after) / (before - 2.0 * least + after)
        gain = np.sqrt(share[longest] / max(least, MIN_SHARE))
        out.append(Shift(k - longest + float(between), float(gain), float(np.sqrt(least))))
    return out


def stops(x: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Deflections, as samples go on along the first axis, of springs that slide beyond ± widths."""
    steps = np.diff(x, axis=0)
    out = np.zeros((len(x), *widths.shape))
    for k, way in enumerate(steps, 1):
        out[k] = np.minimum(np.maximum(out[k - 1] + way, -widths), widths)  # `np.clip` takes four times as long.
    return out
