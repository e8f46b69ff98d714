"""Sensitivity of the estimates to trials, sensor gains and CAD, by the implicit function theorem, without refits.

The estimate θ_s of stage s is where its score S_s, the gradient of its cost, is zero: S_s(θ_s, θ_t<s, φ) = 0. For a
datum φ (the weight of a trial, the gain of a sensor, a value of CAD),

    dθ_s/dφ = −(∂S_s/∂θ_s)⁻¹ (∂S_s/∂φ + Σ_t<s ∂S_s/∂θ_t dθ_t/dφ),

stage after stage. Second derivatives are exact, those of the residuals and of Huber's cost included. The noise model is
fixed.

The derivative by the weight of a trial does not give the estimate without that trial: a parameter that a single trial
determines is the same at any weight. One Newton step from the fit gives it (Pregibon 1981), with H_k = J_kᵀJ_k of
trial k:

    Δθ_s = (∂S_s/∂θ_s − H_k)⁻¹ (S_s,k − Σ_t<s (∂S_s/∂θ_t − H_k,st) Δθ_t).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.compilation import one_blas_thread, quick_jit
from jaxfinger.data import Session
from jaxfinger.errors import UserError, chosen, require
from jaxfinger.experiments import Batch, Stack
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.gauss_newton import scaled_directions
from jaxfinger.identify.linearise import Filters, robust_residuals, white_rows
from jaxfinger.identify.nominal import cad_covariance, cad_prior
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.predictions import model_for
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.resample import read_again
from jaxfinger.identify.sources import Source
from jaxfinger.model import Model

TRIALS, SENSORS, CAD = "trials", "sensors", "cad"
KINDS = (TRIALS, SENSORS, CAD)
# Share of a parameter's information, the diagonal of JᵀJ, below which the other trials do not determine the parameter:
# without the trial its standard deviation would grow a thousandfold.
MIN_SHARE_OF_OTHERS = 1e-6
# Longest further Newton step, in standard deviations, of a fit at its optimum. A search may end in a kink with a step
# of 0.1 (`solve.KINK_TOLERANCE`); other data move a fit by more.
MAX_STEP_AT_OPTIMUM = 0.3


@dataclass(frozen=True, repr=False)
class Sensitivity:
    """Derivatives dθ/dφ of P parameters by the K data φ of one kind."""

    kind: str  # of φ: `trials`, their weights; `sensors`, their gains about 1; `cad`, its values
    names: tuple[str, ...]
    values: Float[np.ndarray, "K P"]  # dθ/dφ, SI units
    moves: Float[np.ndarray, "K P"]  # Δθ for a step of φ: a trial left out, gain + 1 %, CAD + 1 standard deviation

    def __repr__(self) -> str:
        moved = np.count_nonzero(self.values.any(axis=0))
        return f"Sensitivity(of {moved} parameters to {len(self.names)} of the {self.kind})"

    def shifts(self, fit: Fit) -> Float[np.ndarray, "K p"]:
        """`moves` of the estimated parameters in their standard deviations.

        The entry is 0 where the standard deviation is unknown, and infinite where no other trial determines the
        parameter.
        """
        std = fit.std[fit.estimated]
        sure = (std > 0) & np.isfinite(std)
        return np.where(sure, self.moves[:, fit.estimated] / np.where(sure, std, 1.0), 0.0)


@one_blas_thread
def sensitivity(fit: Fit, session: Session, to: str | Sequence[str] = KINDS) -> dict[str, Sensitivity]:
    """Derivatives of the fit's parameters by the weight of each trial, the gain of each sensor, each value of CAD.

    Sensors are those of the joints' torques and of the tendons' forces and excursions. `to`: one or more of `trials`,
    `sensors`, `cad`.

    The mass of the axis changes by so many kg where the gain of the torque sensor is 1 % too large:

    >>> import jaxfinger as jf
    >>> session, fit = jf.read("session.h5"), jf.load("fit.json")
    >>> gains = jf.sensitivity(fit, session)["sensors"]
    >>> gains
    Sensitivity(of 4 parameters to 1 of the sensors)
    >>> float(gains.moves[0, fit.estimated[0]].round(2))
    0.95

    Raises:
        UserError: the fit was not made from this session.
    """
    require(Fit, fit=fit)
    require(Session, session=session)
    kinds = chosen(to, KINDS, "kind of data")
    model_for(fit, session)  # raises for a session of another finger
    parameters, (plan, stacks, sources) = describe(fit.model), read_again(session, fit)
    if not sources:
        raise UserError(f"{session.file or 'the session'}: has none of the trials that the fit was made from")
    sensors = _sensors(session, stacks, sources) if SENSORS in kinds else {}
    scores = {e: _gradient_of(fit, s, [at(e) for at in sensors.values()]) for e, s in sources.items()}
    std = np.sqrt(np.diag(cad_covariance(session, parameters)))
    cad = np.flatnonzero(std > 0)
    given = np.setdiff1d(cad, np.concatenate([free for _, free in plan]))  # what no stage estimates

    data = _Data(tuple((e, t) for e in sources for t in stacks[e].trials), tuple(sensors), cad)
    P, K = len(parameters), len(data.trials)
    derivatives, without, alone = np.zeros((P, data.count)), np.zeros((P, K)), np.zeros((P, K), bool)
    derivatives[given, data.columns_of_cad(given)] = 1.0
    for of_stage, free in plan:
        parts = {e: (sources[e].positions, scores[e]) for e in of_stage}
        prior = cad_prior(session, fit.recipe, parameters, free)
        precision = prior.root.T @ prior.root
        H, S, by = _score_of_stage(fit, free, prior, parts, data)
        own, others = H[np.ix_(free, free)], np.setdiff1d(np.arange(P), free)
        basis = _visible_basis(own)
        _require_optimum(basis.T @ S[free], session)
        right = by[free] + H[np.ix_(free, others)] @ derivatives[others]
        derivatives[free] = -basis @ np.linalg.solve(basis.T @ own @ basis, basis.T @ right)
        total = np.diag(H)[free] - np.diag(precision)
        for j, (e, name) in enumerate(data.trials):
            mine = _information_of(stacks[e].trials.index(name), parts.get(e), P)
            left = total - np.diag(mine)[free]
            alone[free, j] = (np.diag(precision) == 0.0) & (left < MIN_SHARE_OF_OTHERS * total)
            kept = np.flatnonzero(~alone[free, j])
            without[free[kept], j] = _step_without(H - mine, by[:, j], free, kept, without[:, j])
    names = {TRIALS: [t for _, t in data.trials], SENSORS: list(sensors), CAD: [parameters[i].name for i in cad]}
    values = {k: derivatives[:, data.columns(k)].T for k in KINDS}
    moves = {TRIALS: np.where(alone, np.inf, without).T, SENSORS: 0.01 * values[SENSORS]}
    moves[CAD] = std[cad][:, None] * values[CAD]
    return {k: Sensitivity(k, tuple(names[k]), values[k], moves[k]) for k in KINDS if k in kinds}


class CostGradient(eqx.Module):
    """Gradient of the cost of one experiment by the k parameters that it depends on, and its derivatives."""

    by_trial: Float[Array, "B k"]  # gradient of each trial's cost
    information: Float[Array, "B k k"]  # JᵀJ of each trial, from the rows within Huber's limit
    hessian: Float[Array, "k k"]  # of all trials
    by_sensor: Float[Array, "K k"]  # derivative of the gradient by each gain


class _Data(NamedTuple):
    """All data φ, one column each: trials, then sensors, then values of CAD."""

    trials: tuple[tuple[str, str], ...]  # experiment and name
    sensors: tuple[str, ...]
    cad: Int[np.ndarray, " c"]  # positions in the flat vector, ascending

    @property
    def count(self) -> int:
        """Number of columns."""
        return len(self.trials) + len(self.sensors) + self.cad.size

    def columns(self, kind: str) -> slice:
        """Columns of one kind of data."""
        ends = np.cumsum([0, len(self.trials), len(self.sensors), self.cad.size])
        k = KINDS.index(kind)
        return slice(int(ends[k]), int(ends[k + 1]))

    def columns_of_cad(self, positions: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
        """Columns of the values of CAD at these positions of the flat vector."""
        return self.columns(CAD).start + np.searchsorted(self.cad, positions)


def _score_of_stage(
    fit: Fit,
    free: Int[np.ndarray, " p"],
    prior: Prior,
    parts: dict[str, tuple[Int[np.ndarray, " _k"], CostGradient]],
    data: _Data,
) -> tuple[Float[np.ndarray, "P P"], Float[np.ndarray, " P"], Float[np.ndarray, "P K"]]:
    """∂S/∂θ, S and ∂S/∂φ of a stage with its prior, over the whole flat vector.

    `parts`: for each experiment of the stage, the positions that it depends on and the gradient of its cost.
    """
    theta = np.asarray(ravel(fit.model))
    H, S, by = np.zeros((theta.size, theta.size)), np.zeros(theta.size), np.zeros((theta.size, data.count))
    for e, (at, score) in parts.items():
        H[np.ix_(at, at)] += score.hessian
        S[at] += score.by_trial.sum(axis=0)
        mine = np.array([k for k, (name, _) in enumerate(data.trials) if name == e])
        by[np.ix_(at, mine)] += score.by_trial.T
        by[at, data.columns(SENSORS)] += score.by_sensor.T
    precision = prior.root.T @ prior.root
    H[np.ix_(free, free)] += precision
    S[free] += precision @ (theta[free] - prior.mean)
    known = np.diag(precision) > 0.0
    by[np.ix_(free, data.columns_of_cad(free[known]))] -= precision[:, known]
    return H, S, by


def _information_of(
    trial: int, part: tuple[Int[np.ndarray, " k"], CostGradient] | None, size: int
) -> Float[np.ndarray, "P P"]:
    """JᵀJ of one trial over the flat vector, P = `size`; zero where its experiment has no `part` in the stage."""
    out = np.zeros((size, size))
    if part is not None:
        at, score = part
        out[np.ix_(at, at)] = score.information[trial]
    return out


def _step_without(
    H: Float[np.ndarray, "P P"],
    score: Float[np.ndarray, " P"],
    free: Int[np.ndarray, " p"],
    kept: Int[np.ndarray, " k"],
    earlier: Float[np.ndarray, " P"],
) -> Float[np.ndarray, " k"]:
    """Newton step Δθ of the parameters free[kept] of a stage without one trial.

    `H`: ∂S/∂θ without the trial. `score`: that of the trial. `earlier`: Δθ of earlier stages.
    """
    others = np.setdiff1d(np.arange(len(H)), free)
    own = H[np.ix_(free[kept], free[kept])]
    basis = _visible_basis(own)
    right = score[free] - H[np.ix_(free, others)] @ earlier[others]
    return basis @ np.linalg.solve(basis.T @ own @ basis, basis.T @ right[kept])


def _visible_basis(hessian: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p k"]:
    """Basis of the combinations visible to a stage, one in each column, from its Hessian."""
    values, vectors = np.linalg.eigh(_scaled(hessian))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    basis, _, seen, *_ = scaled_directions(root.T * np.sqrt(np.abs(np.diag(hessian))))
    return basis[:, seen]


def _scaled(H: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"]:
    size = np.sqrt(np.abs(np.diag(H)))
    size = np.where(size > 0.0, size, 1.0)
    return H / np.outer(size, size)


def _require_optimum(step: Float[np.ndarray, " k"], session: Session) -> None:
    if not np.all(np.abs(step) < MAX_STEP_AT_OPTIMUM):
        raise UserError(
            f"{session.file or 'the session'}: the fit is not the optimum of these trials, which would move it by "
            f"{np.abs(step).max():.2g} standard deviations; give the session that it was made from, or fit that again"
        )


def _sensors(
    session: Session, stacks: dict[str, Stack], experiments: Iterable[str]
) -> dict[str, Callable[[str], Batch]]:
    """Sensors that matter in one of the experiments, by name.

    Each comes with a function that gives the derivative of an experiment's batch by the sensor's gain.
    """
    finger, out = session.finger, {}
    for i, joint in enumerate(finger.joint_names):
        out[f"torque {joint}"] = lambda e, i=i: _gain(stacks[e].batch, "joint_torque", i)
    for k, tendon in enumerate(finger.tendon_names):
        if finger.active[k]:
            out[f"tension {tendon}"] = lambda e, k=k: _gain(stacks[e].batch, "tension", k)
            out[f"excursion {tendon}"] = lambda e, k=k: _gain(stacks[e].batch, "tendon_excursion", k)
    return {name: at for name, at in out.items() if any(_moves(at(e)) for e in experiments)}


def _gain(batch: Batch, what: str, column: int) -> Batch:
    """Derivative of the batch by the gain of one column of the channel `what`."""

    def only(a):
        values = np.zeros_like(a)
        values[column] = np.asarray(a)[column]
        return jnp.asarray(values)

    none = jax.tree.map(jnp.zeros_like, batch)
    if what == "tension":
        return eqx.tree_at(lambda b: b.x.tension, none, only(batch.x.tension))
    return none if what not in batch.y else eqx.tree_at(lambda b: b.y[what], none, only(batch.y[what]))


def _moves(change: Batch) -> bool:
    return any(np.any(np.asarray(a)) for a in jax.tree.leaves(change))


def _gradient_of(fit: Fit, source: Source, changes: list[Batch]) -> CostGradient:
    free = Free.at(fit.model, source.positions)
    limit = jnp.asarray(fit.recipe.fit.huber)
    B = source.batch.x.time.shape[0]
    nothing = jax.tree.map(lambda a: np.zeros((0, *a.shape)), source.batch)
    stacked = jax.tree.map(lambda *a: np.stack(a), *changes) if changes else nothing
    return jax.tree.map(np.asarray, _gradient(fit.model, free, source.batch, source.filters, limit, stacked, B))


@quick_jit
def _gradient(model: Model, free: Free, batch: Batch, filters: Filters, limit, changes: Batch, B: int) -> CostGradient:
    theta = free.get(model)

    def rows(theta, data: Batch):
        return white_rows(free.set(model, theta), data, filters)[1]

    def informative(theta):
        """White residuals whose Jacobian is zero beyond Huber's limit, where the cost is linear."""
        r = rows(theta, batch)
        return jnp.where(limit > 0.0, jnp.clip(r, -limit, limit), r)

    def cost(theta, data: Batch, weights):
        return 0.5 * jnp.sum(weights[:, None] * robust_residuals(rows(theta, data), limit) ** 2)

    whole, gradient = jnp.ones(B), jax.grad(cost)
    # The gradient's derivative by the weight of a trial is that trial's own gradient.
    by_trial = jax.lax.map(lambda w: jax.jvp(lambda v: gradient(theta, batch, v), (whole,), (w,))[1], jnp.eye(B))
    hessian = jax.lax.map(
        lambda v: jax.jvp(lambda t: gradient(t, batch, whole), (theta,), (v,))[1], jnp.eye(theta.size)
    )

    def moved(tension, y):
        return gradient(theta, eqx.tree_at(lambda b: (b.x.tension, b.y), batch, (tension, y)), whole)

    # Angles are left out: at an angle of zero JAX gives no finite derivative of its powers.
    data = batch.x.tension, batch.y
    by_sensor = jax.lax.map(lambda c: jax.jvp(moved, data, (c.x.tension, c.y))[1], changes)
    J = jax.lax.map(lambda v: jax.jvp(informative, (theta,), (v,))[1], jnp.eye(theta.size))
    return CostGradient(by_trial, jnp.einsum("kbr,lbr->bkl", J, J), hessian, by_sensor)
