"""VD.3 in a fit: prediction errors a moment ahead, so that motion under tension alone tells of every parameter.

    min_θ  Σ_k ‖(q(t_k + h) − q̂(t_k + h | θ)) / σ‖²,   t_k = 0, h, 2h, …

q̂ is simulated from the state measured at t_k under the measured tension, sticking and sliding as they come: multiple
shooting (Bock and Plitt 1984) whose states are measured, or least squares of a prediction error (Ljung 1999, §7.2). σ
is what the sensors' noise in state, tension and reading changes it by. A whole simulation would be no criterion: a tiny
error at its start grows until it is all that one sees at its end.

Noise of the tension frees joints that stick, so that predictions are off in the mean, too, and with them the fit. How
far is seen by adding more of the same noise: the mean of what that changes is added to the measured angles, and the fit
made once more (simulation and extrapolation: Cook and Stefanski 1994). Intervals widen by as far as the fit then moves.
Noise slower than the experiment's cut-off cannot be told from tension itself and stays; so intervals widen, too, by as
much as VD.3 contradicts the other trials (`joint`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.experiments import Batch, Stack, prepare
from jaxfinger.identify.linearise import residuals_of
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.starts import HORIZONS, Measured, angles, measured, starts
from jaxfinger.model import Model

AHEAD = "VD.3 ahead"  # among the experiments that a fit reads, and among its stages
# s, at the protocol's pace: h. With 0.05 s an unseen motion is predicted a tenth better where load cells are quiet, and
# a fifth worse where they are not; with 0.2 s a third worse, and a fifth better (benchmarks/ahead.py).
HORIZON = HORIZONS[1]
DRAWS = 16  # of the sensors' noise: they tell its mean effect to a quarter of its standard deviation


@dataclass(frozen=True)
class Shooting:
    """The starts of all VD.3 trials, with the angles that follow."""

    trials: tuple[Measured, ...]
    stack: Stack

    def changed(self, model: Model) -> Float[np.ndarray, "draws m B W"]:
        """rad: what every draw of the sensors' noise changes the model's predictions by."""
        batch, horizon = self.stack.batch, self.stack.dt
        here, out = residuals_of(model, batch, ("q",))["q"], []
        for k in range(DRAWS):
            noise = [np.random.default_rng([b, k]) for b in range(len(self.trials))]
            again = _batch(self.trials, horizon, noise)
            out.append(here - residuals_of(model, again, ("q",))["q"])
        return np.clip(np.nan_to_num(out, nan=np.pi), -np.pi, np.pi)  # beyond half a turn it says no more

    def noise(self, model: Model) -> Noise:
        """Of a prediction and the reading beside it."""
        reading = np.stack([m.q_std for m in self.trials], axis=1)  # (m, B, 1)
        square = np.mean(self.changed(model) ** 2, axis=0) + reading**2
        std = np.sqrt(np.average(square, axis=(1, 2), weights=np.asarray(self.stack.batch.mask["q"])))
        return Noise.white(std, "sensors' noise in state and tension")

    def corrected(self, model: Model) -> Batch:
        """With what noise changes the model's predictions by, in the mean, added to the measured angles."""
        batch = self.stack.batch
        return replace(batch, y={"q": batch.y["q"] + self.changed(model).mean(axis=0)})


def shooting(session: Session) -> Shooting:
    """All VD.3 trials, cut into starts.

    Raises:
        UserError: the session has no VD.3 trial that tendons drive, or one is too short.
    """
    file = session.file or "the session"
    names = [t.name for t in session if t.experiment == "VD.3"]
    if not names or not session.finger.n:
        raise UserError(f"{file}: has no VD.3 trial that tendons drive; refine without --ahead")
    whole = prepare(session, names, reduced=False)["VD.3"]
    horizon = HORIZON * whole.experiment.pace
    trials = tuple(measured(session[name], whole, b, whole.batch.x) for b, name in enumerate(whole.trials))
    short = [name for name, m in zip(whole.trials, trials, strict=True) if m.time[-1] <= horizon]
    if short:
        raise UserError(f"{file}: trial {short[0]} is shorter than {horizon:g} s; leave it out")
    batch = _batch(trials, horizon)
    spec = replace(whole.experiment, name=AHEAD, channels=("q",), rate=1.0 / horizon)
    holds = np.full(batch.x.time.shape, -1)
    return Shooting(trials, replace(whole, experiment=spec, batch=batch, holds=holds, dt=horizon, measured={"q": True}))


def _batch(
    trials: Sequence[Measured], horizon: float, noise: Sequence[np.random.Generator | None] | None = None
) -> Batch:
    """Every start of every trial; those added for a common shape repeat the last one, and count not. With `noise`, of
    each trial, its states and tensions are redrawn.
    """
    times = [np.arange(0.0, m.time[-1] - horizon, horizon) for m in trials]
    W = max(t.size for t in times)
    wide = [t[np.minimum(np.arange(W), t.size - 1)] for t in times]
    each = zip(trials, wide, noise or [None] * len(trials), strict=True)
    x = jax.tree.map(lambda *a: jnp.stack(a, axis=-2), *[starts(m, t, horizon, rng) for m, t, rng in each])
    y = jnp.stack([angles(m, t + horizon) for m, t in zip(trials, wide, strict=True)], axis=-2)
    counts = np.arange(W) < np.array([t.size for t in times])[:, None]
    return Batch(x, {"q": y}, {"q": jnp.broadcast_to(counts, y.shape).astype(float)})
