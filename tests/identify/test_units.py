"""A fit does not depend on the units of its data, nor on the size and pace of the machine."""

from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.data import FingerDescription, Session, Trial, read_session
from jaxfinger.data.importing.by_mapping import import_file
from jaxfinger.data.signals.sizes import PACE_RATIO
from jaxfinger.identify import Recipe, identify, read_recipe
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.recipe import FitRecipe, ModelRecipe
from jaxfinger.model import Finger, rigid_body
from tests.units import Scale

ROOT = Path(__file__).parents[2]


def arm(seed: int = 0) -> tuple[Session, Recipe]:
    """Arm of three joints, 10 kg and 1 m, with the torques of its motors while all joints move at once."""
    rng, m = np.random.default_rng(seed), 3
    finger = FingerDescription(
        gravity=np.array([0.0, 0.0, -9.81]),
        joint_names=("base", "shoulder", "elbow"),
        axis=np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]),
        origin=np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3], [0.45, 0.0, 0.0]]),
        limits=np.tile([-2.5, 2.5], (m, 1)),
        mass=np.array([5.0, 3.0, 2.0]),
        mass_std=np.array([0.5, 0.3, 0.2]),
        com=np.array([[0.0, 0.0, 0.1], [0.2, 0.0, 0.0], [0.2, 0.0, 0.0]]),
        com_std=np.full((m, 3), 0.02),
        inertia=np.array([np.diag([0.02, 0.05, 0.05])] * m),
        fingertip=np.array([0.4, 0.0, 0.0]),
        tendon_names=(),
        active=np.zeros(0, bool),
        crosses=np.zeros((0, m), bool),
    )
    true = Finger.from_description(replace(finger, mass=finger.mass * [1.05, 0.95, 1.1]))
    trials = {}
    for k in range(2):
        time = np.arange(0.0, 12.0, 5e-3)
        w = rng.uniform(1.0, 3.0, (m, 3, 1))
        a, phase = rng.uniform(0.1, 0.4, (m, 3, 1)), rng.uniform(0.0, 2 * np.pi, (m, 3, 1))
        q = np.sum(a * np.sin(w * time + phase), axis=1)
        qd = np.sum(a * w * np.cos(w * time + phase), axis=1)
        qdd = np.sum(-a * w**2 * np.sin(w * time + phase), axis=1)
        torque = np.asarray(rigid_body.inverse_dynamics(true, jnp.asarray(q), jnp.asarray(qd), jnp.asarray(qdd)))
        torque = torque + np.array([[3.0], [2.0], [1.0]]) * qd + np.array([[4.0], [3.0], [1.5]]) * np.sign(qd)
        torque = torque + 0.3 * rng.standard_normal(torque.shape)
        measured = q + 2e-5 * rng.standard_normal(q.shape)
        trials[f"motion-{k}"] = Trial(f"motion-{k}", "ID.3-dynamic", time, measured.T, joint_torque=torque.T)
    terms = ("joint_coulomb", "joint_damping", "joint_offset", "rotor_inertia", "gravity")
    recipe = Recipe(
        model=ModelRecipe(friction_degree=0, terms=terms), fit=FitRecipe(stages=("ID.3-dynamic",), free_inertia=True)
    )
    return Session("arm", finger, trials), recipe


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    file = tmp_path_factory.mktemp("emps") / "emps.h5"
    import_file([ROOT / "datasets/emps/DATA_EMPS.mat"], ROOT / "datasets/emps/emps.toml", file)
    return read_session(file), read_recipe("emps")


@pytest.fixture(scope="module", params=["axis", *(pytest.param(m, marks=pytest.mark.long) for m in ("finger", "arm"))])
def machine(request):
    """Session of a machine and its fit."""
    if request.param == "finger":
        return request.getfixturevalue("session"), request.getfixturevalue("staged")
    session, recipe = request.getfixturevalue("axis") if request.param == "axis" else arm()
    return session, identify(session, recipe)


def beside(fit, other, scale) -> tuple[np.ndarray, np.ndarray]:
    """Difference of each estimate of the scaled session in standard deviations, and the ratio of these."""
    units = np.array([scale.of(describe(fit.model)[i].units) for i in fit.estimated])
    np.testing.assert_array_equal(other.estimated, fit.estimated)
    std, scaled = fit.std[fit.estimated], other.std[fit.estimated] / units
    np.testing.assert_array_equal(np.isfinite(scaled), np.isfinite(std))
    seen = np.isfinite(std)
    shift = np.asarray(ravel(other.model))[fit.estimated] / units - np.asarray(ravel(fit.model))[fit.estimated]
    return shift[seen] / std[seen], scaled[seen] / std[seen]


def test_in_other_units_it_is_the_same_scaled(machine):
    """Time is scaled by one step of the pace, with which all constants in seconds and Hz are scaled."""
    session, fit = machine
    scale = Scale(mass=1e-3, length=10.0, time=PACE_RATIO)
    other = identify(scale(session), fit.recipe)
    shift, ratio = beside(fit, other, scale)
    np.testing.assert_allclose(shift, 0.0, atol=1e-6)
    np.testing.assert_allclose(ratio, 1.0, rtol=1e-6)
    assert [s.warnings for s in other.stages] == [s.warnings for s in fit.stages]


@pytest.mark.long
@pytest.mark.parametrize("time", [0.1, 1.25, 2.0, 10.0])
def test_a_quicker_or_slower_machine_has_the_same_fit_within_its_errors(machine, time):
    """Between two steps of the pace, filters remove another share of noise and model errors."""
    session, fit = machine
    scale = Scale(time=time)
    shift, ratio = beside(fit, identify(scale(session), fit.recipe), scale)
    assert np.abs(shift).max() < 1.96
    assert ratio.min() > 0.4
    assert ratio.max() < 1.7
