"""Contents of a rig file: slot, calibration and unit of each channel, limits, deadlines, the finger on the bench."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NoReturn

import numpy as np
from jaxtyping import Float

from jaxfinger.data.session import FingerDescription
from jaxfinger.data.toml import parse_toml

# Kinds of channel, and for each the units in which its calibration may be written, as factors to SI. The first is SI.
UNITS: Mapping[str, Mapping[str, float]] = {
    "tension": {"N": 1.0},
    "excursion": {"m": 1.0, "mm": 1e-3},
    "joint_position": {"rad": 1.0, "deg": np.pi / 180},
    "external_torque": {"N m": 1.0, "N mm": 1e-3},
    "fingertip_force": {"N": 1.0},
    "tension_setpoint": {"N": 1.0},
    "motor_temperature": {"degC": 1.0},
}
SAFETY_KINDS = ("tension_setpoint", "motor_temperature")  # watched, but no part of a session; a rig may lack them
SI_UNITS = {kind: next(iter(units)) for kind, units in UNITS.items()}
# Factor from SI, and name, of the units in which rig files give limits, where these are not SI.
_PEOPLE = {"rad": (180 / np.pi, "°"), "rad/s": (180 / np.pi, " °/s"), "m": (1e3, " mm"), "m/s": (1e3, " mm/s")}
# Kinds behind an analog input. Its noise changes every value, so a value that repeats for long is a fault.
ANALOG_KINDS = ("tension", "external_torque", "fingertip_force")
# Hz, −3 dB. Channels with less are refused for dynamic experiments. A first-order filter of 100 Hz delays a signal by
# 1.6 ms, in which a joint at 1.5 rad/s (ID.3-dynamic) turns by 0.14°. The factory filter of an EL3008 has 22 Hz.
MIN_DYNAMIC_BANDWIDTH = 100.0


def for_people(value: float, unit: str) -> str:
    """A value in an SI unit as people read it, in the unit of the rig file's limits."""
    factor, name = _PEOPLE.get(unit, (1.0, f" {unit}"))
    return f"{value * factor:.4g}{name}".rstrip()


@dataclass(frozen=True)
class Filter:
    """Filter of a terminal: whether it is on, setting (CoE 0x8000:15), −3 dB bandwidth in Hz (None: unknown)."""

    enabled: bool
    setting: int
    bandwidth: float | None


@dataclass(frozen=True)
class RigChannel:
    """One channel: value in SI = (raw · scale + offset) · factor.

    `of` is the tendon, joint or axis that it measures. A value that repeats for `frozen` s is a fault (0: never).
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
        """Factor from the calibration's unit to SI."""
        return UNITS[self.kind][self.unit]


@dataclass(frozen=True)
class Limits:
    """The host's limits. Connecting is refused where one is looser than the controller's own.

    `tension_rate`, `joint_margin`, `joint_velocity` and `joint_acceleration` bound commands: one beyond them is
    refused. The others bound measured values: one beyond them stops the rig.
    """

    tension_max: float  # N, of commands and measured values
    tension_rate: float  # N/s, of commands
    tension_rate_max: float  # N/s, measured
    joint_margin: float  # rad that commanded angles keep from the joint's mechanical limits
    joint_velocity: float  # rad/s, of commands
    joint_acceleration: float  # rad/s², of commands
    joint_velocity_max: float  # rad/s, measured
    joint_torque_max: float  # N m, of the external motor
    fingertip_force_max: float  # N, each axis
    tension_error_max: float  # N between set-point and tension; infinite on a rig whose set-points are no channel
    tension_error_s: float  # s that the tension may differ by more
    temperature_max: float  # °C, of the motors; infinite on a rig that does not measure it


@dataclass(frozen=True)
class LoosestLimits:
    """The loosest limits that the controller itself may have (SI). Connecting is refused where its own are looser.

    The controller is the backstop of the host: with limits far beyond the host's it would not be one. `heartbeat_s` is
    how long it may hold tension without a heartbeat of the host, s.
    """

    tension_max: float
    tension_rate_max: float
    joint_velocity_max: float
    joint_torque_max: float
    fingertip_force_max: float
    heartbeat_s: float


@dataclass(frozen=True)
class Deadlines:
    """Times after which the host stops the rig, in s; `clock_rate` is a ratio."""

    stale_s: float  # without a new sample of the controller
    lag_s: float  # from a sample to its supervision
    thread_s: float  # without a sign of life of a watched thread of the host
    disk_s: float  # for the disk to take a frame of the log
    prompt_s: float  # for the operator to answer a prompt while the drives are on
    clock_offset_s: float  # between the device's clock and its samples, and between samples and the host's clock
    clock_rate: float  # relative error of these clocks that is followed without counting as an offset


@dataclass(frozen=True)
class RigDescription:
    """A rig file, read. `text` is the file itself; every session keeps it."""

    name: str
    backend: str
    specimen: str
    finger: FingerDescription
    channels: tuple[RigChannel, ...]
    limits: Limits
    loosest_limits: LoosestLimits
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

    @cached_property
    def hindsight_s(self) -> float:
        """Longest time in s that a fault of a measured value needs to show: so far back it spoils samples."""
        tracking = self.limits.tension_error_s
        return max([c.frozen for c in self.channels] + [tracking if np.isfinite(tracking) else 0.0])

    @cached_property
    def slots(self) -> list[int]:
        """Slot of each channel in the controller's sample."""
        return [c.slot for c in self.channels]

    @cached_property
    def _gain(self) -> Float[np.ndarray, " C"]:
        return np.array([c.scale * c.factor for c in self.channels])

    @cached_property
    def _bias(self) -> Float[np.ndarray, " C"]:
        return np.array([c.offset * c.factor for c in self.channels])

    @cached_property
    def _force(self) -> list[int]:
        """Columns of the fingertip's force along x, y and z, as far as the rig measures it."""
        return self.columns("fingertip_force", "xyz")

    def calibrate(self, raw: Float[np.ndarray, "N V"]) -> Float[np.ndarray, "N C"]:
        """Convert raw values of the controller's samples to SI, the fingertip's force in the base frame."""
        x = raw[:, self.slots] * self._gain + self._bias
        if len(self._force) == 3:
            x[:, self._force] = x[:, self._force] @ self.sensor_rotation.T
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
