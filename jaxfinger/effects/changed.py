"""Changes of nominal parameters since an earlier fit: candidates where a session is diagnosed against that fit.

Each effect changes one term of the nominal model at one site, by the term's own law and parameters.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude
from jaxfinger.effects.body import MAX_REMOVED_SHARE
from jaxfinger.effects.drive import JointFrictionAsymmetric, JointOffset, JointTorqueFriction
from jaxfinger.effects.nominal import JointCoulomb, JointDamping, JointElastic, TendonFrictionTerm


class Changed(CatalogueEffect):
    """Base class: the amplitudes are changes of the nominal parameters of `GROUP` at the site, in their order."""

    GROUP: ClassVar[str]
    FIRST: ClassVar[int] = 0  # position among these of the parameter that the first amplitude changes
    LOOKS: ClassVar = "Every trial that depends on it is off in the same way; no trial from before the change is."
    CHANGE: ClassVar = "Find out what was changed on the finger since, or identify it again."


class ChangedElastic(Changed, JointElastic):
    """k₀ + k₁ q + k₂ q²: change of a joint's elastic torque."""

    ID: ClassVar = "changed_elastic"
    GROUP: ClassVar = "elastic"
    HAPPENS: ClassVar = "The joint's elastic torque has changed since the fit was made."


class ChangedPretension(Changed, JointOffset):
    """τ₀: change of the constant part of a joint's elastic torque, at the same stiffness."""

    ID: ClassVar = "changed_pretension"
    GROUP: ClassVar = "elastic"
    HAPPENS: ClassVar = (
        "The pretension of the joint's spring, or a constant torque, has changed since the fit was made."
    )


class ChangedFriction(Changed, JointCoulomb):
    """s(q̇) (c₀ + c₁ q + c₂ q²): change of a joint's Coulomb friction, of either sign."""

    ID: ClassVar = "changed_friction"
    GROUP: ClassVar = "friction"
    HAPPENS: ClassVar = "The joint's dry friction has changed since the fit was made."

    c0: Float[Array, ""] = amplitude("N m", 0.1, "torque", signed=True)


class ChangedFrictionLevel(Changed):
    """s(q̇) c₀: change of a joint's Coulomb friction by the same amount at every angle, of either sign."""

    ID: ClassVar = "changed_friction_level"
    GROUP: ClassVar = "friction"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = (
        "The joint's dry friction has changed since the fit was made, by the same amount at every angle."
    )

    c0: Float[Array, ""] = amplitude("N m", 0.1, "torque", signed=True)

    def joint_friction(self, x, f_j, C, F):
        return F.at[self.index[0]].add(self.c0)


class ChangedDamping(Changed, JointDamping):
    """d q̇: change of a joint's damping, of either sign."""

    ID: ClassVar = "changed_damping"
    GROUP: ClassVar = "damping"
    HAPPENS: ClassVar = "The joint's damping has changed since the fit was made."

    d: Float[Array, ""] = amplitude("N m s/rad", 0.03, "torque/speed", signed=True)


class ChangedFrictionByDirection(Changed, JointFrictionAsymmetric):
    """coulomb + damping |q̇|: change of half the difference between a joint's friction forwards and back."""

    ID: ClassVar = "changed_friction_by_direction"
    GROUP: ClassVar = "friction_by_direction"
    HAPPENS: ClassVar = "The joint's friction one way has changed since the fit was made, against that the other way."


class ChangedTorqueFriction(Changed, JointTorqueFriction):
    """μ |τ| s(q̇): change of the share of its torque that a joint's drive loses, of either sign."""

    ID: ClassVar = "changed_torque_friction"
    GROUP: ClassVar = "torque_friction"
    HAPPENS: ClassVar = "The share of its torque that the joint's drive loses has changed since the fit was made."

    mu: Float[Array, ""] = amplitude("1", 0.1, signed=True, most=0.95)


class ChangedRotorInertia(Changed):
    """inertia · q̈: change of a rotor's inertia, reflected to its joint, of either sign."""

    ID: ClassVar = "changed_rotor_inertia"
    GROUP: ClassVar = "rotor_inertia"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The inertia of the joint's rotor has changed since the fit was made."

    inertia: Float[Array, ""] = amplitude("kg m2", 0.2, "mass*length*length", signed=True)

    def finger(self, finger):
        i = self.index[0]
        return eqx.tree_at(lambda f: f.rotor_inertia, finger, finger.rotor_inertia.at[i, i].add(self.inertia))


class ChangedTendonFriction(Changed, TendonFrictionTerm):
    """a₀ + a₁ f: change of the affine friction of a tendon's path."""

    ID: ClassVar = "changed_tendon_friction"
    GROUP: ClassVar = "tendon_friction"
    HAPPENS: ClassVar = "The friction of the tendon's path has changed since the fit was made."


class ChangedTendonShare(Changed):
    """a₁ f: change of the share of its tension that a tendon loses on its path."""

    ID: ClassVar = "changed_tendon_share"
    GROUP: ClassVar = "tendon_friction"
    FIRST: ClassVar = 1  # behind a₀
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The share of its tension that the tendon loses has changed since the fit was made."

    a1: Float[Array, ""] = amplitude("1", 0.3, signed=True)

    def loss(self, x, f, C, loss):
        k = self.index[0]
        return loss.at[k].add(self.a1 * f[k])


class ChangedMomentArm(Changed):
    """a₁ q + a₂ q² + a₃ q³: change of a tendon's excursion over one joint, and of its moment arm with it."""

    ID: ClassVar = "changed_moment_arm"
    GROUP: ClassVar = "moment_arm"
    PLACE: ClassVar = "tendon and joint"
    HAPPENS: ClassVar = "The tendon's moment arm at the joint has changed since the fit was made."

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
    """Δm: change of a link's mass. Its centre of mass and radii of gyration stay."""

    ID: ClassVar = "changed_mass"
    GROUP: ClassVar = "mass"
    PLACE: ClassVar = "joint"  # A link has its joint's name.
    HAPPENS: ClassVar = "The link's mass has changed since the fit was made; its centre is the same."

    m: Float[Array, ""] = amplitude("kg", 0.1, "mass", signed=True)

    def bounds(self, scales):
        """Bounds that leave a link a tenth of its mass."""
        return {"m": (-MAX_REMOVED_SHARE * scales("mass", self.site), np.inf)}

    def finger(self, finger):
        return eqx.tree_at(lambda f: f.mass, finger, finger.mass.at[self.index[0]].add(self.m))


class ChangedCom(Changed):
    """Δc: displacement of a link's centre of mass, in the link's frame."""

    ID: ClassVar = "changed_com"
    GROUP: ClassVar = "com"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The link's centre of mass has moved since the fit was made."

    x: Float[Array, ""] = amplitude("m", 0.03, "length", signed=True)
    y: Float[Array, ""] = amplitude("m", 0.03, "length", signed=True)
    z: Float[Array, ""] = amplitude("m", 0.03, "length", signed=True)

    def finger(self, finger):
        shift = jnp.stack([self.x, self.y, self.z])
        return eqx.tree_at(lambda f: f.com, finger, finger.com.at[self.index[0]].add(shift))
