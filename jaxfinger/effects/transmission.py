"""Friction of the tendons' paths beyond the affine law, and crosstalk between tendons."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude, shape
from jaxfinger.effects.presliding import dahl, delta


class TendonFrictionCapstan(CatalogueEffect):
    """f (1 − exp(−μ θ(q))), θ = Σ |q_i| over the joints crossed: the loss grows with the wrap angle, so with posture.

    `curvature` 1 is Euler and Eytelwein's law; 0 is its first order, f μ θ.
    """

    ID: ClassVar = "tendon_friction_capstan"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The tendon's friction grows with the angle of its wrap, so with posture."
    LOOKS: ClassVar = "The share of tension that is lost rises as the finger flexes."
    CHANGE: ClassVar = "Use Euler and Eytelwein's law for the wrap, or larger pulleys."
    SIZES: ClassVar = (1.0, 0.05)

    crossed: Float[Array, " m"]
    mu: Float[Array, ""] = amplitude("1/rad", 0.1)
    curvature: Float[Array, ""] = shape(
        "1", (1.0, 0.0), moves="not", says=("Euler and Eytelwein's law", "in proportion to the wrap")
    )

    @classmethod
    def constants(cls, finger, site):
        return {"crossed": jax.device_put(np.array(finger.crosses[finger.tendon_names.index(site[0])], float))}

    def loss(self, x, f, C, loss):
        k = self.index[0]
        wrap = jnp.sum(self.crossed.reshape(-1, *(1,) * (x.q.ndim - 1)) * jnp.abs(x.q), axis=0)
        straight = self.mu * wrap
        return loss.at[k].add(f[k] * (straight + self.curvature * (1.0 - jnp.exp(-straight) - straight)))


class TendonFrictionViscous(CatalogueEffect):
    """b |l̇|: friction grows with the tendon's speed (sheath, lubricant)."""

    ID: ClassVar = "tendon_friction_viscous"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The tendon's friction grows with its speed."
    LOOKS: ClassVar = "More tension is lost in fast motions than in slow ones."
    CHANGE: ClassVar = "Add damping to the tendon, or change the lubricant of its sheath."

    b: Float[Array, ""] = amplitude("N s/m", 0.04, "tension/pull")

    def loss(self, x, f, C, loss):
        k = self.index[0]
        return loss.at[k].add(self.b * jnp.abs(jnp.sum(C[k] * x.qd, axis=0)))


class TendonFrictionPresliding(CatalogueEffect):
    """dz = (1 − z sgn dl)^δ dl/x₀: after a reversal the share `a` of friction builds up over an excursion x₀, or f₀ of
    tension at held joints (Dahl, LuGre).

    At held joints a tendon that `stretches` (1) slides in proportion to its tension: friction builds up over a change
    f₀ of tension. One that does not stretch (0) has the nominal friction there.
    """

    ID: ClassVar = "tendon_friction_presliding"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The tendon's friction builds up over a small excursion after each reversal."
    LOOKS: ClassVar = "Torque follows tension with rounded corners after each step back."
    CHANGE: ClassVar = "Give the tendon a Dahl or LuGre friction with this length."
    sharp: ClassVar = True

    a: Float[Array, ""] = amplitude("1", 1.0, most=1.0)
    x0: Float[Array, ""] = shape("m", (0.0025, 0.008, 0.025, 0.08, 0.25), "excursion")
    f0: Float[Array, ""] = shape("N", (0.03, 0.1, 0.3), "tension")
    stretches: Float[Array, ""] = shape(
        "1", (1.0, 0.0), moves="not", says=("at held joints too", "at moving joints alone")
    )
    delta: Float[Array, ""] = delta()

    @classmethod
    def sensible(cls, scales, site, shapes):
        first = cls.worth_trying(scales, site)["f0"][0]
        return bool(shapes["stretches"] and shapes["delta"] == 1) or shapes["f0"] == first

    def drive(self, model, x):
        k = self.index[0]
        return x.tension[k] / self.f0 if x.held else model.moment_arm.of(k).excursion(x.q)[0] / self.x0

    def initial_memory(self, drive):
        return jnp.zeros_like(drive)

    def next_memory(self, memory, before, drive):
        return dahl(memory, drive - before, self.delta)

    def directions(self, x, memory, joint, tendon):
        k = self.index[0]
        return joint, tendon.at[k].set((1 - self.a) * tendon[k] + self.a * memory)

    def held_tension(self, x, memory, f, loss, f_j):
        k = self.index[0]
        built_up = f[k] - memory * loss[k]
        return f_j.at[k].add(self.stretches * self.a * (built_up - f_j[k]))


class TendonFrictionSaturating(CatalogueEffect):
    """c f* ((f/f*)^p − f/f*), f* a large tension: part of the loss that is not affine in tension."""

    ID: ClassVar = "tendon_friction_saturating"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The tendon's loss is not a straight line in its tension."
    LOOKS: ClassVar = "The share of tension that is lost falls, or rises, from low tension to high."
    CHANGE: ClassVar = "Use a power law for the tendon's friction; record more tensions in ID.4."

    c: Float[Array, ""] = amplitude("1", 0.15, signed=True)
    p: Float[Array, ""] = shape("1", (0.5, 2.0), moves="by differences")
    large: Float[Array, ""] = shape("N", (1.0,), "tension", moves="not")

    def loss(self, x, f, C, loss):
        k = self.index[0]
        u = jnp.maximum(f[k] / self.large, 1e-7)
        return loss.at[k].add(self.c * self.large * (u**self.p - u))


class TendonCrosstalk(CatalogueEffect):
    """f_k + ε max(f_j − f₀, 0): a pulled tendon j drags its neighbour k once its tension exceeds the `onset` f₀.

    The drag adds to the tension at the actuators (`behind` 0), so that the neighbour's friction takes a share of it, or
    past the friction of both tendons (1).
    """

    ID: ClassVar = "tendon_crosstalk"
    PLACE: ClassVar = "tendon pair"
    HAPPENS: ClassVar = "A tendon that is pulled drags its neighbour along."
    LOOKS: ClassVar = "Torque at a joint grows with the tension of a tendon that does not cross it."
    CHANGE: ClassVar = "Separate the two paths, or add the drag to the neighbour's tension."
    SIZES: ClassVar = (1.0, 0.05)

    epsilon: Float[Array, ""] = amplitude("1", 0.05)
    behind: Float[Array, ""] = shape(
        "1",
        (0.0, 1.0),
        moves="not",
        says=("before the friction of the tendon that is dragged", "past the friction of both tendons"),
    )
    onset: Float[Array, ""] = shape("N", (0.0, 0.4), "tension", moves="by differences")

    def _drag(self, f):
        return self.epsilon * jnp.maximum(f[self.index[1]] - self.onset, 0.0)

    def tension(self, x, memory, f):
        return f.at[self.index[0]].add((1.0 - self.behind) * self._drag(x.tension))

    def delivered(self, x, f_j):
        return f_j.at[self.index[0]].add(self.behind * self._drag(f_j))
