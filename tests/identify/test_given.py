"""Rotors and excursions of a finger's description as starts and priors, and the terms that real drives need."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.identify import Recipe
from jaxfinger.identify.nominal import cad_prior, free_groups, nominal_model
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.recipe import PAPER, ModelRecipe, structure
from jaxfinger.synthetic import paper_finger

FINGER = paper_finger().description
M, N = FINGER.m, FINGER.n


def given(degree: int) -> Session:
    rng = np.random.default_rng(degree)
    known = rng.standard_normal((N, M, degree)) * FINGER.crosses[:, :, None]
    finger = replace(
        FINGER,
        rotor_inertia=np.array([1e-6, 2e-6, 3e-6]),
        rotor_inertia_std=np.array([1e-7, 0.0, 2e-7]),
        excursion=known,
        excursion_std=np.full(known.shape, 0.1),
    )
    return Session("given", finger)


@pytest.mark.parametrize("degree", [2, 6])
def test_known_excursions_and_rotors_are_where_a_fit_starts(degree):
    session = given(degree)
    model = nominal_model(session, Recipe())
    q = np.random.default_rng(0).uniform(-1.0, 1.0, M)
    powers = q[:, None] ** np.arange(1, degree + 1)
    expected = np.sum(session.finger.excursion * powers, axis=(1, 2))
    np.testing.assert_allclose(model.moment_arm.excursion(q[:, None])[:, 0], expected, rtol=1e-12)
    np.testing.assert_array_equal(model.finger.rotor_inertia, np.diag([1e-6, 2e-6, 3e-6]))


def test_standard_deviations_of_the_description_are_the_prior():
    session = given(2)
    model = nominal_model(session, Recipe())
    parameters = describe(model)
    free = np.array([i for i, p in enumerate(parameters) if p.group in ("moment_arm", "rotor_inertia")])
    prior = cad_prior(session, Recipe(), parameters, free)
    said = {parameters[free[k]].name: 1.0 / row[k] for row in prior.root for k in np.flatnonzero(row)}
    rotors = {n: s for n, s in said.items() if n.startswith("rotor")}
    joints = FINGER.joint_names
    assert rotors == {
        f"rotor inertia {joints[0]}": pytest.approx(1e-7),
        f"rotor inertia {joints[2]}": pytest.approx(2e-7),
    }
    arms = {n: s for n, s in said.items() if n.startswith("excursion")}
    assert arms
    np.testing.assert_allclose(list(arms.values()), 0.1)
    assert not any(n.endswith(("^3", "^4")) for n in arms)  # the description gives no standard deviations of these
    np.testing.assert_array_equal(prior.mean, np.asarray(ravel(model))[free])


def test_a_constant_torque_is_an_elastic_torque_of_degree_zero():
    terms = ("joint_offset", "joint_friction_asymmetric", "joint_torque_friction", "rotor_inertia")
    recipe = Recipe(model=ModelRecipe(terms=terms))
    assert nominal_model(Session("x", FINGER), recipe).joint_torque.elastic.shape == (M, 1)
    assert free_groups(recipe) == {"moment_arm", "elastic", "friction_by_direction", "torque_friction", "rotor_inertia"}
    with pytest.raises(UserError, match="joint_offset beside joint_elastic"):
        structure({"model": {"terms": [*PAPER, "joint_offset"]}}, "mine.toml")
