"""Sensors: noise of the stated size and colour, converter steps, spikes, CAD errors, missing columns."""

import numpy as np
import pytest

from jaxfinger.synthetic import paper_finger, recipe_from, session_plan
from jaxfinger.synthetic.recipe import Cad, Sensor, Sensors
from jaxfinger.synthetic.sensors import coloured_noise, drawn_from_cad, record

DESCRIPTION = paper_finger().description
TRIALS = recipe_from({"trials": {"rate": 1000.0, "id4": {"dwell": 0.3}}}).trials
PLANS = {p.experiment: p for p in session_plan(DESCRIPTION, TRIALS)}


def _clean(plan):
    n = plan.time.size
    return {
        "q": plan.q,
        "tendon_force": plan.tension,
        "tendon_excursion": np.zeros((5, n)),
        "joint_torque": np.zeros((3, n)),
        "fingertip_force": np.zeros((3, n)),
    }


def _record(experiment, sensors=None, seed=0):
    plan = PLANS[experiment]
    return record(plan, _clean(plan), DESCRIPTION, sensors or Sensors(), np.random.default_rng(seed))


@pytest.mark.parametrize(("coloured", "dt"), [(0.0, 1e-3), (0.4, 1e-3), (0.4, 4e-3), (1.0, 1e-3)])
def test_noise_has_its_variance_and_correlation_at_any_rate(coloured, dt):
    channel = Sensor(2.0, 1e-3, coloured, correlation_time=0.03)
    x = coloured_noise(channel, (400_000, 2), dt, np.random.default_rng(1))
    assert x.std(axis=0) == pytest.approx(2.0, rel=0.03)
    assert np.corrcoef(x.T)[0, 1] == pytest.approx(0.0, abs=0.03)
    for lag in (1, 10, 100):
        expected = coloured * np.exp(-lag * dt / 0.03)
        assert np.mean(x[lag:] * x[:-lag]) / 4.0 == pytest.approx(expected, abs=0.03)


def test_noise_starts_stationary():
    channel = Sensor(1.0, 1e-3, coloured=1.0, correlation_time=0.03)
    x = coloured_noise(channel, (5, 40_000), 1e-3, np.random.default_rng(2))
    assert x.std(axis=1) == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize(
    ("experiment", "channel", "std"),
    [("ID.4", "q", 2e-4), ("ID.3-static", "tendon_force", 0.03), ("ID.4", "tendon_excursion", 1e-5)],
)
def test_readings_are_converter_steps_with_the_stated_noise(experiment, channel, std):
    trial, sensor = _record(experiment), getattr(Sensors(), channel)
    x = getattr(trial, channel)
    x = x[:, np.isfinite(x).all(axis=0)]
    steps = x / sensor.resolution
    assert np.abs(steps - np.round(steps)).max() < 2e-3  # stored in single precision
    clean = x.mean(axis=0)
    assert (x - clean).std(axis=0) == pytest.approx(np.hypot(std, sensor.resolution / np.sqrt(12)), rel=0.1)


def test_sensors_have_the_resolution_of_the_papers_parts():
    s = Sensors()
    assert 2 * np.pi / s.q.resolution == pytest.approx(2**14)  # AA5048B
    assert 200 / s.tendon_force.resolution == pytest.approx(2**12)  # EL3008 over ±100 N


def test_only_what_the_rig_measures_is_recorded():
    active, pulled = DESCRIPTION.active, np.arange(5) == PLANS["ID.4"].tendon
    id4, id2, id3 = (_record(e) for e in ("ID.4", "ID.2", "ID.3-static"))
    for trial in (id4, id2, id3):
        assert np.array_equal(np.isfinite(trial.tendon_force).all(axis=0), active)
        assert np.isnan(trial.tendon_force[:, ~active]).all()
    assert np.array_equal(np.isfinite(id4.tendon_excursion).all(axis=0), pulled)
    assert np.array_equal(np.isfinite(id2.tendon_excursion).all(axis=0), active)
    assert np.array_equal(np.isfinite(id3.joint_torque).all(axis=0), np.arange(3) == PLANS["ID.3-static"].joint)
    assert (id4.joint, id4.tendon, id2.tendon) == ("MCP", "T4", None)


def test_spikes_are_as_many_and_as_large_as_asked():
    x = _record("ID.3-static", Sensors(outliers=0.03)).tendon_force[:, :4]
    spikes = np.abs(x) > 0.03 * 9
    assert spikes.mean() == pytest.approx(0.03, abs=0.003)
    assert np.abs(x).max() < 0.03 * 56
    assert not (np.abs(_record("ID.3-static").tendon_force[:, :4]) > 0.03 * 9).any()


def test_offsets_are_constant_within_a_trial_and_differ_between_trials():
    sensors = Sensors(tendon_excursion=Sensor(0.0, 1e-9, offset=2e-4))
    offsets = []
    for seed in range(60):
        x = _record("VD.1", sensors, seed).tendon_excursion[:, :4]
        assert np.ptp(x, axis=0).max() < 2e-9
        offsets.append(x[0])
    assert np.std(offsets) == pytest.approx(2e-4, rel=0.15)


def test_clock_runs_forward_from_zero():
    time = _record("VD.1", Sensors(clock_jitter=1e-2)).time
    assert time[0] == 0.0
    assert (np.diff(time) > 0).all()


def test_cad_is_off_by_what_it_says():
    drawn = [drawn_from_cad(DESCRIPTION, Cad(0.02, 3e-4), np.random.default_rng(k)) for k in range(500)]
    z = np.array([(d.mass - DESCRIPTION.mass) / d.mass_std for d in drawn])
    assert z.std() == pytest.approx(1.0, abs=0.08)
    z = np.array([(d.com - DESCRIPTION.com) / d.com_std for d in drawn])
    assert z.std() == pytest.approx(1.0, abs=0.08)
    exact = drawn_from_cad(DESCRIPTION, Cad(), np.random.default_rng(0))
    assert exact.mass_std is None
    assert exact.com_std is None
    assert np.array_equal(exact.mass, DESCRIPTION.mass)
