"""Validation: the truth scores at the noise floor, errors of known size are found, missing trials are named."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify.excursion_path import excursion_path
from jaxfinger.identify.validate import validate
from jaxfinger.model import Model


@pytest.fixture(scope="module")
def scored(short_truth, short):
    return validate(short_truth, short)


def pick(result, experiment, channel, method=""):
    return [s for s in result.scores if (s.experiment, s.channel) == (experiment, channel) and method in s.method]


def test_every_validation_experiment_and_channel_is_scored(scored, short):
    finger = short.finger
    active = [t for t, a in zip(finger.tendon_names, finger.active, strict=True) if a]
    assert [s.column for s in pick(scored, "VD.1", "tendon_excursion", "f(q)")] == active
    assert [s.column for s in pick(scored, "VD.1", "tendon_excursion", "∫")] == active
    assert [s.column for s in pick(scored, "VD.2", "fingertip_force")] == ["x", "y", "z"]
    for method in ("from the first sample", *(f"{ms} ms ahead" for ms in (50, 100, 200, 500))):
        assert [s.column for s in pick(scored, "VD.3", "q", method)] == list(finger.joint_names)
    assert scored.messages == ()


def test_the_truth_is_at_the_noise_floor(scored):
    for s in scored.scores:
        if s.channel in ("tendon_excursion", "fingertip_force") and "∫" not in s.method and s.experiment != "VD.3":
            # Forces also carry the noise of the tension, at its own hold and through friction at earlier ones.
            assert 0.6 < s.rms / s.noise < 1.5, s


def test_a_moment_ahead_the_truth_departs_by_the_noise_of_the_sensors(scored):
    """Sticking is included. Joints are averaged, since a single one slips only a few times in two seconds."""
    for ms in (50, 100, 200, 500):
        joints = pick(scored, "VD.3", "q", f"{ms} ms ahead")
        departs, noise = (np.mean([getattr(s, x) ** 2 for s in joints]) ** 0.5 for x in ("rms", "noise"))
        assert 0.5 < departs / noise < 1.75, joints
    errors = [np.mean([s.rms for s in pick(scored, "VD.3", "q", f"{ms} ms ahead")]) for ms in (50, 500)]
    assert errors[0] < errors[1]
    (share,) = {s.method for s in pick(scored, "VD.3", "joint_torque")}
    assert "% of the samples" in share


@pytest.mark.long
def test_a_weak_spring_shows_a_moment_ahead(short_truth, scored, short):
    """Errors grow with a threefold elastic torque, and a joint pushed out of its range is reported to diverge."""
    elastic = short_truth.model.joint_torque.elastic
    wrong = eqx.tree_at(lambda m: m.joint_torque.elastic, short_truth.model, 3.0 * elastic)
    result = validate(replace(short_truth, model=wrong), short, ("VD.3",))
    for s, true in zip(pick(result, "VD.3", "q", "100 ms"), pick(scored, "VD.3", "q", "100 ms"), strict=True):
        assert s.rms > true.rms
    away: Model = eqx.tree_at(lambda m: m.joint_torque.elastic, short_truth.model, elastic.at[:, 0].add(-1.0))
    assert any("diverges" in m for m in validate(replace(short_truth, model=away), short, ("VD.3",)).messages)


def test_units_are_those_that_people_read(scored):
    units = {s.channel: s.units for s in scored.scores}
    assert units == {"tendon_excursion": "mm", "fingertip_force": "N", "joint_torque": "N mm", "q": "degrees"}


def test_the_integral_drifts_and_the_difference_does_not(short_truth, short):
    trial = next(iter(short.select("VD.1")))
    path, active = excursion_path(short_truth.model, trial), short.finger.active
    drift, direct = (np.abs(p[:, active] - path.measured[:, active]).max() for p in (path.integral, path.direct))
    assert direct < 1e-4 < drift


def test_the_integral_of_a_slow_motion_is_the_difference(short_truth, short):
    """∫ C q̇ dt = f(q) − f(q₀) where errors of filter and sampling are negligible."""
    trial = next(iter(short.select("VD.1")))
    time = np.linspace(0.0, 20.0, 20001)
    sweep = 0.5 - 0.4 * np.cos(0.3 * time)
    trial = replace(trial, tendon_force=None, tendon_excursion=None)
    slow = replace(trial, time=time, q=np.stack([sweep, 0.5 * sweep, 0.3 * sweep], axis=1))
    path = excursion_path(short_truth.model, slow)
    np.testing.assert_allclose(path.integral, path.direct, atol=1e-4)


def test_a_wrong_moment_arm_is_found_in_size_and_place(short_truth, scored, short):
    k = 2  # T3 crosses the MCP alone
    arms = short_truth.model.moment_arm.coefficients
    wrong: Model = eqx.tree_at(lambda m: m.moment_arm.coefficients, short_truth.model, arms.at[k].multiply(1.05))
    result = validate(replace(short_truth, model=wrong), short, ("VD.1",))
    before, after = ({s.column: s.rms for s in pick(r, "VD.1", "tendon_excursion", "f(q)")} for r in (scored, result))
    assert after["T1"] == pytest.approx(before["T1"])
    trial = next(iter(short.select("VD.1")))
    spread = 1e3 * 0.05 * np.std(excursion_path(short_truth.model, trial).direct[:, k])
    assert after["T3"] == pytest.approx(np.hypot(spread, before["T3"]), rel=0.1)


def test_slope_of_the_force_and_its_error_from_the_fit(short_truth, short):
    """The slope's standard deviation from the covariance equals its change under a step of the parameter."""
    from jaxfinger.identify.parameters import describe

    i = [p.name for p in describe(short_truth.model)].index("tendon friction T2 a1")
    std = 0.01
    covariance = np.zeros_like(short_truth.covariance)
    covariance[i, i] = std**2
    trial = next(iter(short.select("VD.2")))
    fit, short = replace(short_truth, covariance=covariance), short.with_trials([trial.name])
    slope = next(s for s in validate(fit, short, ("VD.2",)).slopes if s.axis == "x")
    assert trial.tendon == slope.tendon == "T2"
    assert slope.measured == pytest.approx(slope.predicted, abs=4 * slope.measured_std)
    friction = short_truth.model.tendon_friction.proportional
    moved = eqx.tree_at(
        lambda m: m.tendon_friction.proportional, short_truth.model, friction + std * jnp.eye(len(friction))[1]
    )
    other = next(s for s in validate(replace(fit, model=moved), short, ("VD.2",)).slopes if s.axis == "x")
    assert slope.predicted_std == pytest.approx(abs(other.predicted - slope.predicted), rel=0.05)


def test_a_slope_through_two_holds_has_no_known_error(short_truth, short):
    """A line goes through two points without scatter, which says nothing of its error."""
    trials = {t.name: replace(t, hold=np.where(np.isin(t.hold, (0, 1)), t.hold, -1)) for t in short.select("VD.2")}
    slopes = validate(short_truth, replace(short, trials=trials), ("VD.2",)).slopes
    assert slopes
    assert all(np.isfinite(s.measured) and np.isnan(s.measured_std) for s in slopes)


def test_what_is_missing_is_said(short_truth, short):
    result = validate(short_truth, short.select("VD.1"))
    assert result.messages == ("the session has no VD.2 trial", "the session has no VD.3 trial")
    with pytest.raises(UserError, match=r"has no trial of VD\.1, VD\.2, VD\.3 to validate with, it has ID\.4"):
        validate(short_truth, short.select("ID.4"))
