"""Zero-phase derivatives from noisy encoders: a low-pass, then a spline.

1. The low-pass is a Gaussian. It has no phase and no ringing, and one parameter, its cut-off, where |H| = 1/√2.
   A Butterworth filter applied both ways is flatter below the cut-off, but lets more noise into the second derivative
   and spreads a jump of friction three times as far.
2. The Gaussian's standard deviation in time is σ = √(ln 2) / (2π cutoff): 13 ms at 10 Hz.
3. Samples that are not evenly spaced are first interpolated to the median interval, since the filter needs even ones.
4. Beyond both ends the signal is continued by its odd mirror image about the end, further than filter and spline reach.
   Minus the straight line between its ends the continued signal is periodic, so the low-pass is a product with its
   Fourier series.
5. The derivatives are those of the quintic spline through the filtered samples. Differencing would add an error, and a
   factor iω would multiply noise near half the sampling rate by that rate. The spline's coefficients are the Fourier
   series divided by that of the B-spline's samples (Unser, IEEE Signal Processing Magazine 16(6), 1999, eq. 9). scipy's
   `BSpline` agrees to rounding, but its import takes 0.3 s, for which `check` would have to wait.

Within about `1/cutoff_hz` of an end the results depend on the mirror image.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.signals.quantiles import median
from jaxfinger.errors import UserError

if TYPE_CHECKING:
    from jaxtyping import Float

_EVEN = 1e-3  # Intervals that differ by less than this share need no resampling.
_SPLINE_REACH = 20  # samples after which the quintic spline's largest pole, 0.43, has decayed to 5e-8
# Value and five derivatives of the quintic spline at a sample: weights of the B-spline coefficients from two samples
# before it to three after. The fifth derivative is that of the interval after the sample.
_B_SPLINE = (
    np.array(
        [
            [1, 26, 66, 26, 1, 0],
            [-1, -10, 0, 10, 1, 0],
            [1, 2, -6, 2, 1, 0],
            [-1, 2, 0, -2, 1, 0],
            [1, -4, 6, -4, 1, 0],
            [-1, 5, -10, 10, -5, 1],
        ]
    )
    / np.array([120.0, 24.0, 6.0, 2.0, 1.0, 1.0])[:, None]
)


def smooth(
    time: Float[np.ndarray, " N"], x: Float[np.ndarray, "N *k"], cutoff_hz: float
) -> tuple[Float[np.ndarray, "N *k"], Float[np.ndarray, "N *k"], Float[np.ndarray, "N *k"]]:
    """Low-pass x with zero phase and differentiate it twice: x, ẋ and ẍ at the given times.

    `time` is in s, `cutoff_hz` the frequency of -3 dB. NaN are interpolated for the filter and stay NaN in the result,
    as do columns with fewer than three finite samples.

    Raises:
        UserError: the cut-off is not between zero and half the sampling rate.
    """
    value, rate, acceleration = _smoothed(time, x, cutoff_hz, (0, 1, 2))
    return value, rate, acceleration


def smooth_rate(
    time: Float[np.ndarray, " N"], x: Float[np.ndarray, "N *k"], cutoff_hz: float
) -> Float[np.ndarray, "N *k"]:
    """Low-passed ẋ alone, as `smooth` gives it, in less time."""
    return _smoothed(time, x, cutoff_hz, (1,))[0]


def low_pass(
    time: Float[np.ndarray, " N"], x: Float[np.ndarray, "N *k"], cutoff_hz: float
) -> Float[np.ndarray, "N *k"]:
    """Low-pass x as `smooth` does, without derivatives."""
    return _smoothed(time, x, cutoff_hz, (0,))[0]


def _smoothed(time: np.ndarray, x: np.ndarray, cutoff_hz: float, orders: tuple[int, ...]) -> np.ndarray:
    """Derivatives of these orders of the filtered x, stacked along the first axis."""
    time, x = np.asarray(time, np.float64), np.asarray(x, np.float64)
    if len(time) < 3:
        return np.stack([np.zeros_like(x) if k else x for k in orders])
    grid = uniform_grid(time)
    rate = (len(grid) - 1) / (grid[-1] - grid[0])
    if not 0.0 < cutoff_hz < 0.5 * rate:
        raise UserError(
            f"a cut-off of {cutoff_hz:g} Hz must lie between 0 and half the sampling rate, {0.5 * rate:.4g} Hz"
        )
    columns = np.ascontiguousarray(x.reshape(len(time), -1).T)
    out, finite = np.full((len(orders), *columns.shape), np.nan), np.isfinite(columns)
    usable = np.flatnonzero(finite.sum(axis=1) >= 3)
    if usable.size:
        even = np.stack([_on_grid(time, columns[k], grid) for k in usable])
        coefficients = _spline(even, rate, cutoff_hz)
        at = None if grid is time else (time - grid[0]) * rate
        derivatives = _derivatives(coefficients, orders, at)
        for order, of_order, values in zip(orders, out, derivatives, strict=True):
            of_order[usable] = rate**order * values
            of_order[~finite] = np.nan
    return np.moveaxis(out, 1, 2).reshape(len(orders), *x.shape)


def _spline(x: Float[np.ndarray, "k N"], rate: float, cutoff_hz: float) -> Float[np.ndarray, "k N+5"]:
    """Coefficients of the quintic spline through low-passed x, from two samples before the first to three after the
    last.
    """
    # 1/cutoff is 7.5 standard deviations of the Gaussian.
    N, reach = x.shape[1], math.ceil(rate / cutoff_hz) + _SPLINE_REACH
    wide = np.pad(x, [(0, 0), (reach, reach)], mode="reflect", reflect_type="odd")
    count = wide.shape[1]
    # A straight line is its own spline coefficients, so it is added back to them.
    line = wide[:, :1] + (wide[:, -1:] - wide[:, :1]) / (count - 1) * np.arange(count)
    size = fourier_length(count)
    near = slice(reach - 2, reach + N + 3)
    series = np.fft.rfft(wide - line, size) * _transfer(size, rate * filter_std(cutoff_hz))
    return np.fft.irfft(series, size)[:, near] + line[:, near]


@lru_cache(maxsize=16)
def _transfer(size: int, std: float) -> Float[np.ndarray, " k"]:
    """Factor of low-pass and spline on a Fourier series of `size` samples; `std`: of the Gaussian, in samples.

    Trials of a session are mostly of a few lengths.
    """
    turn = 2.0 * np.pi / size * np.arange(size // 2 + 1)  # rad from sample to sample
    B = _B_SPLINE[0, 2] + 2.0 * (_B_SPLINE[0, 3] * np.cos(turn) + _B_SPLINE[0, 4] * np.cos(2.0 * turn))
    return np.exp(-0.5 * (std * turn) ** 2) / B


def _derivatives(
    coefficients: Float[np.ndarray, "k C"], orders: tuple[int, ...], at: Float[np.ndarray, " M"] | None
) -> Float[np.ndarray, "d k M"]:
    """Derivatives of d orders of a spline, per sample interval; that of order 0 is its value.

    They are taken at the N = C - 5 samples, or at `at`, counted in samples. The coefficients are those of `_spline`.
    """
    if at is None:
        return np.array([[np.correlate(c, _B_SPLINE[k], "valid") for c in coefficients] for k in orders])
    before = np.clip(np.floor(at).astype(int), 0, coefficients.shape[1] - 6)
    away = at - before
    # At `away` past a sample derivative k is its Taylor series Σ_j s⁽ᵏ⁺ʲ⁾ awayʲ/j!. Every s⁽ᵏ⁺ʲ⁾ is a weighted sum of
    # six coefficients, and so is the derivative.
    powers = np.ones((6, len(away)))  # awayʲ/j!
    for j in range(1, 6):
        powers[j] = powers[j - 1] * away / j
    weights = [_B_SPLINE[k:].T @ powers[: 6 - k] for k in orders]
    out, part = np.zeros((len(orders), len(coefficients), len(at))), np.empty(len(at))
    for column, derivatives in zip(coefficients, np.moveaxis(out, 1, 0), strict=True):  # one at a time fits the cache
        for i in range(6):
            near = column[i:].take(before)
            for derivative, weight in zip(derivatives, weights, strict=True):
                derivative += np.multiply(weight[i], near, out=part)
    return out


def fourier_length(size: int) -> int:
    """Shortest even length, at least `size`, with a fast Fourier transform: 1, 3, 5, 9 or 15 times a power of two.

    `scipy.fft.next_fast_len` finds such lengths too, but its import takes 0.2 s, for which `check` would have to wait.
    """
    return min(k << max(1, math.ceil(math.log2(size / k))) for k in (1, 3, 5, 9, 15))


def uniform_grid(time: Float[np.ndarray, " N"]) -> Float[np.ndarray, " K"]:
    """Evenly spaced times over the recording, at about its median interval; `time` itself where it is even."""
    steps = np.diff(time)
    interval = median(steps)
    if np.all(np.abs(steps - interval) <= _EVEN * interval):
        return time
    return np.linspace(time[0], time[-1], max(3, 1 + round((time[-1] - time[0]) / interval)))


def _on_grid(time: np.ndarray, column: np.ndarray, grid: np.ndarray) -> np.ndarray:
    good = np.isfinite(column)
    if grid is time and good.all():
        return column
    return np.interp(grid, time[good], column[good])


def filter_std(cutoff_hz: float) -> float:
    """Standard deviation, s, of the Gaussian filter, whose transfer function is 1/√2 at `cutoff_hz`."""
    return np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff_hz)


def filtered_noise_std(cutoff_hz: float, step: float, order: int = 0) -> float:
    """Standard deviation of low-passed white noise, or of its derivative of order k, per s^k.

    The noise has unit variance and a sample every `step` s. With σ the filter's standard deviation, the variance is
    step/(2π) ∫ ω^(2k) e^(−ω²σ²) dω = step Γ(k + ½)/(2π σ^(2k+1)).
    """
    return math.sqrt(step * math.gamma(order + 0.5) / (2.0 * math.pi * filter_std(cutoff_hz) ** (2 * order + 1)))
