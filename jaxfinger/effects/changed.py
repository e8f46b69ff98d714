"""Nominal parameters that are others than an earlier fit found: candidates where a session is diagnosed against it.

Each is what a term of the nominal model, at one place, has changed by, in the term's own parameters and by its law.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude
from jaxfinger.effects.body import KEEPS
from jaxfinger.effects.drive import JointOffset
from jaxfinger.effects.nominal import JointCoulomb, JointDamping, JointElastic, TendonFrictionTerm


class Changed(CatalogueEffect):
    """Amplitudes in the order of the nominal parameters of `GROUP` at its site."""

    GROUP: ClassVar[str]
    LOOKS: ClassVar = "Every trial that depends on it is off in the same way; none before the change was."
    CHANGE: ClassVar = "Find out what was changed on the finger in between, or identify it anew."


class ChangedElastic(Changed, JointElastic):
    """k₀ + k₁ q + k₂ q²: what a joint's elastic torque has changed by."""

    ID: ClassVar = "changed_elastic"
    GROUP: ClassVar = "elastic"
    HAPPENS: ClassVar = "The joint's elastic torque is another than when the fit was made."


class ChangedPretension(Changed, JointOffset):
    """τ₀: what the constant part of a joint's elastic torque has changed by, its stiffness the same."""

    ID: ClassVar = "changed_pretension"
    GROUP: ClassVar = "elastic"
    HAPPENS: ClassVar = "The pretension of the joint's spring, or a constant torque, is another than before."


class ChangedFriction(Changed, JointCoulomb):
    """s(q̇) (c₀ + c₁ q + c₂ q²): what a joint's Coulomb friction has changed by, more or less."""

    ID: ClassVar = "changed_friction"
    GROUP: ClassVar = "friction"
    HAPPENS: ClassVar = "The joint's dry friction is another than when the fit was made."

    c0: Float[Array, ""] = amplitude("N m", 0.1, "torque", signed=True)


class ChangedDamping(Changed, JointDamping):
    """d q̇: what a joint's damping has changed by, more or less."""

    ID: ClassVar = "changed_damping"
    GROUP: ClassVar = "damping"
    HAPPENS: ClassVar = "The joint's damping is another than when the fit was made."

    d: Float[Array, ""] = amplitude("N m s/rad", 0.03, "torque/speed", signed=True)


class ChangedTendonFriction(Changed, TendonFrictionTerm):
    """a₀ + a₁ f: what the affine friction of a tendon's path has changed by."""

    ID: ClassVar = "changed_tendon_friction"
    GROUP: ClassVar = "tendon_friction"
    HAPPENS: ClassVar = "The friction of the tendon's path is another than when the fit was made."


class ChangedMomentArm(Changed):
    """a₁ q + a₂ q² + a₃ q³: what a tendon's excursion over one joint has changed by, and its moment arm with it."""

    ID: ClassVar = "changed_moment_arm"
    GROUP: ClassVar = "moment_arm"
    PLACE: ClassVar = "tendon and joint"
    HAPPENS: ClassVar = "The tendon's moment arm at the joint is another than when the fit was made."

    a1: Float[Array, ""] = amplitude("m/rad", 0.05, "excursion/angle", signed=True)
    a2: Float[Array, ""] = amplitude("m/rad^2", 0.05, "excursion/angle/angle", signed=True)
    a3: Float[Array, ""] = amplitude("m/rad^3", 0.05, "excursion/angle/angle/angle", signed=True)

    @classmethod
    def sites(cls, finger):
        active = [k for k, a in enumerate(finger.active) if a]
        pairs = [(k, i) for k in active for i in range(finger.m) if finger.crosses[k][i]]
        return [(finger.tendon_names[k], finger.joint_names[i]) for k, i in pairs]

    @classmethod
    def indices(cls, finger, site):
        return finger.tendon_names.index(site[0]), finger.joint_names.index(site[1])

    def excursion(self, x, memory, f, l):
        k, i = self.index
        q = x.q[i]
        return l.at[k].add(q * (self.a1 + q * (self.a2 + q * self.a3)))

    def coupling(self, x, f, C):
        k, i = self.index
        q = x.q[i]
        return C.at[k, i].add(self.a1 + q * (2.0 * self.a2 + q * 3.0 * self.a3))


class ChangedMass(Changed):
    """Δm at the link's own centre of mass, its shape kept: what its mass has changed by."""

    ID: ClassVar = "changed_mass"
    GROUP: ClassVar = "mass"
    PLACE: ClassVar = "joint"  # a link goes by its joint's name
    HAPPENS: ClassVar = "The link's mass is another than when the fit was made, its centre the same."

    m: Float[Array, ""] = amplitude("kg", 0.1, "mass", signed=True)

    def bounds(self, scales):
        """A link keeps a tenth of its mass: else it is no body."""
        return {"m": (-KEEPS * scales("mass", self.site), np.inf)}

    def finger(self, finger):
        return eqx.tree_at(lambda f: f.mass, finger, finger.mass.at[self.index[0]].add(self.m))


class ChangedCom(Changed):
    """Δc: what a link's centre of mass has moved by, in its frame."""

    ID: ClassVar = "changed_com"
    GROUP: ClassVar = "com"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The link's centre of mass is elsewhere than when the fit was made."

    x: Float[Array, ""] = amplitude("m", 0.03, "length", signed=True)
    y: Float[Array, ""] = amplitude("m", 0.03, "length", signed=True)
    z: Float[Array, ""] = amplitude("m", 0.03, "length", signed=True)

    def finger(self, finger):
        by = jnp.stack([self.x, self.y, self.z])
        return eqx.tree_at(lambda f: f.com, finger, finger.com.at[self.index[0]].add(by))
