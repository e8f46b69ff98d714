"""Departures of the rigid body, of the mounting, and of the sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from .base import Departure, add_at


@dataclass(frozen=True, eq=False)
class Payload(Departure):
    """An unknown point mass on a link, or mass displaced along it."""

    effect: ClassVar[str] = "payload"
    units: ClassVar[str] = "kg"
    start_size: ClassVar[float] = 2e-3
    largest: ClassVar[float] = 0.02
    forms: ClassVar[tuple[str, ...]] = ("point_mass", "displaced")

    def body(self, finger):
        i = self.index[0]
        place = np.array([self.shape["x"], 0.0, self.shape["z"]])
        mass, com, inertia = finger.mass.copy(), finger.com.copy(), finger.inertia.copy()
        if self.form == "displaced":
            com[i] = com[i] + self.size * place / mass[i]
        else:
            mass[i] += self.size
            com[i] = (finger.mass[i] * finger.com[i] + self.size * place) / mass[i]
            for m, r in ((finger.mass[i], finger.com[i] - com[i]), (self.size, place - com[i])):
                inertia[i] += m * (r @ r * np.eye(3) - np.outer(r, r))  # parallel axes
        return replace(finger, mass=mass, com=com, inertia=inertia)


@dataclass(frozen=True, eq=False)
class Tilt(Departure):
    """Mounting at another angle than described, in the finger's plane or out of it."""

    effect: ClassVar[str] = "gravity_tilt"
    units: ClassVar[str] = "rad"
    start_size: ClassVar[float] = 0.05
    largest: ClassVar[float] = 0.35
    forms: ClassVar[tuple[str, ...]] = ("in_plane", "oblique")

    def body(self, finger):
        axis = np.array([0.0, 1.0, 0.0]) if self.form == "in_plane" else np.array([0.4, 0.87, 0.28])
        axis /= np.linalg.norm(axis)
        g, angle = finger.gravity, self.size * self.shape["sign"]
        turned = g * np.cos(angle) + np.cross(axis, g) * np.sin(angle) + axis * (axis @ g) * (1 - np.cos(angle))
        return replace(finger, gravity=turned)


@dataclass(frozen=True, eq=False)
class TorqueScale(Departure):
    """Gain error of the torque sensor, constant or growing with the load."""

    effect: ClassVar[str] = "torque_sensor_scale"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.04
    largest: ClassVar[float] = 0.4
    forms: ClassVar[tuple[str, ...]] = ("gain", "bending_gain")

    def known(self):
        return {"gain": self.size * self.shape["sign"]} if self.form == "gain" else {}

    def read(self, channels):
        tau = channels.torque
        if tau is None:
            return channels
        gain = self.size * self.shape["sign"]
        if self.form == "bending_gain":
            gain = gain * (0.6 + 0.4 * np.abs(tau) / 0.03)
        return replace(channels, torque=tau * (1 + gain))


@dataclass(frozen=True, eq=False)
class TorqueDrift(Departure):
    """Offset of the torque sensor that drifts after its tare: in proportion to time, exponentially as the session warms
    it, as sines over minutes, or anew after every tare.
    """

    effect: ClassVar[str] = "torque_sensor_drift"
    units: ClassVar[str] = "N m"
    start_size: ClassVar[float] = 5e-4
    largest: ClassVar[float] = 0.02
    forms: ClassVar[tuple[str, ...]] = ("linear", "warm_up", "wandering")
    foreign: ClassVar[tuple[str, ...]] = ("after_each_tare",)

    def read(self, channels):
        if channels.torque is None:
            return channels
        now, tare = channels.session, channels.session[0] - 3.0
        if self.form == "after_each_tare":
            since = channels.time + 1.0
            rise = 3.0 * self.shape["sign"] * (1.0 - (1.0 + since / 8.0) ** -1.0)
            return replace(channels, torque=channels.torque + self.size * rise[:, None])
        offset = self._offset(now) - self._offset(tare)
        return replace(channels, torque=channels.torque + self.size * offset[:, None])

    def _offset(self, t):
        if self.form == "linear":
            return t / 60.0 * self.shape["sign"]
        if self.form == "warm_up":
            return 20.0 * self.shape["sign"] * (1 - np.exp(-t / 400.0))
        return 2.0 * np.sin(2 * np.pi * t / 90.0 + 6 * self.shape["phase"]) + np.sin(2 * np.pi * t / 41.0)


