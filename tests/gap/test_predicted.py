"""Predictions of another simulator that are a user's mistake are said to be one; those of a poor simulator are not."""

from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest

from jaxfinger.data.predictions import refuse_misfits
from jaxfinger.errors import UserError
from jaxfinger.gap import diagnose
from jaxfinger.gap.predicted import check_predictions, checked
from jaxfinger.identify.predictions import predict_session
from jaxfinger.model import Model
from jaxfinger.synthetic import paper_finger, polynomial_finger, recipe_from, simulate, true_model

from .conftest import TABLE

EXPERIMENTS = ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4", "VD.2", "VD.3"]
ALL = {**TABLE, "trials": {**TABLE["trials"], "experiments": EXPERIMENTS, "vd2": {"tendons": ["T2", "T3"]}}}


@pytest.fixture(scope="module")
def session():
    return replace(simulate(recipe_from(ALL), seed=4), file="s.h5")


@pytest.fixture(scope="module")
def truth():
    return true_model(polynomial_finger(paper_finger()))


@pytest.fixture(scope="module")
def predictions(session, truth):
    return predict_session(truth, session)


def changed(predictions, change, channel=None, trials=None):
    """Predictions with `change` applied to a channel, or to all, in some trials or in all."""
    return {
        name: {
            c: change(v) if c != "time" and channel in (None, c) and (trials is None or name in trials) else v
            for c, v in channels.items()
        }
        for name, channels in predictions.items()
    }


def names_of(session, experiment):
    return [t.name for t in session.select(experiment)]


def said(session, predictions, severity):
    return [x.sentence for x in check_predictions(session, predictions) if x.severity == severity]


def order(*columns):
    return lambda v: v[:, list(columns)]


def turned(column):
    return lambda v: np.where(np.arange(v.shape[1]) == column, -v, v)


@pytest.mark.parametrize(
    ("channel", "change", "says"),
    [
        ("joint_torque", lambda v: 0.0 * v, "predictions of MCP, PIP, DIP do not change while the measurements move"),
        ("tendon_excursion", lambda v: 0.0 * v + 1.0, "T4 do not change while the measurements move"),
        ("joint_torque", np.negative, "predictions of MCP, PIP, DIP have the opposite sign of the measurements; turn"),
        ("tendon_excursion", turned(1), "tendon_excursion: predictions of T2 have the opposite sign"),
        ("joint_torque", turned(2), "joint_torque: predictions of DIP have the opposite sign"),
        ("fingertip_force", np.negative, "fingertip_force: predictions of x, z have the opposite sign"),
        ("tendon_excursion", lambda v: 1e3 * v, "are about 1000 times as large as measured; give m, not mm"),
        ("tendon_excursion", lambda v: 1e-3 * v, "are about 1000 times as small as measured; give m, not mm"),
        ("joint_torque", lambda v: 1e3 * v, "are about 1000 times as large as measured; give N m, not N mm"),
        ("joint_torque", lambda v: np.rad2deg(v), "57 times as large as measured; give the simulator angles in rad"),
        ("tendon_excursion", lambda v: -1e3 * v, "opposite sign of the measurements and are about 1000 times as large"),
        ("fingertip_force", lambda v: 1e3 * v, "are about 1000 times as large as measured; give N, not mN"),
        ("fingertip_force", order(2, 1, 0), "look exchanged: the prediction of z is like the measured x"),
        ("tendon_excursion", order(1, 0, 2, 3, 4), "look exchanged: the prediction of T2 is like the measured T1"),
    ],
)  # fmt: skip
def test_a_mistake_is_refused_with_its_mend(session, predictions, channel, change, says):
    with pytest.raises(UserError, match=r"^p\.h5: /trials/") as refused:
        checked(session, changed(predictions, change, channel), "p.h5")
    assert says in str(refused.value)
    assert f"/{channel}: " in str(refused.value)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
@pytest.mark.parametrize("quantity", ["joint_torque", "tendon_excursion"])
def test_the_rule_has_no_size(session, predictions, scale, quantity):
    """A machine of any size, recorded right: the same predictions pass, and the same mistake is refused."""
    big = {
        t.name: replace(t, **{quantity: scale * getattr(t, quantity)})
        for t in session
        if getattr(t, quantity) is not None
    }
    big = replace(session, trials={**session.trials, **big})
    right = changed(predictions, lambda v: scale * v, quantity)
    assert not said(big, right, "warning")
    assert not said(big, right, "error")
    with pytest.raises(UserError, match="1000 times as large"):
        checked(big, changed(right, lambda v: 1e3 * v, quantity), "p.h5")


def test_all_trials_with_the_mistake_are_named(session, predictions):
    (sentence,) = said(session, changed(predictions, np.negative, "fingertip_force"), "error")
    first, *others = names_of(session, "VD.2")
    assert sentence.startswith(f"/trials/{first}/fingertip_force")
    assert all(name in sentence for name in others[:3])


