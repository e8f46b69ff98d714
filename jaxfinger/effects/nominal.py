"""Terms of the nominal model that a recipe may leave out: they are candidates like any other."""

from functools import cache
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import ELASTIC, TENSION, TORQUE, CatalogueEffect


class JointElastic(CatalogueEffect):
    """k₀ + k₁ q + k₂ q²: elastic torque of a joint."""

    ID: ClassVar = "joint_elastic"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {"k0": ("N m", 0.01, True), "k1": ("N m/rad", 0.03, True), "k2": ("N m/rad^2", 0.02, True)}
    SHOWS: ClassVar = ELASTIC

    k0: Float[Array, ""]
    k1: Float[Array, ""]
    k2: Float[Array, ""]

    def torque(self, x, memory, h):
        i = self.index[0]
        return h.at[i].add(self.k0 + self.k1 * x.q[i] + self.k2 * x.q[i] ** 2)


class JointCoulomb(CatalogueEffect):
    """s(q̇) (c₀ + c₁ q + c₂ q²): Coulomb friction of a joint."""

    ID: ClassVar = "joint_coulomb"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {
        "c0": ("N m", 0.005, False),
        "c1": ("N m/rad", 0.003, True),
        "c2": ("N m/rad^2", 0.002, True),
    }
    SHOWS: ClassVar = TORQUE

    c0: Float[Array, ""]
    c1: Float[Array, ""]
    c2: Float[Array, ""]

    def joint_friction(self, x, f_j, C, F):
        i = self.index[0]
        return F.at[i].add(self.c0 + self.c1 * x.q[i] + self.c2 * x.q[i] ** 2)


class JointDamping(CatalogueEffect):
    """d q̇: damping of a joint."""

    ID: ClassVar = "joint_damping"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {"d": ("N m s/rad", 1e-3, False)}
    SHOWS: ClassVar = TORQUE

    d: Float[Array, ""]

    def torque(self, x, memory, h):
        i = self.index[0]
        return h.at[i].add(self.d * x.qd[i])


class TendonFrictionTerm(CatalogueEffect):
    """a₀ + a₁ f: the affine friction of a tendon's path."""

    ID: ClassVar = "tendon_friction"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"a0": ("N", 0.5, True), "a1": ("1", 0.3, True)}
    SHOWS: ClassVar = TENSION

    a0: Float[Array, ""]
    a1: Float[Array, ""]

    def loss(self, x, f, C, loss):
        k = self.index[0]
        return loss.at[k].add(self.a0 + self.a1 * f[k])


class Gravity(CatalogueEffect):
    """The weight of the links: a gravity vector where the nominal model has none."""

    ID: ClassVar = "gravity"
    PLACE: ClassVar = "base"
    AMPLITUDES: ClassVar = {"x": ("m s-2", 9.8, True), "y": ("m s-2", 9.8, True), "z": ("m s-2", 9.8, True)}
    SHOWS: ClassVar = ELASTIC
    MOVES_RIGID_BODY: ClassVar = True

    x: Float[Array, ""]
    y: Float[Array, ""]
    z: Float[Array, ""]

    def finger(self, finger):
        return eqx.tree_at(lambda f: f.gravity, finger, finger.gravity + jnp.stack([self.x, self.y, self.z]))


@cache
def of_degree(term: type[CatalogueEffect], degree: int) -> type[CatalogueEffect]:
    """A polynomial term as a recipe of this degree has it: higher coefficients are nothing, and not looked for."""
    names = list(term.AMPLITUDES)
    if degree + 1 >= len(names):
        return term

    class OfDegree(term):
        AMPLITUDES: ClassVar = {n: term.AMPLITUDES[n] for n in names[: degree + 1]}

        @classmethod
        def constants(cls, finger, site):
            return {n: jnp.zeros(()) for n in names[degree + 1 :]}

    return OfDegree
