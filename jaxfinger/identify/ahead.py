"""Errors of VD.3 over short horizons, on all samples, sticking included.

From the measured state at t the model is simulated forward under the measured tension, up to half a second. The noise
of such a prediction is its change under another draw of the sensors' noise in state and tension; errors beyond it are
the model's. The simulation of a whole trial from its first sample is judged likewise. Where it leaves the finger's
range it has diverged, and its angles mean nothing.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.data import Session
from jaxfinger.experiments import Stack, padded_size
from jaxfinger.identify.starts import Measured, angles, measured, starts
from jaxfinger.model import Model, simulated_from

FAR = 1e3  # rad or m: an angle beyond has diverged, and its square may overflow


@dataclass(frozen=True)
class Ahead:
    """Errors of angles predicted over one horizon from many starts, in rad; NaN beyond the end of a trial."""

    horizon: float  # s
    error: Float[np.ndarray, "starts m"]  # where a simulation diverges, that of the bound at which it is clipped
    noise: Float[np.ndarray, " m"]  # standard deviation of the error of a right model


def ahead(model: Model, session: Session, stack: Stack) -> list[Ahead]:
    """Errors at every horizon, from starts spread over the VD.3 trials of a full-rate stack."""
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
    """Root mean square change, rad, of the simulation of whole trials under another draw of the sensors' noise."""
    squares = []
    for b, m in enumerate(_trials(model, session, stack)):
        steps = int(np.ceil(m.time[-1] / m.step))
        horizon = m.step * padded_size(steps, 512)  # for a common shape
        _, change = _changed(model, m, np.zeros(1), horizon, np.random.default_rng(b))
        squares.append(np.mean(change[:, : steps + 1, 0] ** 2, axis=-1))
    return np.sqrt(np.mean(squares, axis=0))


def diverges(q: Float[np.ndarray, "N m"], limits: Float[np.ndarray, "m 2"]) -> Bool[np.ndarray, " m"]:
    """Whether each joint's simulated angle leaves its range by more than half the range, which no real motion does."""
    low, high = _ends(limits)
    return np.any((q < low) | (q > high), axis=0)


def _ends(limits: Float[np.ndarray, "m 2"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Lower and upper angle of each joint, rad, beyond which a simulation has diverged."""
    low, high = limits.T
    half = 0.5 * np.where(np.isfinite(high - low), high - low, 2.0 * np.pi)
    return low - half, high + half


def _trials(model: Model, session: Session, stack: Stack) -> tuple[Measured, ...]:
    x = model.true_motion(stack.batch.x)
    return measured(session, stack, x)


def _errors(model: Model, m: Measured, limits: Float[np.ndarray, "m 2"], rng: np.random.Generator):
    """Error and noise (starts, m) at every horizon; starts follow one another at the shortest horizon."""
    time = np.arange(0.0, m.time[-1] - m.horizons[0], m.horizons[0])
    predicted, change = _changed(model, m, time, m.horizons[-1], rng)
    predicted = np.clip(predicted, *(x[:, None, None] for x in _ends(limits)))
    errors, noises = [], []
    for horizon in m.horizons:
        k, inside = round(horizon / m.step), time + horizon <= m.time[-1]
        error = angles(m, time + horizon) - predicted[:, k]
        noise = np.sqrt(change[:, k] ** 2 + m.q_std**2)
        errors.append(np.where(inside, error, np.nan).T)
        noises.append(np.where(inside, noise, np.nan).T)
    return errors, noises


def _changed(
    model: Model, m: Measured, time: Float[np.ndarray, " W"], horizon: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "m L W"], Float[np.ndarray, "m L W"]]:
    """Simulated angles from W starts, rad, and their change under another draw of the sensors' noise."""
    W = time.size
    padded = time[np.minimum(np.arange(padded_size(W, 2)), W - 1)]  # pad to a common shape with the last start
    two = (np.asarray(_simulate(model, starts(m, padded, horizon, noise)))[..., :W] for noise in (None, rng))
    exact, noisy = (np.clip(np.nan_to_num(q, nan=FAR), -FAR, FAR) for q in two)
    return exact, noisy - exact


_simulate = quick_jit(simulated_from)
