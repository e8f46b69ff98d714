"""Record the paper's session from the stand-in over ADS, identify, and compare with the truth."""

import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.identify import identify
from jaxfinger.identify.validate import validate
from jaxfinger.rig import parse_plan, run
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.examples import plan_toml
from jaxfinger.rig.simulated.plant import Plant, default_truth
from tests.rig.conftest import ads_rig, serious

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session with every experiment, joint and tendon, recorded over ADS as fast as the stand-in runs."""
    path = tmp_path_factory.mktemp("bench") / "session.h5"
    with standin.running(speed=0) as where:
        rig = ads_rig(where)
        outcome = run(parse_plan(plan_toml(postures=1), rig.description), rig, path)
    assert outcome.cause == ""
    assert serious(path) == []
    return read_session(path)


@pytest.fixture(scope="module")
def fit(session):
    return identify(session)


def test_every_trial_is_complete_and_free_of_gaps(session):
    assert len(session) == 16
    for trial in session:
        assert trial.complete
        np.testing.assert_allclose(np.diff(trial.time), 1e-3, atol=1e-9)


def test_static_torque_against_plain_least_squares(session):
    """Least squares on the holds, without jaxfinger's fits, finds elastic torque and friction of every joint."""
    truth, plant = default_truth(), Plant()
    for trial in session.select("ID.3-static"):
        j = session.finger.joint_names.index(trial.joint)
        rows, torque, angles = [], [], []
        for hold in range(trial.hold.max() + 1):
            at = trial.hold == hold
            plant.q = np.median(trial.q[at], 0).tolist()
            q, s = plant.q[j], trial.joint_direction[at, j][0]
            rows.append([1, q, q * q, s, s * q, s * q * q])
            torque.append(trial.joint_torque[at, j].mean() - plant.gravity_torque()[j])
            angles.append(q)
        c = np.linalg.lstsq(np.array(rows), np.array(torque), rcond=None)[0]
        grid = np.linspace(min(angles), max(angles), 20)
        for got, true in ((c[:3], truth.elastic[j]), (c[3:], truth.friction[j])):
            error = np.polyval(got[::-1], grid) - np.polyval(true[::-1], grid)
            assert np.abs(error).max() < 0.1e-3  # N m; the tare alone is good to 0.01e-3


def test_identify_finds_the_truth_of_the_finger(fit, session):
    """Moment arms agree to 0.02 mm, torques to 0.15 N mm over the driven angles, tendon friction to 2 %."""
    truth = default_truth()
    found = {row["name"]: row["value"] for row in fit.table()}
    angles = np.linspace(0.1, 1.1, 30)
    for i, tendon in enumerate(session.finger.tendon_names):
        for j, joint in enumerate(session.finger.joint_names):
            if session.finger.crosses[i, j]:
                got = [found[f"excursion {tendon} {joint}^{k}"] * k for k in range(1, 5)]
                error = np.polyval((got - truth.excursion[i, j] * np.arange(1, 5))[::-1], angles)
                assert np.abs(error).max() < 0.02e-3, (tendon, joint)
        assert found[f"tendon friction {tendon} a0"] == pytest.approx(truth.a0[i], abs=0.03)
        assert found[f"tendon friction {tendon} a1"] == pytest.approx(truth.a1[i], rel=0.02)
    for j, joint in enumerate(session.finger.joint_names):
        for what, true in (("elastic", truth.elastic[j]), ("friction", truth.friction[j])):
            got = np.array([found[f"{what} torque {joint}^{k}"] for k in range(3)])
            assert np.abs(np.polyval((got - true)[::-1], angles)).max() < 0.15e-3, (what, joint)
        assert found[f"damping {joint}"] == pytest.approx(truth.damping[j], abs=3e-5)


def test_the_model_predicts_excursion_along_a_free_path(fit, session):
    """VD.1: f(q) − f(q(0)) with the fitted polynomials agrees to 0.02 mm rms."""
    found = {row["name"]: row["value"] for row in fit.table()}
    (trial,) = session.select("VD.1")
    for i, tendon in enumerate(session.finger.tendon_names):
        crossed = [j for j in session.finger.joint_names if f"excursion {tendon} {j}^1" in found]
        predicted = sum(
            found[f"excursion {tendon} {joint}^{k}"] * trial.q[:, session.finger.joint_names.index(joint)] ** k
            for joint in crossed
            for k in range(1, 5)
        )
        error = trial.tendon_excursion[:, i] - predicted
        assert np.std(error) < 0.02e-3


def test_the_model_predicts_the_fingertips_force(fit, session):
    """VD.2: the slope of the fingertip's force against tension agrees to 3 %. No fit reads VD.2."""
    slopes = {s.axis: s for s in validate(fit, session.select("VD.2"), ("VD.2",)).slopes}
    for axis in ("x", "z"):
        assert slopes[axis].predicted == pytest.approx(slopes[axis].measured, rel=0.03)
