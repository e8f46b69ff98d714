"""Prescribed trials: the specimen's plant agrees with the nominal model on a specimen of its form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.compilation import quick_options
from jaxfinger.model import Motion, external_torque, fingertip_force
from jaxfinger.synthetic import (
    SpecimenPlant,
    paper_finger,
    polynomial_finger,
    recipe_from,
    session_plan,
    true_model,
)
from jaxfinger.synthetic.plant import BLOCK_SAMPLES, joint_tension

SPECIMEN = polynomial_finger(paper_finger())
TRIALS = {"rate": 100.0, "id3_static": {"dwell": 0.3}, "id4": {"joints": "all"}}


@pytest.fixture(scope="module")
def plant():
    return SpecimenPlant(SPECIMEN)


@pytest.fixture(scope="module")
def plans():
    return session_plan(SPECIMEN.description, recipe_from({"trials": TRIALS}).trials)


SAMPLES = 300
TORQUE = jax.jit(external_torque, compiler_options=quick_options())
FORCE = jax.jit(fingertip_force, compiler_options=quick_options())


def _sampled(plan, x):
    """Return SAMPLES instants spread over the plan, so that one compilation serves all plans."""
    return x[..., np.linspace(0, plan.time.size - 1, SAMPLES).astype(int)]


def _motion(plan):
    state = [
        _sampled(plan, x) for x in (plan.time, plan.q, plan.qd, plan.qdd, plan.tension, 1.0 * plan.joint_direction)
    ]
    rest = np.zeros((5, SAMPLES)), np.zeros(SAMPLES), np.zeros((3, SAMPLES))
    return Motion(*map(jnp.asarray, (*state, *rest)), held=plan.held)


@pytest.mark.parametrize("experiment", ["ID.3-static", "ID.3-dynamic", "ID.4"])
def test_joint_torque_is_that_of_equation_1(plant, plans, experiment):
    model = true_model(SPECIMEN)
    chosen = [p for p in plans if p.experiment == experiment]
    for plan in chosen[:: max(1, len(chosen) // 3)]:
        torque = _sampled(plan, plant.prescribed(plan)["joint_torque"])
        assert torque == pytest.approx(np.asarray(TORQUE(model, _motion(plan))), abs=1e-12)


def test_fingertip_force_is_the_least_squares_one(plant, plans):
    plan = next(p for p in plans if p.experiment == "VD.2")
    force = _sampled(plan, plant.prescribed(plan)["fingertip_force"])
    assert force == pytest.approx(np.asarray(FORCE(true_model(SPECIMEN), _motion(plan))), abs=1e-7)


def test_motor_torque_has_the_sign_of_the_load(plant):
    """Palm up, at rest at 0°: gravity and the rubber band extend the finger, the motor must flex it."""
    recipe = recipe_from({"trials": {"rate": 50.0, "experiments": ["ID.3-static"]}})
    plan = session_plan(SPECIMEN.description, recipe.trials)[0]
    torque = plant.prescribed(plan)["joint_torque"][0]
    up = np.array([torque[plan.hold == k].mean() for k in range(plan.hold.max() + 1)])
    half = up.size // 2
    assert (up > 0).all()
    friction = 0.5 * (up[:half] - up[half:][::-1])
    angle = np.array([[plan.q[0, plan.hold == k][0] for k in range(half)], [0.0] * half, [0.0] * half])
    assert friction == pytest.approx(SPECIMEN.coulomb(angle)[0], abs=1e-12)


def test_held_tendon_rises_by_the_law_and_falls_from_a_plateau():
    f = np.concatenate([np.linspace(0, 10, 101), np.linspace(10, 0, 101)])[None]
    loss = 0.4 * f
    reached = joint_tension(f, loss)
    assert reached[0, :101] == pytest.approx(0.6 * f[0, :101])
    plateau = f[0, 101:] > 6.0 / 1.4
    assert reached[0, 101:][plateau] == pytest.approx(6.0)
    assert reached[0, 101:][~plateau] == pytest.approx(1.4 * f[0, 101:][~plateau])


def test_blocks_leave_no_seam(plant):
    """The torque of a trial longer than a block is that of its pieces."""
    q = np.tile(np.linspace(0.1, 1.0, BLOCK_SAMPLES + 100), (3, 1))
    whole = plant._rigid_body(q, q, q)
    pieces = [plant._rigid_body(*[q[:, k]] * 3) for k in (slice(0, 50), slice(BLOCK_SAMPLES - 50, BLOCK_SAMPLES + 100))]
    assert whole[:, :50] == pytest.approx(pieces[0], abs=1e-15)
    assert whole[:, BLOCK_SAMPLES - 50 :] == pytest.approx(pieces[1], abs=1e-15)