def test_trials_that_are_exchanged_are_named(session, predictions):
    a, b = (next(t.name for t in session.select("VD.2") if t.tendon == tendon) for tendon in ("T2", "T3"))
    (sentence,) = said(session, {**predictions, a: predictions[b], b: predictions[a]}, "warning")
    assert f"look exchanged: those of {b} fit {a}, those of {a} fit {b}; exchange the trials, or what the" in sentence


def test_a_shift_in_time_is_a_warning_since_a_channel_may_be_late(session, predictions):
    def late(name):
        time = session[name].time
        return {
            c: v if c == "time" else np.stack([np.interp(time - 0.5, time, x) for x in v.T], axis=1)
            for c, v in predictions[name].items()
        }

    shifted = {name: late(name) if name in names_of(session, "ID.3-dynamic") else v for name, v in predictions.items()}
    assert not said(session, shifted, "error")
    (sentence,) = said(session, shifted, "warning")
    assert "come about 0.5 s too late; give them at the session's times, or go on if it is meant so" in sentence


def test_one_trial_of_one_column_may_be_meant(session, predictions):
    """A moment arm of the wrong sign turns the torque of one trial, and is for the diagnosis to find."""
    name = next(t.name for t in session.select("ID.4") if t.joint == "MCP")
    turned_once = changed(predictions, np.negative, "joint_torque", {name})
    assert not said(session, turned_once, "error")
    (sentence,) = said(session, turned_once, "warning")
    assert sentence.startswith(f"/trials/{name}/joint_torque: predictions of MCP have the opposite sign")


def test_motion_of_another_kind_is_a_warning(session, predictions):
    rng = np.random.default_rng(1)
    other = changed(
        predictions,
        lambda v: np.nanstd(v) * np.cumsum(rng.normal(size=v.shape), axis=0) / len(v) ** 0.5,
        "fingertip_force",
    )
    assert not said(session, other, "error")
    assert any("miss the measured motion by" in sentence for sentence in said(session, other, "warning"))


def test_the_torque_of_the_free_finger_is_not_given_as_zero(session, predictions):
    """It is zero in the measurements, so that a simulator that says so would be perfect."""
    name = names_of(session, "VD.3")[0]
    with pytest.raises(
        UserError, match=f"/trials/{name}/joint_torque: predictions are zero throughout; give the torque"
    ):
        checked(session, changed(predictions, lambda v: 0.0 * v, "joint_torque", {name}), "p.h5")


POOR = {
    "as it is": lambda m: m,
    "heavy": lambda m: eqx.tree_at(lambda m: m.finger.mass, m, 1.5 * m.finger.mass),
    "light": lambda m: eqx.tree_at(lambda m: m.finger.mass, m, 0.5 * m.finger.mass),
    "without friction": lambda m: eqx.tree_at(lambda m: m.joint_torque.friction, m, 0.0 * m.joint_torque.friction),
    "without damping": lambda m: eqx.tree_at(lambda m: m.joint_torque.damping, m, 0.0 * m.joint_torque.damping),
    "without friction of tendons": lambda m: eqx.tree_at(
        lambda m: (m.tendon_friction.constant, m.tendon_friction.proportional),
        m,
        (0.0 * m.tendon_friction.constant, 0.0 * m.tendon_friction.proportional),
    ),
    "without weight": lambda m: eqx.tree_at(lambda m: m.finger.gravity, m, 0.0 * m.finger.gravity),
    "stiff": lambda m: eqx.tree_at(lambda m: m.joint_torque.elastic, m, 2.0 * m.joint_torque.elastic),
    "other moment arms": lambda m: eqx.tree_at(
        lambda m: m.moment_arm.coefficients,
        m,
        m.moment_arm.coefficients * np.resize([0.8, 1.2], len(m.moment_arm.coefficients))[:, None],
    ),
}


@pytest.mark.parametrize("poor", POOR)
def test_a_poor_simulator_is_no_mistake(session, truth, poor):
    model: Model = POOR[poor](truth)
    assert list(check_predictions(session, predict_session(model, session))) == []


def test_zeros_of_sensors_are_arbitrary(session, predictions):
    assert list(check_predictions(session, changed(predictions, lambda v: v + 10.0 * np.nanmax(np.abs(v))))) == []


def test_stretch_at_held_joints_is_not_asked_for(session, predictions):
    held = {*names_of(session, "ID.4"), *names_of(session, "VD.2")}
    assert list(check_predictions(session, changed(predictions, lambda v: 0.0 * v, "tendon_excursion", held))) == []


