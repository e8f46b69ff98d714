"""Errors of the sensors: gains, offsets, drift, rotation, delay."""

from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.signal.windows import tukey

from jaxfinger.effects.base import CatalogueEffect, amplitude, shape
from jaxfinger.effects.rotation import turned


class TorqueSensorScale(CatalogueEffect):
    """τ (1 + gain): gain error of the joint torque sensor."""

    ID: ClassVar = "torque_sensor_scale"
    PLACE: ClassVar = "torque_sensor"
    HAPPENS: ClassVar = "The joint torque sensor has a wrong gain."
    LOOKS: ClassVar = "Every torque it measures is off by the same share."
    CHANGE: ClassVar = "Calibrate the sensor with a known weight on a lever."

    gain: Float[Array, ""] = amplitude("1", 0.06, signed=True)

    def reading(self, channel, x, y):
        return y * (1.0 + self.gain * x.motorised) if channel == "joint_torque" else y


class TorqueSensorDrift(CatalogueEffect):
    """o(s) − o(tare), o = −slope T exp(−s/T) + A cos(φ/P) + B sin(φ/P) + A_2 cos(φ/P_2) + B_2 sin(φ/P_2), where φ is
    2π times the time from the session's middle: a thermal offset.

    The gauge warms up from the session's start, s = 0; its offset changes by `slope` a second at first. The room's
    temperature wanders without a period, but over one session the two strongest lines of its spectrum come near to it.
    A tare, `tare` seconds before the trial, subtracts the offset of that time.
    """

    ID: ClassVar = "torque_sensor_drift"
    PLACE: ClassVar = "torque_sensor"
    HAPPENS: ClassVar = "The torque sensor's offset follows its temperature after it was tared."
    LOOKS: ClassVar = "Torque drifts with the session's time, whatever the joint does."
    CHANGE: ClassVar = "Let the sensor warm up, tare before each trial, or record its temperature."

    slope: Float[Array, ""] = amplitude("N m/s", 0.02, "torque/trial", signed=True)
    A: Float[Array, ""] = amplitude("N m", 0.006, "torque", signed=True)
    B: Float[Array, ""] = amplitude("N m", 0.006, "torque", signed=True)
    A_2: Float[Array, ""] = amplitude("N m", 0.006, "torque", signed=True)
    B_2: Float[Array, ""] = amplitude("N m", 0.006, "torque", signed=True)
    T: Float[Array, ""] = shape("s", (30.0, 0.3), "session")
    P: Float[Array, ""] = shape("s", (0.25, 0.04, 10.0), "session", period_of=("A", "B"))
    P_2: Float[Array, ""] = shape("s", (0.1, 0.02, 10.0), "session", period_of=("A_2", "B_2"))
    tare: Float[Array, ""] = shape("s", (0.1, 0.03), "trial")
    middle: Float[Array, ""] = shape("s", (0.0,), "session", moves="not")

    def _offset(self, s):
        warm = -self.slope * self.T * jnp.expm1(-s / self.T)
        lines = ((self.A, self.B, self.P), (self.A_2, self.B_2, self.P_2))
        turns = [2.0 * jnp.pi * (s - self.middle) / P for _, _, P in lines]
        return warm + sum(A * jnp.cos(t) + B * jnp.sin(t) for t, (A, B, _) in zip(turns, lines, strict=True))

    def reading(self, channel, x, y):
        if channel != "joint_torque":
            return y
        tared = x.session_time - x.time - self.tare
        return y + (self._offset(x.session_time) - self._offset(tared))[None] * x.motorised


