"""Every fit's way to its optimum: `VisibleGaussNewton`, an optimistix solver, on compressed trials.

    min_θ  Σ_trials Huber(white residuals) + ½ ‖W (θ − μ)‖²

One step of the solver reads the trials compressed at its trial point. Here they are linearised by one program an
experiment, which all sessions of like fingers share, and the solver is stepped from outside
(`optimistix` calls that interactive stepping); `batch` puts the same solver and the same rows through
`optimistix.least_squares` in one program, which is compiled anew where a session differs from all before.
An experiment whose residuals are affine in what is free is linearised once and moved along its tangent: exact.
"""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.compilation import side_by_side
from jaxfinger.errors import UserError
from jaxfinger.experiments import Batch
from jaxfinger.identify.gauss_newton import (
    Factor,
    Iterate,
    Outcome,
    VisibleGaussNewton,
    begin,
    bounded_step,
    scaled_directions,
)
from jaxfinger.identify.linearise import Filters, Linearised, Tangent, missed, tangent, triangular, whitened
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.prior import Prior
from jaxfinger.model import Model

SMALL = 1e-6  # a step this small, in standard deviations of the estimate, ends the search
ROUGH = 0.02  # likewise where no more than residuals are wanted, as for their noise
KINK = 0.1  # likewise one that does not lower the cost: what is left is a kink, where a tendon slips or a joint turns
STEPS = 60
LIGHTEST = 0.02  # share of its starting value below which no mass is let to fall
PAD = 48  # compressed problems are padded to multiples of this, to share compilations


class Source(NamedTuple):
    """One experiment as a fit reads it: its data, its whitening, and the parameters that it depends on."""

    batch: Batch
    filters: Filters
    positions: Int[np.ndarray, " k"]  # in the flat vector, ascending
    effects: bool = True  # whether the model's effects show in it, if it has any
    affine: Int[np.ndarray, " a"] = np.zeros(0, int)  # those in which its residuals are affine together
    weights: Float[np.ndarray, " B"] | None = None  # of its trials, 1 by default
    pace: float = 1.0  # times as long as the protocol's that its motions take

    def seen(self, model: Model) -> Model:
        """The model as the experiment shows it: what does not show is not compiled."""
        return model if self.effects or not model.effects else eqx.tree_at(lambda m: m.effects, model, ())

    def linear(self, model: Model, free: Int[np.ndarray, " p"]) -> bool:
        """Whether one linearisation says it all of the free parameters."""
        mine = np.intersect1d(self.positions, free)
        drives = np.any(np.asarray(model.joint_torque.torque_friction))  # they turn the sum of (1) into a share of it
        return not self.seen(model).effects and not drives and bool(np.isin(mine, self.affine).all())


@dataclass(frozen=True)
class Solution:
    """A least-squares estimate at its optimum."""

    outcome: Outcome
    message: str  # empty where the search converged
    linearisations: int
    cost: float  # half the sum of squared white residuals, as Huber has it, priors apart
    rows: int  # white residuals that count
    information: Float[np.ndarray, "P P"]  # JᵀJ over the whole flat vector, priors apart
    invisible: Float[np.ndarray, "k p"]  # unit combinations of scaled parameters that neither trials nor prior see
    scale: Float[np.ndarray, " p"]
    outliers: float  # share of white residuals beyond the robust limit
    linearised: dict[str, Linearised]

    @property
    def converged(self) -> bool:
        """At an optimum, as far as rounding shows, or in a kink a tenth of a standard deviation wide."""
        return not self.message

    def chi2_per_row(self, estimated: int) -> float:
        """1 where model and noise are right, with so many parameters estimated."""
        return 2.0 * self.cost / max(1, self.rows - estimated)


