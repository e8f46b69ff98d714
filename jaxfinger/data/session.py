"""A session in memory: the finger as ID.1 gives it and the trials, NumPy arrays in SI units laid out as in the file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.errors import chosen
from jaxfinger.table import Table

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

# Share of the longest travel among the joints, each over its range: a joint that travels less is held. A fixture yields
# a little, and a joint that is moved goes through much of its range.
_MIN_TRAVEL_SHARE = 0.1
EXPERIMENT_NAMES = ("ID.2", "ID.3-static", "ID.3-dynamic", "ID.4", "VD.1", "VD.2", "VD.3")


@dataclass(frozen=True)
class FingerDescription:
    """`/finger`: m joints from base to tip, n tendons; frames as in the format (x to the tip, z dorsal).

    Lengths are in m, masses in kg, inertias in kg m² about the centre of mass, gravity in m/s² in the base frame.
    `crosses[k, i]` is true where tendon k spans joint i. `mass_std` and `com_std` are None where they are unknown.

    `rotor_inertia` (kg m²) is the inertia of a geared rotor, reflected to the joint. It enters the equation of that
    joint and of no link. `excursion` holds the known excursions from CAD or a model: tendon k pulls in
    Σ_p c[k, i, p-1] q_i^p at joint i, c in m/rad^p for p = 1, 2, …. A tendon whose excursion is unknown is NaN
    throughout; None means that no excursion is known.
    """

    gravity: Float[np.ndarray, "3"]
    joint_names: tuple[str, ...]
    axis: Float[np.ndarray, "m 3"]
    origin: Float[np.ndarray, "m 3"]
    limits: Float[np.ndarray, "m 2"]
    mass: Float[np.ndarray, " m"]
    com: Float[np.ndarray, "m 3"]
    inertia: Float[np.ndarray, "m 3 3"]
    fingertip: Float[np.ndarray, "3"]
    tendon_names: tuple[str, ...]
    active: Bool[np.ndarray, " n"]
    crosses: Bool[np.ndarray, "n m"]
    prismatic: tuple[bool, ...] = ()
    mass_std: Float[np.ndarray, " m"] | None = None
    com_std: Float[np.ndarray, "m 3"] | None = None
    rotor_inertia: Float[np.ndarray, " m"] | None = None
    rotor_inertia_std: Float[np.ndarray, " m"] | None = None
    excursion: Float[np.ndarray, "n m k"] | None = None
    excursion_std: Float[np.ndarray, "n m k"] | None = None

    def __post_init__(self):
        if not self.prismatic:
            object.__setattr__(self, "prismatic", (False,) * len(self.joint_names))

    @property
    def m(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def n(self) -> int:
        """Number of tendons, passive ones included."""
        return len(self.tendon_names)

    @property
    def length(self) -> float:
        """Length, m, of the way from the first joint over all others to the fingertip."""
        return float(np.linalg.norm([*self.origin[1:], self.fingertip], axis=1).sum())

    def joint(self, name: str | None) -> int | None:
        """Index of the joint of this name; None where there is none."""
        return self.joint_names.index(name) if name in self.joint_names else None

    def tendon(self, name: str | None) -> int | None:
        """Index of the tendon of this name; None where there is none."""
        return self.tendon_names.index(name) if name in self.tendon_names else None


@dataclass(frozen=True, repr=False)
class Trial:
    """`/trials/<name>`: one recording of N samples, m joints and n tendons, in SI units.

    A channel that the trial did not measure is None; a column that it did not measure is NaN. `joint` is the joint that
    is moved or instrumented, None where there is none or several. `temperature` is in K, one column for each of
    `temperature_names`.
    """

    name: str
    experiment: str
    time: Float[np.ndarray, " N"]
    q: Float[np.ndarray, "N m"]
    tendon_force: Float[np.ndarray, "N n"] | None = None
    tendon_excursion: Float[np.ndarray, "N n"] | None = None
    joint_torque: Float[np.ndarray, "N m"] | None = None
    fingertip_force: Float[np.ndarray, "N 3"] | None = None
    joint_direction: Int[np.ndarray, "N m"] | None = None
    tendon_direction: Int[np.ndarray, "N n"] | None = None
    hold: Int[np.ndarray, " N"] | None = None
    joint: str | None = None
    tendon: str | None = None
    complete: bool = True
    motion: str | None = None
    session_start: float | None = None
    temperature: Float[np.ndarray, "N c"] | None = None
    temperature_names: tuple[str, ...] = ()

    def motorised(self, finger: FingerDescription) -> tuple[str, ...]:
        """Joints whose external torque is measured: the one that the trial names, else all with a torque column."""
        if self.joint is not None:
            return (self.joint,)
        if self.joint_torque is None:
            return ()
        torque = self.joint_torque
        return tuple(name for i, name in enumerate(finger.joint_names) if not np.isnan(torque[:, i]).all())

    def __repr__(self) -> str:
        where = ", ".join(x for x in (self.experiment, self.joint, self.tendon) if x)
        return f"Trial({self.name!r}: {where}; {len(self.time)} samples, {self.duration:.3g} s)"

    def place(self, channel: str = "") -> str:
        """Path of the trial, or of one of its channels, inside the session's file."""
        return f"/trials/{self.name}/{channel}".rstrip("/")

    @property
    def duration(self) -> float:
        """Length of the recording in s."""
        return float(self.time[-1] - self.time[0]) if len(self.time) else 0.0


