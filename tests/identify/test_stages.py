"""Stages without valid samples are skipped; parameters that no trial determines are named."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import Session, Trial
from jaxfinger.errors import UserError
from jaxfinger.identify import Recipe, identify
from jaxfinger.identify.parameters import describe
from jaxfinger.identify.recipe import ModelRecipe
from jaxfinger.synthetic import recipe_from, simulate
from tests.experiments.test_held import ramps
from tests.experiments.test_prepare import FINGER


def test_a_stage_of_which_nothing_counts_is_skipped_and_says_why():
    trial = ramps(0.1)
    fit = identify(Session("a finger", FINGER, {trial.name: trial}), stages=("ID.4",))
    (report,) = fit.stages
    assert report.status == "skipped"
    assert "no sample of joint_torque counts: no tendon is pulled" in report.message
    assert not fit.estimated.size


@pytest.mark.parametrize("moved", [1, 2])
def test_cross_terms_need_a_trial_that_moves_both_joints(moved):
    """With one joint moved at a time they stay zero, and a warning names the joints to move together."""
    time = np.linspace(0.0, 8.0, 801)
    q = np.full((time.size, FINGER.m), 0.4)
    for i in range(moved):
        q[:, i] += 0.4 * np.sin((1.0 + 0.7 * i) * time)
    l = 0.01 * q @ FINGER.crosses.T + 1e-5 * np.random.default_rng(0).standard_normal((time.size, FINGER.n))
    joint = FINGER.joint_names[0] if moved == 1 else None
    trial = Trial("a", "ID.2", time, q, tendon_excursion=l, joint=joint)
    recipe = Recipe(model=ModelRecipe(moment_arm_degree=2, cross_terms=True))
    fit = identify(Session("a finger", FINGER, {"a": trial}), recipe, stages=("ID.2",))
    parameters, both = describe(fit.model), FINGER.joint_names[:2]
    crossed = [i for i in fit.estimated if parameters[i].spans == both]
    said = " ".join(fit.stages[0].warnings)
    assert bool(crossed) == (moved == 2)
    assert (f"{' and '.join(both)} together" in said) == (moved == 1)


def test_a_stage_that_starts_from_a_fit_is_as_the_session_is_mounted_and_names_both():
    """Gravity belongs to the rig: with that of the other recording the weight of the links would count as elastic."""
    trial = ramps(0.1)
    session = Session("a finger", FINGER, {trial.name: trial})
    first = replace(identify(session, stages=("ID.4",)), data="first.h5", data_hash="1")
    turned = replace(session, finger=replace(FINGER, gravity=np.array([0.0, 9.81, 0.0])))
    second = identify(turned, stages=("ID.4",), start=first)
    np.testing.assert_array_equal(second.model.finger.gravity, turned.finger.gravity)
    assert second.was_made_from(turned)
    assert second.was_made_from(session)
    other = replace(session, finger=replace(FINGER, joint_names=("a", *FINGER.joint_names[1:])))
    with pytest.raises(UserError, match="give a session of the finger that was identified"):
        identify(other, stages=("ID.4",), start=first)


def test_the_noise_of_another_session_is_not_taken_over(session, staged):
    """Other sensors have other noise; the intervals would be those of the wrong one."""
    noisy = {of: replace(n, std=10 * n.std, innovation=10 * n.innovation) for of, n in staged.noise.items()}
    start = replace(staged, noise=noisy, data_hash="of another file")
    again = identify(session.select("ID.2"), stages=("ID.2",), start=start)
    of = ("ID.2", "tendon_excursion")
    np.testing.assert_allclose(again.noise[of].std, staged.noise[of].std, rtol=1e-3)
    assert again.noise["ID.4", "joint_torque"] is noisy["ID.4", "joint_torque"]  # of the fit's own trials


def test_noise_of_accelerations_is_no_sign_of_a_wrong_model():
    """A rotor of 0.01 kg m² makes an encoder's noise, differentiated twice, a torque far above its sensor's noise."""
    body = {"mass": 0.05, "com": [0.02, 0.0, 0.0], "inertia": np.diag([1e-6, 8e-6, 8e-6]).tolist()}
    joint = {"name": "MCP", "axis": [0, 1, 0], "origin": [0, 0, 0], "limits_deg": [-10, 90], "rotor_inertia": 0.01}
    finger = {"gravity": [0.0, 0.0, -9.81], "fingertip": [0.03, 0.0, 0.0], "joints": [joint | body]}
    terms = {"joints": {"MCP": {"elastic": [-0.01, 0.3], "friction": [0.02], "damping": 0.01}}}
    trials = {"experiments": ["ID.3-static", "ID.3-dynamic"]}
    session = simulate(recipe_from({"finger": finger, "terms": terms, "trials": trials}), seed=0)
    fit = identify(session, stages=("ID.3-static", "ID.3-dynamic"))
    for report in fit.stages:
        assert report.chi2_per_row < 1.3
        assert report.outliers < 0.03
    damping = next(p for p in fit.table() if p["name"] == "damping MCP")
    assert abs(damping["value"] - 0.01) < 4.0 * damping["std"] < 4e-4
