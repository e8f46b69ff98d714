"""Sensors that do not say what the finger does: gains, offsets, drift, rotation, delay."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import ALL, BOTH, ELASTIC, TENSION, CatalogueEffect, rate

TORQUE_SENSOR = {e: ("joint_torque",) for e in ("ID.3-static", "ID.3-dynamic", "ID.4")}
EVERYWHERE = {e: tuple(dict.fromkeys((*ELASTIC.get(e, ()), *BOTH.get(e, ())))) for e in ALL}


class TorqueSensorScale(CatalogueEffect):
    """τ (1 + g): gain error of the joint torque sensor."""

    ID: ClassVar = "torque_sensor_scale"
    PLACE: ClassVar = "torque_sensor"
    AMPLITUDES: ClassVar = {"gain": ("1", 0.06, True)}
    SHOWS: ClassVar = TORQUE_SENSOR

    gain: Float[Array, ""]

    def reading(self, channel, x, y):
        return y * (1.0 + self.gain * x.motorised) if channel == "joint_torque" else y


class TorqueSensorDrift(CatalogueEffect):
    """Offset that moves after the sensor was tared: b T (1 − exp(−t/T)), and a slow wandering.

    t counts from the tare, `tare` seconds before the trial. It wanders with the session's time s, of which m is the
    middle: A cos(2π (s − m)/P) + B sin(2π (s − m)/P) and as much with the period P₂, less its value at the tare.
    """

    ID: ClassVar = "torque_sensor_drift"
    PLACE: ClassVar = "torque_sensor"
    AMPLITUDES: ClassVar = {
        "slope": ("N m/s", 4e-5, True),
        **{n: ("N m", 3e-4, True) for n in ("A", "B", "A_2", "B_2")},
    }
    SHAPES: ClassVar = {
        "T": ("s", (1e4, 6.0)),
        "P": ("s", (250.0, 40.0, 1e4)),
        "P_2": ("s", (60.0, 40.0, 1e4)),
        "tare": ("s", (1.0, 6.0)),
        "middle": ("s", (0.0,)),
    }
    CHOICES: ClassVar = ("middle",)
    PERIODS: ClassVar = {"P": ("A", "B"), "P_2": ("A_2", "B_2")}
    SHOWS: ClassVar = TORQUE_SENSOR

    slope: Float[Array, ""]
    A: Float[Array, ""]
    B: Float[Array, ""]
    A_2: Float[Array, ""]
    B_2: Float[Array, ""]
    T: Float[Array, ""]
    P: Float[Array, ""]
    P_2: Float[Array, ""]
    tare: Float[Array, ""]
    middle: Float[Array, ""]

    def reading(self, channel, x, y):
        if channel != "joint_torque":
            return y
        since, s, wander = x.time + self.tare, x.session_time - self.middle, 0.0
        for a, b, period in ((self.A, self.B, self.P), (self.A_2, self.B_2, self.P_2)):
            now, tare = 2.0 * jnp.pi * s / period, 2.0 * jnp.pi * (s - since) / period
            wander += a * (jnp.cos(now) - jnp.cos(tare)) + b * (jnp.sin(now) - jnp.sin(tare))
        return y + (self.slope * self.T * -jnp.expm1(-since / self.T) + wander) * x.motorised


class TensionSensorScale(CatalogueEffect):
    """f = (f_measured − offset)/(1 + gain) of a taut tendon: gain or offset error of its force sensor."""

    ID: ClassVar = "tension_sensor_scale"
    PLACE: ClassVar = "tendon"
    AMPLITUDES: ClassVar = {"gain": ("1", 0.05, True), "offset": ("N", 0.3, True)}
    SHOWS: ClassVar = TENSION

    gain: Float[Array, ""]
    offset: Float[Array, ""]

    def true_motion(self, x):
        k = self.index[0]
        f = x.tension[k]
        true = jnp.where(f > 0, (f - self.offset) / (1.0 + self.gain), f)
        return eqx.tree_at(lambda x: x.tension, x, x.tension.at[k].set(true))


class _Encoder(CatalogueEffect):
    """Shared by errors of a joint's encoder: q = q_measured − error(q_measured)."""

    MOVES_RIGID_BODY: ClassVar = True

    def error(self, q: Float[Array, "*T"]) -> Float[Array, "*T"]:
        return jnp.zeros_like(q)

    def true_motion(self, x):
        i = self.index[0]
        return eqx.tree_at(lambda x: x.q, x, x.q.at[i].add(-self.error(x.q[i])))


