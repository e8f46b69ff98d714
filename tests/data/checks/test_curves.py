"""Trials of one posture show one torque over a joint's angle."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import Session
from jaxfinger.data.checks.curves import check_curves
from jaxfinger.data.findings import Report
from tests.data.checks.sweeps import Sweep, swept
from tests.data.conftest import make_finger

SLOW, FAST = Sweep((0.1, 0.2)), Sweep((0.6, 1.2, 1.8))


def trials(changes=(1.0, 1.0, 1.0), zeros=(0.0, 0.004, -0.003), posture=0.0):
    """Trials at several speeds, each with its own zero (N m); `changes` multiply their torques. The last's posture."""
    made = {}
    for k, (sweep, factor, zero) in enumerate(zip((SLOW, FAST, FAST), changes, zeros, strict=True)):
        trial = swept(sweep, sweep.q, factor * (sweep.torque() + zero))
        made[f"t{k}"] = replace(trial, name=f"t{k}", q=trial.q + np.array([0.0, posture * (k == 2)]))
    return made


def said(made) -> list[str]:
    report = Report()
    check_curves(Session("finger", make_finger(), made), report)
    return [str(finding) for finding in report]


def test_trials_that_differ_in_speed_and_zero_are_silent():
    assert said(trials()) == []


def test_a_gain_that_drifts_is_left_to_the_fit():
    assert said(trials((1.0, 1.2, 0.8))) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((1.0, -1.0, 1.0), ("-1 times at MCP in t1 as in t0;",)),
        ((-1.0, 1.0, 1.0), ("-1 times at MCP in t0 as in t1;",)),
        ((1.0, 1.0, 20.0), ("20 times at MCP in t2 as in t0;",)),
        ((1.0, 0.1, 0.1), ("10 times at MCP in t0 as in t1;",)),
    ],
    ids=["sign", "sign of the first", "lever arm", "two against one"],
)
def test_the_trial_that_is_not_like_the_others_is_named(changes, words):
    (finding,) = said(trials(changes))
    assert all(word in finding for word in words), finding
    assert "check the sign, the units and the columns of joint_torque and q" in finding


def test_of_two_trials_the_one_whose_motor_takes_work_out_is_named():
    made = trials((-1.0, 1.0, 1.0))
    del made["t2"]
    (finding,) = said(made)
    assert "-1 times at MCP in t0 as in t1" in finding


def test_other_postures_may_show_other_torques():
    """Weight and coupling springs depend on the other joints' angles."""
    made = trials((1.0, 1.0, -1.0), posture=0.5)
    assert said(made) == []


def test_torques_of_friction_and_inertia_alone_show_no_curve():
    rng = np.random.default_rng(1)
    made = {}
    for name, sweep in (("a", SLOW), ("b", FAST)):
        way = np.sign(np.gradient(sweep.q))
        made[name] = replace(swept(sweep, sweep.q, 0.004 * way + 1e-4 * rng.standard_normal(len(way))), name=name)
    assert said(made) == []
