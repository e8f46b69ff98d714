"""Friction of the tendons' paths beyond the affine law, and tendons that drag one another."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import DELTA, TENSION, CatalogueEffect, dahl


class TendonFrictionCapstan(CatalogueEffect):
    """f (1 − exp(−μ θ(q))), θ = Σ |q_i| over the joints crossed: the loss grows with the wrap, so with posture.

    `curvature` 1 is Euler and Eytelwein's law, 0 its first order, f μ θ.
    """

    ID: ClassVar = "tendon_friction_capstan"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"mu": ("1/rad", 0.1, False)}
    SIZES: ClassVar = (1.0, 0.05)
    SHAPES: ClassVar = {"curvature": ("1", (1.0, 0.0))}
    CHOICES: ClassVar = ("curvature",)
    SHOWS: ClassVar = TENSION

    mu: Float[Array, ""]
    curvature: Float[Array, ""]
    crossed: Float[Array, " m"]

    @classmethod
    def constants(cls, finger, site):
        return {"crossed": jnp.asarray(finger.crosses[finger.tendon_names.index(site[0])], dtype=float)}

    def loss(self, x, f, C, loss):
        k = self.index[0]
        wrap = jnp.sum(self.crossed.reshape(-1, *(1,) * (x.q.ndim - 1)) * jnp.abs(x.q), axis=0)
        straight = self.mu * wrap
        return loss.at[k].add(f[k] * (straight + self.curvature * (1.0 - jnp.exp(-straight) - straight)))


class TendonFrictionViscous(CatalogueEffect):
    """b |l̇|: friction grows with the tendon's speed (sheath, lubricant)."""

    ID: ClassVar = "tendon_friction_viscous"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"b": ("N s/m", 30.0, False)}
    SHOWS: ClassVar = {"VD.3": ("joint_torque",)}

    b: Float[Array, ""]

    def loss(self, x, f, C, loss):
        k = self.index[0]
        return loss.at[k].add(self.b * jnp.abs(jnp.sum(C[k] * x.qd, axis=0)))


class TendonFrictionPresliding(CatalogueEffect):
    """Friction builds up over a small excursion x₀ after each reversal: dz = (1 − z sgn dl)^δ dl/x₀ (Dahl, LuGre).

    At a held joint a tendon that `stretches` (1) slides by its own stretch, in proportion to tension: there the length
    is f₀ of tension. One that does not (0) has the nominal friction there. `a` is the share of the loss that behaves
    so.
    """

    ID: ClassVar = "tendon_friction_presliding"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"a": ("1", 1.0, False)}
    SHARES: ClassVar = ("a",)
    SHAPES: ClassVar = {
        "x0": ("m", (3e-5, 1e-4, 3e-4, 1e-3, 3e-3)),
        "f0": ("N", (0.3, 1.0, 3.0)),
        "stretches": ("1", (1.0, 0.0)),
        "delta": DELTA,
    }
    CHOICES: ClassVar = ("stretches", "delta")
    SHOWS: ClassVar = TENSION
    has_memory: ClassVar = True
    sharp: ClassVar = True

    a: Float[Array, ""]
    x0: Float[Array, ""]
    f0: Float[Array, ""]
    stretches: Float[Array, ""]
    delta: Float[Array, ""]

    @classmethod
    def shapes(cls, finger, site):
        first = cls.SHAPES["f0"][1][0]
        return [s for s in super().shapes(finger, site) if (s["stretches"] and s["delta"] == 1) or s["f0"] == first]

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
    """c f* ((f/f*)^p − f/f*), f* = 10 N: the loss is not affine in tension."""

    ID: ClassVar = "tendon_friction_saturating"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"c": ("1", 0.15, True)}
    SHAPES: ClassVar = {"p": ("1", (0.5, 2.0))}
    SHIFTS: ClassVar = ("p",)
    SHOWS: ClassVar = TENSION

    c: Float[Array, ""]
    p: Float[Array, ""]

    def loss(self, x, f, C, loss):
        k = self.index[0]
        u = jnp.maximum(f[k], 1e-6) / 10.0
        return loss.at[k].add(10.0 * self.c * (u**self.p - u))


class TendonCrosstalk(CatalogueEffect):
    """f_k + ε max(f_j − f₀, 0): a pulled tendon j drags its neighbour k, from the tension on at which they touch.

    `behind` 0: at the actuators, so that the neighbour's friction takes its share; 1: past the friction of both.
    `onset` is f₀.
    """

    ID: ClassVar = "tendon_crosstalk"
    PLACE: ClassVar = "tendon pair"
    AMPLITUDES: ClassVar = {"epsilon": ("1", 0.05, False)}
    SIZES: ClassVar = (1.0, 0.05)
    SHAPES: ClassVar = {"behind": ("1", (0.0, 1.0)), "onset": ("N", (0.0, 4.0))}
    CHOICES: ClassVar = ("behind",)
    SHIFTS: ClassVar = ("onset",)
    SHOWS: ClassVar = TENSION

    epsilon: Float[Array, ""]
    behind: Float[Array, ""]
    onset: Float[Array, ""]

    def _drag(self, f):
        return self.epsilon * jnp.maximum(f[self.index[1]] - self.onset, 0.0)

    def tension(self, x, memory, f):
        return f.at[self.index[0]].add((1.0 - self.behind) * self._drag(x.tension))

    def delivered(self, x, f_j):
        return f_j.at[self.index[0]].add(self.behind * self._drag(f_j))
