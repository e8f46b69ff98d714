"""Implausible estimates are reported where their interval excludes plausible values, and not otherwise."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.identify import identify
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.plausible import implausible
from jaxfinger.report.curves import curves
from jaxfinger.synthetic import paper_finger, polynomial_finger, true_model
from tests.identify.test_units import arm

MODEL = true_model(polynomial_finger(paper_finger()))
WRONG = {
    "would drive the joint": (lambda m: m.joint_torque.damping, -1e-3, 4e-4),
    "would push the joint on": (lambda m: m.joint_torque.friction, -2e-3, 4e-4),
    "is no inertia": (lambda m: m.finger.rotor_inertia, -1e-6, 4e-7),
    "would add to the drive's torque": (lambda m: m.joint_torque.torque_friction, -0.1, 0.04),
    "would lose more than is pulled": (lambda m: m.tendon_friction.proportional, 1.1, 0.04),
}


def said(where, value: float, std: float) -> list[str]:
    """Warnings for a model with one parameter estimated as `value`."""
    at = where(MODEL)
    first = (0,) * at.ndim
    model = eqx.tree_at(where, MODEL, jnp.zeros_like(at).at[first].set(value))
    marked = eqx.tree_at(where, MODEL, at.at[first].set(jnp.pi))
    (free,) = np.flatnonzero(np.asarray(ravel(marked)) == np.pi)
    covariance = np.zeros((ravel(model).size,) * 2)
    covariance[free, free] = std**2
    return implausible(model, covariance, np.array([free]), np.array([-np.inf]))


@pytest.mark.parametrize("meaning", WRONG)
def test_beyond_its_interval_it_is_said(meaning):
    (sentence,) = said(*WRONG[meaning])
    assert meaning in sentence


@pytest.mark.parametrize("meaning", WRONG)
@pytest.mark.parametrize("times", [4.0, np.inf], ids=["badly known", "not seen"])
def test_within_its_interval_it_may_be_nothing(meaning, times):
    where, value, std = WRONG[meaning]
    assert said(where, value, times * std) == []


def test_a_mass_that_ends_at_its_floor_is_said_to_be_wanted_lighter():
    mass = next(i for i, p in enumerate(describe(MODEL)) if p.group == "mass")
    covariance = np.zeros((ravel(MODEL).size,) * 2)
    floor = float(ravel(MODEL)[mass])
    (sentence,) = implausible(MODEL, covariance, np.array([mass]), np.array([floor]))
    assert "lighter still, down to nothing or below; weigh the link" in sentence
    assert implausible(MODEL, covariance, np.array([mass]), np.array([0.02 * floor])) == []


@pytest.mark.long
def test_a_stage_says_so():
    """The arm's base is pushed along by a negative damping."""
    session, recipe = arm()

    def helped(trial):
        torque = trial.joint_torque.copy()
        torque[:, 0] -= 5.0 * np.gradient(trial.q[:, 0], trial.time)
        return replace(trial, joint_torque=torque)

    fit = identify(replace(session, trials={n: helped(t) for n, t in session.trials.items()}), recipe)
    assert any("damping base is -2" in w and "would drive the joint" in w for w in fit.stages[-1].warnings)


@pytest.mark.long
def test_curves_of_what_is_not_seen_are_unknown_and_of_nothing_lost_as_unsure_as_their_law(staged):
    """This holds also at tensions at which the law gives no loss."""
    tendon = staged.model.finger.tendon_names[0]
    laws = [i for i, p in enumerate(describe(staged.model)) if p.group == "tendon_friction" and p.tendon == tendon]
    negative = np.asarray(ravel(staged.model))[laws[0]]
    assert negative < -0.5  # N: it loses nothing of small tensions
    before = curves(staged).tendon_friction[tendon]
    slack = before.x < 1.0
    assert not before.y[slack].any()
    assert (before.std[slack] > 0).all()
    assert np.isfinite(before.std).all()
    covariance = staged.covariance.copy()
    covariance[laws[0], laws[0]] = np.inf
    assert np.isinf(curves(replace(staged, covariance=covariance)).tendon_friction[tendon].std).all()
    joint = staged.model.finger.joint_names[0]
    elastic = [i for i, p in enumerate(describe(staged.model)) if p.group == "elastic" and p.joint == joint]
    covariance = staged.covariance.copy()
    covariance[elastic[1], elastic[1]] = np.inf  # N m/rad: without effect at 0 rad alone
    found = curves(replace(staged, covariance=covariance)).joints[joint].elastic
    assert np.isinf(found.std[found.x != 0.0]).all()
    assert found.range()[2] == np.inf
