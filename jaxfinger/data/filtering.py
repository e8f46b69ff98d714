"""Derivatives from noisy encoders, without phase: low-pass, then a spline.

1. The low-pass is a Gaussian: no phase, no ringing, and one number to state, its cut-off, where |H| = 1/√2. Butterworth
   both ways was the other choice: flatter below the cut-off, but it lets more noise into the second derivative, and
   spreads a jump of friction three times as far.
2. Its standard deviation in time is σ = √(ln 2) / (2π cutoff): 13 ms at 10 Hz.
3. Samples that are not evenly spaced are first interpolated to the median interval: the filter knows no other.
4. At both ends the signal goes on as its odd mirror image about the end, further than filter and spline reach. Without
   the straight line between the ends of that it is a period, and the low-pass a product of its Fourier series.
5. Derivatives are those of the quintic spline through the filtered samples, so differencing adds no error of its own,
   and noise near half the sampling rate is not multiplied by that rate as (iω) would. Its coefficients are the Fourier
   series over that of the B-spline's samples (Unser, IEEE Signal Processing Magazine 16(6), 1999, eq. 9). scipy's
   `BSpline` says the same to rounding, but takes 0.3 s to import, which `check` would have to wait for.

Within about one `1/cutoff_hz` of an end all of it leans on the image.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.errors import UserError

_JUMP = 12.0  # times their mean: the largest second difference that noise makes, with room
_EVEN = 1e-3  # intervals this equal (relative) need no resampling
_PASSES = 4  # spikes that are found, and those that they hid
_AT_END = 10  # samples that tell how fast a motion starts or ends
_SMALL = 1e-4  # of a column's travel: what lies beyond its surroundings by less is no spike
_SPLINE_REACH = 20  # samples: the quintic spline's largest pole, 0.43, is 5e-8 by then
# The quintic B-spline's value and five derivatives at a sample, of the coefficients from two samples before it to three
# after; the fifth is that of the interval which follows. (Divided by 5!, 4!, 3!, 2!, 1, 1.)
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
    """x, ẋ and ẍ below `cutoff_hz` (the frequency of -3 dB), zero-phase, at the given times.

    Columns that are NaN stay NaN; a few NaN in a column are bridged, and NaN in the result.

    Raises:
        UserError: the cut-off is not between zero and half the sampling rate.
    """
    value, rate, acceleration = _smoothed(time, x, cutoff_hz, 2)
    return value, rate, acceleration


def low_pass(
    time: Float[np.ndarray, " N"], x: Float[np.ndarray, "N *k"], cutoff_hz: float
) -> Float[np.ndarray, "N *k"]:
    """x below `cutoff_hz` as `smooth` gives it, without its derivatives."""
    return _smoothed(time, x, cutoff_hz, 0)[0]


def _smoothed(time: np.ndarray, x: np.ndarray, cutoff_hz: float, highest: int) -> np.ndarray:
    """x and its derivatives up to the highest, stacked."""
    time, x = np.asarray(time, np.float64), np.asarray(x, np.float64)
    if len(time) < 3:
        return np.stack([x, *[np.zeros_like(x)] * highest])
    grid = uniform_grid(time)
    rate = (len(grid) - 1) / (grid[-1] - grid[0])
    if not 0.0 < cutoff_hz < 0.5 * rate:
        raise UserError(
            f"a cut-off of {cutoff_hz:g} Hz must lie between 0 and half the sampling rate, {0.5 * rate:.4g} Hz"
        )
    columns = x.reshape(len(time), -1)
    out = np.full((highest + 1, *columns.shape), np.nan)
    usable = [k for k in range(columns.shape[1]) if np.isfinite(columns[:, k]).sum() >= 3]
    if usable:
        even = np.stack([_on_grid(time, columns[:, k], grid) for k in usable])
        coefficients = _spline(even, rate, cutoff_hz)
        at = None if grid is time else (time - grid[0]) * rate
        found = rate ** np.arange(highest + 1)[:, None, None] * _derivatives(coefficients, highest, at)
        out[:, :, usable] = np.moveaxis(found, 1, 2)
        out[:, ~np.isfinite(columns)] = np.nan
    return out.reshape(highest + 1, *x.shape)


def _spline(x: Float[np.ndarray, "k N"], rate: float, cutoff_hz: float) -> Float[np.ndarray, "k N+5"]:
    """Coefficients of the quintic spline through x low-passed, from two samples before the first to three after the
    last.
    """
    N, reach = x.shape[1], math.ceil(rate / cutoff_hz) + _SPLINE_REACH  # 7.5 standard deviations of the Gaussian
    wide = np.pad(x, [(0, 0), (reach, reach)], mode="reflect", reflect_type="odd")
    count = wide.shape[1]
    line = wide[:, :1] + (wide[:, -1:] - wide[:, :1]) / (count - 1) * np.arange(count)  # its own spline coefficients
    size = _quick_length(count)
    turn = 2.0 * np.pi / size * np.arange(size // 2 + 1)  # rad from sample to sample
    B = _B_SPLINE[0, 2] + 2.0 * (_B_SPLINE[0, 3] * np.cos(turn) + _B_SPLINE[0, 4] * np.cos(2.0 * turn))
    H = np.exp(-0.5 * (rate * filter_std(cutoff_hz) * turn) ** 2)
    found = np.fft.irfft(np.fft.rfft(wide - line, size) * H / B, size)[:, :count] + line
    return found[:, reach - 2 : reach + N + 3]


def _derivatives(
    coefficients: Float[np.ndarray, "k C"], highest: int, at: Float[np.ndarray, " M"] | None
) -> Float[np.ndarray, "d k M"]:
    """A spline and its derivatives, per sample, up to the highest order: d = highest + 1 of them, at the samples or at
    places counted in samples. C = N + 5, as of `_spline`.
    """
    last = coefficients.shape[1] - 6

    def at_samples(order: int) -> Float[np.ndarray, "k N"]:
        near = (coefficients[:, i : i + last + 1] for i in range(6))
        return np.asarray(sum(w * c for w, c in zip(_B_SPLINE[order], near, strict=True) if w))

    if at is None:
        return np.stack([at_samples(order) for order in range(highest + 1)])
    before = np.clip(np.floor(at).astype(int), 0, last)
    away, there = at - before, [at_samples(order)[:, before] for order in range(6)]

    def polynomial(order: int) -> Float[np.ndarray, "k M"]:
        """That of the interval, by Horner's scheme."""
        out = there[5]
        for k in range(4, order - 1, -1):
            out = there[k] + out * away / (k - order + 1)
        return out

    return np.stack([polynomial(order) for order in range(highest + 1)])


