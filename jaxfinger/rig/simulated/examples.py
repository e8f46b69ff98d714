"""Example rig file and plan, for the simulated finger, for the stand-in, or to edit for a bench."""

from __future__ import annotations

from jaxfinger.data.finger_file import finger_toml
from jaxfinger.data.session import FingerDescription
from jaxfinger.rig.simulated.controller import Slots
from jaxfinger.rig.simulated.plant import default_truth

LIMITS = """[limits]
tension_max = 18.0              # N
tension_rate = 20.0             # N/s, of set-points
tension_rate_max = 500.0        # N/s, measured
joint_margin_deg = 2.0          # kept from the mechanical stops
joint_velocity_deg_s = 120.0    # of set-points
joint_velocity_max_deg_s = 600.0
joint_torque_max = 0.3          # N m, of the external motor
fingertip_force_max = 20.0      # N
tension_error_max = 3.0         # N, set-point minus measured …
tension_error_s = 0.2           # … for so many seconds
temperature_max = 70.0          # degC, of the motors
"""


def rig_toml(
    backend: str = "simulated", address: dict | None = None, finger: FingerDescription | None = None, **rig: object
) -> str:
    """Return a rig file with the channels of the simulated rig; `rig` adds keys to `[rig]`."""
    finger = finger or default_truth().finger
    slots = Slots(finger.n, finger.m)
    head = {"name": "example", "backend": backend, "specimen": "simulated finger", "rate_hz": 1000.0, **rig}
    lines = ["[rig]", *(f"{k} = {_toml(v)}" for k, v in head.items()), ""]
    if address:
        lines += ["[address]", *(f"{k} = {_toml(v)}" for k, v in address.items()), ""]
    lines += [LIMITS, finger_toml(finger)]
    rows = [
        ("tension", t, s, "N", "KD60 over GSV-8 and EL3008")
        for t, s in zip(finger.tendon_names, slots.tension, strict=True)
    ]
    rows += [
        ("excursion", t, s, "m", "EL7211 encoder times spool radius")
        for t, s in zip(finger.tendon_names, slots.excursion, strict=True)
    ]
    rows += [("joint_position", j, s, "rad", "AA5048B") for j, s in zip(finger.joint_names, slots.angle, strict=True)]
    rows += [("external_torque", "", slots.torque, "N m", "torque sensor of the external motor")]
    rows += [("fingertip_force", axis, s, "N", "K3D40") for axis, s in zip("xyz", slots.force, strict=True)]
    rows += [
        ("tension_setpoint", t, s, "N", "the controller's ramp")
        for t, s in zip(finger.tendon_names, slots.setpoint, strict=True)
    ]
    rows += [
        ("motor_temperature", t, s, "degC", "drive")
        for t, s in zip(finger.tendon_names, slots.temperature, strict=True)
    ]
    for kind, of, slot, unit, source in rows:
        lines += ["[[channel]]", f'kind = "{kind}"', *([f'of = "{of}"'] if of else []), f"slot = {slot}"]
        lines += [f'unit = "{unit}"', "scale = 1.0", "offset = 0.0", f'source = "{source}"', ""]
    return "\n".join(lines)


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else repr(value)


def plan_toml(repeats: int = 1, postures: int = 2) -> str:
    """Return a plan of the paper's session, shortened: every experiment, joint and tendon, ID.4 at 1 or 2 postures."""
    trials = [f'experiment = "ID.2"\njoint = "{j}"\nrepeats = {repeats}' for j in ("MCP", "PIP", "DIP")]
    trials.append('experiment = "VD.1"\nseconds = 12.0')
    for joint in ("MCP", "PIP", "DIP"):
        trials.append(
            f'experiment = "ID.3-static"\njoint = "{joint}"\nrange_deg = [0.0, 70.0]\n'
            f"speed_deg_s = 60.0\nrepeats = {repeats}"
        )
    for joint in ("MCP", "PIP", "DIP"):
        trials.append(f'experiment = "ID.3-dynamic"\njoint = "{joint}"\nrange_deg = [10.0, 65.0]')
    for tendon, joint, levels in (
        ("T1", "PIP", "[2.0, 5.0, 8.0, 11.0, 14.0]"),
        ("T2", "MCP", "[2.0, 5.0, 8.0, 11.0, 14.0]"),
        ("T3", "MCP", "[4.0, 6.0, 8.0, 10.0]"),
        ("T4", "MCP", "[4.0, 6.0, 8.0, 10.0]"),
    ):
        for posture in ("[25.0, 60.0, 20.0]", "[50.0, 30.0, 20.0]")[:postures]:
            trials.append(
                f'experiment = "ID.4"\ntendon = "{tendon}"\njoint = "{joint}"\nlevels = {levels}\n'
                f"posture_deg = {posture}\nrepeats = {repeats}"
            )
    trials.append('experiment = "VD.2"\ntendon = "T2"\nposture_deg = [10.0, 40.0, 35.0]')
    trials.append(
        'experiment = "VD.3"\nmean = [4.0, 2.5, 3.0, 3.0]\namplitude = 2.0\n'
        "interval = 0.4\ntension_rate = 20.0\nseconds = 8.0\nseed = 1"
    )
    return '[plan]\nname = "paper, shortened"\noperator = "operator"\n' + "".join(f"\n[[trial]]\n{t}\n" for t in trials)
