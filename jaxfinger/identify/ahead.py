"""VD.3 on all samples, sticking included: how far the model departs from the measured motion within a moment.

From the measured state at t the model is simulated forward under the measured tension, up to half a second. The noise
of such a prediction is what it changes by where state and tension are those that the sensors could have read as well:
one draw of their noise for every start. Errors beyond it are the model's. A whole simulation from the first sample is
judged likewise; where it leaves the finger's range it diverges, and its angles say nothing.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfinger.compilation import quick_jit
from jaxfinger.data import Session, Trial, low_pass, passed, smooth
from jaxfinger.experiments import Stack, roomy
from jaxfinger.identify.predictions import STEP
from jaxfinger.model import Model, simulate

HORIZONS = (0.05, 0.1, 0.2, 0.5)  # s
EVERY = 0.05  # s between starts, the shortest horizon: every sample is reached
SHARP = 2.0  # times the experiment's cut-off, of the filter that tells the state: slips are not lost, nor q̇ in noise


@dataclass(frozen=True)
class Ahead:
    """Predictions of angles over a horizon from many starts: rad, NaN beyond the end of a trial."""

    horizon: float  # s
    error: Float[np.ndarray, "starts m"]  # of what has diverged, that of the angle where it did
    noise: Float[np.ndarray, " m"]  # standard deviation of the error where the model is right


class Measured(NamedTuple):
    """One trial on an even clock, and the standard deviations of its state and tension."""

    time: Float[np.ndarray, " T"]
    q: Float[np.ndarray, "m T"]
    qd: Float[np.ndarray, "m T"]
    tension: Float[np.ndarray, "n T"]
    session_start: float
    q_std: Float[np.ndarray, "m 1"]
    qd_std: Float[np.ndarray, "m 1"]
    tension_noise: Float[np.ndarray, "n T"]  # N, what is quicker than the experiment's cut-off


def ahead(model: Model, session: Session, stack: Stack) -> list[Ahead]:
    """Errors at every horizon from starts all along the VD.3 trials of a full-rate stack."""
    x = model.true_motion(stack.batch.x)
    parts = [_trial(model, session[name], stack, b, x, session.finger.limits) for b, name in enumerate(stack.trials)]
    return [
        Ahead(
            horizon,
            np.concatenate([error[k] for error, _ in parts]),
            np.sqrt(np.nanmean(np.concatenate([noise[k] for _, noise in parts]) ** 2, axis=0)),
        )
        for k, horizon in enumerate(HORIZONS)
    ]


def noise_of_simulation(model: Model, session: Session, stack: Stack) -> Float[np.ndarray, " m"]:
    """rad: what the whole simulation from the first sample changes by where its start and tension are redrawn."""
    x = model.true_motion(stack.batch.x)
    squares = []
    for b, name in enumerate(stack.trials):
        m = measured(session[name], stack, b, x)
        one = _windows(m, np.zeros(1, int), m.time.size)
        squares.append(np.mean(_changed(model, m, one, np.random.default_rng(b))[1][0] ** 2, axis=-1))
    return np.sqrt(np.mean(squares, axis=0))


def diverges(q: Float[np.ndarray, "N m"], limits: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Joints whose simulated angle leaves their range by half of it: no measured motion does."""
    low, high = _ends(limits)
    return np.any((q < low) | (q > high), axis=0)


