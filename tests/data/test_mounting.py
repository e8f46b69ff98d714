"""How a finger is mounted, in numbers and words."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.data.mounting import gravity_levers, mounting_in_words
from jaxfinger.model import Finger, rigid_body
from tests.data.conftest import make_finger
from tests.model.fingers import description


@pytest.mark.parametrize("m", [1, 3, 5])
def test_gravity_acts_on_turning_and_sliding_joints_as_in_the_model(m):
    """A motor that holds the joint needs the opposite torque."""
    d = description(seed=m, m=m)
    q = np.random.default_rng(m).standard_normal((7, m))
    held = rigid_body.gravity_torque(Finger.from_description(d), jnp.asarray(q.T)).T
    np.testing.assert_allclose(gravity_levers(d, q) @ d.gravity, -held, atol=1e-12 * np.abs(held).max())


LEVEL = "the straight finger points level; "


@pytest.mark.parametrize(
    ("gravity", "says"),
    [
        (
            (0, 0, -9.81),
            f"{LEVEL}at q = 0 gravity flexes MCP with 9.81 N mm, PIP with 1.47 N mm; in mid-range it flexes",
        ),
        ((0, 0, 9.81), f"{LEVEL}at q = 0 gravity extends MCP with 9.81 N mm, PIP with 1.47 N mm; in mid-range it ext"),
        ((0, 9.81, 0), f"{LEVEL}gravity acts on no joint: the finger moves in a horizontal plane"),
        ((-9.81, 0, 0), "the straight finger points up; at q = 0 gravity acts on no joint; in mid-range it flexes MCP"),
        ((8.5, 0, -4.9), "the straight finger points 60° down; at q = 0 gravity flexes"),
        ((0, 0, 0), "there is no gravity"),
    ],
)
def test_words_say_how_the_finger_is_mounted(gravity, says):
    assert mounting_in_words(replace(make_finger(), gravity=np.array(gravity, float))).startswith(says)


def test_a_pendulum_that_hangs_in_the_middle_of_its_range_is_in_no_horizontal_plane():
    limits = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    hanging = replace(make_finger(), gravity=np.array([9.81, 0.0, 0.0]), limits=limits)
    assert mounting_in_words(hanging).startswith(
        "the straight finger points down; at q = 0 and in mid-range gravity acts on no joint; "
        "at a quarter of the range it flexes MCP with"
    )


def test_torques_of_an_arm_are_in_newton_metres():
    arm = replace(make_finger(), mass=1e4 * make_finger().mass)
    assert "gravity flexes MCP with 98.1 N m, PIP with 14.7 N m" in mounting_in_words(arm)


def test_words_of_a_chain_with_a_sliding_joint():
    """A vertical rail carries the finger: gravity pulls both links down the rail."""
    finger = replace(make_finger(), prismatic=(True, False), axis=np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    assert mounting_in_words(finger).startswith(
        "at q = 0 gravity pushes back MCP with 0.294 N and flexes PIP with 1.47"
    )
