"""`look` and `new` give the columns of a log to the finger's joints and tendons by the names of both."""

import re

import numpy as np
import pytest

from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from tests.data.conftest import make_finger

TIME = np.arange(1000) / 100.0
JOINTS = make_finger().joint_names


def _said(tmp_path, names, columns, clock=True):
    """What is proposed for a log of these columns without a finger, and its path."""
    path = tmp_path / "log.csv"
    table = np.column_stack([*([TIME] if clock else []), *columns])
    np.savetxt(path, table, "%.6f", ",", header=("t," if clock else "") + names, comments="")
    return proposal([load_recording(path)]), path


def _proposed(tmp_path, names):
    """What is proposed for a log with columns of these names, which all change, and what it reads by channel."""
    path = tmp_path / "log.csv"
    table = np.column_stack([TIME, *(0.6 + 0.5 * np.sin((1.0 + 0.1 * k) * TIME) for k in range(len(names)))])
    np.savetxt(path, table, "%.6f", ",", header=",".join(["t", *names]), comments="")
    said = proposal([load_recording(path)], make_finger())
    return said, {f"{c}.{n}": name for c, n, name in re.findall(r'channels\.(\w+)\.(\w+) = \{ from = "([^"]+)"', said)}


@pytest.mark.parametrize("form", ["{} position", "q_{}", "q{}", "arm.{}.pos", "{} Angle [rad]"])
def test_of_a_whole_robots_log_the_columns_with_the_fingers_names_are_read(form, tmp_path):
    """They stand behind those of other joints, and before some."""
    names = [form.format(name) for name in ("WristYaw", "WristPitch", *JOINTS, "Thumb")]
    said, read = _proposed(tmp_path, [*names, *(f"torque {name}" for name in ("WristYaw", *JOINTS))])
    assert read == {f"q.{name}": form.format(name) for name in JOINTS} | {
        f"joint_torque.{name}": f"torque {name}" for name in JOINTS
    }
    assert "in their order" not in said


def test_a_number_is_no_part_of_a_longer_one(tmp_path):
    names = [f"q_J{k}" for k in (10, 11, 12, 1, 2)]
    path = tmp_path / "log.csv"
    np.savetxt(
        path, np.column_stack([TIME, *(np.sin(TIME) for _ in names)]), header=" ".join(["t", *names]), comments=""
    )
    finger = make_finger()
    finger = type(finger)(**{**vars(finger), "joint_names": ("J1", "J2")})
    said = proposal([load_recording(path)], finger)
    assert 'channels.q.J1 = { from = "q_J1"' in said
    assert 'channels.q.J2 = { from = "q_J2"' in said


def test_a_column_without_a_name_of_the_finger_gets_one_that_is_left(tmp_path):
    """PIP is named, whatever its place, so that the other column is of the other joint."""
    _, read = _proposed(tmp_path, ["PIP angle", "knuckle angle"])
    assert read == {"q.PIP": "PIP angle", "q.MCP": "knuckle angle"}


def test_several_sets_of_columns_with_the_fingers_names_are_told_apart(tmp_path):
    said, read = _proposed(tmp_path, ["MCP pos", "PIP pos", "MCP enc", "PIP enc", "thumb pos"])
    assert read == {"q.MCP": "MCP pos", "q.PIP": "PIP pos"}
    assert '# q could also be "MCP enc" to "PIP enc": take what was measured' in said
    assert '# in no channel yet: "thumb pos"' in said


def test_more_columns_than_joints_without_a_name_in_common_are_said(tmp_path):
    said, read = _proposed(tmp_path, ["hip angle", "knee angle", "ankle angle", "tau knee"])
    assert read == {"q.MCP": "hip angle", "q.PIP": "knee angle", "joint_torque.MCP": "tau knee"}
    assert "# q: 3 columns for MCP, PIP, in their order: correct" in said


def test_a_torque_with_a_joints_name_is_not_given_to_the_joint_that_moves_most(tmp_path):
    path = tmp_path / "log.csv"
    table = np.column_stack([TIME, 1.4 * np.sin(TIME), 0.3 * np.sin(TIME), np.cos(TIME)])
    np.savetxt(path, table, "%.6f", ",", header="t,MCP angle,PIP angle,PIP torque", comments="")
    assert 'channels.joint_torque.PIP = { from = "PIP torque"' in proposal([load_recording(path)], make_finger())


