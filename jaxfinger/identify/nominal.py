"""The nominal model of a session, and what the finger's description says of its parameters."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxfinger.data import Session
from jaxfinger.identify.parameters import Parameter, describe, ravel
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.recipe import Recipe
from jaxfinger.model import Finger, Model

# Group of the parameters of each term that a recipe may name; gravity has none.
GROUP_OF_TERM = {
    "joint_elastic": "elastic",
    "joint_coulomb": "friction",
    "joint_damping": "damping",
    "tendon_friction": "tendon_friction",
    "joint_offset": "elastic",  # a polynomial of degree zero
    "joint_friction_asymmetric": "friction_by_direction",
    "joint_torque_friction": "torque_friction",
    "rotor_inertia": "rotor_inertia",
}


def nominal_model(session: Session, recipe: Recipe) -> Model:
    """Nominal model of the session's finger, with the recipe's terms: values from the description, else zero."""
    finger = Finger.from_description(session.finger)
    r, known = recipe.model, session.finger.excursion
    model = Model.zeros(
        finger,
        moment_arm_degree=max(r.moment_arm_degree, 0 if known is None else known.shape[2]),
        cross=r.cross_terms,
        elastic_degree=0 if "joint_offset" in r.terms else r.elastic_degree,
        friction_degree=r.friction_degree,
    )
    if "gravity" not in r.terms:
        model = eqx.tree_at(lambda m: m.finger.gravity, model, jnp.zeros(3))
    if known is not None:
        given = jnp.asarray(_by_exponents(model, known, describe(model)))
        model = eqx.tree_at(lambda m: m.moment_arm.coefficients, model, given.reshape(finger.n, -1))
    return model


def _by_exponents(
    model: Model, known: Float[np.ndarray, "n m k"], parameters: list[Parameter]
) -> Float[np.ndarray, " c"]:
    """Flat coefficients of the moment arms, from polynomials `known` of single joints; else zero."""
    joints, tendons = model.finger.joint_names, model.finger.tendon_names
    values = np.zeros(model.moment_arm.coefficients.size)
    for at, p in enumerate(p for p in parameters if p.group == "moment_arm"):
        if p.joint is not None and p.power is not None and p.power <= known.shape[2]:
            values[at] = known[tendons.index(p.tendon), joints.index(p.joint), p.power - 1]
    return np.nan_to_num(values)


def free_groups(recipe: Recipe) -> set[str]:
    """Groups of parameters in the recipe's nominal model."""
    return {"moment_arm"} | {GROUP_OF_TERM[t] for t in recipe.model.terms if t in GROUP_OF_TERM}


def covariance_before(session: Session, recipe: Recipe, parameters: list[Parameter]) -> Float[np.ndarray, "P P"]:
    """Covariance of the flat vector before any fit: `cad_covariance`, infinite for what nothing tells yet.

    That is a parameter of the recipe's terms, or of a moment arm, of which the description gives no value. It stands at
    zero until a stage estimates it; what rests on it before is undetermined.
    """
    finger, groups, covariance = session.finger, free_groups(recipe), cad_covariance(session, parameters)
    arms = () if finger.excursion is None else finger.excursion
    known = {name for name, arm in zip(finger.tendon_names, arms, strict=False) if np.isfinite(arm).all()}

    def given(p: Parameter) -> bool:
        if p.group == "moment_arm":
            return p.tendon in known
        return p.group == "rotor_inertia" and finger.rotor_inertia is not None

    unknown = [i for i, p in enumerate(parameters) if p.group in groups and p.determinable and not given(p)]
    covariance[unknown, unknown] = np.inf
    return covariance


def cad_covariance(session: Session, parameters: list[Parameter]) -> Float[np.ndarray, "P P"]:
    """Covariance of what the finger's description gives.

    It is diagonal: the description's standard deviations of masses, centres of mass, rotors and excursions, else zero.
    """
    variance, finger = np.zeros(len(parameters)), session.finger
    for group, std in (("mass", finger.mass_std), ("com", finger.com_std)):
        if std is not None:
            variance[[p.group == group for p in parameters]] = np.ravel(std) ** 2
    for i, p in enumerate(parameters):
        if p.group == "rotor_inertia" and p.determinable and finger.rotor_inertia_std is not None:
            variance[i] = finger.rotor_inertia_std[finger.joint_names.index(p.joint)] ** 2
        if p.group == "moment_arm" and p.determinable and p.joint is not None and finger.excursion_std is not None:
            std = finger.excursion_std[finger.tendon_names.index(p.tendon), finger.joint_names.index(p.joint)]
            variance[i] = 0.0 if p.power is None or p.power > len(std) else np.nan_to_num(std[p.power - 1]) ** 2
    return np.diag(variance)


def cad_prior(session: Session, recipe: Recipe, parameters: list[Parameter], free: Int[np.ndarray, " p"]) -> Prior:
    """Prior from the finger's description: one row for each free parameter whose standard deviation it gives."""
    variance = np.diag(cad_covariance(session, parameters))[free]
    rows = np.flatnonzero(variance > 0)
    root = np.zeros((rows.size, free.size))
    root[np.arange(rows.size), rows] = variance[rows] ** -0.5
    return Prior(np.asarray(ravel(nominal_model(session, recipe)))[free], root)
