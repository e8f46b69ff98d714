"""The rigid body: another load, another mounting, and the inertia and ripple of the external motor's drive."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import ELASTIC, CatalogueEffect


class Payload(CatalogueEffect):
    """A link's mass, first moment and inertia about its joint differ from CAD by Δm, Δ(m c) and ΔI.

    A body of mass Δm at p adds Δm p and Δm |p|². Torques are linear in these three, and in these alone (Atkeson, An and
    Hollerbach 1986): near a mass of nothing a centre of mass would not be.
    """

    ID: ClassVar = "payload"
    PLACE: ClassVar = "joint"  # a link goes by its joint's name
    AMPLITUDES: ClassVar = {
        "mass": ("kg", 3e-3, True),
        "moment_x": ("kg m", 5e-5, True),
        "moment_z": ("kg m", 2e-5, True),
        "inertia": ("kg m2", 2e-6, True),
    }
    SHOWS: ClassVar = ELASTIC
    MOVES_RIGID_BODY: ClassVar = True

    mass: Float[Array, ""]
    moment_x: Float[Array, ""]
    moment_z: Float[Array, ""]
    inertia: Float[Array, ""]

    def finger(self, finger):
        i = self.index[0]
        axis = finger.axis[i]
        mass = finger.mass[i] + self.mass
        moment = (
            finger.mass[i] * finger.com[i]
            + jnp.array([1.0, 0, 0]) * self.moment_x
            + jnp.array([0, 0, 1.0]) * self.moment_z
        )
        about_joint = finger.inertia[i] + _steiner(finger.mass[i], finger.com[i]) + self.inertia * jnp.outer(axis, axis)
        com = moment / mass
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
    """Inertia of a point mass about the frame's origin."""
    return mass * (com @ com * jnp.eye(3) - jnp.outer(com, com))


class GravityTilt(CatalogueEffect):
    """g + φ × g: the finger is mounted at another angle than believed (first order in φ)."""

    ID: ClassVar = "gravity_tilt"
    PLACE: ClassVar = "base"
    AMPLITUDES: ClassVar = {"x": ("rad", 0.06, True), "y": ("rad", 0.06, True), "z": ("rad", 0.06, True)}
    SHOWS: ClassVar = ELASTIC
    MOVES_RIGID_BODY: ClassVar = True

    x: Float[Array, ""]
    y: Float[Array, ""]
    z: Float[Array, ""]

    def finger(self, finger):
        tilt = jnp.stack([self.x, self.y, self.z])
        return eqx.tree_at(lambda f: f.gravity, finger, finger.gravity + jnp.cross(tilt, finger.gravity))


class DriveInertia(CatalogueEffect):
    """I q̈: shaft and coupler of the external motor add inertia where it is coupled."""

    ID: ClassVar = "drive_inertia"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {"inertia": ("kg m2", 2e-5, False)}
    SHOWS: ClassVar = {e: ("joint_torque",) for e in ("ID.3-static", "ID.3-dynamic")}

    inertia: Float[Array, ""]

    def torque(self, x, memory, h):
        i = self.index[0]
        return h.at[i].add(self.inertia * x.qdd[i] * x.motorised[i])


class TorqueRipple(CatalogueEffect):
    """A sin(p q) + B cos(p q): torque of the drive that is periodic in angle (cogging, a misaligned coupler)."""

    ID: ClassVar = "torque_ripple"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {"A": ("N m", 1e-3, True), "B": ("N m", 1e-3, True)}
    SHAPES: ClassVar = {
        "p": ("1", (4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 14.0, 16.0, 18.0, 20.0, 24.0, 28.0, 32.0))
    }
    SHIFTS: ClassVar = ("p",)
    SHOWS: ClassVar = {e: ("joint_torque",) for e in ("ID.3-static", "ID.3-dynamic", "ID.4")}

    A: Float[Array, ""]
    B: Float[Array, ""]
    p: Float[Array, ""]

    def torque(self, x, memory, h):
        i = self.index[0]
        ripple = self.A * jnp.sin(self.p * x.q[i]) + self.B * jnp.cos(self.p * x.q[i])
        return h.at[i].add(ripple * x.motorised[i])
