"""A model as a plant agrees with the specimen whose parameters it has."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.data import EXPERIMENT_NAMES
from jaxfinger.effects import CATALOGUE
from jaxfinger.errors import UserError
from jaxfinger.model import Finger
from jaxfinger.model import simulate as forward
from jaxfinger.synthetic import (
    ModelPlant,
    SpecimenPlant,
    clean_session,
    paper_finger,
    polynomial_finger,
    recipe_from,
    session_plan,
    simulate,
    true_model,
)
from jaxfinger.synthetic.fitted import describe_finger

SPECIMEN = polynomial_finger(paper_finger())
TRIALS = {"rate": 40.0, "vd3": {"motions": 1, "duration": 2.0, "rate": 1000.0}, "vd1": {"motions": 1}}


@pytest.fixture(scope="module")
def plans():
    plans = session_plan(SPECIMEN.description, recipe_from({"trials": TRIALS}).trials)
    return {plan.experiment: plan for plan in plans}


@pytest.mark.parametrize("experiment", [e for e in EXPERIMENT_NAMES if e != "VD.3"])
def test_prescribed_channels_agree(plans, experiment):
    plan, active = plans[experiment], SPECIMEN.description.active
    ours = SpecimenPlant(SPECIMEN).prescribed(plan)
    theirs = ModelPlant(true_model(SPECIMEN)).prescribed(plan)
    assert ours.keys() == theirs.keys()
    for channel in ours:
        rows = active if channel.startswith("tendon") else slice(None)
        assert theirs[channel][rows] == pytest.approx(ours[channel][rows], abs=1e-7)


def test_driven_motion_agrees_under_the_same_tension(plans):
    """Two independent simulations of dry friction agree; one holds tension over a sample, the other interpolates it."""
    ours = SpecimenPlant(SPECIMEN)
    first = ours.driven(plans["VD.3"])
    second = ModelPlant(true_model(SPECIMEN), driver=ours).driven(plans["VD.3"])
    assert np.array_equal(first["tendon_force"], second["tendon_force"])
    assert np.abs(first["q"] - second["q"]).max() < np.deg2rad(0.1)


def test_a_driven_finger_moves_by_the_true_tension_and_its_sensors_read_their_own(plans):
    """A load cell that reads 2 % too much, and an encoder that reads 0.01 rad too much."""
    plan, driver, model = plans["VD.3"], SpecimenPlant(SPECIMEN), true_model(SPECIMEN)
    given = driver.driven(plan)["tendon_force"]
    weaker = given.copy()
    weaker[2] /= 1.02
    errors = (
        CATALOGUE["tension_sensor_scale"].at(model.finger, (SPECIMEN.description.tendon_names[2],), gain=0.02),
        CATALOGUE["encoder_offset"].at(model.finger, (SPECIMEN.description.joint_names[1],), offset=0.01),
    )
    wrong = eqx.tree_at(lambda m: m.effects, model, errors, is_leaf=lambda v: isinstance(v, tuple))
    found = ModelPlant(wrong, driver=driver).driven(plan)
    assert np.array_equal(found["tendon_force"], given)
    time, q0 = jnp.asarray(plan.time), jnp.asarray(plan.q[:, 0] - [0.0, 0.01, 0.0])
    q, _ = forward(model, time, jnp.asarray(weaker), q0, jnp.zeros(3))
    np.testing.assert_allclose(found["q"] - np.asarray(q), np.tile([[0.0], [0.01], [0.0]], plan.time.size), atol=1e-6)
    excursion = np.asarray(model.moment_arm.excursion(q))
    np.testing.assert_allclose(found["tendon_excursion"][:4], excursion[:4], atol=1e-7)


def test_model_without_a_driver_cannot_be_driven(plans):
    with pytest.raises(UserError, match=r"drop VD\.3"):
        ModelPlant(true_model(SPECIMEN)).driven(plans["VD.3"])


def test_session_of_a_model():
    recipe = recipe_from({"trials": TRIALS | {"experiments": ["ID.4"]}})
    session = simulate(recipe, seed=2, plant=ModelPlant(true_model(SPECIMEN)))
    assert {t.experiment for t in session} == {"ID.4"}
    assert all(np.isfinite(t.joint_torque).any() for t in session)


def test_a_sensor_drifts_on_between_repeats_of_one_motion():
    """Repeats differ by the drift between them, in closed form, and by nothing else."""
    recipe = recipe_from({"trials": TRIALS | {"experiments": ["ID.3-static"], "id3_static": {"repeats": 2}}})
    model = true_model(SPECIMEN)
    drift = CATALOGUE["torque_sensor_drift"].at(model.finger, ("torque_sensor",), A=1e-3, P=71.0, tare=3.0)
    model = eqx.tree_at(lambda m: m.effects, model, (drift,), is_leaf=lambda v: isinstance(v, tuple))
    clean = clean_session(recipe, ModelPlant(model), SPECIMEN.description)
    (first, a), (again, b) = clean.trials[:2]
    assert first.motion == again.motion

    def drifted(plan):
        now, tare = 2 * np.pi * (plan.session_start + plan.time) / 71.0, 2 * np.pi * (plan.session_start - 3.0) / 71.0
        return 1e-3 * (np.cos(now) - np.cos(tare))

    difference = (b["joint_torque"] - a["joint_torque"])[first.joint]
    np.testing.assert_allclose(difference, drifted(again) - drifted(first), atol=1e-9)
    assert np.ptp(difference) > 1e-4


def test_the_session_of_a_model_says_its_rotors():
    """Else the file of a simulated session would describe another finger than the one that moved."""
    described = replace(SPECIMEN.description, rotor_inertia=np.array([1e-5, 0.0, 2e-5]))
    assert describe_finger(Finger.from_description(described)).rotor_inertia == pytest.approx([1e-5, 0.0, 2e-5])
