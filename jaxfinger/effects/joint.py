"""Effects at the joints: friction that falls with speed, builds up after a reversal or grows with load; elasticity that
hardens, relaxes, meets a stop, or couples two joints through a passive tendon."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude, shape
from jaxfinger.effects.presliding import dahl, delta
from jaxfinger.effects.spectrum import RelaxingEffect


class JointStribeck(CatalogueEffect):
    """τ_f (1 + a exp(−(|q̇|/v_s)^δ)): friction falls with speed after breakaway (Armstrong-Hélouvry 1994).

    With δ = 1 and a v_s near the joint's own speed, the friction falls almost linearly and could not be told from
    negative damping. With δ = 2 it is flat at first, and can be.
    """

    ID: ClassVar = "joint_stribeck"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "Friction is largest just after the joint breaks away and falls as it speeds up."
    LOOKS: ClassVar = "Slow sweeps need more torque than fast ones; torque against speed dips before it rises."
    CHANGE: ClassVar = "Lubricate or reseat the bearing, or add a Stribeck term to the joint's friction."
    # Largest v_s to try with δ = 1, as a share of the joint's speed; see above.
    MAX_EXPONENTIAL_SPEED: ClassVar = 0.4

    a: Float[Array, ""] = amplitude("1", 0.5)
    v_s: Float[Array, ""] = shape("rad/s", (0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.5), "speed")
    delta: Float[Array, ""] = shape("1", (1.0, 2.0), moves="not", says=("exponential in speed", "Gaussian in speed"))

    @classmethod
    def sensible(cls, scales, site, shapes):
        return shapes["delta"] == 2.0 or shapes["v_s"] <= 1.001 * cls.MAX_EXPONENTIAL_SPEED * scales("speed", site)

    def bounds(self, scales):
        ends, slow = super().bounds(scales), self.MAX_EXPONENTIAL_SPEED * scales("speed", self.site)
        return ends | {"v_s": (ends["v_s"][0], 2.0 * slow)} if self.delta == 1.0 else ends

    def joint_friction(self, x, f_j, C, F):
        i = self.index[0]
        speed = jnp.maximum(jnp.abs(x.qd[i]), 1e-12) / self.v_s
        return F.at[i].add(self.a * F[i] * jnp.exp(-(speed**self.delta)))


class JointPresliding(CatalogueEffect):
    """dz = (1 − z sgn dq)^δ dq/x₀: after a reversal a share `a` of friction builds up over an angle x₀ (Dahl 1968)."""

    ID: ClassVar = "joint_presliding"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "After each reversal friction builds up over a small angle instead of at once."
    LOOKS: ClassVar = "Torque rounds the corners of its loop against the angle at every reversal."
    CHANGE: ClassVar = "Give the joint a Dahl or LuGre friction with this length; stiffer bearings shorten it."
    sharp: ClassVar = True

    a: Float[Array, ""] = amplitude("1", 1.0, most=1.0)
    x0: Float[Array, ""] = shape("rad", (0.0015, 0.003, 0.006, 0.012, 0.022, 0.045, 0.09, 0.18), "angle")
    delta: Float[Array, ""] = delta()

    def drive(self, model, x):
        return x.q[self.index[0]] / self.x0

    def initial_memory(self, drive):
        return jnp.zeros_like(drive)

    def next_memory(self, memory, before, drive):
        return dahl(memory, drive - before, self.delta)

    def directions(self, x, memory, joint, tendon):
        if x.held:
            return joint, tendon  # The fixture carries it.
        i = self.index[0]
        return joint.at[i].set((1 - self.a) * joint[i] + self.a * memory), tendon


class JointLoadFriction(CatalogueEffect):
    """μ Σ_k |c_k f_k|: joint friction grows with the load that the tendons press onto the joint (Palli 2014)."""

    ID: ClassVar = "joint_load_friction"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The tendons press the joint's bearing, and its friction grows with that load."
    LOOKS: ClassVar = "The missing torque grows with tension, and changes its sign with the direction of motion."
    CHANGE: ClassVar = "Use a better bearing, or make the joint's friction grow with the tendons' load."

    mu: Float[Array, ""] = amplitude("1", 0.1)

    def joint_friction(self, x, f_j, C, F):
        i = self.index[0]
        return F.at[i].add(self.mu * jnp.sum(jnp.abs(C[:, i] * f_j), axis=0))


class _TowardsAnEnd(CatalogueEffect):
    """Base class of effects near the ends of a joint's range. `end` is +1 for the upper end, −1 for the lower."""

    limits: Float[Array, "2"]

    @classmethod
    def constants(cls, finger, site):
        return {"limits": jax.device_put(np.array(finger.limits[finger.joint_names.index(site[0])]))}


