"""VD.3 on all samples, sticking included: how far the model departs from the measured motion within a moment.

From the measured state at t the model is simulated forward under the measured tension, up to half a second. The noise
of such a prediction is what it changes by where state and tension are those that the sensors could have read as well:
one draw of their noise for every start. Errors beyond it are the model's. A whole simulation from the first sample is
judged likewise; where it leaves the finger's range it diverges, and its angles say nothing.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.data import Session
from jaxfinger.experiments import Stack, roomy
from jaxfinger.identify.starts import Measured, angles, measured, starts
from jaxfinger.model import Model, simulated_from


@dataclass(frozen=True)
class Ahead:
    """Predictions of angles over a horizon from many starts: rad, NaN beyond the end of a trial."""

    horizon: float  # s
    error: Float[np.ndarray, "starts m"]  # of what has diverged, that of the angle where it did
    noise: Float[np.ndarray, " m"]  # standard deviation of the error where the model is right


def ahead(model: Model, session: Session, stack: Stack) -> list[Ahead]:
    """Errors at every horizon from starts all along the VD.3 trials of a full-rate stack."""
    trials = _trials(model, session, stack)
    parts = [_errors(model, m, session.finger.limits, np.random.default_rng(b)) for b, m in enumerate(trials)]
    return [
        Ahead(
            horizon,
            np.concatenate([error[k] for error, _ in parts]),
            np.sqrt(np.nanmean(np.concatenate([noise[k] for _, noise in parts]) ** 2, axis=0)),
        )
        for k, horizon in enumerate(trials[0].horizons)
    ]


def noise_of_simulation(model: Model, session: Session, stack: Stack) -> Float[np.ndarray, " m"]:
    """rad: what the whole simulation from the first sample changes by where its start and tension are redrawn."""
    squares = []
    for b, m in enumerate(_trials(model, session, stack)):
        steps = int(np.ceil(m.time[-1] / m.step))
        horizon = m.step * roomy(steps, 512)  # for a common shape
        _, change = _changed(model, m, np.zeros(1), horizon, np.random.default_rng(b))
        squares.append(np.mean(change[:, : steps + 1, 0] ** 2, axis=-1))
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


def _trials(model: Model, session: Session, stack: Stack) -> list[Measured]:
    x = model.true_motion(stack.batch.x)
    return [measured(session[name], stack, b, x) for b, name in enumerate(stack.trials)]


def _errors(model: Model, m: Measured, limits: Float[np.ndarray, "m 2"], rng: np.random.Generator):
    """Error and noise of every horizon: (starts, m). A start every shortest horizon reaches every sample."""
    time = np.arange(0.0, m.time[-1] - m.horizons[0], m.horizons[0])
    predicted, change = _changed(model, m, time, m.horizons[-1], rng)
    predicted = np.clip(predicted, *(x[:, None, None] for x in _ends(limits)))
    errors, noises = [], []
    for horizon in m.horizons:
        k, there = round(horizon / m.step), time + horizon <= m.time[-1]
        error = angles(m, time + horizon) - predicted[:, k]
        noise = np.sqrt(change[:, k] ** 2 + m.q_std**2)
        errors.append(np.where(there, error, np.nan).T)
        noises.append(np.where(there, noise, np.nan).T)
    return errors, noises


def _changed(
    model: Model, m: Measured, time: Float[np.ndarray, " W"], horizon: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "m L W"], Float[np.ndarray, "m L W"]]:
    """Simulated angles from these starts on, and by how much noise of state and tension changes them."""
    W = time.size
    wide = time[np.minimum(np.arange(roomy(W, 2)), W - 1)]  # for a common shape the last is repeated
    two = (np.asarray(_simulate(model, starts(m, wide, horizon, noise)))[..., :W] for noise in (None, rng))
    exact, noisy = (np.nan_to_num(q, nan=1e3, posinf=1e3, neginf=-1e3) for q in two)
    return exact, noisy - exact


_simulate = quick_jit(simulated_from)
