"""Coarse converters, and slow experiments that are quick: intervals hold the truth."""

import numpy as np
import pytest

from jaxfinger.data import quantisation
from jaxfinger.data.signals.sizes import sizes_of
from jaxfinger.identify import identify
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.synthetic import (
    SHORT,
    SpecimenPlant,
    clean_session,
    measure,
    recipe_from,
    study_finger,
    true_model,
)

QUICK = {"rate": 1000.0, "id2": {"strokes": 2, "stroke_time": 0.3}, "id3_static": {"move": 0.08, "dwell": 0.12}}


def sessions(count, trials=(), sensors=()):
    """Sessions of a finger with one joint, and the true flat vector."""
    specimen = study_finger()
    recipe = recipe_from({"trials": {**SHORT, **dict(trials)}, "sensors": dict(sensors)})
    clean = clean_session(recipe, SpecimenPlant(specimen), specimen.description)
    return [measure(clean, seed) for seed in range(count)], np.asarray(ravel(true_model(specimen)))


def misses(session, truth):
    """Errors of the estimates in their standard deviations, by group."""
    fit = identify(session)
    z = (np.asarray(ravel(fit.model)) - truth)[fit.estimated] / fit.std[fit.estimated]
    return np.array([describe(fit.model)[i].group for i in fit.estimated]), z


@pytest.mark.parametrize(("noise", "expected"), [(0.0, 1.0), (0.1, 0.82), (0.25, 0.29), (1.0, 0.0)])
def test_noise_dithers_a_converter(noise, expected):
    """At σ = δ/10 the mean of readings at places all over a step is off by 0.82 of δ/√12, at δ/4 by 0.29."""
    rng = np.random.default_rng(0)
    places = np.repeat(rng.uniform(0.0, 50.0, 1000), 300)
    error, duration = quantisation(2.0 * np.round(places + noise * rng.standard_normal(places.size)))
    assert error * np.sqrt(3.0) == pytest.approx(expected, abs=0.07)
    assert duration == pytest.approx(300.0, rel=0.1) if not noise else duration < 300.0


def test_a_column_without_readings_has_no_converter():
    assert quantisation(np.full(5, np.nan)) == (0.0, 1.0)
    assert quantisation(np.full(50, 3.0))[0] == 0.0


def test_slow_experiments_may_be_quick_though_the_sweeps_are_not():
    (session,), _ = sessions(1, QUICK)
    found = sizes_of(session)
    assert found.pace == 1.0
    assert found.slow_pace < 0.25
    assert sizes_of(session.select("ID.2")).slow_pace < 0.25


@pytest.mark.long
def test_quick_strokes_do_not_bend_the_moment_arms():
    z = [misses(s, truth) for many, truth in [sessions(8, QUICK)] for s in many]
    arms = np.concatenate([v[g == "moment_arm"] for g, v in z])
    assert np.sqrt(np.mean(arms**2)) < 1.5


@pytest.mark.long
@pytest.mark.parametrize(
    ("channel", "resolution"), [("joint_torque", 1e-3), ("tendon_excursion", 1e-4), ("tendon_excursion", 5e-4)]
)
def test_intervals_hold_the_truth_of_a_coarse_converter_without_noise(channel, resolution):
    """Its readings do not change within a hold, nor between repeats, so that these show no noise."""
    sensor = {"std": 0.0, "resolution": resolution, "offset": 2e-4 if channel == "tendon_excursion" else 0.0}
    z = [misses(s, truth)[1] for many, truth in [sessions(8, (), {channel: sensor})] for s in many]
    assert np.mean(np.abs(np.concatenate(z)) < 1.96) > 0.9
