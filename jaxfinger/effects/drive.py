"""Effects of a joint's drive: friction that depends on direction, torque or temperature; a constant torque, a dead
zone, and a motor that turns with two joints."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude, shape
from jaxfinger.model import SharedFriction


class JointOffset(CatalogueEffect):
    """τ₀: a constant torque on a joint, from a spring, a counterweight or an amplifier's offset."""

    ID: ClassVar = "joint_offset"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "A constant torque acts on the joint."
    LOOKS: ClassVar = "Torque is off by the same amount at every angle, speed and direction."
    CHANGE: ClassVar = "Balance the joint, zero its amplifier, or add a constant torque."

    tau: Float[Array, ""] = amplitude("N m", 0.1, "torque", signed=True)

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(self.tau)


class JointFrictionAsymmetric(CatalogueEffect):
    """coulomb + damping |q̇|: friction differs between the two directions, by twice that.

    Coulomb friction of F + Δ forwards and F − Δ backwards is the symmetric F plus a constant torque Δ, `coulomb`. It
    acts where the joint is free; where a fixture holds the joint, the fixture carries it.
    """

    ID: ClassVar = "joint_friction_asymmetric"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "Friction one way is larger than the other way."
    LOOKS: ClassVar = "One branch of the loop of torque is farther from its middle than the other, more so at speed."
    CHANGE: ClassVar = "Give the joint one friction for each direction; look for a preloaded gear or seal."

    coulomb: Float[Array, ""] = amplitude("N m", 0.06, "torque", signed=True)
    damping: Float[Array, ""] = amplitude("N m s/rad", 0.03, "torque/speed", signed=True)

    def torque(self, x, memory, h):
        i = self.index[0]
        constant = 0.0 if x.held else self.coulomb
        return h.at[i].add(constant + self.damping * jnp.abs(x.qd[i]))


class JointTorqueFriction(CatalogueEffect):
    """μ |τ| s(q̇): a drive loses a share μ of its torque τ, as gears do (Rhoban's BAM, model M3)."""

    ID: ClassVar = "joint_torque_friction"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The drive loses a share of the torque that it gives, as gears do."
    LOOKS: ClassVar = (
        "The loop of torque widens with the load: driving it takes more torque, being driven gives less back."
    )
    CHANGE: ClassVar = "Give the drive an efficiency, or use a gear with less loss."

    mu: Float[Array, ""] = amplitude("1", 0.1, most=0.95)  # A gear with μ ≥ 1 locks itself.

    def torque_friction(self, mu):
        return mu.at[self.index[0]].add(self.mu)


# K, at which the effect is zero. Another value would shift the identified nominal friction and no prediction.
NOMINAL_TEMPERATURE = 303.15


class JointFrictionWarmup(CatalogueEffect):
    """(a F + d|q̇|) s(q̇) w: friction of cold grease. w = exp(−t/T) of the session's time t, or (303 K − ϑ)/10 K of the
    joint's temperature ϑ (`by` 1).

    `a` is the share of Coulomb friction F, and d the damping, that the joint has more of at the session's start, or at
    293 K. T is no longer than the session: a slower fall could not be told from constant friction.
    """

    ID: ClassVar = "joint_friction_warmup"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "Cold grease is stiff: friction falls as the session goes on, or as the joint warms up."
    LOOKS: ClassVar = "The same motion needs less torque in later trials; the loops shrink."
    CHANGE: ClassVar = "Warm the joint up before recording, measure its temperature, or let friction depend on it."

    a: Float[Array, ""] = amplitude("1", 0.3, signed=True)
    d: Float[Array, ""] = amplitude("N m s/rad", 0.03, "torque/speed", signed=True)
    T: Float[Array, ""] = shape("s", (0.2, 0.05, 0.8), "session")
    by: Float[Array, ""] = shape(
        "1", (0.0, 1.0), moves="not", says=("with the session's time", "with the joint's temperature")
    )

    @classmethod
    def sensible(cls, scales, site, shapes):
        return shapes["by"] == 0.0 or shapes["T"] == cls.worth_trying(scales, site)["T"][0]

    def _cold(self, x) -> Float[Array, "*T"]:
        by_time = jnp.exp(-x.session_time / self.T)
        if x.temperature is None:
            return jnp.where(self.by > 0.5, 0.0, by_time)
        return jnp.where(self.by > 0.5, (NOMINAL_TEMPERATURE - x.temperature[self.index[0]]) / 10.0, by_time)

    def joint_friction(self, x, f_j, C, F):
        i = self.index[0]
        return F.at[i].multiply(jnp.maximum(1.0 + self.a * self._cold(x), 0.0))

    def torque(self, x, memory, h):
        i = self.index[0]
        return h.at[i].add(self.d * x.qd[i] * self._cold(x))


