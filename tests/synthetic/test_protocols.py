"""Plans: derivatives of the commanded motions, directions, holds, and recipes that do not fit the finger."""

import numpy as np
import pytest

from jaxfinger.data import EXPERIMENT_NAMES
from jaxfinger.errors import UserError
from jaxfinger.synthetic import paper_finger, random_finger, recipe_from, session_plan

DESCRIPTION = paper_finger().description


@pytest.fixture(scope="module")
def plans():
    return session_plan(DESCRIPTION, recipe_from({"trials": {"rate": 500.0}}).trials)


def test_every_experiment_is_planned_and_repeats_share_their_motion(plans):
    assert {p.experiment for p in plans} == set(EXPERIMENT_NAMES)
    assert len({p.name for p in plans}) == len(plans)
    motions = [p.motion for p in plans if p.experiment == "ID.4"]
    assert all(motions.count(motion) == 2 for motion in motions)
    starts = [p.session_start for p in plans]
    ends = [p.session_start + p.time[-1] for p in plans]
    assert all(later > earlier for later, earlier in zip(starts[1:], ends[:-1], strict=True))


@pytest.mark.parametrize("experiment", ["ID.2", "ID.3-static", "ID.3-dynamic", "VD.1", "VD.3"])
def test_velocity_and_acceleration_are_derivatives(plans, experiment):
    for plan in (p for p in plans if p.experiment == experiment):
        dt = plan.time[1]
        v, a = np.gradient(plan.q, dt, axis=1)[:, 1:-1], np.gradient(plan.qd, dt, axis=1)[:, 1:-1]
        assert np.abs(v - plan.qd[:, 1:-1]).max() < 1e-3 * np.abs(plan.qd).max() + 1e-12
        # Sweeps join cruise and reversal with a corner in acceleration: a sample of one slope is averaged away.
        assert np.abs(a - plan.qdd[:, 1:-1]).max() < 0.02 * np.abs(plan.qdd).max() + 1e-12


def test_motions_stay_within_the_limits(plans):
    low, high = DESCRIPTION.limits.T[:, :, None]
    assert all(((p.q >= low - 1e-12) & (p.q <= high + 1e-12)).all() for p in plans)


def test_static_holds_are_approached_from_both_sides(plans):
    plan = next(p for p in plans if p.experiment == "ID.3-static" and p.joint == 0)
    holds = [np.flatnonzero(plan.hold == k) for k in range(plan.hold.max() + 1)]
    assert all((plan.qd[0, h] == 0).all() for h in holds)
    angle = np.array([plan.q[0, h[0]] for h in holds])
    direction = np.array([plan.joint_direction[0, h[0]] for h in holds])
    half = len(holds) // 2
    assert angle[:half] == pytest.approx(angle[half:][::-1])
    assert (direction[:half] == 1).all()
    assert (direction[half:] == -1).all()
    moving = plan.qd[0] != 0
    assert np.array_equal(np.sign(plan.qd[0, moving]), plan.joint_direction[0, moving])


def test_sweeps_reach_their_speeds(plans):
    plan = next(p for p in plans if p.experiment == "ID.3-dynamic" and p.joint == 0)
    speed = np.abs(plan.qd[0])
    for v in (0.5, 1.0, 1.5):
        assert (np.abs(speed - v) < 1e-9).sum() > 200
    assert speed.max() <= 1.5 + 1e-12


def test_tension_rises_and_falls_in_steps(plans):
    plan = next(p for p in plans if p.experiment == "ID.4" and p.tendon == 2)
    steps = [plan.tension[2, plan.hold == k] for k in range(plan.hold.max() + 1)]
    assert [s.mean() for s in steps] == pytest.approx([4, 5, 6, 7, 8, 9, 10, 9, 8, 7, 6, 5, 4])
    assert all(np.ptp(s) == 0 for s in steps)
    assert not plan.joint_direction.any()
    assert [plan.tendon_direction[2, plan.hold == k][0] for k in (0, 6, 7, 12)] == [1, 1, -1, -1]
    assert not np.delete(plan.tension, 2, axis=0).any()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"id4": {"postures": [[10, 20]]}}, "give one a joint, 3"),
        ({"id2": {"postures": [[10, 20, 170]]}}, "DIP beyond its limits"),
        ({"vd2": {"tendons": ["T9"]}}, "names 'T9'"),
    ],
)
def test_recipe_that_does_not_fit_the_finger(change, said):
    with pytest.raises(UserError, match=said):
        session_plan(DESCRIPTION, recipe_from({"trials": change}).trials)


def test_any_finger_has_a_programme():
    description = random_finger(5, 6, "abduction", "fewest").description
    plans = session_plan(description, recipe_from({"trials": {"rate": 50.0}}).trials)
    assert {p.experiment for p in plans} == set(EXPERIMENT_NAMES)
    assert {p.joint for p in plans if p.experiment == "ID.3-static"} == set(range(6))
    assert {p.tendon for p in plans if p.experiment == "ID.4"} == set(range(7))
