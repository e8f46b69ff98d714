"""Starts of VD.3: measured states from which the finger is simulated under the measured tension, and their noise.

`ahead` judges a fit by them, and `shooting` makes one.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.data import Trial, filtered_noise_std, low_pass, smooth
from jaxfinger.experiments import Stack
from jaxfinger.identify.predictions import STEP
from jaxfinger.model import Motion

HORIZONS = (0.05, 0.1, 0.2, 0.5)  # s, at the protocol's pace, as the errors of VD.3 are stated
SHARP = 2.0  # times the experiment's cut-off, of the filter that tells the state: slips are not lost, nor q̇ in noise


class Measured(NamedTuple):
    """One trial on an even clock, and the standard deviations of its state and tension."""

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "m T"]
    qd: Float[np.ndarray, "m T"]
    tension: Float[np.ndarray, "n T"]
    session_start: float
    pace: float  # times as long as the protocol's that motions take
    q_std: Float[np.ndarray, "m 1"]
    qd_std: Float[np.ndarray, "m 1"]
    tension_noise: Float[np.ndarray, "n T"]  # N, what is quicker than the experiment's cut-off

    @property
    def horizons(self) -> tuple[float, ...]:
        """s: `HORIZONS` at the pace of the trial."""
        return tuple(h * self.pace for h in HORIZONS)

    @property
    def step(self) -> float:
        """s, of the simulations."""
        return STEP * self.pace


def measured(trial: Trial, stack: Stack, b: int, x: Motion) -> Measured:
    """Trial `b` of a full-rate stack of VD.3, whose motion is `x`."""
    time, N = np.asarray(trial.time), len(trial.time)
    step = float(np.median(np.diff(time)))
    even = np.arange(int(np.floor((time[-1] - time[0]) / step)) + 1) * step
    cutoff = min(SHARP * stack.experiment.cutoff, 0.2 / step)
    raw = np.asarray(x.q)[:, b, :N].T
    q, qd, _ = smooth(time, raw, cutoff)
    tension = np.asarray(x.tension)[:, b, :N].T

    def on(values):
        return np.stack([np.interp(even, time - time[0], column) for column in values.T])

    encoder = np.std(np.asarray(trial.q) - smooth(time, trial.q, cutoff)[0], axis=0)
    value, rate = (encoder * filtered_noise_std(cutoff, step, k) for k in (0, 1))
    rest = tension - low_pass(time, tension, stack.experiment.cutoff_at(step))
    most = 4.0 * 1.4826 * np.median(np.abs(rest), axis=0)
    noise = on(np.clip(rest, -most, most))  # jumps of the tension itself are none
    start = float(np.asarray(x.session_time - x.time)[b, 0])
    return Measured(
        even, on(q), on(qd), on(tension), start, stack.experiment.pace, value[:, None], rate[:, None], noise
    )


def starts(
    m: Measured, time: Float[np.ndarray, " W"], horizon: float, noise: np.random.Generator | None = None
) -> Motion:
    """The states at these moments, and the tension over the horizon; beyond the trial's end its last. With `noise`,
    what the sensors could have read as well.
    """
    moments = time + horizon * np.linspace(0.0, 1.0, math.ceil(horizon / m.step - 1e-6) + 1)[:, None]
    q, qd, tension = angles(m, time), on_clock(m, m.qd, time), m.tension
    if noise is not None:
        q, qd = (a + s * noise.standard_normal(a.shape) for a, s in ((q, m.q_std), (qd, m.qd_std)))
        tension = tension + surrogate(m.tension_noise, noise)
    ahead = on_clock(m, tension, moments)
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
    """Measured at these moments."""
    return on_clock(m, m.q, time)


def on_clock(m: Measured, values: Float[np.ndarray, "k T"], time: Float[np.ndarray, "*t"]) -> Float[np.ndarray, "k *t"]:
    """Rows of the trial at these moments; beyond its end the last."""
    return np.stack([np.interp(time, m.time, row) for row in values])


def surrogate(noise: Float[np.ndarray, "n T"], rng: np.random.Generator) -> Float[np.ndarray, "n T"]:
    """Another noise of the same spectrum: its phases drawn anew (Theiler et al. 1992)."""
    spectrum = np.fft.rfft(noise, axis=-1)
    turn = np.exp(2j * np.pi * rng.random(spectrum.shape))
    return np.fft.irfft(spectrum * turn, noise.shape[-1], axis=-1)
