"""The steps that all kinds of motion share on the way from a recording to arrays that a model reads."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

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
    without_spikes,
)
from jaxfinger.data.motion import quick_cutoff
from jaxfinger.data.sizes import Sizes
from jaxfinger.effects.drive import NOMINAL_TEMPERATURE
from jaxfinger.experiments.table import Experiment

AT_REST = 6.0  # times the median loss: an angle that turns back by less has not moved; twice that for single samples


@dataclass(frozen=True)
class PreparedTrial:
    """A trial, its spikes bridged, and how it is to be reduced."""

    spec: Experiment
    trial: Trial  # spikes bridged in what drives the model
    finger: FingerDescription
    sizes: Sizes
    reduced: bool  # averaged for a fit; else for a prediction of every sample
    step: float  # s
    size: int  # samples of a block
    y: dict[str, Float[np.ndarray, "N columns"]]  # what is to be predicted, spikes bridged
    sound: dict[str, Bool[np.ndarray, "N columns"]]  # measured, and no spike

    @cached_property
    def quick_rates(self) -> Float[np.ndarray, "N m"]:
        """rad/s, in a filter that still sees a joint stand still between two slips."""
        return smooth(self.trial.time, self.trial.q, quick_cutoff(self.spec.cutoff_at(self.step), self.step))[1]

    @property
    def motorised(self) -> Bool[np.ndarray, " m"]:
        """Which joints an external motor or a fixture with a torque sensor is coupled to."""
        coupled = joints_of(self.trial, self.finger) if "joint_torque" in self.spec.channels else ()
        return np.array([name in coupled for name in self.finger.joint_names])

    def mean(self, a: Float[np.ndarray, "N *k"]) -> Float[np.ndarray, "M *k"]:
        """Block means."""
        # A product is ten times as fast as `mean` along an axis in the middle.
        M = len(a) // self.size
        blocks = a[: M * self.size].reshape(M, self.size, math.prod(a.shape[1:]))
        return (np.ones(self.size) @ blocks / self.size).reshape(M, *a.shape[1:])

    def lowest(self, a: Float[np.ndarray, "N k"]) -> Float[np.ndarray, "M k"]:
        """Least value of every block."""
        M = len(a) // self.size
        return a[: M * self.size].reshape(M, self.size, -1).min(axis=1)

    def whole(self, hold: Int[np.ndarray, " N"]) -> Int[np.ndarray, " M"]:
        """Hold of every block, −1 where it is not wholly within one."""
        blocks = hold[: len(hold) // self.size * self.size].reshape(-1, self.size)
        return np.where((blocks == blocks[:, :1]).all(axis=1), blocks[:, 0], -1)

    def tension(self) -> Float[np.ndarray, "N n"]:
        """Measured tension, zero where there is none."""
        force = self.trial.tendon_force
        return np.zeros((len(self.trial.time), self.finger.n)) if force is None else np.nan_to_num(force)

    def taut(self, tension: Float[np.ndarray, "M n"]) -> Float[np.ndarray, "M n"]:
        """Tension without that of tendons that are slack all the time."""
        slack = np.percentile(tension, 95, axis=0) < self.sizes.slack
        return np.where(slack | self.spec.slack, 0.0, tension)


@dataclass(frozen=True)
class Row:
    """One trial, reduced: NumPy arrays with time last."""

    motion: dict[str, np.ndarray]
    y: dict[str, np.ndarray]
    mask: dict[str, np.ndarray]
    hold: np.ndarray
    dt: float  # s


def prepared(
    spec: Experiment,
    trial: Trial,
    session: Session,
    sizes: Sizes,
    reduced: bool = True,
    minus: Predictions | None = None,
    coarse: int = 1,
) -> PreparedTrial:
    """A trial made ready: the channels that drive the model without spikes; those that it predicts keep theirs, which
    do not count.
    """
    step = float(np.median(np.diff(trial.time)))
    size = max(1, round(coarse / (spec.rate * step))) if reduced else 1
    y, sound = _measured(spec, trial, session.finger, minus, longest_spike(step))
    return PreparedTrial(spec, _despiked(trial), session.finger, sizes, reduced, step, size, y, sound)


def _despiked(trial: Trial) -> Trial:
    tension = None if trial.tendon_force is None else without_spikes(trial.tendon_force)
    return replace(trial, q=without_spikes(trial.q), tendon_force=tension)


def _measured(spec: Experiment, trial: Trial, finger: FingerDescription, minus: Predictions | None, longest: int):
    """The channels to be predicted, spikes bridged, and which samples of them are measured and no spike."""
    N = len(trial.time)
    width = {"tendon_excursion": finger.n, "joint_torque": finger.m, "fingertip_force": 3}
    y, sound = {}, {}
    for c in spec.channels:
        values = getattr(trial, c)
        if values is None and c == "joint_torque" and spec.kind == "driven":
            values = np.zeros((N, finger.m))  # nothing acts from outside on the free finger
        if values is None:
            values = np.full((N, width[c]), np.nan)
        if minus is not None:
            values = values - _predicted(minus.get(trial.name, {}), c, trial, values)
        measured = np.isfinite(values).all(axis=0)
        counts = np.zeros(values.shape, bool)
        if measured.any():
            spikes = outlier_mask(values[:, measured], longest=longest)
            counts[:, measured] = ~spikes
            values = values.copy()
            values[:, measured] = bridged(values[:, measured], spikes)
        y[c], sound[c] = np.nan_to_num(values), counts
    return y, sound


def _predicted(prediction: Mapping[str, np.ndarray], channel: str, trial: Trial, like: np.ndarray) -> np.ndarray:
    """A predicted channel at the trial's times, NaN where there is none."""
    if channel not in prediction:
        return np.full(like.shape, np.nan)
    columns = prediction[channel].T
    return np.stack([np.interp(trial.time, prediction.get("time", trial.time), a) for a in columns], axis=1)


