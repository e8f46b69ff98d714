"""Diagnosis of another simulator: effects that it lacks are named, parameters that are wrong in it are refitted."""

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.experiments import demean, prepare
from jaxfinger.gap import Status, diagnose
from jaxfinger.gap.folds import fold_of_row
from jaxfinger.gap.parts import retuned_parameters
from jaxfinger.gap.problem import build
from jaxfinger.gap.result import Key
from jaxfinger.gap.simulator import emulate
from jaxfinger.identify import Recipe, identify
from jaxfinger.identify.fit_with_noise import first_noise
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.predictions import predict_session
from jaxfinger.synthetic import (
    SpecimenPlant,
    paper_finger,
    polynomial_finger,
    recipe_from,
    simulate,
    study_finger,
    true_model,
)

from .conftest import PLANTED, TRUTH, WITHOUT, session_with

DEMO = Path(__file__).parents[2] / "datasets" / "demo-finger" / "session.h5"


@pytest.fixture(scope="module")
def session():
    return session_with(PLANTED)


def simulator(session, **factors):
    """Predictions of a finger without the effect, some of its parameters off by factors."""
    model = true_model(polynomial_finger(paper_finger()))
    torque = model.joint_torque
    for name, factor in factors.items():
        torque = eqx.tree_at(lambda t, name=name: getattr(t, name), torque, factor * getattr(torque, name))
    return predict_session(eqx.tree_at(lambda m: m.joint_torque, model, torque), session)


@pytest.mark.long
def test_the_missing_effect_is_named_and_the_wrong_parameters_retuned(session):
    found = diagnose(session, without=WITHOUT, predictions=simulator(session, damping=3.0), quick=True)
    assert found.status is Status.EXPLAINED
    assert found.named == (Key(*TRUTH),)
    assert any(c.group == "damping" and c.before > 2.0 * c.after for c in found.changes)
    # Before, the simulator predicts as it is; after, the model has the finger's own parameters and the effect.
    line = next(x for x in found.closures if x.experiment == "ID.3-dynamic")
    own = next(x for x in diagnose(session, without=WITHOUT, quick=True).closures if x.experiment == "ID.3-dynamic")
    assert line.before > 1.2 * own.before
    assert line.after == pytest.approx(own.after, rel=0.1)


def test_another_mass_of_the_simulator_stays_out_of_its_moment_arms():
    """The imitation keeps the masses of CAD, so that it misses torques of the free finger."""
    specimen = study_finger()
    trials = {"experiments": ["ID.2", "ID.3-static", "VD.3"], "rate": 100.0, "id2": {"strokes": 2, "stroke_time": 3.0}}
    trials["vd3"] = {"repeats": 1, "motions": 2, "duration": 6.0, "centre": 0.4, "amplitude": 0.3}
    recipe = recipe_from({"specimen": {"kind": "random", "joints": 1}, "trials": trials})
    session = simulate(recipe, seed=0, plant=SpecimenPlant(specimen))
    true = true_model(specimen)
    heavy = eqx.tree_at(lambda m: m.finger.mass, true, 3.0 * true.finger.mass)
    emulator, _, _ = emulate(session, Recipe(), prepare(session), predict_session(heavy, session))
    q = jnp.linspace(*session.finger.limits[0], 20)[None]
    expected = true.moment_arm.coupling(q)
    np.testing.assert_allclose(emulator.moment_arm.coupling(q), expected, atol=1e-3 * float(jnp.abs(expected).max()))


def test_parameters_are_listed_by_what_their_law_changes(planted):
    """Coefficients of one tendon's excursion, each far off, may leave the excursion as it is."""
    parameters, J = [describe(planted.nominal)[i] for i in planted.free], planted.J
    size = np.linalg.norm(J, axis=0)
    damping = next(k for k, p in enumerate(parameters) if p.group == "damping" and p.joint == "PIP")
    law = [k for k, p in enumerate(parameters) if (p.group, p.tendon, p.joint) == ("moment_arm", "T1", "MCP")]
    off = np.zeros(len(parameters))
    off[damping] = 1.0 / size[damping]
    off[law] = 10.0 * np.linalg.svd(J[:, law] / size[law])[2][-1] / size[law]
    free = Free.at(planted.nominal, planted.free)
    model = free.set(planted.nominal, np.asarray(free.get(planted.nominal)) + off)
    known = replace(planted.fit, model=model, covariance=1e-30 * np.eye(ravel(model).size))
    first, *others = retuned_parameters(replace(planted, simulator=planted.nominal), known)
    assert first.name == "damping PIP"
    assert {c.name for c in others} == {parameters[k].name for k in law}


