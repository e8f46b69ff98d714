"""What holds each parameter, beside refits."""

import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import identify
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.sensitivity import sensitivity


@pytest.fixture(scope="module")
def one_of_each(session):
    """Every second trial: of the repeats of a motion, one."""
    return session.with_trials([t.name for t in list(session)[::2]])


@pytest.fixture(scope="module")
def fit(one_of_each):
    return identify(one_of_each)


@pytest.fixture(scope="module")
def found(fit, one_of_each):
    return sensitivity(fit, one_of_each, to="trials")["trials"]


def test_what_a_fit_is_without_a_trial_is_said_without_a_refit(fit, found, one_of_each):
    """Of the trial that moves most of those that others stand in for."""
    shifts = found.shifts(fit)
    k = int(np.argmax(np.abs(np.nan_to_num(shifts, posinf=0.0)).max(axis=1)))
    rest = identify(one_of_each.with_trials([t.name for t in one_of_each if t.name != found.names[k]]))
    moved = np.asarray(ravel(rest.model) - ravel(fit.model))[fit.estimated] / fit.std[fit.estimated]
    seen = np.isfinite(shifts[k])
    assert np.abs(moved[seen]).max() > 0.5
    np.testing.assert_allclose(shifts[k][seen], moved[seen], atol=0.15 * np.abs(moved[seen]).max())


def test_what_one_trial_alone_tells_of_is_unknown_without_it(fit, found, one_of_each):
    """The only trial in which a joint moves slowly is all that says how the tendons pass it."""
    (trial,) = [t for t in one_of_each if t.experiment == "ID.2" and t.joint == "DIP"][:1]
    others = [t for t in one_of_each if t.experiment == "ID.2" and t.joint == "DIP" and t is not trial]
    session = one_of_each.with_trials([t.name for t in one_of_each if t not in others])
    alone = sensitivity(again := identify(session), session, to="trials")["trials"]
    shifts = alone.shifts(again)[alone.names.index(trial.name)]
    parameters = [describe(again.model)[i] for i in again.estimated]
    arms = np.array([p.group == "moment_arm" and p.joint == "DIP" for p in parameters])
    assert np.isinf(shifts[arms]).all()
    assert np.isfinite(shifts[~arms]).all()


def test_the_fit_of_other_trials_is_refused(fit, session):
    """Though they are repeats of the same motions."""
    with pytest.raises(UserError, match="give the session that it was made from"):
        sensitivity(fit, session.with_trials([t.name for t in list(session)[1::2]]), to="trials")