def _ends(limits: Float[np.ndarray, "m 2"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Angles beyond which a simulation has diverged."""
    low, high = limits.T
    half = 0.5 * np.where(np.isfinite(high - low), high - low, 2.0 * np.pi)
    return low - half, high + half


def _trial(model: Model, trial: Trial, stack: Stack, b: int, x, limits: Float[np.ndarray, "m 2"]):
    """Error and noise of every horizon: (starts, m)."""
    m = measured(trial, stack, b, x)
    step = m.time[1] - m.time[0]
    reach = [max(1, round(h / step)) for h in HORIZONS]
    first = np.arange(0, m.time.size - reach[0], max(1, round(EVERY / step)))
    predicted, change = _changed(model, m, _windows(m, first, reach[-1] + 1), np.random.default_rng(b))
    predicted = np.clip(predicted, *(x[:, None] for x in _ends(limits)))
    errors, noises = [], []
    for k in reach:
        there = first + k < m.time.size
        at = np.minimum(first + k, m.time.size - 1)
        errors.append(np.where(there[:, None], m.q[:, at].T - predicted[:, :, k], np.nan))
        noise = np.sqrt(change[:, :, k] ** 2 + m.q_std[:, 0] ** 2)
        noises.append(np.where(there[:, None], noise, np.nan))
    return errors, noises


def measured(trial: Trial, stack: Stack, b: int, x) -> Measured:
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
    value, rate = (encoder * passed(cutoff, step, k) for k in (0, 1))
    rest = tension - low_pass(time, tension, stack.experiment.cutoff_at(step))
    most = 4.0 * 1.4826 * np.median(np.abs(rest), axis=0)
    start = float(np.asarray(x.session_time - x.time)[b, 0])
    noise = on(np.clip(rest, -most, most))  # jumps of the tension itself are none
    return Measured(even, on(q), on(qd), on(tension), start, value[:, None], rate[:, None], noise)


def surrogate(noise: Float[np.ndarray, "n T"], rng: np.random.Generator) -> Float[np.ndarray, "n T"]:
    """Another noise of the same spectrum: its phases drawn anew (Theiler et al. 1992)."""
    spectrum = np.fft.rfft(noise, axis=-1)
    turn = np.exp(2j * np.pi * rng.random(spectrum.shape))
    return np.fft.irfft(spectrum * turn, noise.shape[-1], axis=-1)


def _windows(m: Measured, first: np.ndarray, length: int) -> Int[np.ndarray, "starts T"]:
    """Samples from every start on; beyond the trial's end its last."""
    return np.minimum(first[:, None] + np.arange(length), m.time.size - 1)


def _changed(model: Model, m: Measured, at: np.ndarray, rng: np.random.Generator):
    """Simulated angles from every start, and by how much noise of state and tension changes them: (starts, m, T)."""
    step, (count, T) = float(m.time[1] - m.time[0]), at.shape
    wide = np.minimum(np.arange(roomy(count, 2)), count - 1)
    at = at[wide]
    long = roomy(T, 64)
    at = np.pad(at, [(0, 0), (0, long - T)], mode="edge")
    first = at[:, 0]
    q, qd, f = m.q[:, first].T, m.qd[:, first].T, np.moveaxis(m.tension[:, at], 1, 0)
    drawn = [a + s * rng.standard_normal(a.shape) for a, s in ((q, m.q_std.T), (qd, m.qd_std.T))]
    drawn.append(np.moveaxis((m.tension + surrogate(m.tension_noise, rng))[:, at], 1, 0))
    starts = m.session_start + m.time[first]
    substeps = max(1, int(np.ceil(step / STEP - 1e-6)))
    clock = jnp.asarray(step * np.arange(long))
    two = [_simulate(model, clock, *map(jnp.asarray, (f, q, qd, starts)), substeps=substeps)]
    two.append(_simulate(model, clock, *map(jnp.asarray, (drawn[2], drawn[0], drawn[1], starts)), substeps=substeps))
    exact, noisy = (np.nan_to_num(np.asarray(p)[:count, :, :T], nan=1e3, posinf=1e3, neginf=-1e3) for p in two)
    return exact, noisy - exact


@quick_jit
def _simulate(
    model: Model,
    time: Float[Array, " T"],
    tension: Float[Array, "B n T"],
    q0: Float[Array, "B m"],
    qd0: Float[Array, "B m"],
    start: Float[Array, " B"],
    *,
    substeps: int,
) -> Float[Array, "B m T"]:
    def one(f, q, qd, s):
        return simulate(model, time, f, q, qd, session_start=s, substeps=substeps)[0]

    return jax.vmap(one)(tension, q0, qd0, start)
