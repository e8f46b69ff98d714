"""What no stage determines has no interval, nor has what rests on it; columns that never change are not read."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import compress, fit_many, identify, load_fit, refine, save_fit, sensitivity
from jaxfinger.identify.parameters import describe
from jaxfinger.identify.recipe import PAPER, FitRecipe, ModelRecipe, Recipe
from jaxfinger.identify.validate import validate


def std_of(fit, group, *where):
    """Standard deviations of the estimated parameters of a group, of a joint or tendon if one is named."""
    parameters = describe(fit.model)
    mine = [parameters[i] for i in fit.estimated]
    chosen = [p.group == group and (not where or {p.joint, p.tendon} & set(where)) for p in mine]
    return fit.std[fit.estimated][np.array(chosen, bool)]


def warnings_of(fit):
    return [w for s in fit.stages for w in (s.message, *s.warnings) if w]


@pytest.fixture(scope="module")
def without_torque(session):
    return session.select("ID.2", "ID.4")


@pytest.fixture(scope="module")
def partial(without_torque):
    return identify(without_torque)


def changed(session, channel, how, *experiments, **where):
    """Session with a channel of some trials changed."""
    chosen = session.select(*experiments, **where).trials
    new = {n: replace(t, **{channel: how(getattr(t, channel))}) for n, t in chosen.items()}
    return replace(session, trials={**session.trials, **new})


def test_what_rests_on_an_unknown_law_has_no_interval(partial, tmp_path):
    """Without ID.3 the friction of tendons absorbs the joints' elastic torque, which is taken as zero."""
    assert np.isinf(std_of(partial, "tendon_friction")).all()
    assert np.isfinite(std_of(partial, "moment_arm")).all()
    assert any("has no interval (± ?)" in w for w in warnings_of(partial))
    save_fit(partial, tmp_path / "fit.json")
    np.testing.assert_array_equal(load_fit(tmp_path / "fit.json").covariance, partial.covariance)


def test_a_law_that_the_recipe_leaves_out_is_zero_and_not_unknown(without_torque):
    terms = tuple(t for t in PAPER if t != "joint_elastic")
    fit = identify(without_torque, Recipe(model=ModelRecipe(terms=terms)))
    assert np.isfinite(std_of(fit, "tendon_friction")).all()


def test_the_joint_fit_finds_what_the_stage_could_not(partial, without_torque):
    """It estimates the torque at the held postures too, as far as ID.4 shows it."""
    assert np.isfinite(std_of(refine(without_torque, partial), "tendon_friction")).any()


@pytest.mark.parametrize("value", [0.0, 0.3])
def test_a_column_that_never_changes_is_named_and_not_read(session, value):
    joint = session.finger.joint_names[0]
    dead = changed(session, "joint_torque", lambda x: 0 * x + value, "ID.3-static", "ID.3-dynamic", joint=joint)
    fit = identify(dead)
    assert np.isinf(std_of(fit, "elastic", joint)).all()
    assert np.isfinite(std_of(fit, "elastic", session.finger.joint_names[1])).all()
    assert any(f"joint_torque {joint} is {value:g} at every sample of" in w for w in warnings_of(fit))


def test_a_stuck_encoder_is_no_moment_arm_of_zero(session):
    dead = changed(session, "tendon_excursion", lambda x: np.where(np.arange(x.shape[1]) == 0, 0.01, x), "ID.2")
    first, second = session.finger.tendon_names[:2]
    fit = identify(dead, stages=("ID.2",))
    assert np.isinf(std_of(fit, "moment_arm", first)).all()
    assert np.isfinite(std_of(fit, "moment_arm", second)).all()


def test_validation_says_which_column_never_changes(short, short_truth):
    dead = changed(short, "tendon_excursion", lambda x: 0 * x, "VD.1")
    result = validate(short_truth, dead, ("VD.1",))
    assert any("tendon_excursion T1, T2, T3, T4 are 0 at every sample" in m for m in result.messages)
    assert not [s for s in result.scores if s.channel == "tendon_excursion" and not s.method.startswith("∫")]


def test_an_angle_that_is_missing_is_named_with_its_trial(session):
    lost = changed(session, "q", lambda q: np.where(np.arange(len(q))[:, None] == 7, np.nan, q), "ID.4")
    name = session.select("ID.4").table().column("trial")[0]
    with pytest.raises(UserError, match=f"trial {name}: q is not finite at 1 sample"):
        identify(lost)


@pytest.mark.parametrize("study", [compress, lambda session, fit: sensitivity(fit, session)])
def test_a_study_of_a_fit_needs_the_trials_of_its_stages(session, staged, study):
    """Else the parameters of the stage that is missing would depend on nothing."""
    with pytest.raises(UserError, match=r"has no ID\.4 trial, and the fit was made from some"):
        study(session.select("ID.2", "ID.3-static", "ID.3-dynamic"), staged)
    nothing = identify(session.select("VD.1"))
    with pytest.raises(UserError, match="no stage of the fit was fitted"):
        study(session, nothing)


@pytest.mark.long
def test_members_have_no_interval_where_the_template_has_none(session):
    joint = session.finger.joint_names[-1]
    nothing = changed(session, "joint_torque", lambda x: np.nan * x, "ID.3-static", "ID.3-dynamic", joint=joint)
    template = identify(nothing, Recipe(fit=FitRecipe(stages=("ID.2", "ID.3-static", "ID.3-dynamic"))))
    members = fit_many([nothing], template, nothing)
    free = template.estimated
    assert not members.failed.any()
    assert np.isinf(std_of(template, "elastic", joint)).all()
    np.testing.assert_array_equal(np.isinf(members.std[0][free]), np.isinf(template.std[free]))


def test_sessions_in_memory_are_told_apart_by_their_trials(session, staged):
    assert staged.was_made_from(session)
    assert staged.was_made_from(session.select("ID.4"))
    other = changed(session, "q", lambda q: q + 1e-6)
    assert not staged.was_made_from(other)
    both = staged.made_from(other)
    assert both.was_made_from(other)
    assert both.was_made_from(session)
    assert both.made_from(other) is both
