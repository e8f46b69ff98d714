"""Simulate the session that the rig would record of a fitted model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxfinger.data import FingerDescription, Session
from jaxfinger.model import Finger, Model
from jaxfinger.synthetic.model_plant import ModelPlant
from jaxfinger.synthetic.plant import SpecimenPlant
from jaxfinger.synthetic.recipe import SessionRecipe
from jaxfinger.synthetic.routes import PolynomialRoute
from jaxfinger.synthetic.simulate import Progress, clean_session, measure
from jaxfinger.synthetic.specimen import PolynomialFriction, PolynomialSpring, Specimen


def session_of_model(
    model: Model, name: str, recipe: SessionRecipe, seed: int | None = None, progress: Progress | None = None
) -> Session:
    """Simulate the recipe's trials on a model, with its effects, in place of the recipe's specimen.

    `name` becomes the session's specimen. The recipe's seed is used unless `seed` is given.

    Raises:
        UserError: the recipe does not fit the finger, or a driven motion leaves the joints' limits.
    """
    description = describe_finger(model.finger)
    recipe = replace(recipe, specimen=replace(recipe.specimen, name=name))
    plant = ModelPlant(model, SpecimenPlant(_nominal_specimen(model, description)))
    clean = clean_session(recipe, plant, description, progress)
    return measure(clean, recipe.seed if seed is None else seed)


def describe_finger(finger: Finger) -> FingerDescription:
    """Return the model's finger as a file describes it."""
    arrays = ("gravity", "axis", "origin", "limits", "mass", "com", "inertia", "fingertip")
    rotors = np.diagonal(np.array(finger.rotor_inertia))
    return FingerDescription(
        **{k: np.array(getattr(finger, k)) for k in arrays},
        joint_names=finger.joint_names,
        prismatic=finger.prismatic,
        rotor_inertia=rotors if rotors.any() else None,
        tendon_names=finger.tendon_names,
        active=np.array(finger.active, bool),
        crosses=np.array(finger.crosses, bool).reshape(finger.n, finger.m),
    )


def _nominal_specimen(model: Model, description: FingerDescription) -> Specimen:
    """Return the model without effects and without terms that couple joints, for the rig's controller of VD.3."""
    rows = np.asarray(model.moment_arm.coefficients)

    def route(k: int, i: int) -> PolynomialRoute | None:
        powers = {e[i]: c for e, c in zip(model.moment_arm.exponents, rows[k], strict=True) if e[i] and sum(e) == e[i]}
        return PolynomialRoute(tuple(float(powers[p]) for p in sorted(powers))) if description.crosses[k, i] else None

    def table(a) -> tuple[tuple[float, ...], ...]:
        return tuple(tuple(float(c) for c in row) for row in np.asarray(a))

    def vector(a) -> tuple[float, ...]:
        return tuple(float(c) for c in np.asarray(a))

    return Specimen(
        "fitted",
        description,
        tuple(tuple(route(k, i) for i in range(description.m)) for k in range(description.n)),
        (PolynomialSpring(table(model.joint_torque.elastic)),),
        PolynomialFriction(table(model.joint_torque.friction)),
        vector(model.joint_torque.damping),
        vector(model.tendon_friction.constant),
        vector(model.tendon_friction.proportional),
    )
