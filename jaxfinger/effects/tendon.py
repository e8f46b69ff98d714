"""Tendons: they stretch, creep and lag; their moment arms couple joints and grow with tension."""

from itertools import combinations
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import BOTH, EXCURSION, CatalogueEffect


class TendonStretch(CatalogueEffect):
    """c (f + β f₀ (1 − exp(−f/f₀))): it lengthens under tension, softer while its fibres straighten (the toe)."""

    ID: ClassVar = "tendon_stretch"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"compliance": ("m/N", 5e-5, False)}
    SHAPES: ClassVar = {"toe": ("1", (0.0, 2.0, 6.0)), "f0": ("N", (1.0, 3.0))}
    SHIFTS: ClassVar = ("toe",)
    SHOWS: ClassVar = EXCURSION

    compliance: Float[Array, ""]
    toe: Float[Array, ""]
    f0: Float[Array, ""]

    def excursion(self, x, memory, f, l):
        k = self.index[0]
        taut = jnp.maximum(f[k], 0.0)
        return l.at[k].add(self.compliance * (taut + self.toe * self.f0 * (1.0 - jnp.exp(-taut / self.f0))))


class TendonCreep(CatalogueEffect):
    """c y, T ẏ = f − y: the tendon goes on lengthening under held tension (Kelvin–Voigt)."""

    ID: ClassVar = "tendon_creep"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"compliance": ("m/N", 1e-5, False)}
    SHAPES: ClassVar = {"T": ("s", (0.5, 1.5, 5.0, 15.0, 50.0))}
    SHOWS: ClassVar = EXCURSION
    has_memory: ClassVar = True

    compliance: Float[Array, ""]
    T: Float[Array, ""]

    def drive(self, model, x):
        return x.time, x.tension[self.index[0]]

    def initial_memory(self, drive):
        return jnp.zeros_like(drive[1])

    def next_memory(self, memory, before, drive):
        (t0, _), (t, f) = before, drive
        return f + (memory - f) * jnp.exp(-(t - t0) / self.T)

    def excursion(self, x, memory, f, l):
        return l.at[self.index[0]].add(self.compliance * memory)


class TendonBacklash(CatalogueEffect):
    """Excursion lags by a dead zone: p = clip(p before, f(q) − b/2, f(q) + b/2), the play operator.

    `a` is the share of the excursion that goes through the dead zone `width`; 1 where all of it does. None
    narrower than 10 µm, an encoder's noise, is looked for.
    """

    ID: ClassVar = "tendon_backlash"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"a": ("1", 1.0, False)}
    SHARES: ClassVar = ("a",)
    SHAPES: ClassVar = {"width": ("m", (2e-5, 4e-5, 8e-5, 1.6e-4, 3.2e-4, 6.4e-4))}
    SHOWS: ClassVar = EXCURSION
    has_memory: ClassVar = True
    sharp: ClassVar = True

    a: Float[Array, ""]
    width: Float[Array, ""]

    def drive(self, model, x):
        return model.moment_arm.of(self.index[0]).excursion(x.q)[0]

    def initial_memory(self, drive):
        return drive, jnp.zeros_like(drive)

    def next_memory(self, memory, before, drive):
        played = jnp.clip(memory[0], drive - 0.5 * self.width, drive + 0.5 * self.width)
        return played, played - drive

    def excursion(self, x, memory, f, l):
        return l.at[self.index[0]].add(self.a * memory[1])


class MomentArmCoupling(CatalogueEffect):
    """A q_a q_b + B q_a² q_b + D q_a q_b²: excursion depends on two joints together."""

    ID: ClassVar = "moment_arm_coupling"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"A": ("m", 5e-4, True), "B": ("m", 3e-4, True), "D": ("m", 3e-4, True)}
    SHAPES: ClassVar = {"joint_a": ("1", (0.0,)), "joint_b": ("1", (1.0,))}
    CHOICES: ClassVar = ("joint_a", "joint_b")
    SHOWS: ClassVar = BOTH

    A: Float[Array, ""]
    B: Float[Array, ""]
    D: Float[Array, ""]
    joint_a: Float[Array, ""]
    joint_b: Float[Array, ""]

    @classmethod
    def sites(cls, finger):
        return [s for s in super().sites(finger) if sum(finger.crosses[finger.tendon_names.index(s[0])]) > 1]

    @classmethod
    def shapes(cls, finger, site):
        crossed = [i for i, c in enumerate(finger.crosses[finger.tendon_names.index(site[0])]) if c]
        return [{"joint_a": float(a), "joint_b": float(b)} for a, b in combinations(crossed, 2)]

    def _joints(self):
        return self.joint_a.astype(int), self.joint_b.astype(int)

    def excursion(self, x, memory, f, l):
        a, b = self._joints()
        qa, qb = x.q[a], x.q[b]
        return l.at[self.index[0]].add(qa * qb * (self.A + self.B * qa + self.D * qb))

    def coupling(self, x, f, C):
        (a, b), k = self._joints(), self.index[0]
        qa, qb = x.q[a], x.q[b]
        C = C.at[k, a].add(qb * (self.A + 2 * self.B * qa + self.D * qb))
        return C.at[k, b].add(qa * (self.A + self.B * qa + 2 * self.D * qb))


class MomentArmBowstring(CatalogueEffect):
    """C (1 + b f), l = f(q) (1 + b f): the tendon lifts off, and its moment arm grows with tension."""

    ID: ClassVar = "moment_arm_bowstring"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"b": ("1/N", 0.01, False)}
    SHOWS: ClassVar = BOTH

    b: Float[Array, ""]

    def excursion(self, x, memory, f, l):
        k = self.index[0]
        return l.at[k].multiply(1.0 + self.b * f[k])

    def coupling(self, x, f, C):
        k = self.index[0]
        return C.at[k].multiply(1.0 + self.b * f[k])
