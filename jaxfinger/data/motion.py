"""Directions and holds of a trial: those that the file states, or what the filtered motion says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.data.filtering import block_mean, blocks, low_pass, smooth
from jaxfinger.data.schema import MEASURED
from jaxfinger.data.session import Trial

CUTOFF_HZ = 10.0  # faster than any commanded motion of the protocol, slower than most of the sensors' noise
HOLD_CUTOFF_HZ = 5.0
JOINT_TRAVEL = 0.004  # rad: ten steps of a 14-bit encoder
TENDON_TRAVEL = 1e-4  # m: that travel and more on a moment arm of 7 mm, several times the noise
TENSION_TRAVEL = 0.3  # N: ten times the noise of a tension sensor, a third of the protocol's smallest step
STILL = 0.1  # of the fastest motion of the trial
SHORTEST_HOLD = 0.2  # s
_HELD = ("ID.4", "VD.2")  # experiments in which a fixture holds the joints


def directions(
    time: Float[np.ndarray, " N"], x: Float[np.ndarray, "N k"], cutoff_hz: float, threshold: float
) -> Int[np.ndarray, "N k"]:
    """−1, 0, +1: which way each column of the filtered x travels.

    A reversal counts once x has come back by more than `threshold` (units of x); less is noise, and a stop keeps the
    last direction. Travel and not speed decides, because a slow sweep is no faster than a still sensor's noise.
    Before the first motion, and in columns that are NaN, the direction is 0.
    """
    filtered = low_pass(time, x, cutoff_hz)
    return np.stack([_zigzag(column, threshold) for column in filtered.T], axis=1)


def _zigzag(x: Float[np.ndarray, " N"], threshold: float) -> Int[np.ndarray, " N"]:
    sign = np.zeros(len(x), np.int8)
    good = np.flatnonzero(np.isfinite(x))
    if len(good) < 2:
        return sign
    sign[good] = _zigzag_finite(x[good], threshold)
    return sign


def _zigzag_finite(x: Float[np.ndarray, " N"], threshold: float) -> Int[np.ndarray, " N"]:
    slope = np.sign(np.diff(x))
    turns = np.flatnonzero(slope[1:] != slope[:-1]) + 1  # only the extrema can start a new direction
    sign = np.zeros(len(x), np.int8)
    direction, low, high, begin = 0, 0, 0, 0
    for i in (*turns.tolist(), len(x) - 1):
        low, high = (i if x[i] < x[low] else low), (i if x[i] > x[high] else high)
        rises, falls = x[i] - x[low] > threshold, x[high] - x[i] > threshold
        if (rises and direction <= 0) or (falls and direction >= 0):
            turned, now = (low, 1) if rises and direction <= 0 else (high, -1)
            # Through a stop the last direction holds: the new one begins where x leaves the turning point for good.
            near = np.abs(x[turned : i + 1] - x[turned]) <= 0.5 * threshold
            start = turned + int(np.flatnonzero(near)[-1])
            sign[begin:start] = direction
            direction, begin, low, high = now, start, i, i
    sign[begin:] = direction
    return sign


def joint_directions(
    trial: Trial, cutoff_hz: float = CUTOFF_HZ, threshold: float = JOINT_TRAVEL
) -> Int[np.ndarray, "N m"]:
    """Direction of each joint's motion: the file's channel, or derived (`threshold` in the units of q).

    Where a fixture holds the joints (ID.4, VD.2) it is 0.
    """
    if trial.joint_direction is not None:
        return trial.joint_direction
    if trial.experiment in _HELD:
        return np.zeros(trial.q.shape, np.int8)
    return directions(trial.time, trial.q, fitting_cutoff(trial.time, cutoff_hz), threshold)


def tendon_directions(
    trial: Trial, cutoff_hz: float = CUTOFF_HZ, threshold: float | None = None
) -> Int[np.ndarray, "N n"] | None:
    """Direction of each tendon's motion: the file's channel, or derived; None where nothing was measured.

    It is read off the excursion (`threshold` in m). Where the joints are held the excursion hardly moves, and the
    tension tells which way the motor went (`threshold` in N).
    """
    if trial.tendon_direction is not None:
        return trial.tendon_direction
    held = trial.experiment in _HELD
    x = trial.tendon_force if held else trial.tendon_excursion
    if x is None:
        return None
    if threshold is None:
        threshold = TENSION_TRAVEL if held else TENDON_TRAVEL
    return directions(trial.time, x, fitting_cutoff(trial.time, cutoff_hz), threshold)


def find_holds(trial: Trial, cutoff_hz: float = HOLD_CUTOFF_HZ) -> Int[np.ndarray, " N"]:
    """Index of the static hold of each sample, −1 between holds: the file's channel, or derived from stillness.

    Only stepped experiments hold: ID.3-static (the joint is still), ID.4 and VD.2 (the tension is): slower than a tenth
    of the fastest motion in the trial, for at least 0.2 s. The first and last 1/cutoff of a still stretch, blurred by
    the filter, are left out.
    """
    if trial.hold is not None:
        return trial.hold
    hold = np.full(len(trial.time), -1, np.int32)
    x = _stepped_column(trial)
    if x is None or len(x) < 3:
        return hold
    cutoff = fitting_cutoff(trial.time, cutoff_hz)
    rate = np.abs(smooth(trial.time, x, cutoff)[1])
    still = rate < STILL * np.nanpercentile(rate, 99) if np.isfinite(rate).any() else np.zeros(len(x), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    index = 0
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        begin = trial.time[first] + (1.0 / cutoff if first > 0 else 0.0)
        end = trial.time[stop - 1] - (1.0 / cutoff if stop < len(x) else 0.0)
        if end - begin >= SHORTEST_HOLD:
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


def decimate_trial(trial: Trial, rate_hz: float) -> Trial:
    """The trial in block means at about `rate_hz`. No block mixes two holds; directions are its first sample's."""
    starts = blocks(trial.time, rate_hz, trial.hold)
    channels = {name: getattr(trial, name) for name in (*MEASURED, "temperature")}
    means = {name: block_mean(x, starts) for name, x in channels.items() if x is not None}
    labels = {name: getattr(trial, name) for name in ("joint_direction", "tendon_direction", "hold")}
    firsts = {name: x[starts] for name, x in labels.items() if x is not None}
    return replace(trial, time=block_mean(trial.time, starts), **means, **firsts)
