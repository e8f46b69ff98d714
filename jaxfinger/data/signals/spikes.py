"""Spikes of sensors: samples that no motion leads to. They are marked, bridged, and told from noise.

Spikes come from electronics, such as a bus that stalls for a few cycles of 1 kHz or a power stage that switches. They
last as long on slow machines as on quick ones.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.signals.noise import STD_PER_MAD, resolution
from jaxfinger.data.signals.quantiles import median

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

# Largest second difference as a multiple of the mean one. That of Gaussian noise stays below it, so a column below it
# has no spikes to look for.
_MAX_NOISE_BEND = 12.0
# Standard deviations of noise. With σ the noise of a sample, the straight line through the two samples on one side is
# √6 σ off: 8 σ is 3.3 times that, and a spike must be so far from the line on the other side, too.
_MIN_SPIKE_TO_NOISE = 8.0
_MAX_PASSES = 4  # Each pass finds spikes that those found before had hidden; longer chains of them are rare.
_END_SAMPLES = 10  # at each end, whose steps show how fast a motion starts or stops
_MIN_SPIKE_SHARE = 1e-4  # of a column's travel: a smaller deviation is no spike, even where the column has no noise.


def outlier_mask(x: Float[np.ndarray, "N *k"], longest: int = 5) -> Bool[np.ndarray, "N *k"]:
    """Mark spikes: samples that no motion seen before and after them leads to.

    A sample of a motion lies within the range of its two neighbours and of the straight lines through the two samples
    on either side. Smooth turns, corners and steps stay within that range at any sampling rate. A spike is outside by
    more than `_MIN_SPIKE_TO_NOISE` times the noise. The noise is a robust standard deviation, and at least the sensor's
    resolution, so that a quantised channel at rest has no spikes. NaN is no spike.

    Spikes of up to `longest` samples are found, in up to about one sample in ten.
    """
    x = np.asarray(x, np.float64)
    columns = x.reshape(len(x), -1)
    mask = np.zeros_like(columns, bool)
    for k, column in enumerate(columns.T):
        good = np.isfinite(column)
        values = column[good]
        if len(values) > 2 * longest:
            mask[good, k] = _spikes(values, longest)
    return mask.reshape(x.shape)


def longest_spike(step: float) -> int:
    """Number of samples, `step` s apart, of the longest spike: 5 ms, but at least 2 and at most 25 samples.

    A spike between two samples shows in both. Over more than 25 samples the lines from either side are no prediction.
    """
    return round(min(max(5e-3 / step, 2.0), 25.0)) if step > 0.0 else 2


def without_spikes(x: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """x with spikes of one or two samples replaced by straight lines, so that a filter does not spread them."""
    out = np.array(x, np.float64)
    if len(out) > 2:
        bend = np.abs(np.diff(out, 2, axis=0))
        rough = ~(bend.max(axis=0) < _MAX_NOISE_BEND * bend.mean(axis=0))
        out[:, rough] = bridged(out[:, rough], outlier_mask(out[:, rough], longest=2))
    return out


def bridged(x: Float[np.ndarray, "N k"], spikes: Bool[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """x with the samples that `spikes` marks replaced by straight lines between their neighbours."""
    n, out = np.arange(len(x)), np.array(x, np.float64)
    for column, bad in zip(out.T, spikes.T, strict=True):
        if bad.any() and not bad.all():
            column[bad] = np.interp(n[bad], n[~bad], column[~bad])
    return out


def _spikes(values: Float[np.ndarray, " N"], longest: int) -> Bool[np.ndarray, " N"]:
    """Mark the spikes of one finite column (`outlier_mask`)."""
    # Second differences show the noise in motion and at rest. Their mean is about zero, their variance 6 σ².
    noise = STD_PER_MAD * median(np.abs(np.diff(values, 2))) / np.sqrt(6.0)
    noise = max(noise, resolution(values), _MIN_SPIKE_SHARE * np.ptp(values))
    spikes, least = np.zeros(len(values), bool), _MIN_SPIKE_TO_NOISE * noise
    sound = values
    for _ in range(_MAX_PASSES):  # A spike bends the lines beside it, so its neighbours are judged again without it.
        found = _beyond(sound, least, longest) & ~spikes
        if not found.any():
            break
        spikes |= found
        sound = bridged(values[:, None], spikes[:, None])[:, 0]
    if not spikes.any():
        return spikes
    # A sound sample between two spikes is outside the range of both. Without them it is not, so it is unmarked here.
    x = np.pad(sound, 2, mode="edge")
    k = np.arange(len(values)) + 2
    lines = 2.0 * x[k - 1] - x[k - 2], 2.0 * x[k + 1] - x[k + 2]
    allowed = np.stack([*lines, x[k - 1], x[k], x[k + 1]])
    return spikes & ((values > allowed.max(axis=0) + least) | (values < allowed.min(axis=0) - least))


def _beyond(values: Float[np.ndarray, " N"], least: float, longest: int) -> Bool[np.ndarray, " N"]:
    """Mark samples that lie outside the range of their surroundings by more than `least`."""
    x = np.concatenate([[median(values[:5])] * 2, values, [median(values[-5:])] * 2])
    spikes = np.zeros(len(x), bool)
    bend = np.abs(np.diff(x, 2))
    sharp = bend > least  # A spike bends most about the sample before its first and the one after its last.
    if not sharp.any():
        return spikes[2:-2]
    ends = x[0], x[-1]
    # Near an end one side is missing. A spike there must be further from the end's median than five of the steps beside
    # it, and further than a motion can lead that starts or stops within the last four samples. Such a motion bends at
    # most as sharply as the sharpest bend elsewhere, less five standard deviations of noise. Over four samples a bend
    # adds up to six times itself.
    sets_off = 6.0 * max(bend[6:-6].max(initial=0.0) - 0.6 * np.sqrt(6.0) * least, 0.0)
    reach = [
        5.0 * np.abs(np.diff(part)).max() + sets_off for part in (values[2:_END_SAMPLES], values[-_END_SAMPLES:-2])
    ]
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
