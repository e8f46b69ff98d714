"""The joint refinement covers the truth, narrows intervals, has one optimum, and counts no data twice."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.data import EXPERIMENT_NAMES, read_session, write_session
from jaxfinger.errors import UserError
from jaxfinger.identify import Recipe, identify, refine
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.recipe import FitRecipe
from jaxfinger.synthetic import (
    SHORT,
    SpecimenPlant,
    clean_session,
    measure,
    recipe_from,
    study_finger,
    true_model,
)


def values(fit):
    return np.asarray(ravel(fit.model))


def scaled(fit, factor, *groups):
    positions = np.array([i for i in fit.estimated if describe(fit.model)[i].group in groups])
    free = Free.at(fit.model, positions)
    return replace(fit, model=free.set(fit.model, jnp.asarray(factor * values(fit)[positions])))


def test_estimates_lie_within_their_intervals(joint, truth):
    free = joint.estimated
    z = (values(joint) - truth)[free] / joint.std[free]
    assert joint.stages[-1].status == "fitted"
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4  # bounds for about thirty independent values
    assert np.abs(z).max() < 4.5
    assert 0.9 < joint.stages[-1].chi2_per_row < 1.1


@pytest.mark.long
def test_all_trials_of_one_joint_are_refined_to_their_noise():
    """The external torque of VD.3 is zero throughout.

    Its noise must not be taken for zero: the parameters of one joint are enough to fit it exactly, at the cost of all
    other channels.
    """
    specimen = study_finger()
    trials = {**SHORT, "experiments": list(EXPERIMENT_NAMES), "vd1": {"duration": 6.0}, "vd3": {"duration": 4.0}}
    recipe = recipe_from({"cad": {"mass": 0.05, "com": 2e-3}, "trials": trials})
    session = measure(clean_session(recipe, SpecimenPlant(specimen), specimen.description), 0)
    joint = refine(session, identify(session, Recipe(fit=FitRecipe(joint_experiments=EXPERIMENT_NAMES))))
    free = joint.estimated
    z = (values(joint) - np.asarray(ravel(true_model(specimen))))[free] / joint.std[free]
    assert 0.8 < joint.stages[-1].chi2_per_row < 1.2
    assert np.sqrt(np.mean(z**2)) < 1.5


def test_no_interval_is_wider_than_the_stages(staged, joint):
    ratio = joint.std[staged.estimated] / staged.std[staged.estimated]
    assert ratio.max() < 1.02
    assert np.median(ratio) < 1.0


def test_the_same_data_are_counted_once(session, joint):
    """A second refinement changes neither estimates nor intervals."""
    again = refine(session, joint)
    free = joint.estimated
    np.testing.assert_allclose(again.std[free], joint.std[free], rtol=1e-3)
    assert np.abs((values(again) - values(joint))[free] / joint.std[free]).max() < 0.05


@pytest.mark.long
def test_other_data_are_the_prior(clean, joint):
    """A second session halves the variance of parameters on which CAD has no prior."""
    other = measure(clean, 1)
    both = refine(other, replace(joint, data_hash="of another file"))
    groups = np.array([p.group for p in describe(joint.model)])
    free = joint.estimated[np.isin(groups[joint.estimated], ["moment_arm", "friction", "damping"])]
    ratio = both.std[free] / joint.std[free]
    assert abs(np.median(ratio) - np.sqrt(0.5)) < 0.05  # each session estimates its own noise
    assert ratio.min() > 0.55
    assert ratio.max() < 0.9


def test_a_fit_remembers_every_session_that_it_was_made_from(session, staged, tmp_path):
    """Else a second refinement on one of them would count its trials twice."""
    files = [tmp_path / f"{name}.h5" for name in "ab"]
    for k, file in enumerate(files):
        write_session(replace(session, specimen=f"{k}"), file)
    a, b = map(read_session, files)
    of_a = replace(staged, data="", data_hash="").made_from(a, alone=True)
    of_both = of_a.made_from(b)
    assert (of_a.was_made_from(a), of_a.was_made_from(b)) == (True, False)
    assert (of_both.was_made_from(a), of_both.was_made_from(b)) == (True, True)
    assert of_both.made_from(a) is of_both
    assert of_both.data == "a.h5, b.h5"
    assert not of_both.made_from(b, alone=True).was_made_from(a)
    assert not of_both.was_made_from(session)  # of no file


@pytest.mark.long
def test_a_second_refinement_on_other_data_does_not_count_them_twice(clean, joint, tmp_path):
    write_session(measure(clean, 1), tmp_path / "other.h5")
    other = read_session(tmp_path / "other.h5")
    both = refine(other, replace(joint, data_hash="of another file"))
    again = refine(other, both)
    free = joint.estimated
    assert np.median(again.std[free] / both.std[free]) > 1.0  # the first session no longer counts
    assert "the trials are read once" in again.stages[-1].message


def test_what_no_trial_of_a_joint_fit_shows_is_said_with_the_reason(session, staged):
    """A tendon that is pulled too fast for its friction needs no second tension."""
    at_rest = {t.name: replace(t, hold=np.full(len(t.time), -1)) for t in session.select("ID.4")}
    found = refine(replace(session, trials=dict(session.select("ID.2").trials) | at_rest), staged)
    assert any("no sample of joint_torque in ID.4 counts: no tendon is pulled" in w for w in found.stages[-1].warnings)


GROUPS = ("moment_arm", "elastic", "friction", "damping", "tendon_friction")


@pytest.mark.long
@pytest.mark.parametrize(
    ("factor", "groups"),
    [
        pytest.param(0.0, ("moment_arm",), marks=pytest.mark.long),
        pytest.param(0.0, ("tendon_friction",), marks=pytest.mark.long),
        (0.0, ("elastic", "friction")),
        pytest.param(3.0, GROUPS, marks=pytest.mark.long),
        pytest.param(1 / 3, GROUPS, marks=pytest.mark.long),
    ],
)
def test_poor_starts_lead_to_the_same_optimum(session, staged, joint, factor, groups):
    found = refine(session, scaled(staged, factor, *groups))
    free = joint.estimated
    assert found.stages[-1].status == "fitted"
    assert np.abs((values(found) - values(joint))[free] / joint.std[free]).max() < 0.1


@pytest.mark.long
def test_a_start_without_a_slope_is_left(session, staged, joint):
    """Losses clipped at zero everywhere have no derivative. The fit finds the optimum, or reports that it did not."""
    found = refine(session, scaled(staged, -3.0, "tendon_friction"))
    free = joint.estimated
    same = np.abs((values(found) - values(joint))[free] / joint.std[free]).max() < 0.1
    assert same or found.stages[-1].status == "not converged"


@pytest.mark.long
def test_masses_stay_positive(session, staged):
    """From masses in CAD that are far too large and uncertain, trials reduce them, but not below zero."""
    finger = replace(session.finger, mass=session.finger.mass * 3, mass_std=session.finger.mass * 3)
    fit = refine(replace(session, finger=finger), staged)
    assert np.all(np.asarray(fit.model.finger.mass) > 0)
    assert fit.stages[-1].status == "fitted"


def test_a_session_without_such_trials_is_refused(session, staged):
    with pytest.raises(UserError, match=r"has no trial of ID\.2"):
        refine(session.with_trials([]), staged)


def test_a_missing_stage_is_named_and_its_parameters_left_alone(session):
    partial = session.select("ID.2", "ID.4")
    fit = identify(partial, Recipe(fit=FitRecipe()))
    assert [s.status == "skipped" for s in fit.stages] == [False, True, True, False]
    assert "ID.3-static" in fit.stages[1].message
    assert not np.any(np.asarray(fit.model.joint_torque.friction))
