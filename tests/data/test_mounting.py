"""How a finger is mounted, in numbers and words; and gravity against the torques of ID.3."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.data import Session, Trial
from jaxfinger.data.check_gravity import check_gravity
from jaxfinger.data.findings import Report
from jaxfinger.data.mounting import gravity_levers, mounting_in_words
from jaxfinger.model import Finger, rigid_body
from jaxfinger.synthetic.random_finger import random_finger
from tests.data.conftest import make_finger
from tests.model.fingers import description

POSTURES = (-0.6, 0.2, 1.1)  # rad, of all joints but the one that moves


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


def swept(finger, i, posture, gravity, rng, rate=200.0, noise=2e-4, tare=5e-3, cycles=3.0) -> Trial:
    """Trial in which a motor sweeps joint i, with all laws of a joint that the check is to leave aside."""
    time = np.arange(int(8.0 * rate)) / rate
    q = np.full((len(time), finger.m), posture) + 1e-4 * rng.standard_normal((len(time), finger.m))
    q[:, i] = 0.7 - 0.6 * np.cos(2.0 * np.pi * cycles * time / time[-1])
    speed = np.gradient(q[:, i], time)
    own = 0.02 * (q[:, i] - 0.5) + 0.01 * (q[:, i] - 0.5) ** 3 + 0.002 * np.tanh(speed / 0.02) + 5e-5 * speed
    torque = np.full_like(q, np.nan)
    torque[:, i] = own - gravity_levers(finger, q)[:, i] @ gravity + noise * rng.standard_normal(len(q))
    torque[:, i] += tare * rng.standard_normal()
    name = f"{finger.joint_names[i]}-{posture}"
    return Trial(name, "ID.3-dynamic", time, q, joint_torque=torque, joint=finger.joint_names[i])


def session_of(finger, postures=POSTURES, seed=0, **how) -> Session:
    rng = np.random.default_rng(seed)
    trials = [swept(finger, i, x, finger.gravity, rng, **how) for i in range(finger.m) for x in postures]
    return Session("finger", finger, {trial.name: trial for trial in trials})


def said(session, **changes):
    """Findings where the finger is described with these changes."""
    report = Report()
    check_gravity(replace(session, finger=replace(session.finger, **changes)), report)
    return [str(finding) for finding in report]


@pytest.mark.parametrize(
    "changes",
    [
        {"gravity": np.array([0.0, 0.0, 9.81])},
        {"gravity": np.array([0.0, -9.81, 0.0])},
        {"gravity": np.array([-9.81, 0.0, 0.0])},
        {"axis": np.array([[0.0, -1.0, 0.0], [0.0, -1.0, 0.0]])},
    ],
    ids=["up", "sideways", "along the finger", "axes turned round"],
)
def test_gravity_turned_round_or_sideways_is_named(changes):
    (finding,) = said(session_of(make_finger()), **changes)
    assert "/finger: has `gravity` with" in finding
    assert "correct `gravity`, `axis` or `com`, or the signs of q and joint_torque of MCP, PIP" in finding


@pytest.mark.parametrize(
    "how",
    [{}, {"rate": 1000.0}, {"rate": 50.0, "noise": 1e-3}, {"tare": 0.5}, {"noise": 0.0, "tare": 0.0}, {"cycles": 0.5}],
    ids=repr,
)
def test_sound_fingers_are_silent(how):
    for seed in range(12):
        layout = ("planar", "abduction", "spatial")[seed % 3]
        finger = random_finger(seed, 1 + seed % 4, layout).description
        assert said(session_of(finger, seed=seed, **how)) == []


def test_a_small_tilt_is_left_to_the_diagnosis():
    session = session_of(make_finger())
    assert said(session, gravity=9.81 * np.array([np.sin(0.35), 0.0, -np.cos(0.35)])) == []


TURNED = np.array([0.0, 0.0, 9.81])


def test_one_posture_cannot_show_gravity():
    assert said(session_of(make_finger(), postures=POSTURES[:1]), gravity=TURNED) == []


def test_a_passive_tendon_that_couples_joints_makes_the_elastic_torque_depend_on_the_posture():
    assert said(session_of(make_finger()), gravity=TURNED, active=np.array([False, True, True])) == []


def test_torques_that_show_far_more_than_gravity_have_another_reason():
    session = session_of(replace(make_finger(), gravity=-2.0 * TURNED))
    assert said(session, gravity=TURNED) == []


def test_torques_as_noisy_as_the_weight_do_not_show_it():
    assert said(session_of(make_finger(), noise=0.1), gravity=TURNED) == []


def test_missing_and_standing_torques_do_not_stop_the_check():
    session = session_of(make_finger())
    first, *others = session
    still = replace(first, name="still", q=np.full_like(first.q, 0.3))
    huge = replace(first, name="huge", q=1e200 * first.q, joint_torque=np.full_like(first.q, 1e300))
    missing = replace(first, name="missing", joint_torque=None)
    with np.errstate(all="ignore"):
        for trials in ((still, huge, missing, *others), (missing,), (still,), (huge,)):
            assert said(replace(session, trials={t.name: t for t in trials})) == []