@dataclass(frozen=True, repr=False)
class Session:
    """One specimen, its finger, and its trials by name (in the order of the session).

    >>> import jaxfinger as jf
    >>> session = jf.read("session.h5")
    >>> session["01-ID3-dynamic-axis"]
    Trial('01-ID3-dynamic-axis': ID.3-dynamic, axis; 24841 samples, 24.8 s)
    >>> session.finger.joint_names
    ('axis',)
    """

    specimen: str
    finger: FingerDescription
    trials: Mapping[str, Trial] = field(default_factory=dict)
    source: str = "jaxfinger"
    created: str = ""
    file: str = ""  # Path that it was read from; empty for a session made in memory.

    def __iter__(self) -> Iterator[Trial]:
        return iter(self.trials.values())

    def __len__(self) -> int:
        return len(self.trials)

    def __getitem__(self, name: str) -> Trial:
        if name not in self.trials:
            raise KeyError(f"no trial {name!r}; there are {', '.join(self.trials) or 'none'}")
        return self.trials[name]

    def table(self) -> Table:
        """Table with one row a trial: name, experiment, joint, tendon, samples, duration in s."""
        return Table(
            {
                "trial": t.name,
                "experiment": t.experiment,
                "joint": t.joint,
                "tendon": t.tendon,
                "samples": len(t.time),
                "duration": t.duration,
            }
            for t in self
        )

    def __repr__(self) -> str:
        counts = Counter(t.experiment for t in self)
        trials = ", ".join(f"{k} {e}" for e, k in counts.items()) or "no trials"
        m, n = self.finger.m, self.finger.n
        return f"Session({self.specimen!r}: {m} joint{'s' * (m != 1)}, {n} tendon{'s' * (n != 1)}; {trials})"

    def _repr_html_(self) -> str:
        return f"<p>{escape(repr(self))}</p>{self.table()._repr_html_()}"

    def select(
        self, *experiments: str, joint: str | None = None, tendon: str | None = None, complete: bool | None = None
    ) -> Session:
        """Session with only the trials of these experiments, this joint, this tendon and this completeness.

        A criterion that is not given selects all.

        Raises:
            UserError: there is no such experiment, joint or tendon.
        """
        chosen(experiments, EXPERIMENT_NAMES, "experiment")
        chosen(() if joint is None else joint, self.finger.joint_names, "joint")
        chosen(() if tendon is None else tendon, self.finger.tendon_names, "tendon")
        keep = {
            t.name: t
            for t in self
            if (not experiments or t.experiment in experiments)
            and (joint is None or t.joint == joint)
            and (tendon is None or t.tendon == tendon)
            and (complete is None or t.complete == complete)
        }
        return replace(self, trials=keep)

    def with_trials(self, names: str | Iterable[str]) -> Session:
        """Session with only the named trials, one or more, in this order.

        Raises:
            UserError: there is no such trial.
        """
        return replace(self, trials={name: self.trials[name] for name in chosen(names, self.trials, "trial")})


def joints_of(trial: Trial, finger: FingerDescription) -> tuple[str, ...]:
    """Joints that a trial of ID.2, ID.3 or ID.4 moves or instruments; empty for VD.1, VD.2 and VD.3.

    A trial of ID.2 or ID.3 that names no joint moves those that travel (`moving_joints`), in ID.3 of those whose torque
    is measured.
    """
    if not trial.experiment.startswith("ID."):
        return ()
    instrumented = trial.motorised(finger)
    if trial.joint is not None or trial.experiment == "ID.4" or not len(trial.time):
        return instrumented
    moving = moving_joints(trial, finger)
    return moving if trial.experiment == "ID.2" else tuple(name for name in moving if name in instrumented)


def moving_joints(trial: Trial, finger: FingerDescription) -> tuple[str, ...]:
    """Joints whose travel, as a share of their range, is more than a tenth of the largest among the joints."""
    span = np.ptp(np.nan_to_num(trial.q), axis=0) / np.maximum(np.ptp(finger.limits, axis=1), 1e-300)
    return tuple(name for name, s in zip(finger.joint_names, span, strict=True) if s > _MIN_TRAVEL_SHARE * span.max())