def test_what_could_be_read_is_named_first_of_what_is_left_out(tmp_path):
    """A long list is cut, and a torque sensor must not be among what is cut off."""
    names = ["MCP pos", "PIP pos", "MCP torque", "PIP torque", *(f"voltage {k}" for k in range(20)), "transducer [Nm]"]
    said, _ = _proposed(tmp_path, names)
    assert '# in no channel yet: "transducer [Nm]", "voltage 0"' in said


@pytest.mark.parametrize("unit", ["Nm/A", "N m/rad", "rad/s", "deg/s^2", "rad/s²"])
def test_a_quantity_by_another_is_no_channel(unit, tmp_path):
    """Not even where its name has the word of one. A bridge's mV/V and a name of two sides are none of these."""
    name = f"torque constant or angle [{unit}]"
    said, read = _proposed(tmp_path, ["MCP angle (left/right)", "PIP angle", name, "tau MCP [mV/V]"])
    assert read == {"q.MCP": "MCP angle (left/right)", "q.PIP": "PIP angle", "joint_torque.MCP": "tau MCP [mV/V]"}
    assert f'in no channel yet: "{name}"' in said


def _proposed_of(tmp_path, suffix, write):
    path = tmp_path / f"log{suffix}"
    write(path)
    return proposal([load_recording(path)])


def test_joints_that_are_numbered_have_one_unit(tmp_path):
    """A joint that is moved by 3 degrees beside others in degrees is not in rad."""
    angles = [40.0 * np.sin(TIME), 3.0 * np.sin(TIME), 60.0 * np.cos(TIME)]
    said, _ = _said(tmp_path, "q1,q2,q3", angles)
    assert re.findall(r'from = "q\d", units = "(\w+)"', said) == ["deg", "deg", "deg"]


def test_a_unit_that_one_joint_of_several_needs_leaves_all_open(tmp_path):
    """It may slide, in mm, or turn several times."""
    said, _ = _said(tmp_path, "q1,q2,q3", [0.5 * np.sin(TIME), 0.3 * np.sin(TIME), 200.0 * np.cos(TIME)])
    assert said.count('units = "?" }   # its size does not tell') == 3


def test_parameters_beside_a_clock_are_no_channels(tmp_path):
    """A file of MATLAB often holds the model beside the samples, or the samples at a lower rate."""
    angle = 0.5 * np.sin(TIME)
    data = {
        "time": TIME,
        "q_raw": angle,
        "q_thinned": angle[::10],
        "f_coul": np.arange(6.0),
        "pos_gain": np.arange(6.0),
    }
    for clock in (True, False):
        rest = {k: v for k, v in data.items() if clock or k != "time"}
        said = _proposed_of(tmp_path, ".npz", lambda path, rest=rest: np.savez(path, **rest))
        assert re.findall(r'channels.*from = "(\w+)"', said) == ["q_raw"]
        assert '# in no channel yet: "q_thinned", "f_coul", "pos_gain"' in said


def test_a_force_that_goes_as_the_speed_is_none(tmp_path):
    """Of a joint that is damped the torque goes as the speed, and tells no sampling rate."""
    said, _ = _said(tmp_path, "Joint1_Pos,Joint1_Force", [np.sin(TIME), 12.0 * np.cos(TIME)], clock=False)
    assert 'channels.joint_torque.J1 = { from = "Joint1_Force", units = "?" }' in said
    assert "# speeds" not in said


@pytest.mark.parametrize(("angles", "said"), [(2, True), (3, False)])
def test_more_torques_than_angles_are_not_paired_in_silence(angles, said, tmp_path):
    """Without a finger the columns are named by their order, and the angle of a joint may be missing."""
    names = [f"position {k}" for k in range(3)][-angles:] + [f"torque {k}" for k in range(3)]
    text, _ = _said(tmp_path, ",".join(names), [np.sin(TIME) for _ in names])
    comment = "# 2 of q and 3 of joint_torque, named in their order: give those of one joint the same name"
    assert (comment in text) == said
    assert 'channels.joint_torque.J3 = { from = "torque 2"' in text
