"""Departures of the tendons."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from . import presliding
from .base import Departure, Memory, add_at, put_at


@dataclass(frozen=True, eq=False)
class Stretch(Departure):
    """Stretch under tension: linear, with a toe, as a power law, or linear in the mean tension along the path, which
    friction changes. The size is the compliance.
    """

    effect: ClassVar[str] = "tendon_stretch"
    units: ClassVar[str] = "m/N"
    start_size: ClassVar[float] = 4e-5
    largest: ClassVar[float] = 3e-4
    forms: ClassVar[tuple[str, ...]] = ("linear", "toe_hardening", "friction_averaged")
    foreign: ClassVar[tuple[str, ...]] = ("power_law",)

    def known(self):
        return {"compliance": self.size} if self.form == "linear" else {}

    def path(self, finger, s, length, arm):
        k = self.index[0]
        f = np.maximum(s.f[..., k], 0.0)
        if self.form == "toe_hardening":
            toe = self.shape["toe"]
            f = f - toe * (1 - np.exp(-f / toe)) * 0.5 + 0.5 * toe * np.log1p(f / toe)
        elif self.form == "friction_averaged" and (s.held or s.st is not None):
            reaching = finger.reaching_held(s) if s.held else finger.reaching_sliding(s)
            f = 0.5 * (f + np.maximum(reaching[..., k], 0.0))
        elif self.form == "power_law":
            f = 5.0 * (f / 5.0) ** 0.55
        return add_at(length, k, self.size * f), arm


@dataclass(frozen=True, eq=False)
class Creep(Memory):
    """Creep under held tension: one Kelvin–Voigt element, or four over three decades (nearly logarithmic in time)."""

    effect: ClassVar[str] = "tendon_creep"
    units: ClassVar[str] = "m/N"
    start_size: ClassVar[float] = 2e-5
    largest: ClassVar[float] = 3e-4
    forms: ClassVar[tuple[str, ...]] = ("kelvin_voigt", "log_time")
    states: ClassVar[int] = 4

    def inputs(self, finger, s):
        return np.maximum(s.f[..., self.index[0], None], 0.0)

    def step(self, z, before, now, dt):
        spread = np.ones(4) if self.form == "kelvin_voigt" else 10.0 ** np.array([-1.5, -0.5, 0.5, 1.5])
        return now + (z - now) * np.exp(-dt / (self.shape["tau"] * spread))

    def path(self, finger, s, length, arm):
        return add_at(length, self.index[0], self.size * self.state(s).mean(axis=-1)), arm


@dataclass(frozen=True, eq=False)
class Backlash(Memory):
    """Dead zone between tendon and encoder: a play operator, or elastic slip with rounded corners."""

    effect: ClassVar[str] = "tendon_backlash"
    units: ClassVar[str] = "m"
    start_size: ClassVar[float] = 5e-5
    largest: ClassVar[float] = 2e-3
    forms: ClassVar[tuple[str, ...]] = ("play", "rounded")

    def inputs(self, finger, s):
        return finger.geometry(s.q)[0][..., self.index[0], None]

    def step(self, z, before, now, dt):
        half = max(self.size, 1e-12) / 2
        if self.form == "play":  # z in [−1, 1]: offset of the output from the input over half the dead zone
            return np.clip(z - (now - before) / half, -1.0, 1.0)
        dx = now - before
        return -np.sign(dx) - (-np.sign(dx) - z) * np.exp(-np.abs(dx) / half)

    def path(self, finger, s, length, arm):
        return add_at(length, self.index[0], 0.5 * self.size * self.state(s)[..., 0]), arm


@dataclass(frozen=True, eq=False)
class Coupling(Departure):
    """Excursion that depends on two joints together: a product of sines, of angles, of a sine and a square, or the
    straight run between an eyelet before both joints and one behind them.
    """

    effect: ClassVar[str] = "moment_arm_coupling"
    units: ClassVar[str] = "m"
    start_size: ClassVar[float] = 1e-4
    largest: ClassVar[float] = 2e-3
    forms: ClassVar[tuple[str, ...]] = ("sines", "product", "sin_square")
    foreign: ClassVar[tuple[str, ...]] = ("straight_run",)

    def path(self, finger, s, length, arm):
        k, (a, b) = self.index[0], self.index[1:]
        x, y = s.q[..., a], s.q[..., b]
        if self.form == "sines":
            value, by_a, by_b = np.sin(x) * np.sin(y), np.cos(x) * np.sin(y), np.sin(x) * np.cos(y)
        elif self.form == "product":
            value, by_a, by_b = x * y, y, x
        elif self.form == "straight_run":
            run = np.sqrt(1.3 + np.cos(x + y))
            value, by_a, by_b = run, -0.5 * np.sin(x + y) / run, -0.5 * np.sin(x + y) / run
        else:
            value, by_a, by_b = np.sin(x) * y**2, np.cos(x) * y**2, 2 * np.sin(x) * y
        arm = np.array(arm)
        arm[..., k, a] += self.size * by_a
        arm[..., k, b] += self.size * by_b
        return add_at(length, k, self.size * value), arm


@dataclass(frozen=True, eq=False)
class Bowstring(Departure):
    """c(q) (1 + b g(f)): the tendon lifts off under tension. g is linear, saturating, beyond a threshold, or a root."""

    effect: ClassVar[str] = "moment_arm_bowstring"
    units: ClassVar[str] = "1/N"
    start_size: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.15
    forms: ClassVar[tuple[str, ...]] = ("linear", "saturating", "threshold")
    foreign: ClassVar[tuple[str, ...]] = ("root",)

    def known(self):
        return {"b": self.size} if self.form == "linear" else {}

    def path(self, finger, s, length, arm):
        k = self.index[0]
        f = np.maximum(s.f[..., k], 0.0)
        g = {
            "linear": f,
            "saturating": f / (1 + f / 12.0),
            "threshold": np.logaddexp(0.0, (f - 4.0) / 0.7) * 0.7,
            "root": 3.0 * (np.sqrt(1.0 + f / 1.5) - 1.0),
        }[self.form]
        nominal, nominal_arm = finger.geometry(s.q)
        arm = np.array(arm)
        arm[..., k, :] += self.size * g[..., None] * nominal_arm[..., k, :]
        return add_at(length, k, self.size * g * nominal[..., k]), arm


@dataclass(frozen=True, eq=False)
class Capstan(Departure):
    """Friction that grows with the wrap angle: Euler–Eytelwein's law, its first order, with angles weighted by the
    pulleys' radii, or beyond an angle at which the tendon touches its pulley.
    """

    effect: ClassVar[str] = "tendon_friction_capstan"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.1
    largest: ClassVar[float] = 0.9
    forms: ClassVar[tuple[str, ...]] = ("exponential", "linear_wrap", "pulley_radii")
    foreign: ClassVar[tuple[str, ...]] = ("late_contact",)

    def known(self):
        return {"mu": self.size} if self.form in ("exponential", "linear_wrap") else {}

    def loss(self, finger, s, limit, decided):
        k = self.index[0]
        crossed = finger.specimen.finger.crosses[k]
        angle = np.abs(s.q[..., crossed])
        if self.form == "pulley_radii":
            arm = np.abs(finger.geometry(np.zeros(finger.m))[1][k, crossed])
            angle = angle * arm / arm.mean()
        elif self.form == "late_contact":
            angle = np.maximum(angle - 0.25, 0.0)
        wrap = self.size * angle.sum(axis=-1)
        share = wrap if self.form == "linear_wrap" else 1 - np.exp(-wrap)
        return add_at(limit, k, np.maximum(s.f[..., k], 0.0) * share), decided


@dataclass(frozen=True, eq=False)
class ViscousTendon(Departure):
    """Friction that grows with the tendon's speed, linearly or shear-thinning, with |l̇|^0.7."""

    effect: ClassVar[str] = "tendon_friction_viscous"
    units: ClassVar[str] = "N s/m"
    start_size: ClassVar[float] = 10.0
    largest: ClassVar[float] = 600.0
    forms: ClassVar[tuple[str, ...]] = ("linear", "shear_thinning")

    def known(self):
        return {"b": self.size} if self.form == "linear" else {}

    def loss(self, finger, s, limit, decided):
        k = self.index[0]
        speed = finger.speed(s)[..., k]
        if self.form == "shear_thinning":
            speed = 0.01 * speed / (np.abs(speed) + 1e-4) ** 0.3 / 0.01**0.7
        pull = np.maximum(s.f[..., k], 0.0)
        return limit, add_at(decided, k, np.clip(self.size * speed, -pull, pull))


