"""A finger in TOML is read and written, and refused where it is impossible."""

from dataclasses import fields, replace

import numpy as np
import pytest

from jaxfinger.data.finger_file import Finger, finger_from, finger_toml
from jaxfinger.data.hdf5 import write_session
from jaxfinger.data.toml import parse_toml, structure
from jaxfinger.errors import UserError
from tests.data.conftest import ONE_JOINT, make_finger

FINGER = ONE_JOINT.replace('specimen = "bench finger"\n', "")


def read(text):
    document = parse_toml(text, "finger.toml")
    place = document.place / "finger"
    return finger_from(structure(document.content["finger"], Finger, place), place)


@pytest.mark.parametrize("names", [("MCP", "PIP"), ('M"C\\P', "é.\t")])
def test_what_is_written_is_read_back(names):
    finger = replace(make_finger(), joint_names=names)
    back = read(finger_toml(finger))
    for field in fields(finger):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(finger, field.name))


def test_limits_in_degrees():
    back = read(FINGER.replace("limits = [-0.3, 1.6]", "limits_deg = [-30, 90]"))
    np.testing.assert_allclose(back.limits, [[-np.pi / 6, np.pi / 2]])


def test_it_may_be_in_another_file(tmp_path, session):
    place = parse_toml('finger = "x"', tmp_path / "rig.toml").place / "finger"
    write_session(session, tmp_path / "old.h5")
    (tmp_path / "arm.toml").write_text(FINGER)
    assert finger_from("old.h5", place).joint_names == ("MCP", "PIP")
    assert finger_from("arm.toml", place).joint_names == ("MCP",)
    for other, says in (("none.toml", r"none\.toml: cannot be read"), ("arm.step", r"line 1: finger: is 'arm\.step'")):
        with pytest.raises(UserError, match=says):
            finger_from(other, place)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("mass = 0.02", "mas = 0.02", "line 10: finger.joints[0].mas: is unknown (did you mean 'mass'?)"),
        ("mass = 0.02", "mass = true", "line 10: finger.joints[0].mass: must be a number, not true"),
        ("mass = 0.02", "mass = 0", "line 10: finger.joints[0].mass: is 0 kg; it must be above 0 kg"),
        ("mass = 0.02\n", "", "line 5: finger.joints[0].mass: is missing; add a line 'mass = …'"),
        ("[-0.3, 1.6]", "[1.6, -0.3]", "line 9: finger.joints[0].limits: must be [lower, upper]"),
        ("[0.0, 1.0, 0.0]", "[0.0, 2.0, 0.0]", "line 7: finger.joints[0].axis: is 2 long"),
        ("limits = [-0.3, 1.6]\n", "", "limits: must be given once: `limits` in rad, or `limits_deg`"),
        ("limits = [-0.3, 1.6]", "limits = [-30.0, 160.0]", "line 9: finger.joints[0].limits: joint MCP reaches 160"),
        ("1e-6, 0.0, 0.0", "1e-6, 0.0", "line 12: finger.joints[0].inertia[0]: must be a list of 3 numbers, not 2"),
        ("1e-6, 0.0, 0.0", "9e-6, 0.0, 0.0", "no body has one larger"),
        ('["MCP"]', '["MPC"]', "finger.tendons[0].crosses[0]: is 'MPC' (did you mean 'MCP'?)"),
        ('name = "T2"', 'name = "T1"', "finger.tendons[1].name: is taken already"),
        ('name = "T2"', 'name = "T2"\nactive = "false"', "tendons[1].active: must be true or false, not 'false'"),
        ('name = "T2"', 'name = "T2"\nexcursion = { PIP = [0.01] }', "names PIP, which the tendon does not cross"),
        ('name = "T2"', 'name = "T2"\nexcursion = { MCP = [9.0] }', "convert mm to m"),
        ("[[finger.joints]]", "[[finger.joint]]", "finger.joint: is unknown (did you mean 'joints'?)"),
    ],
)
def test_a_mistake_is_named_with_its_line(old, new, says):
    assert old in FINGER
    with pytest.raises(UserError) as refused:
        read(FINGER.replace(old, new, 1))
    assert str(refused.value).startswith("finger.toml, line ")
    assert says in str(refused.value)
