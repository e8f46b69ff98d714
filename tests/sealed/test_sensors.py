"""Noise, quantisation and what an experiment does not measure."""

import numpy as np
import pytest

from jaxfinger.sealed.record import commanded, record
from jaxfinger.sealed.sensors import CORRELATION, RESOLUTION, WHITE, measure, noise


def test_noise_has_the_stated_variance_and_correlation():
    x = noise((200_000, 1), 1e-3, 2.0, np.random.default_rng(0))[:, 0]
    assert x.std() == pytest.approx(2.0, rel=0.02)
    lag = 12
    assert np.mean(x[:-lag] * x[lag:]) / 4.0 == pytest.approx((1 - WHITE) * np.exp(-lag * 1e-3 / CORRELATION), abs=0.02)


def test_a_holds_mean_scatters_as_stated(sensors):
    means = noise((250, 4000), 1 / 250, sensors.std["q"], np.random.default_rng(1)).mean(axis=0)
    assert means.std() == pytest.approx(sensors.hold_std("q", 1.0, 250.0), rel=0.05)


def test_measured_trial_of_the_nominal_plant_is_truth_plus_noise(specimen, nominal, plans, sensors):
    rng = np.random.default_rng(2)
    for plan in (p for p in plans if p.experiment == "ID.4"):
        truth = record(nominal, plan, commanded(plan))
        trial = measure(truth, specimen, sensors, np.zeros(nominal.n), rng)
        error = trial.joint_torque[:, plan.joint] - truth.torque[:, plan.joint]
        assert error.std() == pytest.approx(sensors.std["joint_torque"], rel=0.1)
        assert abs(error.mean()) < 5 * sensors.hold_std("joint_torque", plan.duration)
        others = np.arange(nominal.m) != plan.joint
        assert np.all(np.isnan(trial.joint_torque[:, others]))
        assert np.all(np.isnan(trial.tendon_excursion[:, np.arange(nominal.n) != plan.tendon]))
        steps = trial.q[:, 0].astype(float) / RESOLUTION["q"]
        assert np.abs(steps - np.round(steps)).max() < 1e-2
        assert np.all(np.diff(trial.time) > 0)
        assert set(np.unique(trial.hold)) == {-1, *range(len(plan.holds))}
        assert set(np.unique(trial.tendon_direction[trial.hold >= 0, plan.tendon])) == {-1, 1}


def test_id2_lies_in_the_nominal_class(specimen, nominal, plans, sensors):
    """A polynomial of fourth order and one offset fit the excursion to its noise, and block means to theirs."""
    plan = next(p for p in plans if p.experiment == "ID.2")
    trial = measure(
        record(nominal, plan, commanded(plan)), specimen, sensors, np.zeros(nominal.n), np.random.default_rng(3)
    )
    basis = trial.q[:, [plan.joint]].astype(float) ** np.arange(5)
    for k in np.flatnonzero(specimen.finger.crosses[:, plan.joint] & specimen.finger.active):
        y = trial.tendon_excursion[:, k].astype(float)
        rest = y - basis @ np.linalg.lstsq(basis, y, rcond=None)[0]
        assert rest.std() == pytest.approx(sensors.std["tendon_excursion"], rel=0.08)
        blocks = rest[: len(rest) // 100 * 100].reshape(-1, 100).mean(axis=1)
        assert blocks.std() == pytest.approx(sensors.hold_std("tendon_excursion", 0.4), rel=0.4)
