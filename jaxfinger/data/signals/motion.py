"""Directions and holds of a trial: the file's channels where it has them, else derived from the filtered motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.session import FingerDescription, Trial
from jaxfinger.data.signals.filtering import smooth_rate
from jaxfinger.data.signals.quantiles import median, medians, quantiles
from jaxfinger.data.signals.sizes import Sizes

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

STILL_ANGLE = 0.01  # rad: five times the noise of a 14-bit encoder
STILL_DISTANCE = 1e-4  # m, likewise of a prismatic joint: a hundredth of a rad at a radius of 10 mm
MIN_MOTION = 0.1  # rad: fixtures that hold a joint yield by less.
CUTOFF_HZ = 10.0  # Faster than any commanded motion of the protocol, slower than most of the sensors' noise.
HOLD_CUTOFF_HZ = 5.0  # Stillness needs no fast filter, and at half the cut-off the speed has a third of the noise.
QUICK_CUTOFF_RATIO = 3.0  # A slip that one filter spreads shows in a filter three times as fast.
MAX_CUTOFF_SHARE = 0.4  # of the sampling rate; `smooth` needs a cut-off below half of it.
REST_SPEED_NOISE = 6.0  # times the noise of the speed: a slower joint may be at rest.
# The rest speed's bounds, as shares of the motion's speed. The lower one exceeds a filter's tails in a recording
# without noise, the upper one keeps a slow and noisy motion from being taken for rest.
REST_SPEED_SHARES = 1e-3, 0.1
STILL_SHARE = 0.1  # of the fastest motion of the trial: a stepped column that is slower is held.
MIN_HOLD = 0.2  # s, at the protocol's pace: one length of the filter, 1/HOLD_CUTOFF_HZ, beside the blurred ends.
# Of an interval, by which rounding may move a stamp: 1e-7 s, the last digit of many logs, at 10 kHz. A sample at the
# edge of a hold is in it all the same.
ROUNDING = 1e-3
# A ramp is at least this many blocks of 1/20 s long. Only the block in which a held tendon slips is uncertain, and in a
# ramp that is a twentieth.
RAMP_BLOCKS = 20


def still_spans(finger: FingerDescription) -> Float[np.ndarray, " m"]:
    """Travel of each joint, rad or m, below which it stands still."""
    return np.where(finger.prismatic, STILL_DISTANCE, STILL_ANGLE)


def joint_directions(trial: Trial) -> Float[np.ndarray, "N m"]:
    """Direction of each joint's motion, −1, 0 or 1: the file's channel, or derived from the filtered motion."""
    if trial.joint_direction is not None:
        return trial.joint_direction.astype(float)
    cutoff = fitting_cutoff(trial.time, CUTOFF_HZ)
    step = median(np.diff(trial.time)) if len(trial.time) > 1 else 1.0
    slow, quick = (smooth_rate(trial.time, trial.q, c) for c in (cutoff, quick_cutoff(cutoff, step)))
    return directions(slow, rest_speed(slow, quick))


def quick_cutoff(cutoff_hz: float, step: float) -> float:
    """Cut-off, Hz, of a filter that shows the slips which one at `cutoff_hz` spreads. `step`: s between samples."""
    return min(QUICK_CUTOFF_RATIO * cutoff_hz, MAX_CUTOFF_SHARE / step)


def speed_noise(slow: Float[np.ndarray, "N k"], quick: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Noise of a speed: the median of its absolute change between a slower and a quicker filter."""
    return medians(np.abs(quick - slow))


