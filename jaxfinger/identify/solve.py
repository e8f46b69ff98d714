"""Minimisation behind every fit of one session: `VisibleGaussNewton`, stepped from outside, on compressed trials.

    min_θ  Σ_trials Huber(white residuals) + ½ ‖Λ^½ (θ − μ)‖²

with the prior's mean μ and precision Λ. A step of the solver needs the trials linearised and compressed at its trial
point. Each experiment is linearised by a program of its own, which all sessions of similar fingers share; the solver is
stepped from Python (optimistix calls that interactive stepping). `batch` instead passes the same rows to
`optimistix.least_squares` in one program, which is compiled for its sessions. An experiment whose residuals are affine
in the free parameters is linearised once and then moved along its tangent, which is exact. Where all are, and no Huber
cost bends theirs, the compressed rows of the start hold everywhere, and one call of the stepping program ends the fit.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfinger.compilation import quick_jit, side_by_side
from jaxfinger.errors import UserError
from jaxfinger.identify.gauss_newton import (
    Factor,
    Iterate,
    LinearRows,
    Outcome,
    VisibleGaussNewton,
    begin,
    bounded_step,
    scaled_directions,
    with_linear_rows,
)
from jaxfinger.identify.linearise import (
    Linearised,
    Tangent,
    gram_of_linear_rows,
    tangent,
    triangular,
    whitened,
)
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.sources import Source
from jaxfinger.model import Model

# Lengths of a step, in standard deviations of the estimate, that end a search.
STEP_TOLERANCE = 1e-6  # a millionth of an interval's half width, and still above rounding
# Where residuals are wanted, for their noise or for a diagnosis: all white ones change by so much in norm.
ROUGH_TOLERANCE = 0.02
# Of a rejected step, a twentieth of an interval's half width: it lies within a kink of the cost, as where a tendon
# slips or a joint turns. Also of the whole way that is left when the last of `MAX_STEPS` has been made.
KINK_TOLERANCE = 0.1
MAX_STEPS = 60  # linearisations; it bounds the time of a fit, whose report says when it was reached
MIN_MASS_SHARE = 0.02  # lower bound of a mass over its starting value: no link is fifty times lighter than CAD says
# Sentences of the outcomes. Python compares these; to compare the outcomes themselves is an operation of JAX's.
RUNNING, CONVERGED, KINK, ROUNDED, UNDEFINED_START = (
    Outcome[o] for o in (Outcome.running, Outcome.converged, Outcome.kink, Outcome.rounded, Outcome.undefined_start)
)
PADDING = 48  # problems are padded to a multiple of so many parameters, so that they share compiled programs


@dataclass(frozen=True)
class Solution:
    """A least-squares estimate at its optimum."""

    outcome: Outcome
    message: str  # empty where the search converged
    linearisations: int
    cost: float  # ½ Σ s² of the white residuals under Huber's cost, without the prior
    jacobian: Float[np.ndarray, "k p"]  # of all trials and the prior, compressed, at the optimum
    huber: float  # robust limit in standard deviations, 0 for none
    linearise: Callable[[], dict[str, Linearised]]  # at the optimum

    @cached_property
    def invisible(self) -> Float[np.ndarray, "i p"]:
        """Unit vectors of scaled parameters along the invisible combinations."""
        return visible(self.jacobian)[1].T

    @cached_property
    def linearised(self) -> dict[str, Linearised]:
        """Every experiment, linearised at the optimum.

        Derivatives by parts of the model without a free parameter may be zero (`with_all_slopes`).
        """
        return self.linearise()

    @property
    def rows(self) -> int:
        """Number of white residuals that are not zero."""
        return sum(int(np.count_nonzero(lin.white)) for lin in self.linearised.values())

    @property
    def outliers(self) -> float:
        """Share of white residuals beyond the robust limit."""
        beyond = sum(int(np.count_nonzero(np.abs(lin.white) > self.huber)) for lin in self.linearised.values())
        return beyond / max(1, self.rows) if self.huber else 0.0

    @property
    def converged(self) -> bool:
        """Whether the search ended at an optimum, to rounding, or in a kink a tenth of a standard deviation wide.

        A search that is out of steps did so, too, if its last steps tell that no more than that is left of its way.
        """
        return not self.message

    def chi2_per_row(self, estimated: int) -> float:
        """χ² over the degrees of freedom left by `estimated` parameters: about 1 where model and noise are right."""
        return 2.0 * self.cost / max(1, self.rows - estimated)


class Tangents:
    """Cache of the tangents of affine experiments, reused until a parameter moves in which they are not affine."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[np.ndarray, Tangent]] = {}
        self._white: dict[str, tuple[Source, float, np.ndarray, Linearised]] = {}

    def at(
        self, name: str, model: Model, source: Source, limit: float, affine: bool, parts: set[str] | None = None
    ) -> Linearised:
        """Linearise experiment `name` at the model; a cached tangent is whitened anew where the source has changed.

        `parts`: as in `linearise.tangent`, where the experiment is not affine.
        """
        relevant, free = source.seen(model)
        if not affine:
            along = tangent(relevant, free, source.batch, tuple(source.filters), parts)
            return whitened(along, source.batch, source.filters, limit, source.weights, source.reversals)
        values = np.asarray(free.get(relevant))
        known, along = self._known.get(name, (values, None))
        by = values - known
        if along is None or np.any(by[~np.isin(source.positions, source.affine)]):
            along, by = tangent(relevant, free, source.batch, tuple(source.filters)), np.zeros_like(values)
            self._known[name] = values, along
            self._white.pop(name, None)
        along = along.moved(by) if by.any() else along
        of, under, there, white = self._white.get(name, (None, limit, values, None))
        if white is not None and of is source and under == limit:
            white = white.moved(values - there, along, limit, source.weights)
        else:
            white = whitened(along, source.batch, source.filters, limit, source.weights, source.reversals)
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
    tolerance: float = STEP_TOLERANCE,
) -> tuple[Model, Solution]:
    """Fit the free parameters, given by their positions in the flat vector.

    `huber`: robust limit in standard deviations, 0 for none. `limits`: lower and upper bounds of the free parameters;
    one that starts outside of them moves only towards them. `tangents`: those of earlier fits of the same trials.
    `tolerance`: length of a step, in standard deviations, that ends the search.

    Returns:
        The model at the optimum, and the solution there.

    Raises:
        UserError: the model is not defined at its start.
    """
    flat, p, tangents = np.asarray(ravel(model)), free.size, tangents or Tangents()
    moved, theta, size = Free.at(model, free), flat[free], flat.size
    low, high = parameter_bounds(model, free, limits)
    prior = prior or Prior.none(theta)
    affine = not huber and all(s.is_affine(model, free) for s in sources.values())
    room = _room(p)
    y = _padded(theta, room)
    state = begin(y)
    how = np.asarray(tolerance), np.asarray(affine), _padded(low, room), _padded(high, room)
    at, sizes = model, [np.inf]  # lengths of the full steps, in standard deviations
    for _ in range(MAX_STEPS):
        linearised = linearise_each(at, sources, huber, tangents, free)
        factor = stacked(linearised, sources, size)
        offset = prior.root @ (np.asarray(state.trial)[:p] - prior.mean)
        rows = np.concatenate([factor[:, [*free, size]], np.column_stack([prior.root, offset])])
        trial = state.trial
        here = _factor_of(rows, room, _linear_rows(linearised, sources, free, size, huber))
        y, state = _advance(y, state, here, *how)
        sizes.append(float(state.size))
        if affine or np.array_equal(y, trial):
            best = at, linearised, rows
        outcome = Outcome[state.outcome]
        if outcome == UNDEFINED_START:
            raise UserError(f"{outcome}: start from other parameters")
        if affine or outcome != RUNNING:
            break
        at = moved.set(model, np.asarray(state.trial)[:p])
    at, linearised, rows = best
    y = np.asarray(y)[:p]
    optimum = moved.set(model, y) if affine else at
    return optimum, Solution(
        state.outcome,
        _sentence(outcome, state, _way_left(sizes[-2], sizes[-1])),
        int(state.evaluations),
        float(state.cost) - prior.cost(y),
        rows[:, :-1],
        huber,
        partial(linearise_each, optimum, sources, huber, tangents, free) if affine else lambda: linearised,
    )


