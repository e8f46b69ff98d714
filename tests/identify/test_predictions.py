"""Predictions at every sample, against the channels of a specimen that shares no code with the model."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import read_predictions, write_predictions
from jaxfinger.data.predictions import refuse_misfits
from jaxfinger.errors import UserError
from jaxfinger.identify.predictions import model_for, predict_session
from jaxfinger.synthetic import recipe_from

NOISE = recipe_from({}).sensors
CHANNELS = {
    "ID.2": {"tendon_excursion"},
    "ID.3-static": {"joint_torque"},
    "ID.3-dynamic": {"joint_torque"},
    "ID.4": {"joint_torque", "tendon_excursion"},
    "VD.1": {"tendon_excursion"},
    "VD.2": {"fingertip_force", "tendon_excursion"},
    "VD.3": {"q", "tendon_excursion", "joint_torque"},
}


@pytest.fixture(scope="module")
def predicted(short_truth, short):
    return predict_session(short_truth, short)


def test_every_trial_has_the_channels_and_shapes_of_the_format(predicted, short, tmp_path):
    assert list(predicted) == list(short.trials)
    for trial in short:
        assert predicted[trial.name].keys() == CHANNELS[trial.experiment]
    write_predictions(tmp_path / "p.h5", short, predicted)  # refuses any other shape
    read = read_predictions(tmp_path / "p.h5")
    for name, channels in predicted.items():
        for channel, values in channels.items():
            np.testing.assert_array_equal(read[name][channel], values)


@pytest.mark.parametrize("experiment", [e for e in CHANNELS if e != "VD.3"])
def test_the_truth_predicts_to_the_noise(predicted, short, experiment):
    for trial in short.select(experiment):
        for channel in CHANNELS[experiment]:
            measured = getattr(trial, channel)
            error = measured - predicted[trial.name][channel]
            if channel == "tendon_excursion":
                error = error - np.ma.median(np.ma.masked_invalid(error), axis=0).filled(0.0)
            counts = np.isfinite(error)
            assert (counts == np.isfinite(measured)).all()
            # The instant of a reversal is not known to a sample, so that a tenth of the samples may be wrong.
            limit = 4.5 * getattr(NOISE, channel).std + getattr(NOISE, channel).resolution
            share = np.mean(np.abs(error[counts]) < limit)
            assert share > (0.9 if experiment == "ID.3-dynamic" else 0.97), (trial.name, channel)


def test_the_torque_that_a_free_finger_lacks_keeps_little_of_the_noise_of_tension(predicted, short_truth, short):
    """No measured torque stands beside it. Its cut-off of 10 Hz lets a fifth of the noise below 250 Hz pass."""
    (name,) = (t.name for t in short.select("VD.3"))
    trial = short[name]
    noise = 0.02 * np.random.default_rng(3).standard_normal(trial.tendon_force.shape)
    taut = trial.tendon_force > 1.0
    noisy = replace(trial, tendon_force=trial.tendon_force + noise * taut)
    session = replace(short, trials={**short.trials, name: noisy})
    change = predict_session(short_truth, session, [name])[name]["joint_torque"] - predicted[name]["joint_torque"]
    C = np.asarray(short_truth.model.moment_arm.coupling(trial.q.T))
    unfiltered = 0.02 * np.sqrt(np.sum(np.square(C) * taut.T[:, None], axis=0)).T
    assert np.sqrt(np.mean(change**2)) < 0.3 * np.sqrt(np.mean(unfiltered**2))


def test_tension_at_a_hold_does_not_creep_up_with_the_noise(predicted, short):
    for trial in short.select("ID.4"):
        error = (trial.joint_torque - predicted[trial.name]["joint_torque"])[trial.hold >= 0]
        error = error[np.isfinite(error)]
        assert abs(error.mean()) < 1e-4  # N m: a hundredth of the torque, a third of the noise of one sample


def test_what_the_rig_does_not_measure_stays_nan(predicted, short):
    finger = short.finger
    for trial in short:
        torque = predicted[trial.name].get("joint_torque")
        if torque is not None and trial.experiment != "VD.3":
            others = [i for i, name in enumerate(finger.joint_names) if name != trial.joint]
            assert np.isnan(torque[:, others]).all()
        excursion = predicted[trial.name].get("tendon_excursion")
        if excursion is not None:
            assert np.isnan(excursion[:, ~finger.active]).all()
            assert np.isfinite(excursion[:, finger.active]).all()


def test_a_torque_that_was_not_recorded_is_predicted_at_the_trial_s_joint(short_truth, short, predicted):
    trial = next(iter(short.select("ID.4")))
    blind = replace(short, trials={trial.name: replace(trial, joint_torque=None)})
    np.testing.assert_array_equal(
        predict_session(short_truth, blind)[trial.name]["joint_torque"], predicted[trial.name]["joint_torque"]
    )


def test_simulation_starts_at_the_first_sample_and_stays_near(predicted, short):
    for trial in short.select("VD.3"):
        error = np.abs(trial.q - predicted[trial.name]["q"])
        assert error[0].max() < 2e-3
        assert np.degrees(error.max()) < 6.0


def test_gravity_is_the_session_s(short_truth, short):
    trial = next(iter(short.select("ID.3-static", joint="MCP")))
    turned = replace(short.finger, gravity=-short.finger.gravity)
    up, down = (
        predict_session(short_truth, replace(short, finger=f, trials={trial.name: trial}))[trial.name]
        for f in (short.finger, turned)
    )
    difference = (up["joint_torque"] - down["joint_torque"])[:, 0]
    assert 2e-3 < np.abs(difference).max() < 5e-2


def test_a_trial_of_one_sample_is_left_out(short_truth, short):
    trial = next(iter(short.select("ID.2")))
    cut = replace(trial, time=trial.time[:1], q=trial.q[:1], tendon_force=None, tendon_excursion=None)
    other = next(iter(short.select("VD.1")))
    cut_session = replace(short, trials={cut.name: cut, other.name: other})
    assert list(predict_session(short_truth, cut_session)) == [other.name]


def test_another_finger_is_refused(short_truth, short):
    finger = replace(short.finger, joint_names=("MCP", "PIP", "thumb"))
    with pytest.raises(UserError, match="has MCP, PIP, thumb where the fit has MCP, PIP, DIP"):
        predict_session(short_truth, replace(short, finger=finger))


def late(time):
    return time + 0.5 * (time[-1] - time[0])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda time, y: {"time": late(time)}, "/trials/{name}: run from"),
        (lambda time, y: {"time": time[::-1]}, "/trials/{name}: have times that do not rise"),
        (lambda time, y: {"joint_torque": y[:-5]}, "/trials/{name}/joint_torque: has shape"),
        (lambda time, y: {"joint_torque": y[:, :1]}, "/trials/{name}/joint_torque: has shape"),
        (
            lambda time, y: {"joint_torque": np.where(np.arange(len(y))[:, None] < 9, np.nan, y)},
            "/trials/{name}/joint_torque: is NaN in 9 of",
        ),
    ],
)
def test_predictions_that_do_not_fit_a_trial_are_refused(change, says, predicted, short):
    trial = next(iter(short.select("ID.3-static")))
    mine = {**predicted, trial.name: predicted[trial.name] | change(trial.time, predicted[trial.name]["joint_torque"])}
    with pytest.raises(UserError, match=says.format(name=trial.name)):
        refuse_misfits(short, mine)


def test_predictions_that_fit_are_not_refused(predicted, short):
    """A model's own, those of other trials beside them, and those on times of the simulator's own."""
    refuse_misfits(short, {**predicted, "of another session": {"joint_torque": np.zeros(3)}})
    trial = next(iter(short.select("ID.3-static")))
    time = np.linspace(trial.time[0] + 1e-4, trial.time[-1] - 1e-4, 57)
    refuse_misfits(short, {trial.name: {"time": time, "joint_torque": np.zeros((57, short.finger.m))}})


def changed(finger, **entries):
    """The finger with other entries: {field: (index, value)}."""
    out = {}
    for field, (index, value) in entries.items():
        out[field] = np.array(getattr(finger, field))
        out[field][index] = value
        if isinstance(getattr(finger, field), tuple):
            out[field] = tuple(out[field].tolist())
    return replace(finger, **out)


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ({"origin": ((2, 0), 0.06)}, "joint DIP is elsewhere than in the fit"),
        ({"axis": (1, (0.0, 0.0, 1.0))}, "joint PIP has another axis than in the fit"),
        ({"axis": (1, (0.0, -1.0, 0.0))}, "joint PIP has another axis than in the fit"),
        ({"prismatic": (0, True)}, "joint MCP is of another type than in the fit"),
        ({"crosses": ((2, 1), True)}, "tendon T3 crosses joint PIP, other than in the fit"),
    ],
)
def test_another_finger_with_the_same_names_is_refused(short_truth, short, entries, says):
    with pytest.raises(UserError, match=says):
        model_for(short_truth, replace(short, finger=changed(short.finger, **entries)))


@pytest.mark.parametrize(
    "entries",
    [
        {"origin": ((2, 0), 0.026)},  # CAD and ruler disagree by a few per cent
        {"origin": (0, (0.1, 0.2, 0.3))},  # mounted elsewhere
        {"mass": (0, 0.1), "com": ((0, 0), 0.02), "limits": ((0, 1), 1.0)},  # weighed anew, and other stops
        {"gravity": (slice(None), (0.0, 9.81, 0.0))},
        {"active": (1, False)},  # not measured this time
    ],
)
def test_the_same_finger_described_anew_is_not(short_truth, short, entries):
    model_for(short_truth, replace(short, finger=changed(short.finger, **entries)))