def _quick_length(size: int) -> int:
    """The least even length of a quick Fourier transform that holds so many samples: a power of two, or 3, 5, 9 or 15
    times one.
    """
    return min(k << max(1, math.ceil(math.log2(size / k))) for k in (1, 3, 5, 9, 15))


def uniform_grid(time: Float[np.ndarray, " N"]) -> Float[np.ndarray, " K"]:
    """Evenly spaced times from the first to the last, at about the median interval; `time` itself where it is even."""
    steps = np.diff(time)
    interval = float(np.median(steps))
    if np.all(np.abs(steps - interval) <= _EVEN * interval):
        return time
    return np.linspace(time[0], time[-1], max(3, 1 + round((time[-1] - time[0]) / interval)))


def _on_grid(time: np.ndarray, column: np.ndarray, grid: np.ndarray) -> np.ndarray:
    good = np.isfinite(column)
    if grid is time and good.all():
        return column
    return np.interp(grid, time[good], column[good])


def filter_std(cutoff_hz: float) -> float:
    """Standard deviation, s, of the Gaussian whose transfer function is 1/√2 at `cutoff_hz`."""
    return np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff_hz)


def filtered_noise_std(cutoff_hz: float, step: float, order: int = 0) -> float:
    """Standard deviation of a derivative of low-passed white noise of unit variance, a sample every `step` s.

    With σ the filter's width, its square is step/(2π) ∫ ω^(2k) e^(−ω²σ²) dω = step Γ(k + ½)/(2π σ^(2k+1)).
    """
    return math.sqrt(step * math.gamma(order + 0.5) / (2.0 * math.pi * filter_std(cutoff_hz) ** (2 * order + 1)))


def outlier_mask(x: Float[np.ndarray, "N *k"], threshold: float = 8.0, longest: int = 5) -> Bool[np.ndarray, "N *k"]:
    """True where a sample is a spike: no motion that is seen before and after it leads there.

    What motion allows, at whatever rate it is sampled, lies between the straight lines through the two samples on
    either side, and those samples themselves: a smooth turn, a corner and a step stay between them, a spike does not.
    Finds spikes of up to `longest` samples, up to about one sample in ten; `threshold` times the noise, a robust
    standard deviation, and at least a sensor's step, so that a quantised channel at rest is not full of spikes. NaN is
    no spike.
    """
    x = np.asarray(x, np.float64)
    columns = x.reshape(len(x), -1)
    mask = np.zeros(columns.shape, bool)
    for k, column in enumerate(columns.T):
        good = np.isfinite(column)
        values = column[good]
        if len(values) > 2 * longest:
            mask[good, k] = _spikes(values, threshold, longest)
    return mask.reshape(x.shape)


def longest_spike(step: float) -> int:
    """Samples, `step` s apart, of the longest spike: 5 ms, but 2 to 25.

    What disturbs is electronics, a bus that stalls for a few cycles of 1 kHz or a power stage that switches, as long on
    slow machines as on quick ones. One that falls between two samples shows in both; of more than 25 in a row the lines
    from either side no longer tell.
    """
    return round(min(max(5e-3 / step, 2.0), 25.0)) if step > 0.0 else 2


