"""Terms of the nominal model that a recipe may leave out. They are then candidates like other effects."""

from functools import cache
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude


class JointElastic(CatalogueEffect):
    """k₀ + k₁ q + k₂ q²: elastic torque of a joint."""

    ID: ClassVar = "joint_elastic"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The joint has a spring that the recipe leaves out."
    LOOKS: ClassVar = "Torque depends on the angle, the same in both directions."
    CHANGE: ClassVar = "Add `joint_elastic` to `model.terms` of the recipe."

    k0: Float[Array, ""] = amplitude("N m", 0.2, "torque", signed=True)
    k1: Float[Array, ""] = amplitude("N m/rad", 0.8, "torque/angle", signed=True)
    k2: Float[Array, ""] = amplitude("N m/rad^2", 0.8, "torque/angle/angle", signed=True)

    def torque(self, x, memory, h):
        i = self.index[0]
        return h.at[i].add(self.k0 + self.k1 * x.q[i] + self.k2 * x.q[i] ** 2)


class JointCoulomb(CatalogueEffect):
    """s(q̇) (c₀ + c₁ q + c₂ q²): Coulomb friction of a joint."""

    ID: ClassVar = "joint_coulomb"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The joint has dry friction that the recipe leaves out."
    LOOKS: ClassVar = "Torque jumps at each reversal, by the same amount at any speed."
    CHANGE: ClassVar = "Add `joint_coulomb` to `model.terms` of the recipe."

    c0: Float[Array, ""] = amplitude("N m", 0.1, "torque")
    c1: Float[Array, ""] = amplitude("N m/rad", 0.1, "torque/angle", signed=True)
    c2: Float[Array, ""] = amplitude("N m/rad^2", 0.1, "torque/angle/angle", signed=True)

    def joint_friction(self, x, f_j, C, F):
        i = self.index[0]
        return F.at[i].add(self.c0 + self.c1 * x.q[i] + self.c2 * x.q[i] ** 2)


class JointDamping(CatalogueEffect):
    """d q̇: damping of a joint."""

    ID: ClassVar = "joint_damping"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The joint has damping that the recipe leaves out."
    LOOKS: ClassVar = "Torque is proportional to speed."
    CHANGE: ClassVar = "Add `joint_damping` to `model.terms` of the recipe."

    d: Float[Array, ""] = amplitude("N m s/rad", 0.03, "torque/speed")

    def torque(self, x, memory, h):
        i = self.index[0]
        return h.at[i].add(self.d * x.qd[i])


class TendonFrictionTerm(CatalogueEffect):
    """a₀ + a₁ f: the affine friction of a tendon's path."""

    ID: ClassVar = "tendon_friction"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The tendon loses tension on its way, which the recipe leaves out."
    LOOKS: ClassVar = (
        "Torque is less than tension times moment arm while the tendon is pulled, more while it is let go."
    )
    CHANGE: ClassVar = "Add `tendon_friction` to `model.terms` of the recipe."

    a0: Float[Array, ""] = amplitude("N", 0.05, "tension", signed=True)
    a1: Float[Array, ""] = amplitude("1", 0.3, signed=True)

    def loss(self, x, f, C, loss):
        k = self.index[0]
        return loss.at[k].add(self.a0 + self.a1 * f[k])


class Gravity(CatalogueEffect):
    """The weight of the links: a gravity vector where the nominal model has none."""

    ID: ClassVar = "gravity"
    PLACE: ClassVar = "base"
    HAPPENS: ClassVar = "The links have weight, which the recipe leaves out."
    LOOKS: ClassVar = "Torque changes with posture as that of a weight does."
    CHANGE: ClassVar = "Add `gravity` to `model.terms` of the recipe."

    x: Float[Array, ""] = amplitude("m s-2", 0.2, "torque/mass/length", signed=True)
    y: Float[Array, ""] = amplitude("m s-2", 0.2, "torque/mass/length", signed=True)
    z: Float[Array, ""] = amplitude("m s-2", 0.2, "torque/mass/length", signed=True)

    def finger(self, finger):
        return eqx.tree_at(lambda f: f.gravity, finger, finger.gravity + jnp.stack([self.x, self.y, self.z]))


@cache
def of_degree(term: type[CatalogueEffect], degree: int) -> type[CatalogueEffect]:
    """Restrict a polynomial term to a degree. Higher coefficients are zero, and no parameters."""
    names = list(term.parameters())
    if degree + 1 >= len(names):
        return term

    class OfDegree(term):
        @classmethod
        def parameters(cls):
            declared = term.parameters()
            return {n: declared[n] for n in names[: degree + 1]}

        @classmethod
        def constants(cls, finger, site):
            return {n: jnp.zeros(()) for n in names[degree + 1 :]}

    return OfDegree
