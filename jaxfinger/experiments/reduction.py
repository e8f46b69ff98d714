"""Steps of the reduction of a trial that all kinds of motion share."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.data import (
    FingerDescription,
    Predictions,
    Session,
    Trial,
    bridged,
    joints_of,
    longest_spike,
    outlier_mask,
    smooth,
    smooth_rate,
    without_spikes,
)
from jaxfinger.data.predictions import predicted_at
from jaxfinger.data.signals.motion import quick_cutoff
from jaxfinger.data.signals.quantiles import median, medians, quantiles
from jaxfinger.data.signals.sizes import Sizes
from jaxfinger.effects.drive import NOMINAL_TEMPERATURE
from jaxfinger.experiments.table import Experiment

# An angle that turns back by less has not moved: four standard deviations of the encoder's noise, given in its median
# residuals. Twice as much for single samples, which are not averaged.
JITTER = 6.0


@dataclass(frozen=True)
class PreparedTrial:
    """A trial of N samples whose spikes are bridged, to be reduced to M blocks of `size` samples."""

    experiment: Experiment
    trial: Trial  # with spikes bridged in the angles and tensions
    finger: FingerDescription
    sizes: Sizes
    reduced: bool  # whether blocks are averaged for a fit; otherwise each sample is a block
    reversals: bool  # whether the times of reversals are to be found
    step: float  # s, between samples
    size: int  # samples of a block
    y: dict[str, Float[np.ndarray, "N columns"]]  # channels to be predicted, spikes bridged
    sound: dict[str, Bool[np.ndarray, "N columns"]]  # whether a sample is measured and not a spike

    @cached_property
    def quick_rates(self) -> Float[np.ndarray, "N m"]:
        """Joint speeds, rad/s, in a filter quick enough to resolve a stop between two slips."""
        return smooth_rate(self.trial.time, self.trial.q, quick_cutoff(self.experiment.cutoff_at(self.step), self.step))

    @property
    def motorised(self) -> Bool[np.ndarray, " m"]:
        """Whether an external motor, or a fixture with a torque sensor, is coupled to each joint."""
        coupled = joints_of(self.trial, self.finger) if "joint_torque" in self.experiment.channels else ()
        return np.array([name in coupled for name in self.finger.joint_names])

    def mean(self, a: Float[np.ndarray, "N *k"]) -> Float[np.ndarray, "M *k"]:
        """Means of blocks."""
        # A matrix product is ten times as fast as `mean` along the middle axis.
        M = len(a) // self.size
        blocks = a[: M * self.size].reshape(M, self.size, math.prod(a.shape[1:]))
        return (np.ones(self.size) @ blocks / self.size).reshape(M, *a.shape[1:])

    def blocks_are_sound(self, channel: str) -> Bool[np.ndarray, "M columns"]:
        """Whether most samples of a block are measured and no spikes."""
        return self.mean(self.sound[channel].astype(float)) > 0.5

    def lowest(self, a: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "M k"]:
        """Minima of blocks."""
        M = len(a) // self.size
        return a[: M * self.size].reshape(M, self.size, -1).min(axis=1)

    def whole(self, hold: Int[np.ndarray, " N"]) -> Int[np.ndarray, " M"]:
        """Number of the hold of each block, −1 where the block is not wholly within one."""
        blocks = hold[: len(hold) // self.size * self.size].reshape(-1, self.size)
        return np.where((blocks == blocks[:, :1]).all(axis=1), blocks[:, 0], -1)

    def tension(self) -> Float[np.ndarray, "N n"]:
        """Measured tension, N, zero where it was not measured."""
        force = self.trial.tendon_force
        return np.zeros((len(self.trial.time), self.finger.n)) if force is None else np.nan_to_num(force)

    def taut(self, tension: Float[np.ndarray, "M n"]) -> Float[np.ndarray, "M n"]:
        """Tension, N, set to zero where the protocol leaves a tendon slack: a sensor then reads the error of its tare.

        So it is with all tendons in ID.3, and where joints are held with those that are not pulled. Tendons that move
        the finger pull as measured, however little that is.
        """
        if not self.experiment.held:
            return np.zeros_like(tension) if self.experiment.slack else tension
        return np.where(quantiles(tension, 0.95) < self.sizes.slack, 0.0, tension)


class Reversals(NamedTuple):
    """Samples whose friction would be known if the time of a reversal beside them were; time last, as in `Row`."""

    beside: Bool[np.ndarray, "m *T"]
    # Change of the joints' directions if every reversal came one standard deviation of its time earlier, and later.
    changes: Float[np.ndarray, "2 m *T"]


@dataclass(frozen=True)
class Row:
    """One reduced trial: NumPy arrays with time last, by field of `Motion` or by channel."""

    motion: dict[str, np.ndarray]
    y: dict[str, np.ndarray]
    mask: dict[str, np.ndarray]
    hold: np.ndarray
    dt: float  # s, length of a block
    reversals: Reversals | None


def prepared(
    experiment: Experiment,
    trial: Trial,
    session: Session,
    sizes: Sizes,
    reduced: bool = True,
    minus: Predictions | None = None,
    coarse: int = 1,
    reversals: bool = False,
) -> PreparedTrial:
    """Prepare a trial for its reduction: bridge spikes and find valid samples.

    `minus`, `coarse`, `reversals`: as in `prepare`.
    """
    step = median(np.diff(trial.time))
    size = max(1, round(coarse / (experiment.rate * step))) if reduced else 1
    y, sound = _measured(experiment, trial, session.finger, minus, longest_spike(step))
    return PreparedTrial(experiment, _despiked(trial), session.finger, sizes, reduced, reversals, step, size, y, sound)


def _despiked(trial: Trial) -> Trial:
    tension = None if trial.tendon_force is None else without_spikes(trial.tendon_force)
    return replace(trial, q=without_spikes(trial.q), tendon_force=tension)


def _measured(experiment: Experiment, trial: Trial, finger: FingerDescription, minus: Predictions | None, longest: int):
    """Channels to be predicted, with spikes bridged, and whether each sample is measured and not a spike.

    Where tendons are slack, the torque of no joint counts that the trial does not move: friction at rest has any value.
    """
    N = len(trial.time)
    width = {"tendon_excursion": finger.n, "joint_torque": finger.m, "fingertip_force": 3}
    y, sound = {}, {}
    for c in experiment.channels:
        values = getattr(trial, c)
        if values is None and c == "joint_torque" and experiment.unloaded:
            values = np.zeros((N, finger.m))
        if values is None:
            values = np.full((N, width[c]), np.nan)
        if minus is not None:
            values = values - predicted_at(minus.get(trial.name, {}), c, trial, values.shape)
        measured = np.isfinite(values).all(axis=0)
        if c == "joint_torque" and experiment.slack:
            measured &= np.isin(finger.joint_names, joints_of(trial, finger))
        counts = np.zeros(values.shape, bool)
        if measured.any():
            spikes = outlier_mask(values[:, measured], longest=longest)
            counts[:, measured] = ~spikes
            values = values.copy()
            values[:, measured] = bridged(values[:, measured], spikes)
        y[c], sound[c] = np.nan_to_num(values), counts
    return y, sound


@dataclass(frozen=True)
class Joints:
    """Filtered angles, rad, with derivatives, rad/s and rad/s²."""

    q: Float[np.ndarray, "N m"]
    qd: Float[np.ndarray, "N m"]
    qdd: Float[np.ndarray, "N m"]
    noise: Float[np.ndarray, " m"]  # rad, median magnitude of the filter's residual, the encoder's noise
    cutoff: float  # Hz, of the filter


def joints(r: PreparedTrial, sharp: bool) -> Joints:
    """Filter the angles of a trial.

    `sharp` raises the cut-off. It is for channels that are not low-passed themselves, in which quick motion remains.
    """
    cutoff = r.experiment.cutoff_at(r.step, sharp)
    q, qd, qdd = smooth(r.trial.time, r.trial.q, cutoff)
    return Joints(q, qd, qdd, medians(np.abs(r.trial.q - q)), cutoff)


def row(
    r: PreparedTrial,
    q: Float[np.ndarray, "M m"],
    rates: tuple[Float[np.ndarray, "N m"], Float[np.ndarray, "N m"]],
    tension: Float[np.ndarray, "M n"],
    counting: Mapping[str, Bool[np.ndarray, "M *k"]],
    noise: Float[np.ndarray, " m"],
    directions: tuple[Float[np.ndarray, "N m"], Float[np.ndarray, "N n"]] | None = None,
    hold: Int[np.ndarray, " M"] | None = None,
    blur: float = 0.0,
    y: dict[str, Float[np.ndarray, "N k"]] | None = None,
    reversals: Reversals | None = None,
) -> Row:
    """Assemble a reduced trial of M blocks.

    `q`, rad, `tension`, N, and `hold` are of the blocks, `rates`, rad/s and rad/s², `directions` and `y` of the
    samples, which are averaged here. `counting`: blocks of each channel that are valid where measured. `noise`: rad, of
    the encoder. `blur`: s, width of the low-pass of all arrays. `reversals`: where they
    are looked for.
    """
    y = r.y if y is None else y
    M = len(q)
    time = r.mean(r.trial.time)
    nothing = np.zeros((M, r.finger.m)), np.zeros((M, r.finger.n))
    joint, tendon = nothing if directions is None else map(r.mean, directions)
    start = r.trial.session_start if r.trial.session_start is not None else 0.0
    motion = {
        "time": time,
        "q": q.T,
        "qd": r.mean(rates[0]).T,
        "qdd": r.mean(rates[1]).T,
        "tension": tension.T,
        "joint_direction": joint.T,
        "tendon_direction": tendon.T,
        "session_time": time + start,
        "motorised": np.repeat(r.motorised.astype(float)[:, None], M, axis=1),
        "temperature": _temperatures(r).T,
        "jitter": np.repeat(JITTER * (1.0 if r.reduced else 2.0) * noise[:, None], M, axis=1),
    }
    if r.reduced:
        motion |= {"blur": np.full(M, blur), "block": np.full(M, r.size * r.step)}
    values, mask = {}, {}
    for c in y:
        sound = r.blocks_are_sound(c).T
        mask[c] = (sound & counting[c].T).astype(float)
        values[c] = r.mean(y[c]).T * sound  # mean of all samples, as of the other arrays
    return Row(motion, values, mask, np.full(M, -1) if hold is None else hold, r.size * r.step, reversals)


def _temperatures(r: PreparedTrial) -> Float[np.ndarray, "M m"]:
    """Temperature of each joint, K: from sensors named after it, else from all, else `NOMINAL_TEMPERATURE`."""
    M, trial = len(r.trial.time) // r.size, r.trial
    if trial.temperature is None:
        return np.full((M, r.finger.m), NOMINAL_TEMPERATURE)
    of = [
        [k for k, name in enumerate(trial.temperature_names) if joint in name]
        or list(range(trial.temperature.shape[1]))
        for joint in r.finger.joint_names
    ]
    known = np.where(np.isfinite(trial.temperature), trial.temperature, NOMINAL_TEMPERATURE)
    return np.stack([r.mean(known[:, k]).mean(axis=1) for k in of], axis=1)


def runs_of_holds(hold: Int[np.ndarray, " M"]) -> list[Int[np.ndarray, " k"]]:
    """Indices of the samples of each hold, in order of time."""
    return [np.flatnonzero(hold == k) for k in dict.fromkeys(hold[hold >= 0].tolist())]
