"""The direction of gravity against the torques of ID.3."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import Session, Trial
from jaxfinger.data.checks.gravity import check_gravity, check_torque_scales
from jaxfinger.data.findings import Report
from jaxfinger.data.mounting import gravity_levers
from jaxfinger.model import Finger
from jaxfinger.model.rigid_body import inverse_dynamics
from jaxfinger.synthetic.random_finger import random_finger
from tests.data.conftest import make_finger

POSTURES = (-0.6, 0.2, 1.1)  # rad, of all joints but the one that moves


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


def excited(finger, rng, rate=100.0, noise=0.01, friction=0.2) -> Session:
    """Session of one trial in which motors move all joints at once, as an arm is excited.

    `noise` and `friction` are multiples of the torque with which gravity acts on each joint.
    """
    time = np.arange(int(40.0 * rate)) / rate
    q = np.empty((len(time), finger.m))
    for i in range(finger.m):
        frequency, phase = rng.uniform(0.05, 0.3, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
        q[:, i] = 0.6 + 0.25 * np.sin(2.0 * np.pi * frequency * time[:, None] + phase).sum(axis=1)
    speed = np.gradient(q, time, axis=0)
    motion = (q.T, speed.T, np.gradient(speed, time, axis=0).T)
    torque = np.asarray(inverse_dynamics(Finger.from_description(finger), *motion)).T
    size = np.abs(gravity_levers(finger, q) @ finger.gravity).mean(axis=0)
    torque = torque + size * (friction * np.tanh(speed / 0.01) + 0.1 * rng.standard_normal(finger.m))
    torque += noise * size * rng.standard_normal(torque.shape)
    q = q + 1e-4 * rng.standard_normal(q.shape)
    return Session("arm", finger, {"all": Trial("all", "ID.3-dynamic", time, q, joint_torque=torque)})


def scales_said(session: Session) -> list[str]:
    report = Report()
    check_torque_scales(session, report)
    return [str(finding) for finding in report]


def test_torques_of_joints_that_move_at_once_are_silent_where_they_are_right():
    for seed in range(12):
        finger = random_finger(seed, 2 + seed % 4, ("planar", "abduction", "spatial")[seed % 3]).description
        assert scales_said(excited(finger, np.random.default_rng(seed))) == []


@pytest.mark.parametrize("scale", [-1.0, 0.07, 20.0])
def test_a_current_for_a_torque_and_a_wrong_sign_are_named_with_their_joint(scale):
    finger = random_finger(4, 3, "spatial").description
    session = excited(finger, np.random.default_rng(0))
    wrong = session["all"].joint_torque * [1.0, scale, 1.0]
    (finding,) = scales_said(replace(session, trials={"all": replace(session["all"], joint_torque=wrong)}))
    found, name = finding.split("with ")[1].split(":")[0].split(" of it at ")
    assert "/trials/all/joint_torque" in finding
    assert name == finger.joint_names[1]
    assert float(found) == pytest.approx(scale, rel=0.3)


def test_torques_that_drown_in_noise_or_lie_in_a_horizontal_plane_show_no_scale():
    finger = random_finger(4, 3, "spatial").description
    noisy = excited(finger, np.random.default_rng(0), noise=20.0)
    wrong = replace(noisy["all"], joint_torque=-noisy["all"].joint_torque)
    assert scales_said(replace(noisy, trials={"all": wrong})) == []
    flat = replace(random_finger(3, 3, "planar").description, gravity=np.array([0.0, 9.81, 0.0]))
    session = excited(replace(flat, gravity=np.array([0.0, 0.0, -9.81])), np.random.default_rng(1))
    wrong = replace(session["all"], joint_torque=-session["all"].joint_torque)
    assert scales_said(Session("flat", flat, {"all": wrong})) == []


def upright(sign: float, spring: float, seed: int = 0) -> Session:
    """Session of an arm that points up and moves its joints in proportion, so that springs could explain each torque.

    `sign` is that of the torques, and `spring` a stiffness as a multiple of the one that the weight imitates.
    """
    finger = replace(make_finger(), gravity=np.array([-9.81, 0.0, 0.0]))
    session = excited(finger, np.random.default_rng(seed))
    trial = session["all"]
    q = 0.4 * (trial.q[:, :1] - trial.q[:, :1].mean()) * [1.0, 0.8]
    weight = -gravity_levers(finger, q) @ finger.gravity
    size = np.abs(weight).mean(axis=0)
    speed = np.gradient(q, trial.time, axis=0)
    torque = weight + spring * size / np.abs(q).mean(axis=0) * q + 0.05 * size * np.sign(speed)
    torque += 0.02 * size * np.random.default_rng(seed).standard_normal(q.shape)
    return replace(session, trials={"all": replace(trial, q=q, joint_torque=sign * torque)})


def test_torques_of_an_upright_arm_with_a_wrong_sign_are_named():
    """A weight that turns an arm over, held with the wrong sign, looks like springs that hold it up."""
    (finding,) = scales_said(upright(-1.0, 0.0))
    assert "/trials/all/joint_torque: goes against gravity, with -1" in finding
    assert "of what it takes at PIP: correct its sign, that of q, or `gravity`" in finding


@pytest.mark.parametrize("spring", [0.0, 0.3, 1.0, 5.0, 20.0])
def test_torques_of_an_upright_arm_with_the_right_sign_are_silent_with_other_springs(spring):
    """Springs of twice the weight at all joints are what the warning names as its exception."""
    for seed in range(3):
        assert scales_said(upright(1.0, spring, seed)) == []


def test_one_joint_that_goes_against_gravity_has_a_spring_or_a_wrong_sign():
    session = upright(-1.0, 0.0)
    torque = session["all"].joint_torque * [1.0, -1.0]
    (said,) = scales_said(replace(session, trials={"all": replace(session["all"], joint_torque=torque)}))
    assert said.startswith(
        "note: /trials/all/joint_torque: goes against gravity, with -1 of what it takes at MCP: springs"
    )
