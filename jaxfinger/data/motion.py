"""Directions and holds of a trial: those that the file states, or what the filtered motion says."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.data.filtering import smooth
from jaxfinger.data.session import Trial
from jaxfinger.data.sizes import Sizes

CUTOFF_HZ = 10.0  # faster than any commanded motion of the protocol, slower than most of the sensors' noise
HOLD_CUTOFF_HZ = 5.0
QUICK, NYQUIST = 3.0, 0.4  # times a cut-off, or of the sampling rate, above which a filter passes everything
# A speed's noise is the median of what a slow filter loses of a quicker one's.
SLOWEST = 6.0  # times its noise: a slower joint keeps the direction that it had
BOUNDS = 1e-3, 0.1  # of the motion's speed: at least, beside a filter's tails, and at most, in a slow trial
STILL = 0.1  # of the fastest motion of the trial
SHORTEST_HOLD = 0.2  # s, at the protocol's pace
RAMP = 20  # averages of 1/20 s without a hold: the one in which a held tendon slips is a twentieth, and says little


def joint_directions(trial: Trial) -> Float[np.ndarray, "N m"]:
    """Direction of each joint's motion: the file's channel, or derived from the filtered motion."""
    if trial.joint_direction is not None:
        return trial.joint_direction.astype(float)
    cutoff = fitting_cutoff(trial.time, CUTOFF_HZ)
    step = float(np.median(np.diff(trial.time))) if len(trial.time) > 1 else 1.0
    slow, quick = (smooth(trial.time, trial.q, c)[1] for c in (cutoff, quicker(cutoff, step)))
    return directions(slow, still(slow, quick))


def quicker(cutoff_hz: float, step: float) -> float:
    """Hz, of a filter in which a slip shows that one at `cutoff_hz` spreads; `step`: s between samples."""
    return min(QUICK * cutoff_hz, NYQUIST / step)


def noise_of(slow: Float[np.ndarray, "N k"], quick: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Of a speed: the median of what the slower filter loses of it."""
    return np.median(np.abs(quick - slow), axis=0)


def still(slow: Float[np.ndarray, "N k"], quick: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """The speed below which a joint keeps the direction that it had."""
    pace = np.percentile(np.abs(slow), 95, axis=0)
    return np.clip(SLOWEST * noise_of(slow, quick), *(share * pace for share in BOUNDS))


def directions(rate: Float[np.ndarray, "N k"], still: Float[np.ndarray, " k"]) -> Float[np.ndarray, "N k"]:
    """−1, 0, 1: the sign of each rate where it is more than `still`, and in between the last one.

    Before the first motion the direction is not known, and 0.
    """
    moves = np.abs(rate) > still
    known = np.maximum.accumulate(np.where(moves, np.arange(len(rate))[:, None], -1), axis=0)
    return np.where(known < 0, 0.0, np.sign(np.take_along_axis(rate, np.maximum(known, 0), axis=0)))


def turned_on_time(
    sure: Float[np.ndarray, "N k"], x: Float[np.ndarray, "N k"], way: Float[np.ndarray, " k"]
) -> Float[np.ndarray, "N k"]:
    """Directions that are sure, from the turning points of x on: there the old one gives way to the new.

    It does so over the first `way` back for good, as straight as x goes: what lies at rest against one another gives
    before it slides, and no encoder tells by how much less than its own noise.
    """
    out = sure.copy()
    for direction, column, least in zip(out.T, x.T, way, strict=True):
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

    Only stepped experiments hold: ID.3-static (the joint is still), ID.4 and VD.2 (the tension is): slower than a tenth
    of the fastest motion in the trial, for at least 0.2 s. The first and last 1/cutoff of a still stretch, blurred by
    the filter, are left out. `pace`: of the session (`data.sizes`), as so many times longer all of it is counted.
    """
    if trial.hold is not None:
        return trial.hold
    hold = np.full(len(trial.time), -1, np.int32)
    x = _stepped_column(trial)
    if x is None or len(x) < 3:
        return hold
    cutoff = fitting_cutoff(trial.time, HOLD_CUTOFF_HZ / pace)
    rate = np.abs(smooth(trial.time, x, cutoff)[1])
    still = rate < STILL * np.nanpercentile(rate, 99) if np.isfinite(rate).any() else np.zeros(len(x), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    index = 0
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        begin = trial.time[first] + (1.0 / cutoff if first > 0 else 0.0)
        end = trial.time[stop - 1] - (1.0 / cutoff if stop < len(x) else 0.0)
        if end - begin >= SHORTEST_HOLD * pace:
            hold[(trial.time >= begin) & (trial.time <= end)] = index
            index += 1
    return hold


def _stepped_column(trial: Trial) -> Float[np.ndarray, " N"] | None:
    """The column whose stillness makes a hold: the one that travels most."""
    x = {"ID.3-static": trial.q, "ID.4": trial.tendon_force, "VD.2": trial.tendon_force}.get(trial.experiment)
    if x is None or x.shape[1] == 0:
        return None
    return x[:, int(np.argmax(np.nan_to_num(np.ptp(x, axis=0), nan=-1.0)))]


def fitting_cutoff(time: Float[np.ndarray, " N"], cutoff_hz: float) -> float:
    """The cut-off, lowered to a quarter of the sampling rate where a recording is too slow for it."""
    if len(time) < 3:
        return cutoff_hz
    return min(cutoff_hz, 0.25 / float(np.median(np.diff(time))))


def slow_ramps(
    tension: Float[np.ndarray, "M n"], hold: Int[np.ndarray, " M"], least: int, travel: float
) -> Bool[np.ndarray, " M"]:
    """Stretches of at least so many samples without a hold, in which no tendon needs less for its way.

    `travel`: N, below which a tendon has not moved.
    """
    out, every = np.zeros(len(hold), bool), max(1, least // RAMP)
    for begin, end in stretches_of(hold < 0):
        way = np.ptp(tension[begin:end], axis=0)
        fastest = np.abs(np.diff(tension[begin:end:every], axis=0)).max(axis=0, initial=0.0)
        slow = (fastest <= 1.2 * every / least * way + 0.1 * travel)[way > travel]
        out[begin:end] = end - begin >= least and slow.size > 0 and slow.all()
    return out


def stretches_of(inside: Bool[np.ndarray, " M"]) -> list[tuple[int, int]]:
    """First sample of every stretch, and the first after it."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


def pulled_slowly(trial: Trial, pulled: Float[np.ndarray, " N"], sizes: Sizes) -> bool:
    """Whether a held joint's tendon is pulled in holds, or in ramps so slow that its friction can be told; of what is
    not measured, or too short, nothing is said. `sizes`: of the session.
    """
    if len(pulled) < 3 or not np.isfinite(pulled).all():
        return True
    hold, step = find_holds(trial, sizes.slow_pace), float(np.median(np.diff(trial.time)))
    if (hold >= 0).any():
        return True
    size = max(1, round(sizes.slow_pace / (RAMP * step)))
    means = pulled[: len(pulled) // size * size].reshape(-1, size).mean(axis=1)[:, None]
    least = max(1, round(sizes.slow_pace / (size * step)))
    return bool(slow_ramps(means, np.full(len(means), -1), least, sizes.travel).any())
