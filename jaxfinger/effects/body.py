"""Effects on the rigid body: load, mounting, and the inertia and ripple of the external motor."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude, shape
from jaxfinger.effects.rotation import turned

# Largest share of a link's mass that an effect may remove. The equations divide by the mass that is left, so it has to
# stay positive. CAD is never wrong by nine tenths of a mass: the bound excludes no plausible link.
MAX_REMOVED_SHARE = 0.9


class Payload(CatalogueEffect):
    """Point `mass` at (x, y, z) in a link's frame, added to the link (`moved` 0) or taken evenly from its own mass (1).

    Mass, first moment and inertia are those of the body and the point (parallel axes). Torques are linear in `mass`.
    """

    ID: ClassVar = "payload"
    PLACE: ClassVar = "joint"  # A link has its joint's name.
    HAPPENS: ClassVar = "A link carries a mass that CAD does not know of, or its mass sits elsewhere."
    LOOKS: ClassVar = "Torque is off by that of a weight: it depends on posture, at this joint and all before it."
    CHANGE: ClassVar = "Weigh the link again, with cables and screws, and correct its mass and centre of mass."

    mass: Float[Array, ""] = amplitude("kg", 0.3, "mass")
    x: Float[Array, ""] = shape("m", (0.3, 0.0, 0.6), "length", moves="by differences")
    y: Float[Array, ""] = shape("m", (0.0,), "length", moves="by differences")
    z: Float[Array, ""] = shape("m", (0.0, 0.15, -0.15), "length", moves="by differences")
    moved: Float[Array, ""] = shape(
        "1", (0.0, 1.0), moves="not", says=("added to the link", "moved there from elsewhere in the link")
    )

    def bounds(self, scales):
        """Bounds that leave a link a tenth of its mass where mass is moved within it."""
        ends = super().bounds(scales)
        return ends | ({"mass": (0.0, MAX_REMOVED_SHARE * scales("mass", self.site))} if self.moved > 0.5 else {})

    def finger(self, finger):
        i, p = self.index[0], jnp.stack([self.x, self.y, self.z])
        own = finger.mass[i] - self.moved * self.mass
        mass = own + self.mass
        com = (own * finger.com[i] + self.mass * p) / mass
        about_joint = own * (finger.gyration[i] + _steiner(1.0, finger.com[i])) + _steiner(self.mass, p)
        return eqx.tree_at(
            lambda f: (f.mass, f.com, f.gyration),
            finger,
            (
                finger.mass.at[i].set(mass),
                finger.com.at[i].set(com),
                finger.gyration.at[i].set((about_joint - _steiner(mass, com)) / mass),
            ),
        )


def _steiner(mass, com):
    """Inertia of a point mass at `com` about the frame's origin, kg m²."""
    return mass * (com @ com * jnp.eye(3) - jnp.outer(com, com))


class GravityTilt(CatalogueEffect):
    """R(φ) g, φ = (x, y, z): the finger is mounted at another angle than described, turned by the vector φ."""

    ID: ClassVar = "gravity_tilt"
    PLACE: ClassVar = "base"
    HAPPENS: ClassVar = "The finger is mounted at another angle than described."
    LOOKS: ClassVar = "The weight torques of all joints are off together, as under one turned gravity vector."
    CHANGE: ClassVar = "Measure the mounting with a level, and correct `gravity` of the finger."

    x: Float[Array, ""] = amplitude("rad", 0.06, signed=True, most=jnp.pi)
    y: Float[Array, ""] = amplitude("rad", 0.06, signed=True, most=jnp.pi)
    z: Float[Array, ""] = amplitude("rad", 0.06, signed=True, most=jnp.pi)

    def finger(self, finger):
        tilt = jnp.stack([self.x, self.y, self.z])
        return eqx.tree_at(lambda f: f.gravity, finger, turned(finger.gravity, tilt))


class DriveInertia(CatalogueEffect):
    """inertia · q̈: shaft and coupler of the external motor add inertia at the joint that it moves."""

    ID: ClassVar = "drive_inertia"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "Shaft and coupler of the external motor add inertia."
    LOOKS: ClassVar = "Torque is off in proportion to acceleration, only where the motor is coupled."
    CHANGE: ClassVar = "Add the inertia to the recipe (`rotor_inertia`), or take it off the measured torque."

    inertia: Float[Array, ""] = amplitude("kg m2", 0.2, "mass*length*length")

    def torque(self, x, memory, h):
        i = self.index[0]
        return h.at[i].add(self.inertia * x.qdd[i] * x.motorised[i])


# Periods in a turn of the joint, or in the range of a sliding one. Steps grow with the number, since a joint's range is
# a part of a turn and does not resolve neighbours at short periods; a refit moves between them.
RIPPLES_PER_TURN = (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 14.0, 16.0, 18.0, 20.0, 24.0, 28.0, 32.0)


class TorqueRipple(CatalogueEffect):
    """A sin(p q) + B cos(p q): torque of the drive that is periodic in the angle (cogging, a misaligned coupler)."""

    ID: ClassVar = "torque_ripple"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The drive's torque is periodic in the angle."
    LOOKS: ClassVar = "The residual repeats over the angle, the same both ways."
    CHANGE: ClassVar = "Align the coupler, or add the ripple to the motor: the finger itself has none."

    A: Float[Array, ""] = amplitude("N m", 0.02, "torque", signed=True)
    B: Float[Array, ""] = amplitude("N m", 0.02, "torque", signed=True)
    p: Float[Array, ""] = shape("1/rad", RIPPLES_PER_TURN, "1/turn", moves="by differences")

    def torque(self, x, memory, h):
        i = self.index[0]
        ripple = self.A * jnp.sin(self.p * x.q[i]) + self.B * jnp.cos(self.p * x.q[i])
        return h.at[i].add(ripple * x.motorised[i])