@dataclass(frozen=True, eq=False)
class TendonPresliding(Memory):
    """Friction that builds up over an excursion after each reversal. The size is that excursion.

    At held joints the nominal hysteresis stays, since an inextensible tendon does not move there.
    """

    effect: ClassVar[str] = "tendon_friction_presliding"
    units: ClassVar[str] = "m"
    start_size: ClassVar[float] = 2e-4
    largest: ClassVar[float] = 2e-3
    smallest: ClassVar[float] = 5e-5
    forms: ClassVar[tuple[str, ...]] = ("dahl", "lugre", "maxwell_slip")
    foreign: ClassVar[tuple[str, ...]] = ("bouc_wen",)
    states: ClassVar[int] = presliding.ELEMENTS

    def inputs(self, finger, s):
        return finger.geometry(s.q)[0][..., self.index[0], None]

    def start(self, u):
        return presliding.towards_first_motion(u[..., 0])

    def step(self, z, before, now, dt):
        return presliding.advance(self.form, z, (now - before)[..., 0], max(self.size, 1e-9))

    def loss(self, finger, s, limit, decided):
        if s.held:
            return limit, decided
        k = self.index[0]
        built = limit[..., k] * presliding.friction(self.state(s))
        return put_at(limit, k, np.zeros_like(limit[..., k])), add_at(decided, k, built)