class JointCoupling(CatalogueEffect):
    """f on joint a, ratio · f on joint b, f = coulomb s(v) + damping v + inertia v̇: a motor at v = q̇_a + ratio · q̇_b.

    Such a motor drives a joint through a belt or a differential across another joint. The direction of its Coulomb
    friction is that of its last motion, and zero before the first.
    """

    ID: ClassVar = "joint_coupling"
    PLACE: ClassVar = "joint pair"
    HAPPENS: ClassVar = "One motor turns with two joints, and its friction and inertia act on both."
    LOOKS: ClassVar = "Torque at a joint that stands still follows the speed of the other one."
    CHANGE: ClassVar = "Add the motor as a rotor on the sum of both angles, with its own friction."
    sharp: ClassVar = True

    coulomb: Float[Array, ""] = amplitude("N m", 0.1, "torque")
    damping: Float[Array, ""] = amplitude("N m s/rad", 0.03, "torque/speed")
    inertia: Float[Array, ""] = amplitude("kg m2", 0.2, "mass*length*length")
    ratio: Float[Array, ""] = shape(
        "1", (1.0, -1.0), moves="not", says=("by the sum of both speeds", "by their difference")
    )

    def _ways(self, m: int) -> Float[Array, " m"]:
        """Factors of the m joints' speeds in the motor's speed."""
        a, b = self.index
        return jnp.zeros(m).at[a].add(1.0).at[b].add(self.ratio)

    def drive(self, model, x):
        a, b = self.index
        return x.q[a] + self.ratio * x.q[b]

    def initial_memory(self, drive):
        return jnp.zeros_like(drive)

    def next_memory(self, memory, before, drive):
        return jnp.where(drive != before, jnp.sign(drive - before), memory)

    def finger(self, finger):
        ways = self._ways(finger.m)
        return eqx.tree_at(
            lambda f: f.rotor_inertia, finger, finger.rotor_inertia + self.inertia * jnp.outer(ways, ways)
        )

    def torque(self, x, memory, h):
        ways = self._ways(len(x.qd))
        return h + jnp.multiply.outer(ways, self.damping * jnp.tensordot(ways, x.qd, 1))

    def shared_friction(self, x, memory):
        if x.held:
            return ()  # The fixture carries it.
        return (SharedFriction(self._ways(len(x.qd)), self.coulomb * jnp.ones_like(memory), memory),)


class JointBacklash(CatalogueEffect):
    """q_link = q + a (p − q), p = clip(p before, q − width/2, q + width/2): a dead zone between drive and link.

    The drive's angle q is measured. The link rests while the drive crosses the dead zone `width` (play operator). `a`
    is the share of the angle that goes through it. A trial starts in its middle.
    """

    ID: ClassVar = "joint_backlash"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "A dead zone lies between the drive, whose angle is measured, and the link."
    LOOKS: ClassVar = "After each reversal the link lags: torque against angle is shifted between the two ways."
    CHANGE: ClassVar = "Preload or replace the gear, measure the link's angle, or add a play of this width."

    a: Float[Array, ""] = amplitude("1", 1.0, most=1.0)
    width: Float[Array, ""] = shape("rad", (0.004, 0.007, 0.014, 0.03, 0.06), "angle")

    def true_motion(self, x):
        if x.held:
            return x
        i = self.index[0]

        def follow(p, q):
            p = jnp.clip(p, q - 0.5 * self.width, q + 0.5 * self.width)
            return p, p

        q = jnp.moveaxis(x.q[i], -1, 0)
        _, link = jax.lax.scan(follow, q[0], q)
        behind = jnp.moveaxis(link - q, 0, -1)
        return eqx.tree_at(lambda x: x.q, x, x.q.at[i].add(self.a * behind))