class ElasticHardening(_TowardsAnEnd):
    """± τ_end exp(−d/width), d the angle to an end: an exponential spring at one or both ends (Esteki 1996).

    `end` is 0 for a joint that stiffens alike towards both ends.
    """

    ID: ClassVar = "elastic_hardening"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The joint's elastic torque stiffens towards one end of its range, or towards both."
    LOOKS: ClassVar = "Torque against angle bends away near an end, the same both ways."
    CHANGE: ClassVar = "Add an exponential spring at each end that stiffens, or free what is compressed there."

    tau_end: Float[Array, ""] = amplitude("N m", 0.4, "torque")
    width: Float[Array, ""] = shape("rad", (0.07, 0.15, 0.3, 0.5), "angle")
    end: Float[Array, ""] = shape(
        "1",
        (1.0, -1.0, 0.0),
        moves="not",
        says=("towards the upper limit", "towards the lower limit", "towards both limits"),
    )

    def torque(self, x, memory, h):
        i = self.index[0]
        low, high = self.limits
        upper = jnp.where(self.end >= 0, jnp.exp(-(high - x.q[i]) / self.width), 0.0)
        lower = jnp.where(self.end <= 0, jnp.exp(-(x.q[i] - low) / self.width), 0.0)
        return h.at[i].add(self.tau_end * (upper - lower))


class JointStop(_TowardsAnEnd):
    """± stiffness ⟨d⟩₊ (1 + damping ḋ), d the depth beyond `place`: contact with a stop inside the range.

    The stop stands at the share `place` of the range, from the lower limit where `end` is +1, else from the upper one.
    """

    ID: ClassVar = "joint_stop"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The joint meets a stop inside the recorded range."
    LOOKS: ClassVar = "Torque rises steeply beyond one angle and nowhere else."
    CHANGE: ClassVar = "Record short of the stop, move it, or add it as a contact."

    stiffness: Float[Array, ""] = amplitude("N m/rad", 3.0, "torque/angle")
    place: Float[Array, ""] = shape("1", (0.55, 0.62, 0.69, 0.76, 0.82, 0.88, 0.94), moves="by differences")
    end: Float[Array, ""] = shape(
        "1",
        (1.0, -1.0),
        moves="not",
        says=("a stop on the way to the upper limit", "a stop on the way to the lower limit"),
    )
    damping: Float[Array, ""] = shape("s/rad", (0.0,), moves="not")

    def torque(self, x, memory, h):
        i = self.index[0]
        low, high = self.limits
        at = jnp.where(self.end > 0, low + self.place * (high - low), high - self.place * (high - low))
        depth = jnp.maximum(self.end * (x.q[i] - at), 0.0)
        force = self.stiffness * depth * jnp.maximum(1.0 + self.damping * self.end * x.qd[i], 0.0)
        return h.at[i].add(self.end * force)


class ElasticRelaxation(RelaxingEffect):
    """stiffness · z, ż = q̇ − z/T: a Maxwell branch beside the elastic torque, which relaxes at a hold.

    With `decades` z is the mean over a spectrum of times about T.
    """

    ID: ClassVar = "elastic_relaxation"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "The elastic torque relaxes while the joint is held, and lags while it moves."
    LOOKS: ClassVar = "Torque creeps at each hold, and the loop of torque against angle is widest at a certain speed."
    CHANGE: ClassVar = "Add a spring and damper in series beside the joint's spring; wait longer at holds."
    OF_SPRING: ClassVar = True

    stiffness: Float[Array, ""] = amplitude("N m/rad", 0.3, "torque/angle")
    T: Float[Array, ""] = shape("s", (0.003, 0.01, 0.03, 0.1, 0.3, 1.0), "trial")

    def drive(self, model, x):
        return x.time, x.q[self.index[0]]

    def next_memory(self, memory, before, drive):
        (t0, q0), (t, q) = before, drive
        halfway = self.decay(0.5 * (t - t0))
        return memory * halfway**2 + (q - q0)[None] * halfway

    def torque(self, x, memory, h):
        return h.at[self.index[0]].add(self.stiffness * memory.mean(axis=0))


class PassiveTendon(CatalogueEffect):
    """κ x and −ρ κ x on joints a and b: an unmeasured elastic tendon, taut where x = q_a − ρ q_b − φ > 0.

    A spring k on moment arms r_a, r_b with slack l₀ has κ = k r_a², ρ = r_b/r_a, φ = l₀/r_a (Borghesan 2010).
    """

    ID: ClassVar = "passive_tendon"
    PLACE: ClassVar = "joint pair"
    HAPPENS: ClassVar = "An elastic tendon that is not measured couples two joints."
    LOOKS: ClassVar = "Torque at one joint depends on the angle of the other, on one side of a line only."
    CHANGE: ClassVar = "Add a passive tendon with this stiffness, ratio and slack, or slacken it."

    kappa: Float[Array, ""] = amplitude("N m/rad", 1.5, "torque/angle")
    rho: Float[Array, ""] = shape("1", (0.5, 0.8, 1.0, 1.3, 2.0))
    phi: Float[Array, ""] = shape("rad", (-0.7, -0.35, -0.18, 0.0, 0.18, 0.35), "angle", moves="by differences")
    side: Float[Array, ""] = shape(
        "1",
        (1.0, -1.0),
        moves="not",
        says=("taut where q_a − rho q_b exceeds phi", "taut where q_a − rho q_b is below phi"),
    )

    def torque(self, x, memory, h):
        a, b = self.index
        tension = self.kappa * jnp.maximum(self.side * (x.q[a] - self.rho * x.q[b] - self.phi), 0.0)
        return h.at[a].add(self.side * tension).at[b].add(-self.side * self.rho * tension)