def test_predictions_of_another_motion_are_refused_by_their_angles(session, predictions):
    """Of a session with the same names and lengths of trials; angles of VD.3 are predicted, and may be poor."""
    rng = np.random.default_rng(3)

    def with_angles(angles):
        return {n: channels | {"q": angles(session[n].q)} for n, channels in predictions.items()}

    assert list(check_predictions(session, with_angles(lambda q: q))) == []
    assert list(check_predictions(session, with_angles(lambda q: q + 1e-3 * rng.standard_normal(q.shape)))) == []
    for angles, experiment in ((np.flipud, "ID.3-dynamic"), (np.rad2deg, "ID.2"), (np.zeros_like, "ID.2")):
        sentence, *_ = said(session, with_angles(angles), "error")
        says = "q: predictions were made for another motion of MCP than the session's; predict this session, at its own"
        assert sentence.startswith(f"/trials/{names_of(session, experiment)[0]}/{says}")


# Coverage -------------------------------------------------------------------------------------------------------------
def test_how_many_trials_count_is_said(session, predictions):
    names = names_of(session, "ID.3-dynamic")
    recorded = len(session.select("ID.3-dynamic"))
    few = {name: predictions[name] for name in names[:2]}
    (sentence,) = said(session, few, "note")
    assert sentence == (
        f"2 of {len(session)} trials are predicted (2 of {recorded} ID.3-dynamic); the diagnosis rests on these alone"
    )
    assert said(session, predictions, "note") == []


def test_trials_that_the_session_lacks_are_said_to_be_passed_over(session, predictions):
    (sentence,) = said(session, {**predictions, "of another": next(iter(predictions.values()))}, "warning")
    assert "predictions of 1 trial that the session lacks (of another) are passed over" in sentence


def test_channels_that_are_not_judged_are_not_called_missing_trials(session):
    trial = next(iter(session.select("ID.3-dynamic")))
    with pytest.raises(UserError, match=rf"of {trial.name} \(ID.3-dynamic\) predict joint_torque"):
        diagnose(session, predictions={trial.name: {"time": trial.time, "q": trial.q}})


def test_the_column_of_another_joint_is_said(session, predictions):
    trial = next(t for t in session.select("ID.3-dynamic") if t.joint == "MCP")
    torque = predictions[trial.name]["joint_torque"][:, ::-1]
    torque = np.where([False, False, True], torque, np.nan)
    sentences = said(session, {**predictions, trial.name: {"time": trial.time, "joint_torque": torque}}, "warning")
    assert sentences == [
        f"/trials/{trial.name}/joint_torque: predictions are of DIP alone, and MCP was measured; predict MCP"
    ]


def test_steps_too_long_for_the_motion_are_said(session, predictions):
    trial = next(iter(session.select("ID.3-dynamic")))
    time = np.linspace(trial.time[0], trial.time[-1], int(trial.duration / 0.2))
    torque = predictions[trial.name]["joint_torque"]
    coarse = {"time": time, "joint_torque": torque[np.searchsorted(trial.time, time).clip(max=len(torque) - 1)]}
    assert any(
        "predictions come every 0.21 s" in x for x in said(session, {**predictions, trial.name: coarse}, "warning")
    )


def test_predictions_with_too_few_digits_are_said(session, predictions):
    """Steps of 1 mm, a hundred times the noise of the encoder; those of 1 nm do not matter."""
    coarse = changed(predictions, lambda v: np.round(v, 3), "tendon_excursion")
    assert any(
        "come in steps of 0.001 m, longer than the sensor's noise; write" in x for x in said(session, coarse, "warning")
    )
    assert list(check_predictions(session, changed(predictions, lambda v: np.round(v, 9)))) == []
    assert list(check_predictions(session, changed(predictions, lambda v: v.astype(np.float32).astype(float)))) == []


@pytest.mark.parametrize(
    ("gear", "severity", "says"),
    [
        (5.0, "warning", "predictions of MCP miss the measured motion by 4 times its own size"),
        (50.0, "error", "are about 50 times as large as measured; look at units and gear ratios"),
        (0.02, "warning", "are about 50 times as small as measured; look at units and gear ratios, or go on"),
    ],
)
def test_a_gear_may_be_in_between(session, predictions, gear, severity, says):
    """No unit has its ratio. A simulator that lacks nearly all of a torque may give a small one."""
    sentences = said(session, changed(predictions, lambda v: gear * v, "joint_torque"), severity)
    assert any(says in sentence for sentence in sentences)


@pytest.mark.parametrize(("value", "word"), [(np.inf, "infinite"), (np.nan, "NaN")])
def test_what_is_no_number_is_called_by_its_name(session, predictions, value, word):
    name = names_of(session, "ID.3-dynamic")[0]
    bad = changed(predictions, lambda v: np.where(np.arange(len(v))[:, None] < 9, value, v), trials={name})
    with pytest.raises(UserError, match=f"is {word} in 9 of"):
        refuse_misfits(session, bad)


def test_a_simulation_that_ran_away_is_not_taken_for_a_missing_one(session, predictions):
    with pytest.raises(UserError, match="is infinite in"):
        refuse_misfits(session, changed(predictions, lambda v: v + np.inf, "joint_torque"))
