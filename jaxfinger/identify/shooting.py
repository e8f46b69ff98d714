"""VD.3 in a fit: errors of angles predicted a short horizon h ahead, under measured tension alone.

    min_θ  Σ_k ‖(q(t_k + h) − q̂(t_k + h | θ)) / σ‖²,   t_k = 0, h, 2h, …

q̂ is simulated from the state measured at t_k under the measured tension, with sticking and sliding. This is multiple
shooting with measured states (Bock and Plitt 1984), or least squares of a prediction error (Ljung 1999, §7.2). σ is the
standard deviation of the error due to the sensors' noise in state, tension and reading. A single simulation of the
whole trial would not do: small errors at its start grow until they dominate its end.

Noise of the tension frees joints that stick, which biases predictions and thus the fit. The bias is estimated by adding
more noise of the same kind (simulation and extrapolation: Cook and Stefanski 1994). The mean change of the predictions
is added to the measured angles, the fit is repeated, and its intervals widen by the change of the estimates. Noise
slower than the experiment's cut-off cannot be separated from the tension itself. Intervals therefore also widen where
VD.3 contradicts the other trials (`joint`).
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

AHEAD = "VD.3 ahead"  # name of the experiment and of the stage
# h, in s at the protocol's pace. Compared with it, 0.05 s predicts an unseen motion a tenth better with quiet load
# cells and a fifth worse with noisy ones; 0.2 s predicts a third worse and a fifth better (benchmarks/ahead.py).
HORIZON = HORIZONS[1]
NOISE_DRAWS = 16  # of the sensors' noise; the mean effect is then known to 1/√16 of its standard deviation


@dataclass(frozen=True)
class Shooting:
    """Starts of all VD.3 trials, with the angles measured one horizon later."""

    trials: tuple[Measured, ...]
    stack: Stack

    def changed(self, model: Model) -> Float[np.ndarray, "draws m B W"]:
        """Change of the model's predictions by each draw of the sensors' noise, rad, for B trials of W starts."""
        batch, horizon = self.stack.batch, self.stack.dt
        here, out = residuals_of(model, batch, ("q",))["q"], []
        for k in range(NOISE_DRAWS):
            noise = [np.random.default_rng([b, k]) for b in range(len(self.trials))]
            again = _batch(self.trials, horizon, noise)
            out.append(here - residuals_of(model, again, ("q",))["q"])
        # A simulation that changes by half a turn has diverged.
        return np.clip(np.nan_to_num(out, nan=np.pi), -np.pi, np.pi)

    def noise(self, model: Model) -> Noise:
        """Noise of the difference of a reading and a prediction."""
        reading = np.stack([m.q_std for m in self.trials], axis=1)  # (m, B, 1)
        square = np.mean(self.changed(model) ** 2, axis=0) + reading**2
        std = np.sqrt(np.average(square, axis=(1, 2), weights=np.asarray(self.stack.batch.mask["q"])))
        return Noise.white(std, "sensors' noise in state and tension")

    def corrected(self, model: Model) -> Batch:
        """Batch whose measured angles are shifted by the mean change of the predictions under noise."""
        batch = self.stack.batch
        return replace(batch, y={"q": batch.y["q"] + self.changed(model).mean(axis=0)})


def shooting(session: Session) -> Shooting:
    """Cut all VD.3 trials into starts.

    Raises:
        UserError: the session has no VD.3 trial that tendons drive, or one is too short.
    """
    file = session.file or "the session"
    names = [t.name for t in session if t.experiment == "VD.3"]
    if not names or not session.finger.n:
        raise UserError(f"{file}: has no VD.3 trial that tendons drive; refine without --ahead")
    whole = prepare(session, names, reduced=False)["VD.3"]
    horizon = HORIZON * whole.experiment.pace
    trials = measured(session, whole, whole.batch.x)
    short = [name for name, m in zip(whole.trials, trials, strict=True) if m.time[-1] <= horizon]
    if short:
        raise UserError(f"{file}: trial {short[0]} is shorter than {horizon:g} s; leave it out")
    batch = _batch(trials, horizon)
    experiment = replace(whole.experiment, name=AHEAD, channels=("q",), rate=1.0 / horizon)
    holds = np.full(batch.x.time.shape, -1)
    return Shooting(
        trials, replace(whole, experiment=experiment, batch=batch, holds=holds, dt=horizon, measured={"q": True})
    )


def _batch(
    trials: Sequence[Measured], horizon: float, noise: Sequence[np.random.Generator | None] | None = None
) -> Batch:
    """Batch of every start of every trial.

    Trials with fewer starts are padded with their last start, whose mask is 0. `noise`: for each trial a generator,
    with which its states and tensions are redrawn.
    """
    times = [np.arange(0.0, m.time[-1] - horizon, horizon) for m in trials]
    W = max(t.size for t in times)
    wide = [t[np.minimum(np.arange(W), t.size - 1)] for t in times]
    each = zip(trials, wide, noise or [None] * len(trials), strict=True)
    x = jax.tree.map(lambda *a: jnp.stack(a, axis=-2), *[starts(m, t, horizon, rng) for m, t, rng in each])
    y = jnp.stack([angles(m, t + horizon) for m, t in zip(trials, wide, strict=True)], axis=-2)
    counts = np.arange(W) < np.array([t.size for t in times])[:, None]
    return Batch(x, {"q": y}, {"q": jnp.broadcast_to(counts, y.shape).astype(float)})