class Tangents:
    """What is known of experiments along their tangents: kept as long as nothing moves in which they are not affine."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[np.ndarray, Tangent]] = {}
        self._white: dict[str, tuple[Source, float, np.ndarray, Linearised]] = {}

    def at(self, name: str, model: Model, source: Source, limit: float, linear: bool) -> Linearised:
        """The experiment linearised at the model; whitened anew where the source is another one than before."""
        seen = source.seen(model)
        free = Free.at(seen, source.positions)
        if not linear:
            along = tangent(seen, free, source.batch, tuple(source.filters))
            return whitened(along, source.batch, source.filters, limit, source.weights)
        values = np.asarray(free.get(seen))
        known, along = self._known.get(name, (values, None))
        by = values - known
        if along is None or np.any(by[~np.isin(source.positions, source.affine)]):
            along, by = tangent(seen, free, source.batch, tuple(source.filters)), np.zeros_like(values)
            self._known[name] = values, along
            self._white.pop(name, None)
        along = along.moved(by) if by.any() else along
        of, under, there, white = self._white.get(name, (None, limit, values, None))
        if white is not None and of is source and under == limit:
            white = white.moved(values - there, along.residuals, limit, source.weights)
        else:
            white = whitened(along, source.batch, source.filters, limit, source.weights)
        self._white[name] = source, limit, values, white
        return white


def solve(
    model: Model,
    free: Int[np.ndarray, " p"],
    sources: dict[str, Source],
    prior: Prior | None = None,
    huber: float = 0.0,
    limits: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]] | None = None,
    tangents: Tangents | None = None,
    small: float = SMALL,
) -> tuple[Model, Solution]:
    """The model with its free parameters (positions in the flat vector) at the optimum, and what is known of it.

    `limits`: of each free parameter, below and above; what starts outside of them stays until a step leads back.
    `huber`: robust limit in standard deviations, 0 for none. `tangents`: of earlier fits of the same trials.
    `small`: standard deviations by which a step ends the search.

    Raises:
        UserError: the model is not defined at its start.
    """
    flat, p, tangents = np.asarray(ravel(model)), free.size, tangents or Tangents()
    moved, theta, size = Free.at(model, free), flat[free], flat.size
    low, high = within(model, free, limits)
    prior = prior or Prior.none(theta)
    solver = VisibleGaussNewton(atol=small, kink=KINK)
    room = -(-max(p, 1) // PAD) * PAD
    y = _wide(theta, room)
    state = _begin(y)
    ends = _wide(low, room), _wide(high, room)
    at = model
    for _ in range(STEPS):
        linearised = linearise_each(at, sources, huber, tangents, free)
        factor = stacked(linearised, sources, size)
        offset = prior.root @ (np.asarray(state.trial)[:p] - prior.mean)
        rows = np.concatenate([factor[:, [*free, size]], np.column_stack([prior.root, offset])])
        trial = state.trial
        y, state = _advance(solver, y, state, _factor_of(rows, room), *ends)
        if np.array_equal(np.asarray(y), np.asarray(trial)):
            best = at, linearised, factor, rows
        if state.outcome == Outcome.nowhere:
            raise UserError(f"{Outcome[state.outcome]}: start from other parameters")
        if not bool(state.outcome == Outcome.going):
            break
        at = moved.set(model, jax.device_put(np.asarray(state.trial)[:p]))
    model, linearised, factor, rows = best
    _, invisible, scale = visible(rows[:, :-1])
    white = np.concatenate([lin.white.ravel() for lin in linearised.values()])
    count = int(np.count_nonzero(white))
    return model, Solution(
        state.outcome,
        _sentence(state),
        int(state.evaluations),
        0.5 * float(factor[:, -1] @ factor[:, -1]),
        count,
        factor[:, :-1].T @ factor[:, :-1],
        invisible,
        scale,
        float(np.count_nonzero(np.abs(white) > huber)) / max(1, count) if huber else 0.0,
        linearised,
    )


def within(
    model: Model,
    free: Int[np.ndarray, " p"],
    limits: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]] | None = None,
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Limits of every free parameter of a fit that starts from the model; no mass falls to nothing."""
    theta = np.asarray(ravel(model))[free]
    masses = np.array([q.group == "mass" for q in describe(model)])[free]
    low, high = limits or (np.full(theta.size, -np.inf), np.full(theta.size, np.inf))
    return np.where(masses, np.maximum(low, LIGHTEST * theta), low), high


