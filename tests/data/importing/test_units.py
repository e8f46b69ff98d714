"""Units of a log's columns: stated ones are read or asked for, and a size that fits several units is asked for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxfinger.data.findings import Report
from jaxfinger.data.importing.by_mapping import import_session
from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.data.importing.survey import columns_of
from jaxfinger.errors import UserError
from tests.data.conftest import ONE_JOINT, make_finger

TIME = np.arange(400) / 100
SWEEP = 0.5 + 0.4 * np.sin(TIME)  # rad


def log(folder: Path, header: str, *columns: np.ndarray, form: str = "%.6f") -> Path:
    path = folder / "log.csv"
    np.savetxt(
        path, np.column_stack([TIME, *columns]), ["%.3f", *[form] * len(columns)], ",", header=header, comments=""
    )
    return path


def line(path: Path, channel: str) -> str:
    """What the proposed mapping says of a channel."""
    return next(said for said in proposal([load_recording(path)]).splitlines() if f"channels.{channel}" in said)


@pytest.mark.parametrize(
    ("stated", "units"),
    [
        ("rev", "turn"),
        ("turns", "turn"),
        ("cycles", "turn"),
        ("Umdrehungen", "turn"),
        ("gon", "gon"),
        ("grad", "?"),
        ("pouces", "?"),
    ],
)
def test_a_stated_unit_is_read_and_an_unknown_one_is_asked_for(tmp_path, stated, units):
    path = log(tmp_path, f"time [s],angle [{stated}]", SWEEP)
    assert f'units = "{units}"' in line(path, "q")
    assert (f"it states {stated}" in line(path, "q")) == (units == "?")


def test_a_word_behind_a_name_that_is_a_joints_is_no_unit(tmp_path):
    assert 'units = "rad" }' in line(log(tmp_path, "time [s],angle [MCP]", SWEEP), "q")


def test_times_in_an_unknown_unit_are_asked_for(tmp_path):
    said = proposal([load_recording(log(tmp_path, "time [jiffies],angle [rad]", SWEEP))])
    assert 'time = { from = "time [jiffies]", units = "?" }   # it states jiffies' in said


@pytest.mark.parametrize(("turns", "units"), [(1.0, "rad"), (2 * np.pi, "?")])
def test_angles_so_small_that_they_may_be_turns_are_asked_for(tmp_path, turns, units):
    """A joint that is held at a small angle takes the unit of the one that moves."""
    path = log(tmp_path, "time [s],q_1,q_2", SWEEP / turns, np.full(len(TIME), 0.1))
    assert [s.units or "?" for s in columns_of(load_recording(path))[1:]] == [units, units]


def test_an_angle_of_zero_is_zero_in_any_unit(tmp_path):
    assert 'units = "rad"' in line(log(tmp_path, "time [s],pos", np.zeros(len(TIME))), "q")


@pytest.mark.parametrize(("size", "units"), [(0.1, "N m"), (4.0, "?"), (200.0, "?"), (900.0, "N mm")])
def test_torques_that_may_be_a_fingers_or_an_arms_are_asked_for(tmp_path, size, units):
    path = log(tmp_path, "time [s],angle [rad],torque", SWEEP, size * np.cos(TIME))
    assert f'units = "{units}"' in line(path, "joint_torque")


def test_whole_numbers_are_taken_for_counts(tmp_path):
    """However large they are; a number between them shows that they are none."""
    ticks = np.round(300 * SWEEP)
    path = log(tmp_path, "time [s],enc,force", ticks, np.round(50 + 10 * np.sin(TIME)), form="%.1f")
    assert 'units = "?" }   # whole numbers, as counts are' in line(path, "q")
    assert 'units = "?" }   # whole numbers, as counts are' in line(path, "tendon_force")
    assert 'units = "deg" }' in line(log(tmp_path, "time [s],enc", ticks + 0.5), "q")


@pytest.mark.parametrize(
    ("derived", "reading"),
    [
        ("", '{ from = "enc", scale = "turns_per_count", offset = -0.5, units = "turn" }'),
        ('[derived]\nangle = "(enc - 2048) / 4096"\n', '{ from = "angle", units = "turn" }'),
    ],
    ids=["scale", "formula"],
)
def test_counts_become_angles_by_the_counts_in_a_turn(tmp_path, derived, reading):
    ticks = np.round(2048 + 4096 / (2 * np.pi) * SWEEP)
    path = log(tmp_path, "t,enc", ticks, form="%.0f")
    mapping = tmp_path / "m.toml"
    mapping.write_text(
        "specimen = 'x'\n[constants]\nturns_per_count = 0.000244140625\n"
        + derived
        + ONE_JOINT[ONE_JOINT.index("[finger]") :]
        + f'[trials.a]\nexperiment = "VD.1"\ntime = "t"\nchannels.q.MCP = {reading}\n'
        + 'channels.tendon_force.T1 = { from = "enc", scale = 0.0, offset = 2.0 }\n'
    )
    session = import_session([path], mapping)
    assert np.abs(session["a"].q[:, 0] - SWEEP).max() < 1e-3


def test_an_open_unit_is_refused(tmp_path):
    mapping = tmp_path / "m.toml"
    mapping.write_text(
        "specimen = 'x'\n"
        + ONE_JOINT[ONE_JOINT.index("[finger]") :]
        + '[trials.a]\nexperiment = "VD.1"\ntime = "time [s]"\n'
        + line(path := log(tmp_path, "time [s],angle [grad]", SWEEP), "q").replace("q.J1", "q.MCP")
    )
    with pytest.raises(UserError, match=r"channels.q.MCP: has units that are still to be filled in"):
        import_session([path], mapping)


@pytest.mark.parametrize(
    ("name", "units", "doubt"),
    [
        ("torque_N_mm", "N mm", ""),
        ("torque_N_m", "N m", ""),
        ("torque_kgf_cm", "?", "it states kgf cm"),
        ("torque oz_in", "?", "it states oz in"),
        ("force_kg", "kgf", ""),
        ("force_g", "gf", ""),
        ("force_N", "N", ""),
        ("T1_N", "N", ""),
        ("force_mV", "?", "it states mV"),
        ("angle_counts", "?", "it states counts"),
        ("angle_in", "rad", ""),
    ],
)
def test_a_unit_that_ends_a_name_is_read_or_asked_for(tmp_path, name, units, doubt):
    path = log(tmp_path, f"time [s],{name}", SWEEP)
    said = next(s for s in proposal([load_recording(path)]).splitlines() if f'from = "{name}"' in s)
    assert f'units = "{units}"' in said
    assert doubt in said


def test_a_unit_that_ends_a_name_contradicts_a_mapping_with_another(tmp_path):
    path, report = log(tmp_path, "t,q_rad,force_kg", SWEEP, 2.0 + SWEEP), Report()
    (tmp_path / "m.toml").write_text(
        ONE_JOINT + '[trials.a]\nexperiment = "VD.1"\ntime = "t"\nchannels.q.MCP = "q_rad"\n'
        'channels.tendon_force.T1 = "force_kg"\n'
    )
    import_session([path], tmp_path / "m.toml", report)
    assert 'states kg, and the mapping reads N; write units = "kgf"' in str([f.message for f in report])


@pytest.mark.parametrize(
    ("name", "size", "units"),
    [
        ("axis0.encoder.pos_estimate", 2.0, "?"),  # turns of a motor before its gear
        ("motor_pos", 300.0, "?"),
        ("position", 1.0, "?"),
        ("encoder", 1.0, "?"),
        ("encoder", 60.0, "deg"),
        ("joint_pos", 1.0, "rad"),
        ("q", 1.0, "rad"),
        ("motor_pos [deg]", 300.0, "deg"),
    ],
)
def test_a_position_that_may_be_of_a_motor_or_in_turns_is_asked_for(tmp_path, name, size, units):
    said = line(log(tmp_path, f"time [s],{name}", size * SWEEP), "q")
    assert f'units = "{units}"' in said
    assert ("of a motor before a gear write `scale` too" in said) == (units == "?")


@pytest.mark.parametrize(
    ("angle", "speed", "name", "units"),
    [
        (1.0, 1.0, "vel", "?"),  # a speed in the units of its angle tells nothing
        (1.0, 180 / np.pi, "vel", "rad"),
        (1.0, 1.0, "vel [rad/s]", "rad"),
        (1.0, 60 / (2 * np.pi), "speed_rpm", "rad"),
        (1 / (2 * np.pi), 60 / (2 * np.pi), "vel [rpm]", "?"),  # turns, of a motor perhaps
        (3.0, 1.0, "vel [rad/s]", "?"),  # through a gear
        (180 / np.pi, 1.0, "vel", "deg"),
    ],
)
def test_a_speed_tells_the_unit_of_its_angle(tmp_path, angle, speed, name, units):
    path = log(tmp_path, f"time [s],position,{name}", angle * SWEEP, speed * 0.4 * np.cos(TIME))
    assert f'units = "{units}"' in line(path, "q")


@pytest.mark.parametrize(
    ("name", "beside", "values", "units", "doubt"),
    [
        ("q", "motor_current", np.cos(TIME), "?", "motor_current is of a motor, and so may this be"),
        ("angle", "drive_temperature", TIME, "?", "drive_temperature is of a motor, and so may this be"),
        ("angle", "current_A", np.cos(TIME), "rad", "if of the drive with current_A, it may be in turns before a gear"),
        ("joint_angle", "motor_current", np.cos(TIME), "rad", ""),
        ("angle_MCP", "motor_current", np.cos(TIME), "rad", ""),
        ("angle", "motor_angle [deg]", 500 * np.cos(TIME), "rad", ""),
        ("angle", "tau [N m]", 0.1 * np.cos(TIME), "rad", ""),
        ("angle", "motor_speed [rad/s]", 0.4 * np.cos(TIME), "?", "motor_speed [rad/s] tells turns or a gear"),
        ("angle", "rpm", 24.0 * np.cos(TIME), "?", "rpm tells turns or a gear"),
    ],
)
def test_an_angle_beside_a_motor_that_has_no_other_may_be_the_motors(tmp_path, name, beside, values, units, doubt):
    """An angle that is called a joint's is the joint's, and so is one beside that of the motor."""
    said = line(log(tmp_path, f"time [s],{name},{beside}", SWEEP, values), "q")
    assert f'from = "{name}", units = "{units}" }}' in said
    assert doubt in said if doubt else "#" not in said


def test_a_speed_tells_that_an_angle_beside_a_motor_is_the_joints(tmp_path):
    path = log(tmp_path, "time [s],q,dq [rad/s],motor_current", SWEEP, 0.4 * np.cos(TIME), np.cos(TIME))
    assert line(path, "q") == 'channels.q.J1 = { from = "q", units = "rad" }'


@pytest.mark.parametrize(("turns", "units"), [(1.0, "rad"), (2.5, "?"), (0.4, "?")])
def test_known_moment_arms_tell_an_angle_before_a_gear(tmp_path, turns, units):
    finger = replace(make_finger(), excursion=np.full((3, 2, 1), 0.008), excursion_std=None)
    path = log(tmp_path, "time [s],q_MCP,excursion_T1 [mm]", 1.5 * turns * SWEEP, 8.0 * 1.5 * SWEEP)
    said = next(s for s in proposal([load_recording(path)], finger).splitlines() if "channels.q" in s)
    assert f'units = "{units}"' in said
    assert ("in rad it would make a moment arm of" in said) == (units == "?")


def test_a_speed_through_a_gear_opens_the_unit_that_a_size_told(tmp_path):
    path = log(tmp_path, "time [s],q,dq [rad/s]", SWEEP / 2.0, 0.4 * np.cos(TIME))
    assert 'units = "?"' in line(path, "q")


@pytest.mark.parametrize(
    ("arm", "units"), [(8.0, "mm"), (0.8, "?"), (0.008, "m"), (0.315, "?"), (3.0, "?"), (12.0, "mm"), (100.0, "?")]
)
def test_the_travel_of_a_tendon_is_in_the_unit_that_makes_moment_arms(tmp_path, arm, units):
    """Of cm and inches either would fit, and of small arms either of mm and cm."""
    path = log(tmp_path, "time [s],q,excursion", SWEEP, arm * SWEEP)
    assert f'units = "{units}"' in line(path, "tendon_excursion")


@pytest.mark.parametrize(("arm", "units"), [(4.0, "mm"), (0.4, "?")])
def test_known_moment_arms_tell_small_travels_in_mm(tmp_path, arm, units):
    """What would be cm may also be turns of a spool."""
    finger = replace(make_finger(), joint_names=("J1", "J2"), tendon_names=("T1", "T2", "T3"))
    finger = replace(finger, excursion=0.5 * make_finger().excursion)
    path = log(tmp_path, "time [s],q1,q2,excursion 1", SWEEP, 0.0 * SWEEP, arm * SWEEP)
    said = proposal([load_recording(path)], finger)
    assert f'channels.tendon_excursion.T1 = {{ from = "excursion 1", units = "{units}" }}' in said


@pytest.mark.parametrize(("size", "units"), [(1.0, "?"), (14.0, "?"), (40.0, "N"), (400.0, "?"), (5000.0, "?")])
def test_a_tension_of_any_size_that_people_use_in_two_units_is_asked_for(tmp_path, size, units):
    path = log(tmp_path, "time [s],q,tension", SWEEP, size * (0.6 + 0.4 * np.cos(TIME)))
    assert f'units = "{units}"' in line(path, "tendon_force")


@pytest.mark.parametrize(
    ("torque", "tension", "units"),
    [(6.0, 1.0, "N"), (60.0, 0.1, "?"), (30.0, 1.0, "?"), (0.06, 100.0, "?"), (6000.0, 0.01, "?")],
)
def test_a_known_torque_at_a_held_joint_tells_the_unit_of_the_tension(tmp_path, torque, tension, units):
    pull = 6.0 + 5.0 * np.sin(TIME)
    held = 0.5 + 0.0 * TIME
    path = log(tmp_path, "time [s],q,tension,torque [N mm]", held, tension * pull, -torque * tension * pull)
    assert f'units = "{units}"' in line(path, "tendon_force")


@pytest.mark.parametrize(("torque", "units"), [(8.0, "N mm"), (0.8, "?"), (0.008, "N m"), (0.08, "?")])
def test_a_known_tension_at_a_held_joint_tells_the_unit_of_the_torque(tmp_path, torque, units):
    pull = 6.0 + 5.0 * np.sin(TIME)
    path = log(tmp_path, "time [s],q,tension [N],torque", 0.5 + 0.0 * TIME, pull, -torque * pull)
    assert f'units = "{units}"' in line(path, "joint_torque")


def test_travels_in_two_units_are_not_read_in_one(tmp_path):
    """Those a thousand times smaller than others may be in m beside mm."""
    path = log(tmp_path, "time [s],q,excursion 1,excursion 2", SWEEP, 8.0 * SWEEP, 0.009 * SWEEP)
    said = proposal([load_recording(path)])
    assert 'from = "excursion 1", units = "mm" }' in said
    assert 'from = "excursion 2", units = "?" }' in said


def test_a_count_of_samples_is_no_force(tmp_path):
    path = log(tmp_path, "time [s],q,sample_N", SWEEP, np.arange(400.0))
    assert "tendon_force" not in proposal([load_recording(path)])


def test_m_behind_a_name_may_mean_measured(tmp_path):
    """So it tells no unit, and hides no channel."""
    path = log(tmp_path, "time [s],q_J1_m,l_T1_m,f_T1_N", SWEEP, 3.0 * SWEEP, 2.0 + SWEEP)
    said = proposal([load_recording(path)], replace(make_finger(), joint_names=("J1", "J2"), excursion=None))
    assert 'channels.q.J1 = { from = "q_J1_m", units = "rad" }' in said
    assert 'channels.tendon_excursion.T1 = { from = "l_T1_m", units = "?" }' in said
    assert 'channels.tendon_force.T1 = { from = "f_T1_N", units = "N" }' in said


def test_a_header_that_says_rad_of_degrees_is_told_apart_from_a_joint_that_turns_on(tmp_path):
    path = log(tmp_path, "t,q [rad],F [cN]", np.degrees(SWEEP), 200.0 + SWEEP)
    (tmp_path / "m.toml").write_text(
        ONE_JOINT
        + '[trials.a]\nexperiment = "VD.1"\ntime = "t"\nchannels.q.MCP = { from = "q [rad]", units = "rad" }\n'
        'channels.tendon_force.T1 = { from = "F [cN]", units = "cN" }\n'
    )
    with pytest.raises(UserError, match='if they are degrees, write units = "deg" all the same'):
        import_session([path], tmp_path / "m.toml")
    (tmp_path / "m.toml").write_text((tmp_path / "m.toml").read_text().replace('units = "rad"', 'units = "deg"'))
    trial = import_session([path], tmp_path / "m.toml")["a"]
    assert trial.tendon_force is not None
    np.testing.assert_allclose(trial.tendon_force[:, 0], 2.0 + 0.01 * SWEEP, atol=1e-8)


def test_torques_of_one_joint_a_recording_have_one_unit(tmp_path):
    """Those of the last joint are small in kgf cm too."""
    logs = []
    for joint, size in (("MCP", 0.5), ("DIP", 0.05)):
        (folder := tmp_path / joint).mkdir()
        logs.append(log(folder, f"time [s],q_MCP [rad],q_DIP [rad],tau_{joint}", SWEEP, SWEEP, size * np.cos(TIME)))
    said = [s for s in proposal([load_recording(path) for path in logs]).splitlines() if "channels.joint_torque" in s]
    assert len(said) == 2
    assert all('units = "?"' in s for s in said)


@pytest.mark.parametrize(("size", "units"), [(1.0, "rad"), (4.5, "?")])
def test_an_angle_that_goes_farther_than_its_limits_is_asked_for(tmp_path, size, units):
    """It may be of a motor before its gear."""
    finger = replace(make_finger(), joint_names=("J1", "J2"))
    path = log(tmp_path, "time [s],q_J1", size * SWEEP)
    assert f'channels.q.J1 = {{ from = "q_J1", units = "{units}" }}' in proposal([load_recording(path)], finger)
