"""Terms on which a stage rests although no stage has fitted them."""

import numpy as np
import pytest

from jaxfinger.data import Session
from jaxfinger.experiments import EXPERIMENTS
from jaxfinger.identify import identify
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.trial_coverage import Coverage, name_missing, name_unfitted
from jaxfinger.synthetic import study_finger, true_model

MODEL = true_model(study_finger(2))
PARAMETERS, VALUES = describe(MODEL), np.asarray(ravel(MODEL))
NEEDED = np.flatnonzero([p.group in ("elastic", "moment_arm") for p in PARAMETERS])
PULL = Coverage({"J1"}, set(), {"T1"}, [])


@pytest.mark.parametrize(
    ("group", "said"), [("elastic", "ID.3-static of joint J1"), ("moment_arm", "ID.2 of joint J1")]
)
def test_a_law_at_zero_that_no_stage_has_fitted_is_named_with_the_trial_that_shows_it(group, said):
    values = np.where([p.group == group for p in PARAMETERS], 0.0, VALUES)
    (sentence,) = name_missing(PARAMETERS, values, np.zeros(0, int), NEEDED, PULL)
    assert "at zero" not in sentence
    assert "taken as zero" in sentence
    assert f"record {said}" in sentence
    assert "J2" not in sentence


def test_laws_that_are_fitted_or_given_are_not_named():
    assert not name_missing(PARAMETERS, VALUES, np.zeros(0, int), NEEDED, PULL)
    assert not name_missing(PARAMETERS, 0.0 * VALUES, NEEDED, NEEDED, PULL)


def test_tendon_friction_without_the_joints_torque_says_what_it_rests_on(session, staged):
    """ID.4 reads the elastic torque of the joint that holds; without ID.3 the estimates of friction absorb it."""
    assert not any("taken as zero" in w for s in staged.stages for w in s.warnings)
    without: Session = session.select("ID.2", "ID.4")
    said = identify(without, staged.recipe).stages[-1].warnings
    held = {t.joint for t in session if EXPERIMENTS[t.experiment].held}
    assert {w.split(" is taken as zero")[0] for w in said} >= {f"the elastic torque of joint {j}" for j in held}


def test_laws_that_no_trial_showed_are_named_where_predictions_take_them_as_zero():
    groups = {"moment_arm", "elastic", "tendon_friction"}
    no_arms = np.where([p.group == "moment_arm" for p in PARAMETERS], 0.0, VALUES)
    (sentence,) = name_unfitted(PARAMETERS, no_arms, np.zeros(0, int), groups)
    assert sentence.startswith("no trial of the fit showed the moment arms of T1")
    assert "elastic" not in sentence
    fitted = np.flatnonzero([p.group == "moment_arm" for p in PARAMETERS])
    assert not name_unfitted(PARAMETERS, no_arms, fitted, groups)
    assert not name_unfitted(PARAMETERS, no_arms, np.zeros(0, int), {"elastic"})