def _sentence(state: Iterate) -> str:
    """What a user reads of a search that did not converge; nothing of one that did."""
    step = float(state.length * state.size)
    within = bool(state.outcome == Outcome.rounded) and step <= KINK
    if within or bool(state.outcome == Outcome.converged) or bool(state.outcome == Outcome.kink):
        return ""
    last = f"the last step was {step:.2g} standard deviations"
    if bool(state.outcome == Outcome.going):
        return f"no end after {STEPS} linearisations; {last}"
    return f"{Outcome[state.outcome]}; {last}"


def _wide(values: np.ndarray, room: int) -> Float[Array, " room"]:
    return jax.device_put(np.pad(values, (0, room - values.size)))


def _factor_of(rows: Float[np.ndarray, "N q"], room: int) -> Factor:
    """Of [J r], q = p + 1 columns, on the host, with room for more parameters, which show nowhere."""
    p = rows.shape[1] - 1
    T = np.zeros((p + 1, p + 1))
    small = triangular(rows)
    T[: len(small)] = small
    R, d = np.zeros((room, room)), np.zeros(room)
    R[:p, :p], d[:p] = T[:p, :p], T[:p, p]
    return Factor(*jax.device_put((R, d, np.asarray(T[p, p] ** 2))))


_begin = eqx.filter_jit(begin)


@eqx.filter_jit
def _advance(solver: VisibleGaussNewton, y, state: Iterate, here: Factor, low, high):
    return solver.advance(y, state, here, low, high)


def linearise_each(
    model: Model,
    sources: dict[str, Source],
    huber: float = 0.0,
    tangents: Tangents | None = None,
    free: Int[np.ndarray, " p"] | None = None,
) -> dict[str, Linearised]:
    """Every experiment at the model; along the tangents of before where it is affine in what is free."""
    known = tangents or Tangents()

    def one(name: str) -> Linearised:
        s = sources[name]
        return known.at(name, model, s, huber, free is not None and s.linear(model, free))

    return dict(zip(sources, side_by_side(one, sources), strict=True))


def missed_each(model: Model, sources: dict[str, Source]) -> dict[str, dict[str, Float[np.ndarray, "_columns _B _T"]]]:
    """Measured − predicted of every experiment's channels; also where a sample does not count."""

    def one(s: Source):
        seen = s.seen(model)
        return missed(seen, Free.at(seen, s.positions), s.batch, tuple(s.filters))

    return dict(zip(sources, side_by_side(one, sources.values()), strict=True))


def stacked(
    linearised: dict[str, Linearised], sources: dict[str, Source], size: int
) -> Float[np.ndarray, "k {size}+1"]:
    """One triangular factor of all trials, its columns those of the flat vector, then the residual."""
    blocks = []
    for name, lin in linearised.items():
        block = np.zeros((lin.factor.shape[0] * lin.factor.shape[1], size + 1))
        block[:, [*sources[name].positions, size]] = lin.factor.reshape(-1, lin.factor.shape[-1])
        blocks.append(block[np.any(block != 0.0, axis=1)])
    used = np.flatnonzero(np.any(np.concatenate(blocks) != 0, axis=0))
    used = np.union1d(used, [size])
    small = triangular(np.concatenate(blocks)[:, used])
    out = np.zeros((small.shape[0], size + 1))
    out[:, used] = small
    return out


def visible(A: Float[np.ndarray, "k p"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Basis B of the combinations that data or prior see, the others, and the scale of each parameter."""
    p = A.shape[1]
    basis, _, seen, V, scale = map(
        np.asarray, scaled_directions(np.concatenate([A, np.zeros((max(0, p - len(A)), p))]))
    )
    return basis[:, seen], V[:, ~seen].T, scale


def bounded_least_squares(
    A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray | float = np.inf
) -> np.ndarray:
    """argmin ‖A δ + b‖ over low ≤ δ ≤ high, where δ = 0 is allowed: a step of the solver, by itself."""
    p = A.shape[1]
    room = -(-max(p, 1) // PAD) * PAD
    ends = (_wide(np.broadcast_to(e, p), room) for e in (low, high))
    return np.asarray(_bounded(_factor_of(np.column_stack([A, b]), room), *ends))[:p]


@eqx.filter_jit
def _bounded(here: Factor, low: Float[Array, " p"], high: Float[Array, " p"]) -> Float[Array, " p"]:
    return bounded_step(here, low, high)[0]