class TensionSensorScale(CatalogueEffect):
    """f = (f_measured − offset)/(1 + gain) of a taut tendon: gain or offset error of its force sensor."""

    ID: ClassVar = "tension_sensor_scale"
    PLACE: ClassVar = "tendon"
    HAPPENS: ClassVar = "A tendon's force sensor has a wrong gain or offset."
    LOOKS: ClassVar = "Every effect of its tension is off by the same share, in both directions."
    CHANGE: ClassVar = "Calibrate the sensor with hanging weights."

    gain: Float[Array, ""] = amplitude("1", 0.05, signed=True)
    offset: Float[Array, ""] = amplitude("N", 0.03, "tension", signed=True)

    def true_motion(self, x):
        k = self.index[0]
        f = x.tension[k]
        true = jnp.where(f > 0, (f - self.offset) / (1.0 + self.gain), f)
        return eqx.tree_at(lambda x: x.tension, x, x.tension.at[k].set(true))


class _Encoder(CatalogueEffect):
    """Base class of the errors of a joint's encoder: q = q_measured − error(q_measured), and its rates."""

    def error(self, q: Float[Array, "*T"]) -> Float[Array, "*T"]:
        """Error at the measured angle q, rad."""
        return jnp.zeros_like(q)

    def true_motion(self, x):
        i = self.index[0]

        def motion(q, qd):
            return jax.jvp(lambda q: q - self.error(q), (q,), (qd,))

        (q, qd), (_, qdd) = jax.jvp(motion, (x.q[i], x.qd[i]), (x.qd[i], x.qdd[i]))
        true = x.q.at[i].set(q), x.qd.at[i].set(qd), x.qdd.at[i].set(qdd)
        return eqx.tree_at(lambda x: (x.q, x.qd, x.qdd), x, true)


class EncoderOffset(_Encoder):
    """q_measured = q + offset: zero error of a joint's encoder."""

    ID: ClassVar = "encoder_offset"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "A joint's encoder does not read zero at zero."
    LOOKS: ClassVar = "Weights and moment arms fit another angle, by the same offset everywhere."
    CHANGE: ClassVar = "Zero the encoder in a jig of known posture."

    offset: Float[Array, ""] = amplitude("rad", 0.02, "angle", signed=True)

    def error(self, q):
        return self.offset + 0.0 * q


class EncoderEccentricity(_Encoder):
    """q_measured = q + A sin q + B cos q: once-per-turn error of an off-axis magnet.

    The law holds to first order in A and B, about the magnet's offset over its radius; beyond a half it says nothing.
    """

    ID: ClassVar = "encoder_eccentricity"
    PLACE: ClassVar = "joint"
    HAPPENS: ClassVar = "A joint's magnet is off its axis: the angle has an error with a period of one turn."
    LOOKS: ClassVar = "Excursion and torque are off by a sine of the angle."
    CHANGE: ClassVar = "Centre the magnet, or subtract this sine from the angle."

    A: Float[Array, ""] = amplitude("rad", 0.01, "angle", signed=True, most=0.5)
    B: Float[Array, ""] = amplitude("rad", 0.01, "angle", signed=True, most=0.5)

    def error(self, q):
        return self.A * jnp.sin(q) + self.B * jnp.cos(q)


class ForceSensorRotation(CatalogueEffect):
    """R(φ) F, φ = (x, y, z): the fingertip's force sensor is turned against the base frame, by the vector φ."""

    ID: ClassVar = "force_sensor_rotation"
    PLACE: ClassVar = "fingertip"
    HAPPENS: ClassVar = "The fingertip's force sensor is turned against the base."
    LOOKS: ClassVar = "A force in one direction shows in another, in proportion."
    CHANGE: ClassVar = "Measure how the sensor is mounted, and turn its readings."

    x: Float[Array, ""] = amplitude("rad", 0.06, signed=True, most=jnp.pi)
    y: Float[Array, ""] = amplitude("rad", 0.06, signed=True, most=jnp.pi)
    z: Float[Array, ""] = amplitude("rad", 0.06, signed=True, most=jnp.pi)

    def reading(self, channel, x, y):
        if channel != "fingertip_force":
            return y
        return turned(y, jnp.stack([self.x, self.y, self.z]))


# Channels that may lag the others; their order gives the index of a site.
DELAYED_CHANNELS = ("q", "tendon_force", "tendon_excursion", "joint_torque", "fingertip_force")


