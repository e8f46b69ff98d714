"""The dataset format, version 1.1 (docs/dataset-format.md), as tables that the reader, writer and checker share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from jaxfinger.data.session import FingerDescription, Trial

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

FORMAT = "jaxfinger-dataset"
VERSION = "1.1"
MAJOR = "1"

Kind = Literal["float", "bool", "text", "int8", "int32"]


@dataclass(frozen=True)
class Entry:
    """One dataset: its name, its shape (N samples, m joints, n tendons), its units, and whether it may be absent.

    The letters k (powers of an excursion) and c (temperatures) stand for axes of any length.
    """

    name: str
    shape: tuple[str | int, ...]
    units: str | None
    kind: Kind = "float"
    optional: bool = False


@dataclass(frozen=True)
class Channel(Entry):
    """A dataset of a trial, with its columns and the unit in which people read it.

    `people` holds that unit for revolute joints, after the factor from SI to it. `free_zero` is true where each trial
    sets the channel's zero anew, so that values are compared after removing one constant a trial.
    """

    people: tuple[float, str] = (1.0, "")
    free_zero: bool = False

    def columns(self, finger: FingerDescription) -> tuple[str, ...]:
        """Names of the channel's columns: joints, tendons, or the axes of a force."""
        return {"m": finger.joint_names, "n": finger.tendon_names}.get(str(self.shape[1]), AXES)


AXES = ("x", "y", "z")
JOINTS = (
    Entry("name", ("m",), None, "text"),
    Entry("axis", ("m", 3), "1"),
    Entry("type", ("m",), None, "text", optional=True),
    Entry("origin", ("m", 3), "m"),
    Entry("limits", ("m", 2), "rad"),
    Entry("rotor_inertia", ("m",), "kg m2", optional=True),
    Entry("rotor_inertia_std", ("m",), "kg m2", optional=True),
)
LINKS = (
    Entry("mass", ("m",), "kg"),
    Entry("com", ("m", 3), "m"),
    Entry("inertia", ("m", 3, 3), "kg m2"),
    Entry("mass_std", ("m",), "kg", optional=True),
    Entry("com_std", ("m", 3), "m", optional=True),
)
TENDONS = (
    Entry("name", ("n",), None, "text"),
    Entry("active", ("n",), None, "bool"),
    Entry("crosses", ("n", "m"), None, "bool"),
    Entry("excursion", ("n", "m", "k"), "m/rad^p", optional=True),
    Entry("excursion_std", ("n", "m", "k"), "m/rad^p", optional=True),
)
FINGERTIP = Entry("fingertip", (3,), "m")

TIME = Entry("time", ("N",), "s")
TEMPERATURE = Entry("temperature", ("N", "c"), "K", optional=True)
CHANNELS = {
    channel.name: channel
    for channel in (
        Channel("q", ("N", "m"), "rad", people=(180.0 / math.pi, "degrees")),
        Channel("tendon_force", ("N", "n"), "N", optional=True, people=(1.0, "N")),
        Channel("tendon_excursion", ("N", "n"), "m", optional=True, people=(1e3, "mm"), free_zero=True),
        Channel("joint_torque", ("N", "m"), "N m", optional=True, people=(1e3, "N mm")),
        Channel("fingertip_force", ("N", 3), "N", optional=True, people=(1.0, "N")),
        Channel("joint_direction", ("N", "m"), "1", "int8", optional=True),
        Channel("tendon_direction", ("N", "n"), "1", "int8", optional=True),
        Channel("hold", ("N",), "1", "int32", optional=True),
    )
}
MEASURED = tuple(name for name, entry in CHANNELS.items() if entry.kind == "float")

# Experiments whose trials must name a joint or a tendon, and the channels that each experiment drives and measures.
NEEDS_JOINT = ("ID.2", "ID.3-static", "ID.3-dynamic", "ID.4")
NEEDS_TENDON = ("ID.4", "VD.2")
DRIVES = {"ID.4": ("tendon_force",), "VD.2": ("tendon_force",), "VD.3": ("tendon_force",)}
MEASURES = {
    "ID.2": ("tendon_excursion",),
    "ID.3-static": ("joint_torque",),
    "ID.3-dynamic": ("joint_torque",),
    "ID.4": ("joint_torque",),
    "VD.1": ("tendon_excursion",),
    "VD.2": ("fingertip_force",),
    "VD.3": (),
}


def measured_columns(
    trial: Trial, finger: FingerDescription, channels: Iterable[str] = MEASURED
) -> Iterator[tuple[str, str, Float[np.ndarray, " N"]]]:
    """Columns of the channels that a trial holds: channel, name of the joint, tendon or axis, and values."""
    for channel in channels:
        values = getattr(trial, channel)
        if values is not None:
            for name, x in zip(CHANNELS[channel].columns(finger), values.T, strict=True):
                yield channel, name, x


# Units of a finger with prismatic joints only: lengths and forces take the place of angles and torques.
_SLIDING = {
    "rad": "m", "rad/s": "m/s", "1/rad": "1/m", "N m": "N", "N m/s": "N/s", "N m/rad": "N/m", "N m s/rad": "N s/m",
    "s/rad": "s/m", "N m/rad^2": "N/m^2", "kg m2": "kg",
    "m/rad": "1", "m/rad^2": "1/m", "m/rad^3": "1/m^2", "m/rad^p": "m/m^p",
}  # fmt: skip


def units_where(units: str, prismatic: Sequence[bool]) -> str:
    """The units, translated where every joint is prismatic: lengths and forces replace angles and torques."""
    return _SLIDING.get(units, units) if prismatic and all(prismatic) else units


def channel_units(channel: str, prismatic: Sequence[bool], column: int | None = None) -> str:
    """Units of a trial's channel, translated where every joint is prismatic, or the joint of the one `column`."""
    if column is not None and CHANNELS[channel].shape[1] == "m":
        prismatic = prismatic[column : column + 1]
    return units_where(CHANNELS[channel].units or "1", prismatic)


def entry_units(entry: Entry, prismatic: Sequence[bool]) -> str | None:
    """Units of a dataset, translated where every joint is prismatic; None for a dataset without units."""
    return None if entry.units is None else units_where(entry.units, prismatic)
