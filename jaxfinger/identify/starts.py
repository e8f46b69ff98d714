"""Starts of VD.3: measured states from which the finger is simulated under the measured tension, and their noise.

`ahead` evaluates a fit on them, and `shooting` uses them in a fit.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.data import Session, Trial, filtered_noise_std, low_pass, smooth, without_spikes
from jaxfinger.data.signals.noise import STD_PER_MAD
from jaxfinger.data.signals.sizes import sizes_of
from jaxfinger.experiments import EXPERIMENTS, Stack
from jaxfinger.experiments.table import highest_cutoff
from jaxfinger.identify.predictions import MAX_TIME_STEP
from jaxfinger.model import Motion

HORIZONS = (0.05, 0.1, 0.2, 0.5)  # s, at the protocol's pace, at which errors of VD.3 are reported
# Cut-off of the filter of a start's state over that of the experiment: high enough to keep slips, low enough to keep q̇
# above its noise.
STATE_CUTOFF_RATIO = 2.0


class Measured(NamedTuple):
    """One trial sampled at even instants, with the noise of its state and tension."""

    time: Float[np.ndarray, " T"]  # s, from the first sample
    q: Float[np.ndarray, "m T"]  # rad, filtered
    qd: Float[np.ndarray, "m T"]  # rad/s, filtered
    tension: Float[np.ndarray, "n T"]  # N
    session_start: float  # s, from the session's start
    pace: float  # duration of its motions over that of the protocol's
    q_std: Float[np.ndarray, "m 1"]  # rad, noise of q after the filter
    qd_std: Float[np.ndarray, "m 1"]  # rad/s, likewise of q̇
    tension_noise: Float[np.ndarray, "n T"]  # N: the tension above the experiment's cut-off, `slow_noise` below it

    @property
    def horizons(self) -> tuple[float, ...]:
        """`HORIZONS` at the pace of the trial, s."""
        return tuple(h * self.pace for h in HORIZONS)

    @property
    def step(self) -> float:
        """Time step of the simulations, s."""
        return MAX_TIME_STEP * self.pace


def measured(session: Session, stack: Stack, x: Motion) -> tuple[Measured, ...]:
    """Resample the trials of a full-rate stack of VD.3, whose motion is `x`, at even instants."""
    slow = slow_noise(session, stack.experiment.cutoff_at(stack.dt), stack.dt)
    return tuple(_measured(session[name], stack, b, x, slow) for b, name in enumerate(stack.trials))


def _measured(trial: Trial, stack: Stack, b: int, x: Motion, slow: list[Float[np.ndarray, " _"]]) -> Measured:
    time, N = np.asarray(trial.time), len(trial.time)
    step = float(np.median(np.diff(time)))
    even = np.arange(int(np.floor((time[-1] - time[0]) / step)) + 1) * step
    cutoff = min(STATE_CUTOFF_RATIO * stack.experiment.cutoff, highest_cutoff(step))
    raw = np.asarray(x.q)[:, b, :N].T
    q, qd, _ = smooth(time, raw, cutoff)
    tension = np.asarray(x.tension)[:, b, :N].T

    def resampled(values):
        return np.stack([np.interp(even, time - time[0], column) for column in values.T])

    encoder = np.std(np.asarray(trial.q) - smooth(time, trial.q, cutoff)[0], axis=0)
    value, rate = (encoder * filtered_noise_std(cutoff, step, k) for k in (0, 1))
    rest = tension - low_pass(time, tension, stack.experiment.cutoff_at(step))
    most = 4.0 * STD_PER_MAD * np.median(np.abs(rest), axis=0)
    noise = resampled(np.clip(rest, -most, most))  # jumps of the tension itself are not noise
    start = float(np.asarray(x.session_time - x.time)[b, 0])
    return Measured(
        even,
        resampled(q),
        resampled(qd),
        resampled(tension),
        start,
        stack.experiment.pace,
        value[:, None],
        rate[:, None],
        noise + np.stack([np.resize(column, even.size) for column in slow]),
    )


def slow_noise(session: Session, cutoff: float, step: float) -> list[Float[np.ndarray, " _"]]:
    """Noise of each load cell below `cutoff`, Hz, in N, every `step` s: what slack tendons read (ID.3).

    It is as long as these trials are, and zero for a tendon of which none shows it. A constant reading is the error of
    a tare, and no noise.
    """
    slack, readings = sizes_of(session).slack, [[np.zeros(0)] for _ in range(session.finger.n)]
    for trial in session:
        if trial.tendon_force is None or not EXPERIMENTS[trial.experiment].slack:
            continue
        at = np.arange(trial.time[0], trial.time[-1], step)
        reads = np.percentile(np.abs(trial.tendon_force), 95, axis=0) < slack  # false where it was not measured
        force = without_spikes(trial.tendon_force[:, reads])
        slow = low_pass(trial.time, force - force.mean(axis=0), cutoff)
        for k, column in zip(np.flatnonzero(reads), slow.T, strict=True):
            readings[k].append(np.interp(at, trial.time, column))
    return [np.concatenate(x) for x in readings]


def starts(
    m: Measured, time: Float[np.ndarray, " W"], horizon: float, noise: np.random.Generator | None = None
) -> Motion:
    """States at the instants `time`, s, each with the tension that follows over the horizon, s.

    Beyond the end of the trial the last values hold. With `noise`, another draw of the sensors' noise is added.
    """
    moments = time + horizon * np.linspace(0.0, 1.0, math.ceil(horizon / m.step - 1e-6) + 1)[:, None]
    q, qd, tension = angles(m, time), at_instants(m, m.qd, time), m.tension
    if noise is not None:
        q, qd = (a + s * noise.standard_normal(a.shape) for a, s in ((q, m.q_std), (qd, m.qd_std)))
        tension = tension + surrogate(m.tension_noise, noise)
    ahead = at_instants(m, tension, moments)
    return Motion(
        time=jnp.asarray(time),
        q=jnp.asarray(q),
        qd=jnp.asarray(qd),
        qdd=jnp.zeros(q.shape),
        tension=jnp.asarray(ahead[:, 0]),
        joint_direction=jnp.zeros(q.shape),
        tendon_direction=jnp.zeros(ahead[:, 0].shape),
        session_time=jnp.asarray(time + m.session_start),
        motorised=jnp.zeros(q.shape),
        tension_ahead=jnp.asarray(np.swapaxes(ahead, 0, 1)),
        horizon=jnp.full(time.shape, horizon),
    )


def angles(m: Measured, time: Float[np.ndarray, "*t"]) -> Float[np.ndarray, "m *t"]:
    """Measured angles at these instants, rad."""
    return at_instants(m, m.q, time)


def at_instants(
    m: Measured, values: Float[np.ndarray, "k T"], time: Float[np.ndarray, "*t"]
) -> Float[np.ndarray, "k *t"]:
    """Interpolate rows of the trial at these instants; beyond its end the last value holds."""
    return np.stack([np.interp(time, m.time, row) for row in values])


def surrogate(noise: Float[np.ndarray, "n T"], rng: np.random.Generator) -> Float[np.ndarray, "n T"]:
    """Surrogate noise of the same spectrum with random phases (Theiler et al. 1992)."""
    spectrum = np.fft.rfft(noise, axis=-1)
    turn = np.exp(2j * np.pi * rng.random(spectrum.shape))
    return np.fft.irfft(spectrum * turn, noise.shape[-1], axis=-1)
