"""Read a rig file. Every mistake is refused with its line; nothing is connected."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from jaxfinger.data.finger_file import Finger, finger_from
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.toml import Document, Fault, OneOf, Place, Within, one_of, parse_toml, read_toml, structure
from jaxfinger.rig import backends, contract
from jaxfinger.rig.channels import ANALOG_KINDS, UNITS, Deadlines, Limits, LoosestLimits, RigChannel, RigDescription

# s, default of `frozen_s` for analog channels: a thousand equal values at 1 kHz. Sensor noise prevents them unless the
# converter's step is much larger than the noise; give a longer `frozen_s` there.
FROZEN_S = 1.0
# s, the longest deadline that a rig file may set. The finger may be under tension until it is over, and within 5 s a
# person at the bench has reached for the switch.
MAX_DEADLINE_S = 5.0
# deg, the smallest `joint_margin_deg` but 0. In rad the same number is 29°, more than any joint has to spare, so
# what is less is a margin in rad.
MIN_MARGIN_DEG = 0.5
# deg/s², default of `joint_acceleration_deg_s2`: twice what a plan's trials have by default (protocols.py).
ACCELERATION_DEG_S2 = 1200.0


@dataclass(frozen=True)
class RigTable:
    """Keys of `[rig]`. `Deadlines` says what each time limits."""

    name: str
    backend: str
    specimen: str
    rate_hz: Annotated[float, Within(1.0, 20000.0, "Hz")] = 1000.0
    poll_s: Annotated[float, Within(0.001, 1.0, "s")] = 0.05  # pause between two reads of the ring
    allow_filtered: bool = False  # dynamic experiments behind a slow filter
    # stale_s, lag_s and thread_s: four to five times poll_s, and about the 0.25 s after which the controller itself
    # would release the finger for want of a heartbeat.
    stale_s: Annotated[float, Within(0.01, MAX_DEADLINE_S, "s")] = 0.2
    lag_s: Annotated[float, Within(0.01, MAX_DEADLINE_S, "s")] = 0.25
    thread_s: Annotated[float, Within(0.05, MAX_DEADLINE_S, "s")] = 0.2
    disk_s: Annotated[float, Within(0.1, MAX_DEADLINE_S, "s")] = 1.0  # fdatasync took up to 0.29 s on a busy disk
    # A fixture is fitted in a minute or two. Below 10 s nobody can have read and done what a prompt says; after half an
    # hour without an answer nobody is at the rig.
    prompt_s: Annotated[float, Within(10.0, 1800.0, "s")] = 300.0
    clock_offset_s: Annotated[float, Within(0.001, MAX_DEADLINE_S, "s")] = 0.1  # twice poll_s
    # Twice the 5e-4 of quartz and network time. Times and velocities of a session may be wrong by as much: 1 % at most.
    clock_rate: Annotated[float, Within(1e-6, 0.01)] = 1e-3


@dataclass(frozen=True)
class ChannelTable:
    """Keys of `[[channel]]`: the value in `unit` is raw · scale + offset."""

    kind: Annotated[str, OneOf(tuple(UNITS))]
    slot: Annotated[int, Within(0, contract.VALUES - 1)]
    unit: str
    scale: float
    of: str = ""
    name: str = ""
    offset: float = 0.0
    source: str = ""
    frozen_s: Annotated[float, Within(0.0, MAX_DEADLINE_S, "s")] | None = None

    def __post_init__(self):
        if self.unit not in UNITS[self.kind]:
            known = ", ".join(UNITS[self.kind])
            raise Fault(f"is {self.unit!r}, no unit for {self.kind} ({self.title!r}); choose one of {known}", "unit")
        if self.scale == 0:
            raise Fault(f"of {self.title!r} is zero; give {self.unit} per raw unit", "scale")

    @property
    def title(self) -> str:
        """Name of the channel; its kind and owner where the file gives none."""
        return self.name or f"{self.kind} {self.of}".strip()


# Limits on measured values, which the host and the controller both have.
Tension = Annotated[float, Within(0.1, 100.0, "N")]
TensionRate = Annotated[float, Within(1.0, 1e5, "N/s")]
JointVelocity = Annotated[float, Within(1.0, 5000.0, "deg/s")]
JointTorque = Annotated[float, Within(1e-3, 10.0, "N m")]
FingertipForce = Annotated[float, Within(0.1, 100.0, "N")]


@dataclass(frozen=True)
class LimitsTable:
    """Keys of `[limits]`. Those that may be None watch a kind of channel that a rig may lack."""

    tension_max: Tension
    tension_rate: Annotated[float, Within(0.1, 1000.0, "N/s")]
    tension_rate_max: TensionRate
    joint_margin_deg: Annotated[float, Within(0.0, 45.0, "deg")]
    joint_velocity_deg_s: Annotated[float, Within(1.0, 2000.0, "deg/s")]
    joint_velocity_max_deg_s: JointVelocity
    joint_torque_max: JointTorque
    fingertip_force_max: FingertipForce
    # At most the highest `joint_velocity_deg_s` within 0.1 s, in which the host reads samples twice (`poll_s`).
    joint_acceleration_deg_s2: Annotated[float, Within(1.0, 20000.0, "deg/s2")] = ACCELERATION_DEG_S2
    tension_error_max: Annotated[float, Within(0.1, 100.0, "N")] | None = None
    tension_error_s: Annotated[float, Within(0.01, MAX_DEADLINE_S, "s")] | None = None
    temperature_max: Annotated[float, Within(30.0, 200.0, "degC")] | None = None

    def __post_init__(self):
        if self.tension_rate > self.tension_rate_max:
            raise Fault("of set-points is above `tension_rate_max`, so every ramp would trip", "tension_rate")
        if 0.0 < self.joint_margin_deg < MIN_MARGIN_DEG:
            said = f"is {self.joint_margin_deg:g}°, so it seems to be radians"
            mend = f"give it in degrees ({np.degrees(self.joint_margin_deg):.2g}), or 0 for none"
            raise Fault(f"{said}; {mend}", "joint_margin_deg")
        if self.joint_velocity_deg_s > self.joint_velocity_max_deg_s:
            raise Fault("is above `joint_velocity_max_deg_s`, so every move would trip", "joint_velocity_deg_s")


# Kinds of channel that a rig may lack, and the limits that watch them. A limit is demanded with its channel and refused
# without it, since it would watch nothing.
_OPTIONAL_LIMITS = {
    "tension_setpoint": ("tension_error_max", "tension_error_s"),
    "motor_temperature": ("temperature_max",),
}


@dataclass(frozen=True)
class ControllerTable:
    """Keys of `[controller]`: the loosest limits that the controller may have (None: twice the host's)."""

    tension_max: Tension | None = None
    tension_rate_max: TensionRate | None = None
    joint_velocity_max_deg_s: JointVelocity | None = None
    joint_torque_max: JointTorque | None = None
    fingertip_force_max: FingertipForce | None = None
    heartbeat_s: Annotated[float, Within(0.02, MAX_DEADLINE_S, "s")] = 0.25


@dataclass(frozen=True)
class FingertipSensor:
    """Keys of `[fingertip_sensor]`: its rotation to the base frame, row by row."""

    rotation: tuple[float, float, float, float, float, float, float, float, float]

    def __post_init__(self):
        if not np.allclose(self.matrix @ self.matrix.T, np.eye(3), atol=1e-3) or np.linalg.det(self.matrix) < 0:
            raise Fault("must be a rotation matrix (9 numbers, row by row, sensor to base frame)", "rotation")

    @property
    def matrix(self) -> np.ndarray:
        """Rotation (3, 3)."""
        return np.array(self.rotation).reshape(3, 3)


@dataclass(frozen=True)
class RigFile:
    """Tables of a rig file. The keys of `[address]` depend on the backend."""

    rig: RigTable
    limits: LimitsTable
    finger: str | Finger
    channel: tuple[ChannelTable, ...]
    address: Mapping[str, Any] = field(default_factory=dict)
    controller: ControllerTable = field(default_factory=ControllerTable)
    fingertip_sensor: FingertipSensor | None = None


def read_rig(path: str | Path) -> RigDescription:
    """Read and check a rig file. Nothing is connected.

    Raises:
        UserError: the file cannot be read, or a key is wrong. The sentence gives the line.
    """
    return _rig(read_toml(path, "give the path of a rig file"))


def parse_rig(text: str, path: str | Path = "rig.toml") -> RigDescription:
    """Read a rig file from text, which sessions and logs carry, as `read_rig` does. `path` names it in messages."""
    return _rig(parse_toml(text, path))


def _rig(document: Document) -> RigDescription:
    file, place = document.read(RigFile), document.place
    head = file.rig
    try:
        one_of(head.backend, backends.NAMES)
    except Fault as fault:
        (place / "rig" / "backend").fail(fault.message)
    backend = import_module(f"jaxfinger.rig.backends.{head.backend}")
    finger = finger_from(file.finger, place / "finger")
    channels = _channels(file.channel, finger, place)
    axes = sum(c.kind == "fingertip_force" for c in channels)
    if file.fingertip_sensor is not None and axes != 3:
        (place / "fingertip_sensor" / "rotation").fail(f"needs forces along x, y and z; the rig has {axes} of them")
    limits = _limits(file.limits, finger, {c.kind for c in channels}, place / "limits")
    return RigDescription(
        name=head.name,
        backend=head.backend,
        specimen=head.specimen,
        finger=finger,
        channels=channels,
        limits=limits,
        loosest_limits=_loosest_limits(file.controller, limits),
        deadlines=Deadlines(
            stale_s=head.stale_s,
            lag_s=head.lag_s,
            thread_s=head.thread_s,
            disk_s=head.disk_s,
            prompt_s=head.prompt_s,
            clock_offset_s=head.clock_offset_s,
            clock_rate=head.clock_rate,
        ),
        rate_hz=head.rate_hz,
        poll_s=head.poll_s,
        address=asdict(structure(file.address, backend.Address, place / "address")),
        sensor_rotation=np.eye(3) if file.fingertip_sensor is None else file.fingertip_sensor.matrix,
        allow_filtered=head.allow_filtered,
        text=document.text,
        path=str(document.path),
    )


def _channels(tables: tuple[ChannelTable, ...], finger: FingerDescription, place: Place) -> tuple[RigChannel, ...]:
    """Check slots and owners of the channels, and that every joint and every active tendon has one."""
    owners = {
        "tension": finger.tendon_names,
        "excursion": finger.tendon_names,
        "joint_position": finger.joint_names,
        "external_torque": ("",),
        "fingertip_force": ("x", "y", "z"),
        "tension_setpoint": tuple(np.array(finger.tendon_names)[finger.active]),
        "motor_temperature": (*finger.tendon_names, "external"),
    }
    channels: list[RigChannel] = []
    for i, table in enumerate(tables):
        here = place / "channel" / i
        if table.of not in owners[table.kind]:
            has = ", ".join(owners[table.kind])
            (here / "of").fail(f"a channel of kind '{table.kind}' cannot be of '{table.of}'; the finger has {has}")
        for other in channels:
            if other.slot == table.slot:
                (here / "slot").fail(f"slot {table.slot} already holds '{other.name}'; give each channel its own slot")
            if (other.kind, other.of) == (table.kind, table.of):
                (here / "of").fail(f"'{other.name}' already measures the {table.kind} of '{table.of}'; remove one")
        default = FROZEN_S if table.kind in ANALOG_KINDS else 0.0
        channels.append(
            RigChannel(
                name=table.title,
                kind=table.kind,
                of=table.of,
                slot=table.slot,
                unit=table.unit,
                scale=table.scale,
                offset=table.offset,
                source=table.source,
                frozen=default if table.frozen_s is None else table.frozen_s,
            )
        )
    present = {(c.kind, c.of) for c in channels}
    for what, kind, names in (
        ("joint", "joint_position", finger.joint_names),
        ("tendon", "tension", tuple(np.array(finger.tendon_names)[finger.active])),
    ):
        for name in names:
            if (kind, name) not in present:
                place.fail(f'{what} \'{name}\' has no channel; add a [[channel]] of kind "{kind}" with of = "{name}"')
    if finger.n > contract.TARGETS:
        place.fail(f"{finger.n} tendons, but the controller has {contract.TARGETS} actuation modules")
    return tuple(channels)


def _limits(table: LimitsTable, finger: FingerDescription, kinds: set[str], place: Place) -> Limits:
    """Convert `[limits]` to SI. A limit on a kind of channel that the rig lacks becomes infinite."""
    for kind, keys in _OPTIONAL_LIMITS.items():
        for key in keys:
            given = getattr(table, key) is not None
            if given and kind not in kinds:
                (place / key).fail(f'watches nothing without a [[channel]] of kind "{kind}"; add one, or remove it')
            if not given and kind in kinds:
                (place / key).fail(f"is missing; add a line '{key} = …'")
    margin = float(np.radians(table.joint_margin_deg))
    if np.any(finger.limits[:, 1] - finger.limits[:, 0] <= 2 * margin):
        (place / "joint_margin_deg").fail("leaves no range between the joint limits")
    return Limits(
        tension_max=table.tension_max,
        tension_rate=table.tension_rate,
        tension_rate_max=table.tension_rate_max,
        joint_margin=margin,
        joint_velocity=float(np.radians(table.joint_velocity_deg_s)),
        joint_acceleration=float(np.radians(table.joint_acceleration_deg_s2)),
        joint_velocity_max=float(np.radians(table.joint_velocity_max_deg_s)),
        joint_torque_max=table.joint_torque_max,
        fingertip_force_max=table.fingertip_force_max,
        tension_error_max=np.inf if table.tension_error_max is None else table.tension_error_max,
        tension_error_s=np.inf if table.tension_error_s is None else table.tension_error_s,
        temperature_max=np.inf if table.temperature_max is None else table.temperature_max,
    )


def _loosest_limits(table: ControllerTable, limits: Limits) -> LoosestLimits:
    """Convert `[controller]` to SI, with twice the host's limits as defaults."""

    def or_twice(value: float | None, host: float) -> float:
        return 2 * host if value is None else value

    velocity = table.joint_velocity_max_deg_s
    return LoosestLimits(
        tension_max=or_twice(table.tension_max, limits.tension_max),
        tension_rate_max=or_twice(table.tension_rate_max, limits.tension_rate_max),
        joint_velocity_max=or_twice(
            None if velocity is None else float(np.radians(velocity)), limits.joint_velocity_max
        ),
        joint_torque_max=or_twice(table.joint_torque_max, limits.joint_torque_max),
        fingertip_force_max=or_twice(table.fingertip_force_max, limits.fingertip_force_max),
        heartbeat_s=table.heartbeat_s,
    )