def total_cost(model: Model, solution: Solution, free: Int[np.ndarray, " p"], prior: Prior | None) -> float:
    """Cost that a fit minimises, the prior included."""
    return solution.cost + (prior.cost(np.asarray(ravel(model))[free]) if prior else 0.0)


def parameter_bounds(
    model: Model,
    free: Int[np.ndarray, " p"],
    limits: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]] | None = None,
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Lower and upper bounds of the free parameters: `limits`, by default none, and a positive bound of each mass."""
    theta = np.asarray(ravel(model))[free]
    masses = np.array([q.group == "mass" for q in describe(model)])[free]
    low, high = limits or (np.full(theta.size, -np.inf), np.full(theta.size, np.inf))
    return np.where(masses, np.maximum(low, MIN_MASS_SHARE * theta), low), high


def _way_left(before: float, last: float) -> float:
    """Length of `last` and all later steps if each is shorter than the one before it by the ratio of these two."""
    return last / (1.0 - last / before) if last < before else np.inf


def _sentence(outcome: str, state: Iterate, left: float) -> str:
    """Message to the user about a search that did not converge; empty where it did.

    `left`: the way to the optimum that full steps would go, in standard deviations.
    """
    step = float(state.length) * float(state.size)
    near = outcome == RUNNING and left <= KINK_TOLERANCE
    at_rounding = outcome == ROUNDED and step <= KINK_TOLERANCE
    if near or at_rounding or outcome in (CONVERGED, KINK):
        return ""
    last = f"the last step was {step:.2g} standard deviations"
    if outcome == RUNNING:
        return f"no end after {MAX_STEPS} linearisations; {last}"
    return f"{outcome}; {last}"


def _room(p: int) -> int:
    """Number of parameters to which a problem of `p` is padded."""
    return max(-(-p // PADDING), 1) * PADDING


def _padded(values: np.ndarray, room: int) -> Float[np.ndarray, " room"]:
    return np.pad(values, (0, room - values.size))


def _factor_of(rows: Float[np.ndarray, "N q"], room: int, linear: LinearRows | None = None) -> Factor:
    """Compress the rows of [J r], q = p + 1 columns, and pad them with columns of zero to `room` parameters."""
    p = rows.shape[1] - 1
    T = np.zeros((p + 1, p + 1))
    small = triangular(rows)
    T[: len(small)] = small
    here = Factor(T[:p, :p], T[:p, p], np.asarray(T[p, p] ** 2))
    if linear is not None and linear.gram.any() and np.isfinite(T).all():
        here = with_linear_rows(here, linear)
    R, d = np.zeros((room, room)), np.zeros(room)
    R[:p, :p], d[:p] = here.R, here.d
    return Factor(R, d, np.asarray(here.rho2))


def _linear_rows(
    linearised: dict[str, Linearised],
    sources: dict[str, Source],
    free: Int[np.ndarray, " p"],
    size: int,
    huber: float,
) -> LinearRows | None:
    """The linear rows of all experiments together, by the free parameters of the flat vector of `size` entries."""
    if not huber:
        return None
    gram, count = np.zeros((size, size)), 0
    for name, lin in linearised.items():
        s = sources[name]
        gram[np.ix_(s.positions, s.positions)] += gram_of_linear_rows(lin.white, lin.jacobian, huber, s.weights)
        count += int(np.count_nonzero(lin.white))
    return LinearRows(gram[np.ix_(free, free)], count)


@quick_jit
def _advance(
    y: Float[Array, " p"],
    state: Iterate,
    here: Factor,
    tolerance: Float[Array, ""],
    affine: Bool[Array, ""],
    low: Float[Array, " p"],
    high: Float[Array, " p"],
) -> tuple[Float[Array, " p"], Iterate]:
    """Best point and state after one step; where the rows in `here` are `affine`, those at the end of the search."""
    solver, first = VisibleGaussNewton(atol=tolerance, kink=KINK_TOLERANCE), state.evaluations

    def step(carry):
        y, state, here = carry
        best, after = solver.advance(y, state, here, low, high)
        return best, after, here._replace(d=here.d + here.R @ (after.trial - state.trial))

    def goes_on(carry):
        now = carry[1]
        more = affine & (now.outcome == Outcome.running) & (now.evaluations < MAX_STEPS)
        return more | (now.evaluations == first)

    return jax.lax.while_loop(goes_on, step, (y, state, here))[:2]


def linearise_each(
    model: Model,
    sources: dict[str, Source],
    huber: float = 0.0,
    tangents: Tangents | None = None,
    free: Int[np.ndarray, " p"] | None = None,
) -> dict[str, Linearised]:
    """Linearise every experiment at the model.

    `free`: parameters that a fit moves. An experiment that is affine in them is linearised along its cached tangent; in
    others the derivatives by parts of the model without any of them stay zero.
    """
    known = tangents or Tangents()
    parts = set(Free.at(model, free).parts) if free is not None else None

    def one(name: str) -> Linearised:
        s = sources[name]
        return known.at(name, model, s, huber, free is not None and s.is_affine(model, free), parts)

    return dict(zip(sources, side_by_side(one, sources), strict=True))


def with_all_slopes(
    linearised: dict[str, Linearised],
    model: Model,
    free: Int[np.ndarray, " p"],
    sources: dict[str, Source],
    huber: float = 0.0,
) -> dict[str, Linearised]:
    """Linearisations of `solve` at its optimum, with the derivatives by all parameters, free or not."""
    moved = set(Free.at(model, free).parts)
    lacking = {e: s for e, s in sources.items() if not (s.is_affine(model, free) or s.parts(model) <= moved)}
    return linearised | linearise_each(model, lacking, huber)


def stacked(
    linearised: dict[str, Linearised], sources: dict[str, Source], size: int
) -> Float[np.ndarray, "k {size}+1"]:
    """Triangular factor [R d] of all trials together, over the whole flat vector of `size` entries."""
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


def visible(A: Float[np.ndarray, "k p"]) -> tuple[Float[np.ndarray, "p v"], Float[np.ndarray, "p i"]]:
    """Columns of steps along the visible combinations (`scaled_directions`), and of unit vectors along the others."""
    p = A.shape[1]
    basis, _, seen, V, _ = scaled_directions(np.concatenate([A, np.zeros((max(0, p - len(A)), p))]))
    return basis[:, seen], V[:, ~seen]


def bounded_least_squares(
    A: Float[np.ndarray, "N p"],
    b: Float[np.ndarray, " N"],
    low: Float[np.ndarray, " p"],
    high: Float[np.ndarray, " p"] | float = np.inf,
) -> Float[np.ndarray, " p"]:
    """Minimum δ of ‖A δ + b‖ over low ≤ δ ≤ high, by `gauss_newton.bounded_step`; bounds that exclude 0 move to 0."""
    p = A.shape[1]
    room = _room(p)
    ends = (_padded(np.broadcast_to(e, p), room) for e in (low, high))
    return np.asarray(_bounded(_factor_of(np.column_stack([A, b]), room), *ends))[:p]


@quick_jit
def _bounded(here: Factor, low: Float[Array, " p"], high: Float[Array, " p"]) -> Float[Array, " p"]:
    return bounded_step(here, low, high)[0]
