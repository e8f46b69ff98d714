"""VD.3's forward simulation against the inverse dynamics of the same laws."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.sealed.departures import draw
from jaxfinger.sealed.drive import Allocator, desired_trajectory, replay, simulate
from jaxfinger.sealed.laws import Finger
from jaxfinger.sealed.protocols import draw_style, session_plans
from jaxfinger.sealed.record import Motion, last_direction, needed_torque
from jaxfinger.sealed.specimens import LAYOUTS, make_specimen

LONG = [pytest.param(e, marks=pytest.mark.long) for e in ("tendon_friction_viscous", "payload")]


@pytest.mark.parametrize("effect", [None, "passive_tendon", *LONG])
def test_where_everything_slides_the_finger_needs_no_external_torque(effect, specimen, nominal, plans):
    departures = [] if effect is None else [draw(effect, specimen.finger, np.random.default_rng(0))]
    finger = Finger(specimen, departures)
    plan = next(p for p in plans if p.experiment == "VD.3")
    run = simulate(finger, nominal, [plan])[0]
    qdd = np.gradient(run.qd, run.time, axis=0)
    motion = Motion(run.time, run.q, run.qd, qdd, run.tension, last_direction(run.qd, 1e-3))
    torque = needed_torque(finger, plan, motion)
    arm = finger.geometry(run.q)[1]
    tendon = np.abs(np.einsum("tnm,tm->tn", arm, run.qd)) > 1e-3
    crosses = specimen.finger.crosses & specimen.finger.active[:, None]
    slides = (np.abs(run.qd) > 0.15) & ~(~tendon @ crosses)
    assert slides.sum() > 100
    assert np.median(np.abs(torque[slides])) < 1e-4  # N m: a third of the torque sensor's noise. Friction is 3e-3.


def test_repeats_of_a_motion_differ_a_little_and_seeds_repeat(nominal, plans):
    plan = next(p for p in plans if p.experiment == "VD.3")
    plan = replace(plan, duration=1.0)
    pair = [plan, replace(plan, seed=plan.seed + 1)]
    (a, b), (again, _) = simulate(nominal, nominal, pair), simulate(nominal, nominal, pair)
    np.testing.assert_array_equal(a.q, again.q)
    assert 1e-6 < np.abs(a.q - b.q).max() < 0.3


def test_allocation_gives_the_wanted_torque_within_its_bounds(nominal):
    arm = nominal.geometry(np.array([0.8, 0.6, 0.4]))[1]
    want = arm[:4].T @ np.array([3.0, 5.0, 4.0, 2.5])
    tension = Allocator(nominal, 2.0)(arm, want, np.zeros(nominal.n))
    np.testing.assert_allclose(arm.T @ tension, want, atol=1e-4)
    assert np.all(tension[specimen_active(nominal)] >= 2.0 - 1e-12)
    assert tension[~specimen_active(nominal)].sum() == 0.0


def specimen_active(nominal):
    return nominal.specimen.finger.active


SMALLEST = "n-plus-one"  # layout of the quick test; the others have their long ones


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.long] * (k != SMALLEST)) for k in LAYOUTS])
def test_the_same_tensions_open_loop_lead_to_the_same_motion(kind):
    """The fingers are statically stable under the recorded tensions, so that a simulator can replay them."""
    rng = np.random.default_rng([3, 1])
    specimen = make_specimen(kind, rng)
    nominal = Finger(specimen)
    plan = next(p for p in session_plans(specimen, draw_style(rng), rng) if p.experiment == "VD.3")
    plan = replace(plan, duration=2.0)
    plan = replace(plan, q=desired_trajectory(nominal, plan, rng))
    run = simulate(nominal, nominal, [plan])[0]
    assert np.ptp(run.q, axis=0).max() > 0.1
    wished = np.stack([p(run.time)[0] for p in plan.q], axis=1)
    assert np.abs(run.q - wished).max() < 0.2
    motion = np.array(replay(nominal, run.q[0], run.tension))
    assert np.sqrt(np.mean((motion - run.q) ** 2)) < 5e-3
