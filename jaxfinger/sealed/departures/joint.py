"""Departures at the joints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from . import presliding
from .base import Departure, Memory, add_at, put_at


@dataclass(frozen=True, eq=False)
class Stribeck(Departure):
    """limit · (1 + a g(|q̇|/v_s)): friction falls after breakaway. g is Gaussian, exponential, Lorentzian or a stretched
    exponential.
    """

    effect: ClassVar[str] = "joint_stribeck"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.5
    largest: ClassVar[float] = 3.0
    forms: ClassVar[tuple[str, ...]] = ("gaussian", "exponential", "lorentzian")
    foreign: ClassVar[tuple[str, ...]] = ("stretched_exponential",)

    def coulomb(self, finger, s, limit, decided):
        j = self.index[0]
        x = np.abs(s.qd[..., j]) / self.shape["v_s"]
        g = {
            "gaussian": np.exp(-(x**2)),
            "exponential": np.exp(-x),
            "lorentzian": 1 / (1 + x**2),
            "stretched_exponential": np.exp(-np.sqrt(x)),
        }[self.form]
        return put_at(limit, j, limit[..., j] * (1 + self.size * g)), decided


@dataclass(frozen=True, eq=False)
class JointPresliding(Memory):
    """Friction that builds up over an angle after each reversal. The size is the presliding angle."""

    effect: ClassVar[str] = "joint_presliding"
    units: ClassVar[str] = "rad"
    start_size: ClassVar[float] = 0.02
    largest: ClassVar[float] = 0.15
    smallest: ClassVar[float] = 2e-3
    forms: ClassVar[tuple[str, ...]] = ("dahl", "lugre", "maxwell_slip")
    foreign: ClassVar[tuple[str, ...]] = ("bouc_wen",)
    states: ClassVar[int] = presliding.ELEMENTS

    def inputs(self, finger, s):
        return s.q[..., self.index[0], None]

    def start(self, u):
        return presliding.towards_first_motion(u[..., 0])

    def step(self, z, before, now, dt):
        return presliding.advance(self.form, z, (now - before)[..., 0], max(self.size, 1e-6))

    def coulomb(self, finger, s, limit, decided):
        j = self.index[0]
        built = limit[..., j] * presliding.friction(self.state(s))
        return put_at(limit, j, np.zeros_like(limit[..., j])), add_at(decided, j, built)


@dataclass(frozen=True, eq=False)
class LoadFriction(Departure):
    """μ Σ |c_k f_k|: the bearing's friction grows with its load from tension, linearly, as a power (Palli 2014), or
    beyond a preload.
    """

    effect: ClassVar[str] = "joint_load_friction"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.08
    largest: ClassVar[float] = 0.6
    forms: ClassVar[tuple[str, ...]] = ("linear", "power")
    foreign: ClassVar[tuple[str, ...]] = ("preloaded",)

    def known(self):
        return {"mu": self.size} if self.form == "linear" else {}

    def coulomb(self, finger, s, limit, decided):
        j = self.index[0]
        load = np.sum(np.abs(finger.geometry(s.q)[1][..., j] * s.f), axis=-1)
        if self.form == "power":
            load = 0.05 * (load / 0.05) ** 0.8
        elif self.form == "preloaded":
            load = np.hypot(load, 0.02) - 0.02
        return add_at(limit, j, self.size * load), decided


@dataclass(frozen=True, eq=False)
class Hardening(Departure):
    """Elastic torque that stiffens towards an end: exponential, cubic beyond an onset, tangent, or sixth power."""

    effect: ClassVar[str] = "elastic_hardening"
    units: ClassVar[str] = "N m"
    start_size: ClassVar[float] = 2e-3
    largest: ClassVar[float] = 0.08
    forms: ClassVar[tuple[str, ...]] = ("exponential", "cubic", "tangent")
    foreign: ClassVar[tuple[str, ...]] = ("sixth_power",)

    def passive(self, finger, s, torque):
        j, side = self.index[0], self.shape["side"]
        low, high = finger.specimen.finger.limits[j]
        x = (s.q[..., j] - low) / (high - low)
        x = np.clip(x if side > 0 else 1 - x, -0.2, 1.1)  # 0 … 1 towards the stiff end
        if self.form == "exponential":
            rise = (np.exp(self.shape["b"] * x) - 1) / (np.exp(self.shape["b"]) - 1)
        elif self.form == "cubic":
            rise = np.maximum((x - self.shape["onset"]) / (1 - self.shape["onset"]), 0.0) ** 3
        elif self.form == "sixth_power":
            rise = np.maximum(x, 0.0) ** 6
        else:
            rise = np.tan(0.42 * np.pi * np.maximum(x, 0.0)) / np.tan(0.42 * np.pi) - 0.4 * np.maximum(x, 0.0)
        return add_at(torque, j, side * self.size * rise)


@dataclass(frozen=True, eq=False)
class Relaxation(Memory):
    """Viscoelastic torque: one Maxwell branch, or three of them over two decades or over three."""

    effect: ClassVar[str] = "elastic_relaxation"
    units: ClassVar[str] = "N m/rad"
    start_size: ClassVar[float] = 2e-3
    largest: ClassVar[float] = 0.03
    forms: ClassVar[tuple[str, ...]] = ("maxwell", "three_maxwell_branches")
    foreign: ClassVar[tuple[str, ...]] = ("wide_spectrum",)
    states: ClassVar[int] = 3

    SPECTRA: ClassVar = {
        "maxwell": (1.0, 1.0, 1.0),
        "three_maxwell_branches": (0.15, 1.0, 6.0),
        "wide_spectrum": (0.04, 1.0, 25.0),
    }

    def _times(self):
        """Relaxation times of the branches, s."""
        return self.shape["tau"] * np.array(self.SPECTRA[self.form])

    def inputs(self, finger, s):
        return s.q[..., self.index[0], None]

    def step(self, z, before, now, dt):
        tau = self._times()
        decay = np.exp(-dt / tau)
        return z * decay + (now - before) * tau * (1 - decay) / max(dt, 1e-9)

    def passive(self, finger, s, torque):
        return add_at(torque, self.index[0], self.size * self.state(s).mean(axis=-1))


@dataclass(frozen=True, eq=False)
class Stop(Departure):
    """Contact inside the range: a linear spring and damper, or Hunt–Crossley x^1.5 (1 + λ ẋ)."""

    effect: ClassVar[str] = "joint_stop"
    units: ClassVar[str] = "N m/rad"
    start_size: ClassVar[float] = 0.05
    largest: ClassVar[float] = 3.0
    forms: ClassVar[tuple[str, ...]] = ("spring_damper", "hunt_crossley")

    def passive(self, finger, s, torque):
        j, side = self.index[0], self.shape["side"]
        depth = np.maximum(side * (s.q[..., j] - self.shape["angle"]), 0.0)
        rate = side * s.qd[..., j]
        if self.form == "spring_damper":
            push = np.maximum(self.size * (depth + 0.01 * rate * (depth > 0)), 0.0)
        else:
            push = np.maximum(self.size * 2.5 * depth**1.5 * (1 + 0.3 * rate), 0.0)
        return add_at(torque, j, side * push)


@dataclass(frozen=True, eq=False)
class PassiveTendon(Departure):
    """An unmeasured elastic tendon over two joints: a one-sided spring, linear or with a toe."""

    effect: ClassVar[str] = "passive_tendon"
    units: ClassVar[str] = "N/m"
    start_size: ClassVar[float] = 300.0
    largest: ClassVar[float] = 3e4
    forms: ClassVar[tuple[str, ...]] = ("linear", "toe")

    def passive(self, finger, s, torque):
        a, b = self.index
        ra, rb = self.shape["r_a"], self.shape["r_b"]
        stretch = np.maximum(ra * s.q[..., a] - rb * s.q[..., b] - self.shape["slack"], 0.0)
        if self.form == "toe":
            stretch = stretch**2 / (stretch + 1e-3)
        force = self.size * stretch
        return add_at(add_at(torque, a, ra * force), b, -rb * force)


@dataclass(frozen=True, eq=False)
class DriveInertia(Departure):
    """Inertia of shaft and coupler between the torque sensor and the joint."""

    effect: ClassVar[str] = "drive_inertia"
    units: ClassVar[str] = "kg m2"
    start_size: ClassVar[float] = 5e-6
    largest: ClassVar[float] = 4e-4
    forms: ClassVar[tuple[str, ...]] = ("rigid",)

    def known(self):
        return {"inertia": self.size}

    def at_motor(self, finger, s, torque):
        j = self.index[0]
        return add_at(torque, j, self.size * s.qdd[..., j])


@dataclass(frozen=True, eq=False)
class TorqueRipple(Departure):
    """Torque periodic in the joint's angle, from cogging or a misaligned coupler: a sine, two harmonics, or a wave with
    flat tops, as of a slotted motor.
    """

    effect: ClassVar[str] = "torque_ripple"
    units: ClassVar[str] = "N m"
    start_size: ClassVar[float] = 1e-3
    largest: ClassVar[float] = 0.01
    forms: ClassVar[tuple[str, ...]] = ("sine", "two_harmonics")
    foreign: ClassVar[tuple[str, ...]] = ("slots",)

    def at_motor(self, finger, s, torque):
        j = self.index[0]
        angle = self.shape["p"] * s.q[..., j] + self.shape["phase"]
        wave = {
            "sine": np.sin(angle),
            "two_harmonics": np.sin(angle) + 0.3 * np.sin(2 * angle + 1.0),
            "slots": np.tanh(2.0 * np.sin(angle)),
        }[self.form]
        return add_at(torque, j, self.size * wave)


@dataclass(frozen=True, eq=False)
class AsymmetricFriction(Departure):
    """Δd |q̇|: viscous friction that differs between the two directions, or shear-thinning, with |q̇|^0.6."""

    effect: ClassVar[str] = "joint_friction_asymmetric"
    units: ClassVar[str] = "N m s/rad"
    start_size: ClassVar[float] = 5e-4
    largest: ClassVar[float] = 0.05
    forms: ClassVar[tuple[str, ...]] = ("viscous",)
    foreign: ClassVar[tuple[str, ...]] = ("shear_thinning",)

    def passive(self, finger, s, torque):
        j = self.index[0]
        speed = np.abs(s.qd[..., j])
        return add_at(torque, j, self.shape["sign"] * self.size * (speed if self.form == "viscous" else speed**0.6))


@dataclass(frozen=True, eq=False)
class TorqueFriction(Departure):
    """μ |τ| s: friction of the external motor's gear, which grows with the torque τ that it passes on to the finger,
    linearly or as a power.
    """

    effect: ClassVar[str] = "joint_torque_friction"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.05
    largest: ClassVar[float] = 0.9
    forms: ClassVar[tuple[str, ...]] = ("linear",)
    foreign: ClassVar[tuple[str, ...]] = ("power",)

    def at_motor(self, finger, s, torque):
        j = self.index[0]
        through = np.abs(torque[..., j])
        if self.form == "power":
            through = 0.01 * (through / 0.01) ** 0.7
        return add_at(torque, j, self.size * through * s.sj[..., j])


@dataclass(frozen=True, eq=False)
class WarmingFriction(Departure):
    """limit · (1 + a g(t)): dry friction that falls as the bearing warms up. g is exponential or rational."""

    effect: ClassVar[str] = "joint_friction_warmup"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.4
    largest: ClassVar[float] = 3.0
    forms: ClassVar[tuple[str, ...]] = ("exponential",)
    foreign: ClassVar[tuple[str, ...]] = ("rational",)

    def coulomb(self, finger, s, limit, decided):
        j = self.index[0]
        t = np.asarray(s.session) / self.shape["tau"]
        g = np.exp(-t) if self.form == "exponential" else 1.0 / (1.0 + t) ** 2
        return put_at(limit, j, limit[..., j] * (1 + self.size * g)), decided
