"""Departures that the catalogue of the diagnosis lacks. The right verdict is that no known effect explains them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .base import Departure, Memory, add_at


@dataclass(frozen=True, eq=False)
class MotorCogging(Departure):
    """Cogging of a tendon's motor behind its force sensor: the tension that acts ripples with the excursion."""

    effect: ClassVar[str] = "gear cogging of a tendon's motor, in tension"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "N"
    start_size: ClassVar[float] = 0.3
    largest: ClassVar[float] = 3.0
    forms: ClassVar[tuple[str, ...]] = ("sine",)

    def deliver(self, finger, s, reaching):
        k = self.index[0]
        length = finger.geometry(s.q)[0][..., k]
        ripple = np.sin(2 * np.pi * length / self.shape["pitch"] + self.shape["phase"])
        return add_at(reaching, k, self.size * ripple * np.clip(s.f[..., k] / 2.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class SlackSag(Departure):
    """Sag of a tendon between its eyelets at low tension f, in proportion to 1/(1 + f²), as of a catenary."""

    effect: ClassVar[str] = "sag of a tendon at low tension"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "m"
    start_size: ClassVar[float] = 1e-4
    largest: ClassVar[float] = 5e-3
    forms: ClassVar[tuple[str, ...]] = ("catenary",)

    def path(self, finger, s, length, arm):
        k = self.index[0]
        f = np.maximum(s.f[..., k], 0.0)
        posture = 1.0 + np.sum(np.abs(s.q[..., finger.specimen.finger.crosses[k]]), axis=-1)
        return add_at(length, k, -self.size * posture / (1 + f**2)), arm


@dataclass(frozen=True, eq=False)
class SidewaysYield(Departure):
    """Lateral force on the fingertip, from a base that yields sideways under tension."""

    effect: ClassVar[str] = "abduction that the model does not have, yielding under tension"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.3
    forms: ClassVar[tuple[str, ...]] = ("lateral",)

    def contact(self, finger, s, force):
        side = np.where(np.arange(finger.n) % 2 == 0, 1.0, -0.6)
        return add_at(force, 1, self.size * (s.f @ side) * (1 + 0.05 * s.f.sum(axis=-1)))


@dataclass(frozen=True, eq=False)
class StickSlip(Memory):
    """Stick-slip of the fingertip on the sensor: the force relaxes in jumps as tension rises."""

    effect: ClassVar[str] = "stick-slip of the fingertip's contact"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "N"
    start_size: ClassVar[float] = 0.05
    largest: ClassVar[float] = 1.0
    forms: ClassVar[tuple[str, ...]] = ("sawtooth",)

    def inputs(self, finger, s):
        return np.sum(s.f, axis=-1)[..., None]

    def step(self, z, before, now, dt):
        # z is the tangential strain since the last slip, in units of the breakaway strain.
        z = z + (now - before) / self.shape["pitch"]
        return np.where(np.abs(z) > 1.0, 0.2 * np.sign(z), z)

    def contact(self, finger, s, force):
        z = self.state(s)[..., 0]
        return add_at(add_at(force, 0, self.size * z), 2, -0.6 * self.size * z)


@dataclass(frozen=True, eq=False)
class Saturation(Departure):
    """Saturation of the torque amplifier: readings bend towards a ceiling."""

    effect: ClassVar[str] = "saturation of the torque channel's converter"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.05
    largest: ClassVar[float] = 1.0
    forms: ClassVar[tuple[str, ...]] = ("soft_ceiling",)

    def read(self, channels):
        tau = channels.torque
        if tau is None:
            return channels
        beyond = np.logaddexp(0.0, (np.abs(tau) - self.shape["ceiling"]) / 2e-3) * 2e-3
        return replace(channels, torque=tau - self.size * np.sign(tau) * beyond)


@dataclass(frozen=True, eq=False)
class EncoderCrosstalk(Departure):
    """Magnetic crosstalk: a joint's magnet acts on its neighbour's encoder."""

    effect: ClassVar[str] = "magnetic crosstalk between neighbouring encoders"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "rad"
    start_size: ClassVar[float] = 5e-3
    largest: ClassVar[float] = 0.15
    forms: ClassVar[tuple[str, ...]] = ("difference",)

    def read(self, channels):
        a, b = self.index
        error = np.sin(2 * (channels.q[:, b] - channels.q[:, a]) + self.shape["phase"])
        return replace(channels, q=add_at(channels.q, a, self.size * error))


@dataclass(frozen=True, eq=False)
class SumOfAngles(Departure):
    """Torque periodic in the sum of two angles, from magnets on neighbouring links."""

    effect: ClassVar[str] = "magnets on neighbouring links: a torque periodic in the sum of two angles"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "N m"
    start_size: ClassVar[float] = 5e-4
    largest: ClassVar[float] = 0.01
    forms: ClassVar[tuple[str, ...]] = ("sine",)

    def passive(self, finger, s, torque):
        a, b = self.index
        pull = self.size * np.sin(self.shape["p"] * (s.q[..., a] + s.q[..., b]) + self.shape["phase"])
        return add_at(add_at(torque, a, pull), b, pull)


@dataclass(frozen=True, eq=False)
class BaseYield(Departure):
    """Mount that yields under the sum of the tensions: all measured excursions change together."""

    effect: ClassVar[str] = "mount that yields under the sum of the tensions"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "m/N"
    start_size: ClassVar[float] = 1e-5
    largest: ClassVar[float] = 3e-4
    forms: ClassVar[tuple[str, ...]] = ("hardening",)

    def path(self, finger, s, length, arm):
        total = np.sum(np.maximum(s.f, 0.0), axis=-1)
        return length + self.size * (total / (1 + total / 20.0))[..., None], arm


@dataclass(frozen=True, eq=False)
class QuadraticDrag(Departure):
    """Drag with the square of speed, modulated by the angle (grease that churns)."""

    effect: ClassVar[str] = "drag with the square of speed that depends on posture"
    listed: ClassVar[bool] = False
    units: ClassVar[str] = "N m s2/rad2"
    start_size: ClassVar[float] = 5e-4
    largest: ClassVar[float] = 0.02
    forms: ClassVar[tuple[str, ...]] = ("quadratic",)

    def passive(self, finger, s, torque):
        j = self.index[0]
        rate = s.qd[..., j]
        return add_at(torque, j, self.size * np.sin(3 * s.q[..., j]) * rate * np.abs(rate))
