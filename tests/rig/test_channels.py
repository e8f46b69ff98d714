"""Rig files: an error is refused with its line; calibration turns raw values into SI."""

from dataclasses import asdict
from pkgutil import iter_modules

import numpy as np
import pytest

from jaxfinger.data import Session, write_session
from jaxfinger.errors import UserError
from jaxfinger.rig import backends, open_rig, parse_rig, read_rig
from jaxfinger.rig.simulated.examples import rig_toml
from jaxfinger.rig.simulated.plant import default_truth

GOOD = rig_toml()


def line_of(text: str, fragment: str, after: str = "") -> int:
    start = text.index(after) if after else 0
    return text[: text.index(fragment, start)].count("\n") + 1


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('unit = "N m"', 'unit = "kg"', "is 'kg', no unit for external_torque"),
        ('kind = "external_torque"', 'kind = "torque"', "choose one of"),
        ('of = "T3"\nslot = 2', 'of = "T9"\nslot = 2', "cannot be of 'T9'"),
        ("slot = 3\n", "slot = 2\n", "slot 2 already holds"),
        ("slot = 3\n", "slot = 60\n", "outside 0 to 59"),
        ("scale = 1.0", "scale = 0.0", "is zero"),
        ("scale = 1.0", "scale = nan", "must be a finite number"),
        ("tension_max = 18.0", 'tension_max = "18 N"', "limits.tension_max: must be a number, not '18 N'"),
        ("tension_max = 18.0", "tension_max = -1.0", "outside 0.1 to 100"),
        (
            "joint_margin_deg = 2.0",
            "joint_margn_deg = 2.0",
            "limits.joint_margn_deg: is unknown (did you mean 'joint_margin_deg'?)",
        ),
        ("tension_rate = 20.0", "tension_rate = 900.0", "every ramp would trip"),
        ('backend = "simulated"', 'backend = "simulatd"', "choose one of"),
        ("rate_hz = 1000.0", "rate_hz = true", "must be a number"),
        ("axis = [0.0, 1.0, 0.0]", "axis = [0.0, 2.0, 0.0]", "is 2 long"),
        (
            'crosses = ["MCP", "PIP"]',
            'crosses = ["MCP", "XIP"]',
            "is 'XIP' (did you mean 'PIP'?); choose one of MCP, PIP, DIP",
        ),
    ],
)
def test_a_mistake_names_its_line(old, new, says):
    assert old in GOOD
    with pytest.raises(UserError, match="line") as error:
        parse_rig(GOOD.replace(old, new, 1), "bench.toml")
    assert says in str(error.value)
    line = int(str(error.value).split("line ")[1].split(":")[0])
    found = GOOD.replace(old, new, 1).splitlines()[line - 1]
    assert found.startswith(tuple(new.splitlines())), (line, found)


@pytest.mark.parametrize(
    "key",
    [
        *("stale_s", "lag_s", "thread_s", "disk_s", "prompt_s", "clock_offset_s"),
        *("heartbeat_s", "frozen_s", "tension_error_s"),
    ],
)
def test_a_deadline_of_an_hour_is_none(key):
    if key == "heartbeat_s":
        text = GOOD + f"[controller]\n{key} = 3600.0\n"
    elif key == "tension_error_s":
        text = GOOD.replace("tension_error_s = 0.2", "tension_error_s = 3600.0")
    else:
        after = 'kind = "tension"\n' if key == "frozen_s" else "[rig]\n"
        text = GOOD.replace(after, f"{after}{key} = 3600.0\n", 1)
    with pytest.raises(UserError, match=rf"line \d+: .*{key}: is 3600 s, which is outside"):
        parse_rig(text)


def test_a_margin_in_radians_is_no_margin():
    """Commands would reach the joint's stops."""
    with pytest.raises(UserError, match=r"joint_margin_deg: is 0\.035°, so it seems to be radians; .* \(2\), or 0 for"):
        parse_rig(GOOD.replace("joint_margin_deg = 2.0", "joint_margin_deg = 0.035"))
    assert parse_rig(GOOD.replace("joint_margin_deg = 2.0", "joint_margin_deg = 0")).limits.joint_margin == 0.0


@pytest.mark.parametrize("key", ["tension_max", "tension_rate_max", "joint_velocity_max_deg_s", "joint_torque_max"])
def test_a_limit_of_the_controller_that_limits_nothing_is_refused(key):
    with pytest.raises(UserError, match=f"controller.{key}: is 1e\\+09 .*which is outside"):
        parse_rig(GOOD + f"[controller]\n{key} = 1e9\n")


def test_the_line_is_the_very_line():
    text = GOOD.replace('of = "T3"\nslot = 2', 'of = "T9"\nslot = 2', 1)
    with pytest.raises(UserError, match=f"bench.toml, line {line_of(text, 'T9')}:"):
        parse_rig(text, "bench.toml")


@pytest.mark.parametrize("name", [k for k in asdict(parse_rig(GOOD).limits) if k != "joint_acceleration"])
def test_a_missing_limit_is_refused(name):
    name = next(n for n in (name, f"{name}_deg", f"{name}_deg_s") if f"{n} =" in GOOD)
    text = "\n".join(row for row in GOOD.splitlines() if not row.startswith(f"{name} ="))
    with pytest.raises(UserError, match=rf"line \d+: limits\.{name}: is missing; add a line"):
        parse_rig(text)


def test_the_limit_on_accelerations_has_a_default():
    """It admits the moves of every trial that gives none; rig files from before this limit stay good."""
    assert "joint_acceleration_deg_s2" not in GOOD
    assert np.degrees(parse_rig(GOOD).limits.joint_acceleration) == pytest.approx(1200.0)
    lower = GOOD.replace("[limits]\n", "[limits]\njoint_acceleration_deg_s2 = 700.0\n", 1)
    assert np.degrees(parse_rig(lower).limits.joint_acceleration) == pytest.approx(700.0)


