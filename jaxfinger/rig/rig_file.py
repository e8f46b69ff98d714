"""The rig file, read: every mistake is refused with its line, and nothing is connected."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import numpy as np

from jaxfinger.data.session import FingerDescription
from jaxfinger.rig import backends, contract
from jaxfinger.rig.channels import NOISY, UNITS, Channel, Deadlines, HardLimits, Limits, RigDescription
from jaxfinger.rig.finger_file import read_finger
from jaxfinger.rig.toml_file import Table, parse_toml, read_toml


def read_rig(path: str | Path) -> RigDescription:
    """Read and check a rig file; raises UserError with the line to mend. Nothing is connected."""
    return _rig(read_toml(path))


def parse_rig(text: str, path: str | Path = "rig.toml") -> RigDescription:
    """A rig file that is already in memory, as a session or a log carries it."""
    return _rig(parse_toml(text, Path(path)))


def _rig(file: Table) -> RigDescription:
    head = file.table("rig")
    assert head is not None
    backend = head.text_of("backend", choices=backends.NAMES)
    if (where := file.table("address", required=False)) is None:
        where = Table(file.path, file.text, {}, "address")
    address = import_module(f"jaxfinger.rig.backends.{backend}").address(where)
    where.finish()
    finger = read_finger(file)
    channels = _channels(file, finger)
    rotation = np.eye(3)
    if sensor := file.table("fingertip_sensor", required=False):
        rotation = np.array(sensor.vector("rotation", length=9)).reshape(3, 3)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            sensor.fail(
                "rotation", "'rotation' must be a rotation matrix (9 numbers, row by row, sensor to base frame)."
            )
        sensor.finish()
    limits = _limits(file, finger, {c.kind for c in channels})
    description = RigDescription(
        name=head.text_of("name"),
        backend=backend,
        specimen=head.text_of("specimen"),
        finger=finger,
        channels=channels,
        limits=limits,
        hard=_hard_limits(file, limits),
        deadlines=Deadlines(
            stale_s=head.number("stale_s", 0.2, 0.01, 60.0, "s"),
            lag_s=head.number("lag_s", 0.25, 0.01, 60.0, "s"),
            thread_s=head.number("thread_s", 0.2, 0.05, 60.0, "s"),
            disk_s=head.number("disk_s", 1.0, 0.1, 60.0, "s"),  # fdatasync took up to 0.29 s on a busy disk
            clock_offset_s=head.number("clock_offset_s", 0.1, 0.001, 60.0, "s"),
            clock_rate=head.number("clock_rate", 1e-3, 1e-6, 0.1),  # quartz and network time are good to 5e-4
        ),
        rate_hz=head.number("rate_hz", 1000.0, 1.0, 20000.0, "Hz"),
        poll_s=head.number("poll_s", 0.05, 0.001, 1.0, "s"),
        address=address,
        sensor_rotation=rotation,
        allow_filtered=head.flag("allow_filtered", False),
        text=file.text,
        path=str(file.path),
    )
    head.finish()
    file.finish()
    return description


def _channels(file: Table, finger: FingerDescription) -> tuple[Channel, ...]:
    owners = {
        "tension": finger.tendon_names,
        "excursion": finger.tendon_names,
        "joint_position": finger.joint_names,
        "external_torque": ("",),
        "fingertip_force": ("x", "y", "z"),
        "tension_setpoint": tuple(np.array(finger.tendon_names)[finger.active]),
        "motor_temperature": (*finger.tendon_names, "external"),
    }
    channels: list[Channel] = []
    for table in file.tables("channel"):
        kind = table.text_of("kind", choices=tuple(UNITS))
        of = table.text_of("of", "" if kind == "external_torque" else ..., choices=None)
        if of not in owners[kind]:
            table.fail(
                "of", f"a channel of kind '{kind}' cannot be of '{of}'; the finger has {', '.join(owners[kind])}."
            )
        name = table.text_of("name", f"{kind} {of}".strip())
        unit = table.text_of("unit")
        if unit not in UNITS[kind]:
            table.fail("unit", f"'{unit}' is no unit for {kind} ('{name}'); choose one of {', '.join(UNITS[kind])}.")
        channel = Channel(
            name=name,
            kind=kind,
            of=of,
            slot=table.integer("slot", high=contract.VALUES - 1),
            unit=unit,
            scale=table.number("scale"),
            offset=table.number("offset", 0.0),
            source=table.text_of("source", ""),
            frozen=table.number("frozen_s", 1.0 if kind in NOISY else 0.0, 0.0, 60.0, "s"),
        )
        if channel.scale == 0:
            table.fail("scale", f"'scale' of '{name}' is zero; give {unit} per raw unit.")
        for other in channels:
            if other.slot == channel.slot:
                table.fail(
                    "slot", f"slot {channel.slot} already holds '{other.name}'; every channel has a slot of its own."
                )
            if (other.kind, other.of) == (kind, of):
                table.fail("of", f"'{other.name}' already measures the {kind} of '{of}'; remove one of the two.")
        table.finish()
        channels.append(channel)
    present = {(c.kind, c.of) for c in channels}
    for joint in finger.joint_names:
        if ("joint_position", joint) not in present:
            file.fail(
                None,
                f'joint \'{joint}\' has no channel; add a [[channel]] of kind "joint_position" with of = "{joint}".',
            )
    for tendon in np.array(finger.tendon_names)[finger.active]:
        if ("tension", tendon) not in present:
            file.fail(
                None, f'tendon \'{tendon}\' has no channel; add a [[channel]] of kind "tension" with of = "{tendon}".'
            )
    if len(finger.tendon_names) > contract.TARGETS:
        file.fail(None, f"{finger.n} tendons, but the controller has {contract.TARGETS} actuation modules.")
    return tuple(channels)


def _limits(file: Table, finger: FingerDescription, kinds: set[str]) -> Limits:
    table = file.table("limits")
    assert table is not None

    def watched(kind: str, key: str, low: float, high: float, unit: str) -> float:
        """A limit on a kind of channel that a rig may lack: it must be there with the channel, and only then."""
        if kind in kinds:
            return table.number(key, low=low, high=high, unit=unit)
        if key in table.values:
            table.fail(key, f"'{key}' watches nothing without a [[channel]] of kind \"{kind}\"; add one, or remove it.")
        return np.inf

    limits = Limits(
        tension_max=table.number("tension_max", low=0.1, high=100.0, unit="N"),
        tension_rate=table.number("tension_rate", low=0.1, high=1000.0, unit="N/s"),
        tension_rate_max=table.number("tension_rate_max", low=1.0, high=1e5, unit="N/s"),
        joint_margin=np.radians(table.number("joint_margin_deg", low=0.0, high=45.0, unit="deg")),
        joint_velocity=np.radians(table.number("joint_velocity_deg_s", low=1.0, high=2000.0, unit="deg/s")),
        joint_velocity_max=np.radians(table.number("joint_velocity_max_deg_s", low=1.0, high=5000.0, unit="deg/s")),
        joint_torque_max=table.number("joint_torque_max", low=1e-3, high=10.0, unit="N m"),
        fingertip_force_max=table.number("fingertip_force_max", low=0.1, high=100.0, unit="N"),
        tension_error_max=watched("tension_setpoint", "tension_error_max", 0.1, 100.0, "N"),
        tension_error_s=watched("tension_setpoint", "tension_error_s", 0.01, 10.0, "s"),
        temperature_max=watched("motor_temperature", "temperature_max", 30.0, 200.0, "degC"),
    )
    if limits.tension_rate > limits.tension_rate_max:
        table.fail(
            "tension_rate", "'tension_rate' of set-points is above 'tension_rate_max', so every ramp would trip."
        )
    if limits.joint_velocity > limits.joint_velocity_max:
        table.fail(
            "joint_velocity_deg_s",
            "'joint_velocity_deg_s' is above 'joint_velocity_max_deg_s', so every move would trip.",
        )
    if np.any(finger.limits[:, 1] - finger.limits[:, 0] <= 2 * limits.joint_margin):
        table.fail("joint_margin_deg", "'joint_margin_deg' leaves no range between the joint limits.")
    table.finish()
    return limits


def _hard_limits(file: Table, limits: Limits) -> HardLimits:
    """`[controller]`: where a key is missing, twice the host's own limit, and a heartbeat of 0.25 s."""
    if (table := file.table("controller", required=False)) is None:
        table = Table(file.path, file.text, {}, "controller")
    unit = np.pi / 180
    hard = HardLimits(
        tension_max=table.number("tension_max", 2 * limits.tension_max, low=0.1, unit="N"),
        tension_rate_max=table.number("tension_rate_max", 2 * limits.tension_rate_max, low=1.0, unit="N/s"),
        joint_velocity_max=unit
        * table.number("joint_velocity_max_deg_s", 2 * limits.joint_velocity_max / unit, low=1.0, unit="deg/s"),
        joint_torque_max=table.number("joint_torque_max", 2 * limits.joint_torque_max, low=1e-3, unit="N m"),
        fingertip_force_max=table.number("fingertip_force_max", 2 * limits.fingertip_force_max, low=0.1, unit="N"),
        heartbeat_s=table.number("heartbeat_s", 0.25, 0.02, 60.0, "s"),
    )
    table.finish()
    return hard
