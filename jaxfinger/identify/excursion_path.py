"""VD.1: excursions along a trial, measured and predicted by both of the paper's forms."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.signal import butter, sosfilt, sosfilt_zi

from jaxfinger.data import Trial
from jaxfinger.experiments import EXPERIMENTS
from jaxfinger.model import Model

# Cut-off, Hz at the protocol's pace, of the causal filter with which a controller would differentiate angles: that of
# VD.3, the motion that it controls.
ONLINE_CUTOFF = EXPERIMENTS["VD.3"].cutoff


@dataclass(frozen=True)
class ExcursionPath:
    """Excursions of one trial of VD.1, m, relative to its first sample."""

    time: Float[np.ndarray, " N"]
    measured: Float[np.ndarray, "N n"]
    integral: Float[np.ndarray, "N n"]  # ∫ C(q) q̇ dt, q̇ from a causal filter, as a controller has it
    direct: Float[np.ndarray, "N n"]  # f(q) − f(q(0))


def excursion_path(model: Model, trial: Trial, pace: float = 1.0) -> ExcursionPath:
    """Predict the excursions of a trial by both forms of VD.1.

    The paper's integral accumulates the errors of q̇; the difference f(q) − f(q(0)) does not. `pace`: duration of the
    trial's motion over that of the protocol's.
    """
    q = trial.q
    step = float(np.median(np.diff(trial.time)))
    relative = min(0.9, 2.0 * ONLINE_CUTOFF / pace * step)  # to half the sampling rate, below which a filter must stay
    sos = butter(2, relative, output="sos")
    filtered = sosfilt(sos, q, axis=0, zi=sosfilt_zi(sos)[:, :, None] * q[0])[0]
    qd = np.diff(filtered, axis=0, prepend=filtered[:1]) / np.diff(trial.time, prepend=trial.time[0] - step)[:, None]
    C = np.asarray(model.moment_arm.coupling(jnp.asarray(q.T)))
    rate = np.einsum("nmt,tm->tn", C, qd)
    integral = np.cumsum(rate * np.diff(trial.time, prepend=trial.time[0])[:, None], axis=0)
    direct = np.asarray(model.moment_arm.excursion(jnp.asarray(q.T))).T
    measured = np.full(direct.shape, np.nan) if trial.tendon_excursion is None else trial.tendon_excursion
    return ExcursionPath(trial.time, measured - measured[0], integral, direct - direct[0])