class ChannelDelay(CatalogueEffect):
    """y(t − delay): one channel lags the others. In trials with held joints it shows nothing.

    The recording is read as much later (`read_later`), with as much noise as before. To first order, y + delay ẏ, noise
    would grow with the delay, and a fit would prefer too short a one.
    """

    ID: ClassVar = "channel_delay"
    PLACE: ClassVar = "channel"
    HAPPENS: ClassVar = "One channel lags the others."
    LOOKS: ClassVar = "The residual is proportional to the rate of that channel: zero at rest, largest at speed."
    CHANGE: ClassVar = "Take the channel's time stamps at its source, or shift it by the delay."

    delay: Float[Array, ""] = amplitude("s", 0.004, "angle/speed")

    @classmethod
    def sites(cls, finger):
        return [(c,) for c in DELAYED_CHANNELS]

    @classmethod
    def indices(cls, finger, site):
        return (DELAYED_CHANNELS.index(site[0]),)

    def _of(self, channel: str) -> Float[Array, ""]:
        """Delay of a channel, s: zero unless it is the site."""
        return jnp.where(self.index[0] == DELAYED_CHANNELS.index(channel), self.delay, 0.0)

    def true_motion(self, x):
        if x.held:
            return x
        d_q, d_f = self._of("q"), self._of("tendon_force")
        return eqx.tree_at(
            lambda x: (x.q, x.qd, x.qdd, x.tension),
            x,
            (*(read_later(a, x.time, d_q) for a in (x.q, x.qd, x.qdd)), read_later(x.tension, x.time, d_f)),
        )

    def reading(self, channel, x, y):
        if x.held:
            return y
        late = read_later(y, x.time, -self._of(channel))
        if channel == "joint_torque":
            # No sensor measures the free finger's external torque, which is zero by definition. At a hold nothing is
            # late; its first and last sample would be read in the motion beside it.
            return jnp.where((x.qd != 0.0) & (x.motorised > 0.0), late, y)
        return late


def read_later(y: Float[Array, "*T"], time: Float[Array, "*#T"], by: Float[Array, ""]) -> Float[Array, "*T"]:
    """y(t + by), along the last axis of evenly spaced samples: the phase at frequency f is shifted by 2π f `by`.

    It leaves the spectrum of noise as it is. Interpolation between samples lessens noise, most of all half-way, so that
    a fit would prefer such delays. Before the first sample and after the last one y goes on as its own reflection in
    that point. Samples whose time stands still, at the end, pad a trial.
    """
    return _shifted(y, jnp.broadcast_to(time, y.shape), jnp.broadcast_to(by, y.shape[:-1]))


@partial(jnp.vectorize, signature="(t),(t),()->(t)")
def _shifted(y, time, by):
    size, lead = time.size, time.size // 2
    last = jnp.maximum(jnp.sum(jnp.diff(time) > 0.0), 1)  # index of the last sample before the padding
    duration = jnp.where(time[-1] > time[0], time[-1] - time[0], 1.0)
    slope = (y[-1] - y[0]) / duration
    level = y - y[0] - slope * (time - time[0])  # zero at both ends
    # The trial between its odd reflections at both ends, of period 2 last. They fade out from a quarter to half of its
    # length away, since the discrete Fourier transform joins its own two ends.
    place = (jnp.arange(2 * size) - lead) % (2 * last)
    reflected = jnp.where(place <= last, level[jnp.minimum(place, last)], -level[2 * last - jnp.maximum(place, last)])
    spectrum = jnp.fft.rfft(reflected * tukey(2 * size, 0.25))
    phase = 2.0 * np.pi * np.fft.rfftfreq(2 * size) * (by * last.astype(by.dtype) / duration)
    change = jnp.fft.irfft(spectrum * jax.lax.complex(jnp.cos(phase) - 1.0, jnp.sin(phase)), 2 * size)
    return y + slope * by + change[lead : lead + size]