class EncoderOffset(_Encoder):
    """q_measured = q + o: zero error of a joint's encoder."""

    ID: ClassVar = "encoder_offset"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {"offset": ("rad", 0.03, True)}
    SHOWS: ClassVar = EVERYWHERE

    offset: Float[Array, ""]

    def error(self, q):
        return self.offset + 0.0 * q


class EncoderEccentricity(_Encoder):
    """q_measured = q + A sin q + B cos q: once-per-turn error of an off-axis magnet, a sin(q + φ)."""

    ID: ClassVar = "encoder_eccentricity"
    PLACE: ClassVar = "joint"
    AMPLITUDES: ClassVar = {"A": ("rad", 0.015, True), "B": ("rad", 0.015, True)}
    SHOWS: ClassVar = EVERYWHERE

    A: Float[Array, ""]
    B: Float[Array, ""]

    def error(self, q):
        return self.A * jnp.sin(q) + self.B * jnp.cos(q)


class ForceSensorRotation(CatalogueEffect):
    """F + φ × F: the fingertip's force sensor is turned against the base frame (first order in φ)."""

    ID: ClassVar = "force_sensor_rotation"
    PLACE: ClassVar = "fingertip"
    AMPLITUDES: ClassVar = {"x": ("rad", 0.06, True), "y": ("rad", 0.06, True), "z": ("rad", 0.06, True)}
    SHOWS: ClassVar = {"VD.2": ("fingertip_force",)}

    x: Float[Array, ""]
    y: Float[Array, ""]
    z: Float[Array, ""]

    def reading(self, channel, x, y):
        if channel != "fingertip_force":
            return y
        a, b, c = self.x, self.y, self.z
        return y + jnp.stack([b * y[2] - c * y[1], c * y[0] - a * y[2], a * y[1] - b * y[0]])


CHANNELS = ("q", "tendon_force", "tendon_excursion", "joint_torque", "fingertip_force")


class ChannelDelay(CatalogueEffect):
    """y(t − d): one channel lags the others (first order in d). Where a fixture holds the joints all is at rest."""

    ID: ClassVar = "channel_delay"
    PLACE: ClassVar = "channel"
    AMPLITUDES: ClassVar = {"delay": ("s", 5e-3, False)}
    SHOWS: ClassVar = {e: channels for e, channels in EVERYWHERE.items() if e not in ("ID.4", "VD.2")}
    MOVES_RIGID_BODY: ClassVar = True

    delay: Float[Array, ""]

    @classmethod
    def sites(cls, finger):
        return [(c,) for c in CHANNELS]

    @classmethod
    def indices(cls, finger, site):
        return (CHANNELS.index(site[0]),)

    def _of(self, channel: str) -> Float[Array, ""]:
        return jnp.where(self.index[0] == CHANNELS.index(channel), self.delay, 0.0)

    def true_motion(self, x):
        if x.held:
            return x
        d_q, d_f = self._of("q"), self._of("tendon_force")
        return eqx.tree_at(
            lambda x: (x.q, x.qd, x.tension),
            x,
            (x.q + d_q * x.qd, x.qd + d_q * x.qdd, x.tension + d_f * rate(x.tension, x.time)),
        )

    def reading(self, channel, x, y):
        if x.held:
            return y
        if channel == "joint_torque":
            # The free finger's external torque is zero by construction, not by a sensor. A hold has no rate, though
            # the differences of its first and last sample reach over its edges.
            return y - self._of(channel) * rate(y, x.time) * x.motorised * (x.qd != 0.0)
        return y - self._of(channel) * rate(y, x.time)