def rest_speed(slow: Float[np.ndarray, "N k"], quick: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Speed below which a joint may be at rest, so that its direction is the last known one.

    `slow` and `quick` are its speed in two filters (`quick_cutoff`).
    """
    pace = quantiles(np.abs(slow), 0.95)
    return np.clip(REST_SPEED_NOISE * speed_noise(slow, quick), *(share * pace for share in REST_SPEED_SHARES))


def directions(rate: Float[np.ndarray, "N k"], threshold: Float[np.ndarray, " k"]) -> Float[np.ndarray, "N k"]:
    """Sign of each rate, −1 or 1, where it exceeds its threshold; below it the last known sign.

    Before the first motion the direction is unknown and 0.
    """
    moves = np.abs(rate) > threshold
    known = np.maximum.accumulate(np.where(moves, np.arange(len(rate))[:, None], -1), axis=0)
    return np.where(known < 0, 0.0, np.sign(np.take_along_axis(rate, np.maximum(known, 0), axis=0)))


def from_the_start(direction: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "N k"]:
    """Directions with the first known one also before it, for a filter: unknown friction is not absent friction.

    With zeros there, a filter would show friction growing in the first known samples. In a joint that turns one way
    only, nothing else tells friction from elasticity, and a fit would tell them by that.
    """
    first = np.argmax(direction != 0.0, axis=0)
    return np.where(np.arange(len(direction))[:, None] < first, direction[first, np.arange(len(first))], direction)


def directions_from_turning_points(
    sure: Float[np.ndarray, "N k"], x: Float[np.ndarray, "N k"], distance: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "N k"]:
    """Move each change of direction back to the turning point of x before it.

    `sure` are directions that change only once a motion is faster than its noise, so they change late. From the turning
    point on, the direction goes linearly in x from the old to the new over `distance`: bodies in contact deform
    before they slide, by a distance that an encoder does not show within its noise. Only travel that is not undone
    before the next change counts.
    """
    out = sure.copy()
    for direction, column, least in zip(out.T, x.T, distance, strict=True):
        turns = np.flatnonzero((np.diff(direction) != 0) & (direction[:-1] != 0)) + 1
        edges = [0, *turns, len(direction)]
        for last, turn, end in zip(edges, edges[1:], edges[2:], strict=False):
            new = direction[turn]
            began = last + int(np.argmin(new * column[last : turn + 1]))
            stroke = new * (column[began : turn + int(np.argmax(new * column[turn:end])) + 1] - column[began])
            back = np.minimum.accumulate(stroke[::-1])[::-1]
            share = np.clip(back / least, 0.0, 1.0) if least > 0.0 else back > 0.0
            direction[began : began + len(share)] = new * (2.0 * share - 1.0)
    return out


def find_holds(trial: Trial, pace: float = 1.0) -> Int[np.ndarray, " N"]:
    """Index of the static hold of each sample, −1 between holds: the file's channel, or derived from stillness.

    Only stepped experiments have holds. In ID.3-static the joint is held, in ID.4 and VD.2 the tension. A hold is a
    stretch of at least 0.2 s, slower than a tenth of the fastest motion in the trial. Its first and last 1/cutoff
    are left out because the filter blurs them. `pace` is the session's (`signals.sizes`) and multiplies both durations.
    """
    if trial.hold is not None:
        return trial.hold
    hold = np.full(len(trial.time), -1, np.int32)
    x = _stepped_column(trial)
    if x is None or len(x) < 3:
        return hold
    cutoff = fitting_cutoff(trial.time, HOLD_CUTOFF_HZ / pace)
    rate = np.abs(smooth_rate(trial.time, x, cutoff))
    still = rate < STILL_SHARE * np.nanpercentile(rate, 99) if np.isfinite(rate).any() else np.zeros(len(x), bool)
    index, rounding = 0, ROUNDING * median(np.diff(trial.time))
    for first, stop in stretches_of(still):
        begin = trial.time[first] + (1.0 / cutoff if first > 0 else 0.0) - rounding
        end = trial.time[stop - 1] - (1.0 / cutoff if stop < len(x) else 0.0) + rounding
        if end - begin >= MIN_HOLD * pace:
            hold[(trial.time >= begin) & (trial.time <= end)] = index
            index += 1
    return hold


def _stepped_column(trial: Trial) -> Float[np.ndarray, " N"] | None:
    """The column that defines the holds: of the stepped channel the one that travels most."""
    x = {"ID.3-static": trial.q, "ID.4": trial.tendon_force, "VD.2": trial.tendon_force}.get(trial.experiment)
    if x is None or x.shape[1] == 0:
        return None
    return x[:, int(np.argmax(np.nan_to_num(np.ptp(x, axis=0), nan=-1.0)))]


def fitting_cutoff(time: Float[np.ndarray, " N"], cutoff_hz: float) -> float:
    """Cut-off, Hz, lowered to a quarter of the sampling rate where the recording is too slow for it."""
    if len(time) < 3:
        return cutoff_hz
    return min(cutoff_hz, 0.25 / median(np.diff(time)))


def slow_ramps(
    tension: Float[np.ndarray, "M n"], hold: Int[np.ndarray, " M"], least: int, travel: float
) -> Bool[np.ndarray, " M"]:
    """Mark the samples of slow ramps: no hold, and every tendon takes at least `least` samples for its change.

    A tendon whose tension changes by no more than `travel`, N, is not counted as pulled.
    """
    out, every = np.zeros(len(hold), bool), max(1, least // RAMP_BLOCKS)
    for begin, end in stretches_of(hold < 0):
        way = np.ptp(tension[begin:end], axis=0)
        fastest = np.abs(np.diff(tension[begin:end:every], axis=0)).max(axis=0, initial=0.0)
        # An even ramp changes by every/least of its way. A fifth more, and a tenth of `travel`, are left to noise.
        slow = (fastest <= 1.2 * every / least * way + 0.1 * travel)[way > travel]
        out[begin:end] = end - begin >= least and slow.size > 0 and slow.all()
    return out


def stretches_of(inside: Bool[np.ndarray, " M"]) -> list[tuple[int, int]]:
    """First sample of every stretch where `inside` is true, and the first sample after it."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def pulled_slowly(trial: Trial, pulled: Float[np.ndarray, " N"], sizes: Sizes) -> bool:
    """Whether a tendon is pulled in several holds or in slow ramps, so that its friction can be identified.

    One hold alone is the rest before steps that are too quick. True as well for a tension that is not measured or too
    short to tell. `sizes` are those of the session.
    """
    if len(pulled) < 3 or not np.isfinite(pulled).all():
        return True
    hold, step = find_holds(trial, sizes.slow_pace), median(np.diff(trial.time))
    if hold.max() >= (1 if trial.hold is None else 0):
        return True
    size = max(1, round(sizes.slow_pace / (RAMP_BLOCKS * step)))
    means = pulled[: len(pulled) // size * size].reshape(-1, size).mean(axis=1)[:, None]
    least = max(1, round(sizes.slow_pace / (size * step)))
    return bool(slow_ramps(means, np.full(len(means), -1), least, sizes.travel).any())