@pytest.mark.long
def test_a_term_that_the_simulator_lacks_is_a_candidate(session):
    found = diagnose(session, without=(*WITHOUT, "gravity"), predictions=simulator(session, friction=0.0), quick=True)
    assert "joint_coulomb" not in found.problem.fit.recipe.model.terms
    assert any(c.key.effect == "joint_coulomb" for c in found.candidates[:4])


@pytest.mark.long
def test_the_shipped_sessions_own_fit_is_imitated_as_a_simulator():
    """Its predictions are constant in every hold, and zero for the torque of VD.3. Neither is an accuracy that the
    imitation must reach.
    """
    session = read_session(DEMO)
    stacks, told = prepare(session), predict_session(identify(session, Recipe()).model, session)
    _, recipe, rebased = emulate(session, Recipe(), stacks, told)
    assert recipe == Recipe()
    for e, stack in stacks.items():
        for c in set(stack.experiment.channels) - ({"joint_torque"} if e == "VD.3" else set()):
            mask = jnp.asarray(rebased[e].batch.mask[c])
            off = demean(jnp.asarray(rebased[e].batch.y[c] - stack.batch.y[c]), mask)
            assert jnp.sqrt(jnp.sum(off**2) / jnp.sum(mask)) < 0.5 * first_noise(stack, c, stack.batch.y[c]).std.max()


@pytest.mark.parametrize(
    ("tolerance", "says"),
    [
        ({"torque": 0.1}, r"tolerance of torque \(did you mean 'joint_torque'\?\): is of no channel that is judged"),
        ({"joint_torque": 5.0}, "tolerance of joint_torque: is 5; say a share"),
        ({"joint_torque": np.nan}, "tolerance of joint_torque: is nan"),
        ({"tendon_excursion": -0.1}, "tolerance of tendon_excursion: is -0.1"),
    ],
)
def test_a_tolerance_that_would_be_passed_over_is_refused(tolerance, says, session):
    with pytest.raises(UserError, match=says):
        diagnose(session, tolerance=tolerance)


def test_predictions_of_other_trials_are_refused(session):
    other = {"somebody": {"time": np.arange(3.0), "joint_torque": np.zeros((3, 3))}}
    with pytest.raises(UserError, match="none of its trials is in the predictions"):
        diagnose(replace(session, file="s.h5"), predictions=other)


@pytest.mark.long
def test_a_perfect_simulator_leaves_no_gap():
    session = session_with()
    found = diagnose(session, without=WITHOUT, predictions=simulator(session), quick=True)
    assert found.status is Status.NO_GAP
    assert jnp.isfinite(found.problem.r).all()


def test_a_simulator_that_repeats_the_measurements_is_refused(session):
    """With nothing missed, noise would be of no size, and rounding a gap."""
    stacks, told = prepare(session), simulator(session)
    trial = next(t for t in session if t.experiment == "ID.3-dynamic")
    copied = np.float32(trial.joint_torque).astype(float)
    told[trial.name] = {**told[trial.name], "joint_torque": copied}
    with pytest.raises(
        UserError, match=rf"{trial.name}/joint_torque: predictions of MCP repeat the measurements, noise and all"
    ):
        emulate(session, Recipe(), stacks, told)


def test_a_trial_that_is_predicted_alone_is_divided_into_folds(session):
    """Trials of its kind that are not predicted hold nothing out: it would be in a single fold, and nothing closed."""
    name = next(t.name for t in session if t.experiment == "ID.3-dynamic")
    problem = build(session, Recipe(), predictions={name: simulator(session)[name]})
    assert set(fold_of_row(problem)) == {0, 1, 2}


def test_a_column_that_repeats_the_measurements_up_to_a_constant_is_refused(session):
    """Beside columns that a simulator computes, and with the zero that it may choose."""
    stacks, told = prepare(session), simulator(session)
    trial = next(t for t in session if t.experiment == "ID.2")
    excursion = told[trial.name]["tendon_excursion"].copy()
    excursion[:, 1] = trial.tendon_excursion[:, 1] - trial.tendon_excursion[0, 1]
    told[trial.name] = {**told[trial.name], "tendon_excursion": excursion}
    with pytest.raises(UserError, match=rf"{trial.name}/tendon_excursion: predictions of T2 repeat the measurements"):
        emulate(session, Recipe(), stacks, told)