@pytest.mark.parametrize(
    ("kind", "names"),
    [("tension_setpoint", ("tension_error_max", "tension_error_s")), ("motor_temperature", ("temperature_max",))],
)
def test_a_rig_may_lack_set_points_and_temperatures_and_then_has_no_limit_on_them(kind, names):
    """With such a channel its limit is demanded. Without it the limit is refused: it would watch nothing."""
    without = "[[channel]]".join(b for b in GOOD.split("[[channel]]") if f'kind = "{kind}"' not in b)
    for name in names:
        line = line_of(without, f"{name} =")
        with pytest.raises(UserError, match=f'line {line}: limits.{name}: watches nothing without .* "{kind}"'):
            parse_rig(without)
        without = "\n".join(row for row in without.splitlines() if not row.startswith(f"{name} ="))
    limits = parse_rig(without).limits
    assert all(np.isinf(v) == (n in names) for n, v in asdict(limits).items())


def test_a_joint_without_a_channel_is_refused():
    blocks = GOOD.split("[[channel]]")
    text = "[[channel]]".join(b for b in blocks if 'of = "PIP"' not in b)
    with pytest.raises(UserError, match="joint 'PIP' has no channel"):
        parse_rig(text)


def test_an_unknown_key_is_refused():
    with pytest.raises(UserError, match=r"limits\.tension_maks: is unknown \(did you mean 'tension_max'\?\)"):
        parse_rig(GOOD.replace("[limits]", "[limits]\ntension_maks = 5.0"))


def test_calibration_in_millimetres_and_degrees():
    text = GOOD.replace('unit = "m"\nscale = 1.0\noffset = 0.0', 'unit = "mm"\nscale = 0.5\noffset = -2.0', 1)
    text = text.replace('unit = "rad"\nscale = 1.0', 'unit = "deg"\nscale = 2.0', 1)
    rig = parse_rig(text)
    raw = np.full((2, 60), 30.0)
    x = rig.calibrate(raw)
    assert x[0, rig.index("excursion", "T1")] == pytest.approx((30 * 0.5 - 2.0) * 1e-3)
    assert x[1, rig.index("joint_position", "MCP")] == pytest.approx(np.radians(60.0))


def test_the_force_sensor_is_turned_into_the_base_frame():
    quarter = "[fingertip_sensor]\nrotation = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]\n"
    rig = parse_rig(quarter + GOOD)
    raw = np.zeros((1, 60))
    raw[0, rig.channels[rig.index("fingertip_force", "x")].slot] = 5.0
    force = rig.calibrate(raw)[0, [rig.index("fingertip_force", a) for a in "xyz"]]
    np.testing.assert_allclose(force, [0.0, 5.0, 0.0])
    first, *others = GOOD.split("[[channel]]")
    only_z = [c for c in others if 'of = "x"' not in c and 'of = "y"' not in c]
    with pytest.raises(UserError, match="needs forces along x, y and z; the rig has 1 of them"):
        parse_rig(quarter + "[[channel]]".join([first, *only_z]))
    for wrong in ("-2.0", "1.0"):  # The second is a mirror: the sensor would be left-handed.
        with pytest.raises(UserError, match="rotation matrix"):
            parse_rig(quarter.replace("-1.0", wrong) + GOOD)


def test_the_finger_of_the_file_is_the_finger(rig):
    truth = default_truth().finger
    assert rig.finger.joint_names == truth.joint_names
    for name in ("axis", "origin", "limits", "mass", "com", "inertia", "fingertip", "crosses", "gravity"):
        np.testing.assert_allclose(getattr(rig.finger, name), getattr(truth, name), rtol=1e-12, atol=0)


def test_the_finger_may_come_from_an_earlier_session(tmp_path):
    truth = default_truth().finger
    write_session(Session("specimen", truth, {}, created="2026-01-01T00:00:00+00:00"), tmp_path / "old.h5")
    head, rest = GOOD.split("[finger]")
    channels = rest[rest.index("[[channel]]") :]
    (tmp_path / "rig.toml").write_text(f'finger = "old.h5"\n{head}\n{channels}')
    np.testing.assert_allclose(read_rig(tmp_path / "rig.toml").finger.mass, truth.mass)


def test_a_backend_is_one_file(tmp_path, monkeypatch):
    """A module in the folder of backends suffices: rig files may name it, and it declares its own address."""
    (tmp_path / "bench_of_mine.py").write_text(
        "from jaxfinger.rig.backends.simulated import SimulatedRig as make\n"
        "from dataclasses import dataclass\n"
        "@dataclass(frozen=True)\n"
        "class Address:\n"
        "    lucky_number: int\n"
    )
    monkeypatch.setattr(backends, "__path__", [*backends.__path__, str(tmp_path)])
    monkeypatch.setattr(backends, "NAMES", (*backends.NAMES, "bench_of_mine"))  # as an import of the package would find
    assert {module.name for module in iter_modules(backends.__path__)} == set(backends.NAMES)
    rig = parse_rig(rig_toml("bench_of_mine", {"lucky_number": 7}))
    with open_rig(rig) as machine:
        assert len(machine.read_block(1.0)) > 0
    with pytest.raises(UserError, match=r"line \d+: address\.seed: is unknown; it may be one of lucky_number"):
        parse_rig(rig_toml("bench_of_mine", {"lucky_number": 7, "seed": 7}))


def test_a_file_that_is_not_there_or_not_toml(tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        read_rig(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("[rig\nname = 1")
    with pytest.raises(UserError, match=r"bad\.toml, line 1: is not valid TOML"):
        read_rig(tmp_path / "bad.toml")