@dataclass(frozen=True, eq=False)
class TensionScale(Departure):
    """Gain error of one tendon's force sensor, with an offset or without."""

    effect: ClassVar[str] = "tension_sensor_scale"
    units: ClassVar[str] = "1"
    start_size: ClassVar[float] = 0.05
    largest: ClassVar[float] = 0.5
    forms: ClassVar[tuple[str, ...]] = ("gain", "gain_and_offset")

    def known(self):
        gain = self.size * self.shape["sign"]
        return {"gain": gain, "offset": 0.0 if self.form == "gain" else 2.0 * gain}

    def read(self, channels):
        k = self.index[0]
        f = channels.tension[:, k]
        offset = 2.0 if self.form == "gain_and_offset" else 0.0
        return replace(channels, tension=add_at(channels.tension, k, self.size * self.shape["sign"] * (f + offset)))


@dataclass(frozen=True, eq=False)
class EncoderOffset(Departure):
    """Zero error of a joint's encoder."""

    effect: ClassVar[str] = "encoder_offset"
    units: ClassVar[str] = "rad"
    start_size: ClassVar[float] = 0.02
    largest: ClassVar[float] = 0.4
    forms: ClassVar[tuple[str, ...]] = ("offset",)

    def known(self):
        return {"offset": self.size * self.shape["sign"]}

    def read(self, channels):
        return replace(channels, q=add_at(channels.q, self.index[0], self.size * self.shape["sign"]))


@dataclass(frozen=True, eq=False)
class Eccentricity(Departure):
    """Once-per-turn error of an off-axis magnet: a sine, a sine with the second harmonic of a non-uniform field, or the
    angle of the sum of two fields.
    """

    effect: ClassVar[str] = "encoder_eccentricity"
    units: ClassVar[str] = "rad"
    start_size: ClassVar[float] = 0.01
    largest: ClassVar[float] = 0.3
    forms: ClassVar[tuple[str, ...]] = ("once_per_turn", "with_second_harmonic")
    foreign: ClassVar[tuple[str, ...]] = ("two_fields",)

    def read(self, channels):
        j = self.index[0]
        q = channels.q[:, j]
        error = np.sin(q + self.shape["phase"])
        if self.form == "with_second_harmonic":
            error = error + 0.3 * np.sin(2 * q - self.shape["phase"])
        elif self.form == "two_fields":
            error = np.arctan2(np.sin(q + self.shape["phase"]), 1.6 + np.cos(q + self.shape["phase"]))
        return replace(channels, q=add_at(channels.q, j, self.size * error))


@dataclass(frozen=True, eq=False)
class ForceRotation(Departure):
    """Rotation of the fingertip's force sensor against the base frame."""

    effect: ClassVar[str] = "force_sensor_rotation"
    units: ClassVar[str] = "rad"
    start_size: ClassVar[float] = 0.03
    largest: ClassVar[float] = 0.6
    forms: ClassVar[tuple[str, ...]] = ("rotation",)

    def read(self, channels):
        if channels.force is None:
            return channels
        polar, azimuth = self.shape["polar"], self.shape["phase"]
        axis = np.array([np.sin(polar) * np.cos(azimuth), np.cos(polar), np.sin(polar) * np.sin(azimuth)])
        f, c, s = channels.force, np.cos(self.size), np.sin(self.size)
        return replace(channels, force=f * c + np.cross(axis, f) * s + np.outer(f @ axis, axis) * (1 - c))


@dataclass(frozen=True, eq=False)
class Delay(Departure):
    """Lag of one channel: a time shift, or a first-order low pass with that time constant."""

    effect: ClassVar[str] = "channel_delay"
    units: ClassVar[str] = "s"
    start_size: ClassVar[float] = 4e-3
    largest: ClassVar[float] = 0.08
    forms: ClassVar[tuple[str, ...]] = ("shift", "low_pass")

    FIELDS: ClassVar[dict[str, str]] = {
        "q": "q",
        "tendon_force": "tension",
        "tendon_excursion": "excursion",
        "joint_torque": "torque",
    }

    def read(self, channels):
        name = self.FIELDS[self.site[0]]
        values = getattr(channels, name)
        if values is None:
            return channels
        t = channels.time
        if self.form == "shift":
            late = np.stack([np.interp(t - self.size, t, column) for column in values.T], axis=1)
        else:
            # Exact response to a signal that is linear between samples. A ramp lags by the time constant.
            tau = max(self.size, 1e-9)
            slope = np.diff(values, axis=0) / np.diff(t)[:, None]
            decays = np.exp(-np.diff(t) / tau)
            lag = tau * slope[0]
            late = np.array(values)
            late[0] = values[0] - lag
            for i, decay in enumerate(decays):
                lag = tau * slope[i] + (lag - tau * slope[i]) * decay
                late[i + 1] = values[i + 1] - lag
        return replace(channels, **{name: late})
