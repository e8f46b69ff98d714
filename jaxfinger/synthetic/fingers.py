"""Specimens that a recipe can ask for: the paper's finger, its polynomial form, random fingers, described fingers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.errors import UserError
from jaxfinger.model import Finger, JointTorque, Model, MomentArm, TendonFriction
from jaxfinger.synthetic.paper_finger import paper_finger
from jaxfinger.synthetic.random_finger import random_finger
from jaxfinger.synthetic.recipe import DescribedFinger, JointTerms, SpecimenRecipe, TendonTerms
from jaxfinger.synthetic.routes import PolynomialRoute, Route
from jaxfinger.synthetic.specimen import PolynomialFriction, PolynomialSpring, Specimen

EXCURSION_DEGREE, TORQUE_DEGREE = 4, 2  # degrees of the paper's polynomials (ID.2, ID.3)


def specimen_of(recipe: SpecimenRecipe | DescribedFinger) -> Specimen:
    """Return the specimen that `[specimen]` asks for, or the described one.

    Raises:
        UserError: the random finger is to have fewer than 1 or more than 7 joints.
    """
    if isinstance(recipe, DescribedFinger):
        return _described(recipe)
    if recipe.kind == "polynomial":
        return polynomial_finger(paper_finger())
    if recipe.kind == "random":
        if not 1 <= recipe.joints <= 7:
            raise UserError(f"recipe: specimen.joints is {recipe.joints}; choose 1 to 7")
        return random_finger(recipe.seed, recipe.joints, recipe.layout, recipe.tendons)
    return paper_finger(recipe.passive_tendon)


def _described(said: DescribedFinger) -> Specimen:
    """Return the finger of a description, with the moment arms of its file and its terms."""
    finger = said.finger
    joints = [said.terms.joints.get(name, JointTerms()) for name in finger.joint_names]
    tendons = [said.terms.tendons.get(name, TendonTerms()) for name in finger.tendon_names]
    arms = np.zeros((finger.n, finger.m, 1)) if finger.excursion is None else np.nan_to_num(finger.excursion)
    return Specimen(
        name="described finger",
        description=finger,
        routes=tuple(
            tuple(PolynomialRoute(tuple(c.tolist())) if x else None for c, x in zip(*row, strict=True))
            for row in zip(arms, finger.crosses, strict=True)
        ),
        springs=(PolynomialSpring(tuple(j.elastic for j in joints)),),
        friction=PolynomialFriction(tuple(j.friction for j in joints)),
        damping=tuple(j.damping for j in joints),
        loss_constant=tuple(t.constant for t in tendons),
        loss_proportional=tuple(t.proportional for t in tendons),
    )


def polynomial_finger(specimen: Specimen) -> Specimen:
    """Replace a specimen's terms by least-squares polynomials over the joints' ranges, the nominal model's form.

    The nominal model can express the result exactly, so statistics over its sessions have an exact truth.
    """
    limits = specimen.description.limits
    q = np.linspace(limits[:, 0], limits[:, 1], 401, axis=1)

    def route(k: int, i: int) -> Route | None:
        old = specimen.routes[k][i]
        return old and PolynomialRoute(_fitted(q[i], old.excursion(q[i]), range(1, EXCURSION_DEGREE + 1)))

    powers = range(TORQUE_DEGREE + 1)
    torques = [
        tuple(_fitted(q[i], torque[i], powers) for i in range(len(q)))
        for torque in (specimen.elastic(q), specimen.coulomb(q))
    ]
    return replace(
        specimen,
        name=f"polynomial {specimen.name}",
        routes=tuple(tuple(route(k, i) for i in range(len(q))) for k in range(len(specimen.routes))),
        springs=(PolynomialSpring(torques[0]),),
        friction=PolynomialFriction(torques[1]),
    )


def study_finger(joints: int = 1) -> Specimen:
    """Return a polynomial finger for studies over many sessions: the paper's for three joints, else a random one."""
    return polynomial_finger(paper_finger() if joints == 3 else random_finger(0, joints, "planar", "antagonists"))


def true_model(specimen: Specimen) -> Model:
    """Return the nominal model with the true parameters of a polynomial specimen.

    A passive tendon keeps a zero moment arm: it is no part of the nominal model. Powers that the specimen lacks are
    zero.
    """
    (spring,), friction, finger = specimen.springs, specimen.friction, Finger.from_description(specimen.description)
    assert isinstance(spring, PolynomialSpring)
    assert isinstance(friction, PolynomialFriction)
    routes = {
        (k, i): route.coefficients
        for k in np.flatnonzero(finger.active)
        for i, route in enumerate(specimen.routes[k])
        if isinstance(route, PolynomialRoute)
    }
    degree = max([EXCURSION_DEGREE, *map(len, routes.values())])
    arms = np.zeros((finger.n, finger.m, degree))
    for at, coefficients in routes.items():
        arms[at][: len(coefficients)] = coefficients
    return Model(
        finger,
        MomentArm(jnp.asarray(arms.reshape(finger.n, -1)), MomentArm.zeros(finger.n, finger.m, degree).exponents),
        JointTorque.of(_table(spring.coefficients), jnp.asarray(specimen.damping), _table(friction.coefficients)),
        TendonFriction(jnp.asarray(specimen.loss_constant), jnp.asarray(specimen.loss_proportional)),
    )


def _table(rows: Sequence[Sequence[float]]) -> Float[Array, "m powers"]:
    """Coefficients of polynomials, one row a joint, with zeros for the powers that a joint lacks.

    All powers of the paper are there, so that a fit has them to vary.
    """
    width = max([TORQUE_DEGREE + 1, *map(len, rows)])
    return jnp.asarray([[*row, *[0.0] * (width - len(row))] for row in rows])


def _fitted(q, values, powers) -> tuple[float, ...]:
    """Coefficients of the least-squares polynomial with the given powers of q."""
    return tuple(np.linalg.lstsq(np.stack([q**p for p in powers], axis=1), values, rcond=None)[0].tolist())
