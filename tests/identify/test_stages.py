"""A stage that no sample informs says so, and estimates nothing."""

from jaxfinger.data import Session
from jaxfinger.identify import identify
from tests.experiments.test_prepare import FINGER, ramps


def test_a_stage_of_which_nothing_counts_is_skipped_and_says_why():
    trial = ramps(0.1)
    fit = identify(Session("a finger", FINGER, {trial.name: trial}), stages=("ID.4",))
    (report,) = fit.stages
    assert report.status == "skipped"
    assert "no sample of joint_torque counts: no tendon is pulled" in report.message
    assert not fit.estimated.size
