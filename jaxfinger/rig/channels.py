"""What a rig file says: the slot, calibration and unit of each channel, the limits, and the finger on the bench."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from jaxtyping import Float

from jaxfinger.data.session import FingerDescription
from jaxfinger.data.toml import parse_toml

# Dimension of each kind of channel, and the units in which a calibration may be written, as factors to SI.
UNITS: Mapping[str, Mapping[str, float]] = {
    "tension": {"N": 1.0},
    "excursion": {"m": 1.0, "mm": 1e-3},
    "joint_position": {"rad": 1.0, "deg": np.pi / 180},
    "external_torque": {"N m": 1.0, "N mm": 1e-3},
    "fingertip_force": {"N": 1.0},
    "tension_setpoint": {"N": 1.0},
    "motor_temperature": {"degC": 1.0},
}
WATCHED = (
    "tension_setpoint",
    "motor_temperature",
)  # for safety alone: a rig may have them, a session does not need them
SI = {kind: next(iter(units)) for kind, units in UNITS.items()}
NOISY = ("tension", "external_torque", "fingertip_force")  # analog: a value that repeats for long is a fault
DYNAMIC_BANDWIDTH = 100.0  # Hz: below it, a channel is refused for dynamic experiments


@dataclass(frozen=True)
class Filter:
    """The filter that a terminal runs: switched on or not, its setting, its −3 dB bandwidth in Hz (None: unknown)."""

    enabled: bool
    setting: int
    bandwidth: float | None


@dataclass(frozen=True)
class RigChannel:
    """value in SI = (raw · scale + offset) · factor; `of` is the tendon, joint or axis that it measures.

    `frozen` is the time in s after which identical raw values count as a fault (0: never).
    """

    name: str
    kind: str
    of: str
    slot: int
    unit: str
    scale: float
    offset: float
    source: str
    frozen: float

    @property
    def factor(self) -> float:
        """From the calibration's unit to SI."""
        return UNITS[self.kind][self.unit]


@dataclass(frozen=True)
class Limits:
    """Limits that the host watches (SI), never looser than the controller's own.

    `joint_margin` is the distance in rad that a joint keeps from its mechanical limits.
    """

    tension_max: float
    tension_rate: float  # of set-points
    tension_rate_max: float  # measured
    joint_margin: float
    joint_velocity: float  # of set-points
    joint_velocity_max: float  # measured
    joint_torque_max: float
    fingertip_force_max: float
    tension_error_max: float  # set-point minus measured; infinite on a rig whose set-points are no channel
    tension_error_s: float  # that it may last
    temperature_max: float  # of motors, °C; infinite on a rig that does not measure it


@dataclass(frozen=True)
class HardLimits:
    """The loosest limits that the controller itself may have (SI): a backstop far beyond the host's own is none.

    `heartbeat_s` is how long it may hold tension without a sign of life from the host.
    """

    tension_max: float
    tension_rate_max: float
    joint_velocity_max: float
    joint_torque_max: float
    fingertip_force_max: float
    heartbeat_s: float


@dataclass(frozen=True)
class Deadlines:
    """How long, in s, anything may take before tension is let go; `clock_rate` is a ratio.

    stale: no new sample · lag: a sample's way to the supervisor · thread: a thread of the host without a sign of life ·
    disk: a frame's way to the disk · clock_offset, clock_rate: the controller's clock against samples and host.
    """

    stale_s: float
    lag_s: float
    thread_s: float
    disk_s: float
    clock_offset_s: float
    clock_rate: float


@dataclass(frozen=True)
class RigDescription:
    """A rig file, read: `text` is the file itself, which goes into every session."""

    name: str
    backend: str
    specimen: str
    finger: FingerDescription
    channels: tuple[RigChannel, ...]
    limits: Limits
    hard: HardLimits
    deadlines: Deadlines
    rate_hz: float
    poll_s: float
    address: Mapping[str, str | int]
    sensor_rotation: Float[np.ndarray, "3 3"]
    allow_filtered: bool
    text: str
    path: str = ""

    def fail(self, table: str, key: str, message: str) -> NoReturn:
        """Raise UserError at the line of a key of the rig file."""
        (parse_toml(self.text, self.path).place / table / key).fail(message)

    @property
    def slots(self) -> list[int]:
        """Slot of each channel in the controller's sample."""
        return [c.slot for c in self.channels]

    def calibrate(self, raw: Float[np.ndarray, "N V"]) -> Float[np.ndarray, "N C"]:
        """Raw values of the controller's sample to SI; the fingertip's force turned into the base frame."""
        gain = np.array([c.scale * c.factor for c in self.channels])
        bias = np.array([c.offset * c.factor for c in self.channels])
        x = raw[:, self.slots] * gain + bias
        force = self.columns("fingertip_force", "xyz")
        if len(force) == 3:
            x[:, force] = x[:, force] @ self.sensor_rotation.T
        return x

    def index(self, kind: str, of: str = "") -> int | None:
        """Column of the channel of this kind and tendon, joint or axis; None where the rig has none."""
        for i, channel in enumerate(self.channels):
            if channel.kind == kind and channel.of == of:
                return i
        return None

    def columns(self, kind: str, of: Iterable[str]) -> list[int]:
        """Columns of a kind for several tendons or joints, without those that the rig does not measure."""
        return [column for name in of if (column := self.index(kind, name)) is not None]