@dataclass(frozen=True, eq=False)
class Saturating(Departure):
    """Friction that is not affine in tension: −b f², a power law, a₁ f/(1 + f/f₀), or a logarithm."""

    effect: ClassVar[str] = "tendon_friction_saturating"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.05
    largest: ClassVar[float] = 0.6
    forms: ClassVar[tuple[str, ...]] = ("quadratic", "power_law", "hyperbolic")
    foreign: ClassVar[tuple[str, ...]] = ("logarithmic",)

    def loss(self, finger, s, limit, decided):
        k = self.index[0]
        f = np.maximum(s.f[..., k], 0.0)
        bend = {
            "quadratic": f * (1 - f / 12.0),
            "power_law": 12.0 * (f / 12.0) ** 0.6,
            "hyperbolic": f / (1 + f / 4.0) * 2,
            "logarithmic": 4.0 * np.log1p(f / 2.0),
        }[self.form]
        return add_at(limit, k, self.size * bend), decided


@dataclass(frozen=True, eq=False)
class Crosstalk(Departure):
    """f_k + ε f_j: a pulled tendon j drags its neighbour k, linearly or beyond a threshold. The site is (k, j)."""

    effect: ClassVar[str] = "tendon_crosstalk"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.03
    largest: ClassVar[float] = 0.4
    forms: ClassVar[tuple[str, ...]] = ("linear", "threshold")

    def deliver(self, finger, s, reaching):
        dragged, pulled = self.index
        f = np.maximum(reaching[..., pulled], 0.0)
        if self.form == "threshold":
            f = np.logaddexp(0.0, (f - 3.0) / 0.5) * 0.5
        return add_at(reaching, dragged, self.size * f)
