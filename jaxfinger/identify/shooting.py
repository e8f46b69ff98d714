"""VD.3 in a fit: prediction errors a moment ahead, so that motion under tension alone tells of every parameter.

    min_θ  Σ_k ‖(q(t_k + h) − q̂(t_k + h | θ)) / σ‖²,   t_k = 0, h, 2h, …

q̂ is simulated from the state measured at t_k under the measured tension, sticking and sliding as they come: multiple
shooting (Bock and Plitt 1984) whose states are measured, or least squares of a prediction error (Ljung 1999, §7.2). σ
is what the sensors' noise in state, tension and reading changes it by. A whole simulation would be no criterion: what
is small at its start is all that one sees of it at its end.

Noise of the tension frees what sticks, so that a prediction is bent in the mean, too, and a fit with it. Another dose
of the same noise shows by how much: the fit is made once more with what that dose bends put on the measured angles
(simulation and extrapolation: Cook and Stefanski 1994). Intervals widen by as much as it then moves; and since noise
below the experiment's cut-off is not told from tension, by what VD.3 still contradicts the other trials by (`joint`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.experiments import Batch, Experiment, Stack, prepare
from jaxfinger.identify.ahead import Measured, measured, surrogate
from jaxfinger.identify.linearise import residuals_of
from jaxfinger.identify.noise import ORDER, Noise
from jaxfinger.model import Model, Motion

AHEAD = "VD.3 ahead"  # among the experiments that a fit reads
HORIZON = 0.1  # s, at the protocol's pace: h
STEP = 1e-3  # s: longest of a simulation
DRAWS = 16  # of the sensors' noise: they tell its mean effect to a quarter of its standard deviation


@dataclass(frozen=True)
class Shooting:
    """The starts of all VD.3 trials, with the angles that follow."""

    trials: tuple[Measured, ...]
    horizon: float  # s
    batch: Batch

    def changed(self, model: Model) -> Float[np.ndarray, "draws m B W"]:
        """rad: what every draw of the sensors' noise changes the model's predictions by."""
        here, out = residuals_of(model, self.batch, ("q",))["q"], []
        for k in range(DRAWS):
            drawn = [_redrawn(m, np.random.default_rng([b, k])) for b, m in enumerate(self.trials)]
            again = replace(_batch(drawn, self.horizon), y=self.batch.y)
            out.append(here - residuals_of(model, again, ("q",))["q"])
        return np.clip(np.nan_to_num(out, nan=np.pi), -np.pi, np.pi)  # beyond half a turn it says no more

    def noise(self, model: Model) -> Noise:
        """Of a prediction and the reading beside it."""
        reading = np.stack([m.q_std for m in self.trials], axis=1)  # (m, B, 1)
        square = np.mean(self.changed(model) ** 2, axis=0) + reading**2
        std = np.sqrt(np.average(square, axis=(1, 2), weights=np.asarray(self.batch.mask["q"])))
        return Noise(std, std, np.zeros((len(std), ORDER)), "sensors' noise in state and tension")

    def straightened(self, model: Model) -> Batch:
        """With the angles that a prediction which noise bends should be compared with."""
        return replace(self.batch, y={"q": self.batch.y["q"] + self.changed(model).mean(axis=0)})

    def stack(self, of: Stack) -> Stack:
        """As a fit reads it, beside the trials themselves."""
        e = Experiment(AHEAD, "driven", ("q",), 1.0 / self.horizon, of.experiment.cutoff, pace=of.experiment.pace)
        holds = np.full(self.batch.x.time.shape, -1)
        return Stack(e, self.batch, of.trials, of.motions, holds, self.horizon, {"q": True})


def shooting(model: Model, session: Session) -> tuple[Shooting, Stack]:
    """All VD.3 trials, cut into starts.

    Raises:
        UserError: the session has no VD.3 trial that tendons drive, one is too short, or the model holds effects.
    """
    file = session.file or "the session"
    names = [t.name for t in session if t.experiment == "VD.3"]
    if not names or not session.finger.n:
        raise UserError(f"{file}: has no VD.3 trial that tendons drive; refine without `ahead`")
    if model.effects:
        raise UserError(f"{file}: the fit to refine ahead holds effects; give one of the nominal model")
    whole = prepare(session, names, reduced=False)["VD.3"]
    horizon = HORIZON * whole.experiment.pace
    trials = tuple(measured(session[name], whole, b, whole.batch.x) for b, name in enumerate(whole.trials))
    short = [name for name, m in zip(whole.trials, trials, strict=True) if m.time[-1] <= horizon]
    if short:
        raise UserError(f"{file}: trial {short[0]} is shorter than {horizon:g} s; leave it out")
    found = Shooting(trials, horizon, _batch(trials, horizon))
    return found, found.stack(whole)


def _redrawn(m: Measured, rng: np.random.Generator) -> Measured:
    """What the sensors could have read as well."""
    q, qd = (a + s * rng.standard_normal(a.shape) for a, s in ((m.q, m.q_std), (m.qd, m.qd_std)))
    return m._replace(q=q, qd=qd, tension=m.tension + surrogate(m.tension_noise, rng))


def _batch(trials: Sequence[Measured], horizon: float) -> Batch:
    """Every start of every trial; those added for a common shape repeat the last one, and count not."""
    each = [_starts(m, horizon) for m in trials]
    sizes = np.array([q.shape[-1] for _, q in each])
    W = int(sizes.max())

    def stacked(*values) -> Float[Array, "*more B W"]:
        wide = [a[..., np.minimum(np.arange(W), size - 1)] for a, size in zip(values, sizes, strict=True)]
        return jnp.stack(wide, axis=-2)

    x = jax.tree.map(stacked, *[x for x, _ in each])
    y = stacked(*[q for _, q in each])
    counts = np.arange(W) < sizes[:, None]
    return Batch(x, {"q": y}, {"q": jnp.broadcast_to(counts, y.shape).astype(float)})


def _starts(m: Measured, horizon: float) -> tuple[Motion, Float[Array, "m W"]]:
    """The states at the starts, and the angles at their horizons."""
    time = np.arange(0.0, m.time[-1] - horizon, horizon)
    moments = time + horizon * np.linspace(0.0, 1.0, max(1, round(horizon / STEP)) + 1)[:, None]

    def at(values: np.ndarray, t: np.ndarray) -> Float[Array, "rows *t"]:
        return jnp.asarray([np.interp(t, m.time, row) for row in values])

    q, qd, tension = at(m.q, time), at(m.qd, time), at(m.tension, moments)
    motion = Motion(
        time=jnp.asarray(time),
        q=q,
        qd=qd,
        qdd=jnp.zeros_like(q),
        tension=tension[:, 0],
        joint_direction=jnp.zeros_like(q),
        tendon_direction=jnp.zeros_like(tension[:, 0]),
        session_time=jnp.asarray(time + m.session_start),
        motorised=jnp.zeros_like(q),
        ahead=jnp.swapaxes(tension, 0, 1),
        horizon=jnp.full(time.shape, horizon),
    )
    return motion, at(m.q, time + horizon)