def without_spikes(x: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """x with straight lines across spikes of one sample or two, so that a filter does not spread them."""
    out = np.array(x, np.float64)
    if len(out) > 2:
        bend = np.abs(np.diff(out, 2, axis=0))
        rough = ~(bend.max(axis=0) < _JUMP * bend.mean(axis=0))  # else as noise is: nothing to look for
        out[:, rough] = bridged(out[:, rough], outlier_mask(out[:, rough], longest=2))
    return out


def bridged(x: Float[np.ndarray, "N k"], spikes: Bool[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """x with straight lines where `spikes` is true."""
    n, out = np.arange(len(x)), np.array(x, np.float64)
    for column, bad in zip(out.T, spikes.T, strict=True):
        if bad.any() and not bad.all():
            column[bad] = np.interp(n[bad], n[~bad], column[~bad])
    return out


def _spikes(values: Float[np.ndarray, " N"], threshold: float, longest: int) -> Bool[np.ndarray, " N"]:
    # A second difference, of variance 6 σ², shows the noise in motion and at rest.
    noise = max(robust_std(np.diff(values, 2)) / np.sqrt(6.0), _step(values), _SMALL * np.ptp(values))
    spikes, least = np.zeros(len(values), bool), threshold * noise
    for _ in range(_PASSES):  # one spike beside another bends its lines: judge again with a line across what was found
        found = _beyond(bridged(values[:, None], spikes[:, None])[:, 0], least, longest) & ~spikes
        if not found.any():
            break
        spikes |= found
    if not spikes.any():
        return spikes
    # A sound sample between two spikes lies beyond both, and not beyond what is left without them.
    x = np.pad(bridged(values[:, None], spikes[:, None])[:, 0], 2, mode="edge")
    k = np.arange(len(values)) + 2
    lines = 2.0 * x[k - 1] - x[k - 2], 2.0 * x[k + 1] - x[k + 2]
    allowed = np.stack([*lines, x[k - 1], x[k], x[k + 1]])
    return spikes & ((values > allowed.max(axis=0) + least) | (values < allowed.min(axis=0) - least))


def _beyond(values: Float[np.ndarray, " N"], least: float, longest: int) -> Bool[np.ndarray, " N"]:
    """Where samples lie by more than `least` beyond all that their surroundings allow."""
    x = np.concatenate([[np.median(values[:5])] * 2, values, [np.median(values[-5:])] * 2])
    spikes = np.zeros(len(x), bool)
    bend = np.abs(np.diff(x, 2))
    sharp = bend > least  # at the sample before a spike's first, and after its last
    if not sharp.any():
        return spikes[2:-2]
    ends = x[0], x[-1]
    # At an end one side tells less: there a spike is what lies beyond five of the steps beside it, and beyond where a
    # motion leads that sets off or comes to rest within its last four samples, at most by the sharpest bend elsewhere
    # (less five standard deviations, which are noise's own).
    sets_off = 6.0 * max(bend[6:-6].max(initial=0.0) - 0.6 * np.sqrt(6.0) * least, 0.0)
    reach = [5.0 * np.abs(np.diff(part)).max() + sets_off for part in (values[2:_AT_END], values[-_AT_END:-2])]
    first, last = np.flatnonzero(sharp[:-2]) + 2, np.zeros(len(x), bool)
    last[1:-2] = sharp[1:]
    for size in range(1, longest + 1):
        a = first[first + size - 1 < len(x) - 2]
        a = a[last[a + size - 1]]
        z = a + size
        i = np.arange(size)[:, None]
        lines = x[a - 1] + (i + 1) * (x[a - 1] - x[a - 2]), x[z] + (size - i) * (x[z] - x[z + 1])
        allowed = np.stack([*np.broadcast_arrays(*lines, x[a - 1], x[z])])
        inside = a + i
        out = (x[inside] > allowed.max(axis=0) + least) | (x[inside] < allowed.min(axis=0) - least)
        for near, end, steps in zip((a < 4, z > len(x) - 5), ends, reach, strict=True):
            out &= ~near | (np.abs(x[inside] - end) > least + steps)
        out &= out[0] & out[-1]
        spikes[inside[out]] = True
    return spikes[2:-2]


def robust_std(values: Float[np.ndarray, " N"]) -> float:
    """Standard deviation of most of the values."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _step(values: Float[np.ndarray, " N"]) -> float:
    """A sensor's step: the smallest change between samples that is more than rounding."""
    changes = np.abs(np.diff(values))
    changes = changes[changes > 1e-6 * np.ptp(values)]
    return float(changes.min()) if len(changes) else 0.0