@dataclass(frozen=True)
class Joints:
    """Angles and their derivatives in the filter of a prediction, and what that filter took off: (N, m)."""

    q: Float[np.ndarray, "N m"]
    qd: Float[np.ndarray, "N m"]
    qdd: Float[np.ndarray, "N m"]
    noise: Float[np.ndarray, " m"]  # rad, the median of what it took off: the encoder's noise
    cutoff: float  # Hz


def joints(r: PreparedTrial, sharp: bool) -> Joints:
    """Filtered angles; `sharp` where the measured channel beside them is not low-passed, so that q̇ and q̈ must not lose
    what is in it.
    """
    cutoff = r.spec.cutoff_at(r.step, sharp)
    q, qd, qdd = smooth(r.trial.time, r.trial.q, cutoff)
    return Joints(q, qd, qdd, np.median(np.abs(r.trial.q - q), axis=0), cutoff)


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
) -> Row:
    """Put together what a kind of motion has found: block means, and which of them count.

    `q`, `tension`, `hold`: of the blocks; `counting`: which blocks of a channel count where it is measured; `blur`: s,
    the width of the low-pass that all of it went through.
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
        "jitter": np.repeat(AT_REST * (1.0 if r.reduced else 2.0) * noise[:, None], M, axis=1),
    }
    if r.reduced:
        motion["blur"] = np.full(M, blur)
    values, mask = {}, {}
    for c in y:
        counts = (r.mean(r.sound[c].astype(float)) > 0.5) & counting[c]
        mask[c] = counts.astype(float).T
        values[c] = r.mean(y[c]).T * mask[c]  # of all samples, as everything else that the model reads
    return Row(motion, values, mask, np.full(M, -1) if hold is None else hold, r.size * r.step)


def _temperatures(r: PreparedTrial) -> Float[np.ndarray, "M m"]:
    """K, of each joint: of the channels named after it, else of all; `NOMINAL_TEMPERATURE` where none was measured."""
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


def stretches(hold: Int[np.ndarray, " M"]) -> list[Int[np.ndarray, " k"]]:
    """The samples of each hold, hold by hold in the order of time."""
    return [np.flatnonzero(hold == k) for k in dict.fromkeys(hold[hold >= 0].tolist())]
