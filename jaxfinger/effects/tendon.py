"""Effects of the tendons: stretch, creep and backlash; moment arms that couple joints or grow with tension."""

from itertools import combinations
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, amplitude, shape
from jaxfinger.effects.spectrum import RelaxingEffect


class TendonStretch(CatalogueEffect):
    """compliance (f + toe f₀ (1 − exp(−f/f₀))): stretch, softer at low tension while the fibres straighten (toe)."""

    ID: ClassVar = "tendon_stretch"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The tendon lengthens under tension."
    LOOKS: ClassVar = "Excursion changes with tension while no joint moves."
    CHANGE: ClassVar = "Use a stiffer tendon, or give the simulator's tendon this compliance."

    compliance: Float[Array, ""] = amplitude("m/N", 0.04, "excursion/tension")
    toe: Float[Array, ""] = shape("1", (0.0, 2.0, 6.0), moves="by differences")
    f0: Float[Array, ""] = shape("N", (0.1, 0.3), "tension")

    def excursion(self, x, memory, f, l):
        k = self.index[0]
        taut = jnp.maximum(f[k], 0.0)
        return l.at[k].add(self.compliance * (taut + self.toe * self.f0 * (1.0 - jnp.exp(-taut / self.f0))))


class TendonCreep(RelaxingEffect):
    """compliance · y, T ẏ = f − y: the tendon creeps under held tension (Kelvin–Voigt).

    With `decades` y is the mean over a spectrum of times about T, and creep goes on with the logarithm of time.
    """

    ID: ClassVar = "tendon_creep"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The tendon goes on lengthening while its tension is held."
    LOOKS: ClassVar = "Excursion drifts during each hold, more and more slowly."
    CHANGE: ClassVar = "Pre-stretch the tendon, wait longer at holds, or add Kelvin-Voigt elements."

    compliance: Float[Array, ""] = amplitude("m/N", 0.01, "excursion/tension")
    T: Float[Array, ""] = shape("s", (0.015, 0.05, 0.15, 0.5, 1.5), "trial")

    def drive(self, model, x):
        return x.time, x.tension[self.index[0]]

    def next_memory(self, memory, before, drive):
        (t0, _), (t, f) = before, drive
        return f[None] + (memory - f[None]) * self.decay(t - t0)

    def excursion(self, x, memory, f, l):
        return l.at[self.index[0]].add(self.compliance * memory.mean(axis=0))


class TendonBacklash(CatalogueEffect):
    """f + a (p − f), p = clip(p before, f − width/2, f + width/2): the excursion f(q) lags by a dead zone.

    `a` is the share of the excursion that goes through the dead zone `width` (play operator).
    """

    ID: ClassVar = "tendon_backlash"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "The excursion lags by a dead zone at each reversal."
    LOOKS: ClassVar = "Excursion against angle is a loop whose branches are a fixed distance apart."
    CHANGE: ClassVar = "Remove play between spool and tendon, or add a play of this width."
    sharp: ClassVar = True

    a: Float[Array, ""] = amplitude("1", 1.0, most=1.0)
    width: Float[Array, ""] = shape("m", (0.0017, 0.0033, 0.0067, 0.013, 0.027, 0.053), "excursion")

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
    """A q_a q_b + B q_a² q_b + D q_a q_b²: the excursion depends on products of two joints' angles."""

    ID: ClassVar = "moment_arm_coupling"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "A tendon's excursion depends on two joints together, not on each by itself."
    LOOKS: ClassVar = "Its moment arm at one joint changes with the angle of the other."
    CHANGE: ClassVar = (
        "Record a trial that moves both, and set `cross_terms` in the recipe; or route the tendon apart from one joint."
    )

    A: Float[Array, ""] = amplitude("m", 0.08, "excursion/angle/angle", signed=True)
    B: Float[Array, ""] = amplitude("m", 0.07, "excursion/angle/angle/angle", signed=True)
    D: Float[Array, ""] = amplitude("m", 0.07, "excursion/angle/angle/angle", signed=True)
    joint_a: Float[Array, ""] = shape("1", (0.0,), moves="not")
    joint_b: Float[Array, ""] = shape("1", (1.0,), moves="not")

    @classmethod
    def sites(cls, finger):
        return [s for s in super().sites(finger) if sum(finger.crosses[finger.tendon_names.index(s[0])]) > 1]

    @classmethod
    def shapes(cls, finger, site, scales):
        crossed = [i for i, c in enumerate(finger.crosses[finger.tendon_names.index(site[0])]) if c]
        return [{"joint_a": float(a), "joint_b": float(b)} for a, b in combinations(crossed, 2)]

    @classmethod
    def form(cls, finger, values):
        """The two joints, by name."""
        return [f"of {' and '.join(finger.joint_names[int(values[n])] for n in cls.shape_parameters())}"]

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
    HAPPENS: ClassVar = "The tendon lifts off under load and its moment arm grows."
    LOOKS: ClassVar = "Excursion and torque grow faster than the tension."
    CHANGE: ClassVar = "Add a pulley or a sheath, or let the moment arm grow with tension."

    b: Float[Array, ""] = amplitude("1/N", 0.1, "1/tension")

    def excursion(self, x, memory, f, l):
        k = self.index[0]
        return l.at[k].multiply(1.0 + self.b * f[k])

    def coupling(self, x, f, C):
        k = self.index[0]
        return C.at[k].multiply(1.0 + self.b * f[k])
