"""Sets of causes fitted exactly: amplitudes, shapes and nominal parameters move, in the weights of the formula.

Gauss–Newton on amplitudes and shapes with signatures read again at each step, the nominal parameters eliminated by
projection, then the nominal model moved to where they lead, until both settle. What nobody knows is part of the noise
(`formula`): a column that the causes do not explain pulls at none of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from jaxfinger.effects import CatalogueEffect, Scales
from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.formula import LinearFit, LinearModel, Parameters, Weights, unexplained
from jaxfinger.gap.problem import Problem, moved
from jaxfinger.gap.signatures import Signatures, Variant
from jaxfinger.identify.solve import bounded_least_squares

STEPS = 6  # of shapes and amplitudes at one nominal model
STEP = 0.05  # of a difference, in units of a coordinate
FACTOR = 0.7  # logarithm of the most by which a step changes a shape
ROUNDS = 5  # of moving the nominal model
PLAIN = 3  # steps of plain least squares, each nonlinear by a fifth of the one before: `tests/gap/test_problem.py`
SETTLED = 0.5  # change of the score below which it stays
HALVINGS = 3
ROUNDING = 1e-14  # of the largest variance: a sum of ten thousand products is good to a hundred times 2.2e-16
Room = tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]


@dataclass(frozen=True)
class Coordinate:
    """One amplitude or one shape that a refit moves."""

    effect: int
    name: str
    amplitude: bool
    unit: float  # of its prior's standard deviation: an amplitude's own units, or the step of a shape
    shifts: bool  # moves by differences, not by factors
    scales: Scales


@dataclass(frozen=True)
class SearchState:
    """A set of causes at its optimum, and the problem at the nominal model that it leads to."""

    problem: Problem
    columns: Columns
    nominal: ByColumn  # −∂r/∂θ of the nominal parameters
    effects: tuple[CatalogueEffect, ...]
    coordinates: tuple[Coordinate, ...]
    changes: Float[np.ndarray, "effects N"]  # what each effect adds to every white row
    slopes: Float[np.ndarray, "k N"]  # derivatives by the coordinates, in their units
    linear_fit: LinearFit

    @property
    def score(self) -> float:
        """Comparable between sets."""
        return self.linear_fit.score

    @property
    def keys(self) -> tuple[tuple[str, tuple[str, ...]], ...]:
        """(effect, site) of each."""
        return tuple((e.ID, e.site) for e in self.effects)

    def sizes(self) -> Float[np.ndarray, " k"]:
        """Amplitudes in standard deviations of their prior."""
        return _sizes(self.effects, self.coordinates)

    def room(self, at: list[int]) -> Room:
        """How far some of the coordinates may move, back and forth."""
        low, high = _room(self.effects, self.coordinates)
        return low[at], high[at]

    @property
    def r(self) -> Float[np.ndarray, " N"]:
        """White residual."""
        return self.problem.r - self.changes.sum(axis=0)


@dataclass(frozen=True)
class Baseline:
    """What is the same for all sets of one file."""

    columns: Columns
    parameters: Parameters
    null: SearchState  # no cause, the nominal model refitted in the weights of the formula
    unexplained: Float[np.ndarray, " C"]  # log evidence, column by column, that something is at work
    gap: float  # norm of what the nominal model misses: the size of the amplitudes' prior

    @classmethod
    def of(cls, problem: Problem, parameters: Parameters) -> "Baseline":
        columns = Columns.of(problem)
        empty = np.empty((0, problem.r.size))
        nominal, none = ByColumn.of(columns, problem.J.T), ByColumn.of(columns, empty)
        residual = ByColumn.of(columns, problem.r[None])
        judged = LinearModel(columns, (residual, nominal), prior_products(problem, 0), none, parameters).null
        assert judged is not None
        null = SearchState(problem, columns, nominal, (), (), empty, empty, judged)
        unknown = unexplained(columns.counts, judged.evidence, parameters)
        gap = float(np.sqrt(np.sum(judged.evidence.e + judged.evidence.o)))
        return cls(columns, parameters, null, unknown, gap)

    def fit_linear(
        self, problem: Problem, nominal: ByColumn, r: np.ndarray, slopes: np.ndarray, sizes: np.ndarray, room: Room
    ) -> LinearFit:
        """A set at its optimum: `sizes`, how far its coordinates are from the middle of their priors, `room`, how far
        they may move on.
        """
        linear = LinearModel(
            self.columns,
            (ByColumn.of(self.columns, r[None]), nominal),
            prior_products(problem, 0),
            ByColumn.of(self.columns, slopes),
            self.parameters,
            self.null.linear_fit,
        )
        return linear.fit(np.arange(len(slopes)), *room, sizes=sizes)


def prior_products(problem: Problem, k: int) -> Float[np.ndarray, "d d"]:
    """Products of the prior's rows with themselves: for a residual, the nominal parameters, and k slopes of unit
    precision, which are refitted with every set.
    """
    rows = np.column_stack([-problem.offset, problem.root])
    out = np.zeros((rows.shape[1] + k,) * 2)
    out[: rows.shape[1], : rows.shape[1]] = rows.T @ rows
    out[rows.shape[1] :, rows.shape[1] :] = np.eye(k)
    return out


class Projector:
    """Rows in the weights of the formula, projected off the nominal parameters."""

    def __init__(self, problem: Problem, columns: Columns, weights: Weights):
        self.columns, self.weights = columns, weights
        A = np.vstack([self.weighted(problem.J.T).T, problem.root])
        scale = np.linalg.norm(A, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        self.Q, self.T = orthonormalised(A / scale)
        self.T /= scale[:, None]  # Q = A T
        self.offset = problem.offset

    def weighted(self, x: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "k N"]:
        """W^½ x."""
        out = x.copy()
        for c, inside, outside in zip(self.columns.items, self.weights.feature, self.weights.outside, strict=True):
            mine = x[:, c.rows]
            out[:, c.rows] = (
                np.sqrt(outside) * mine + (np.sqrt(inside) - np.sqrt(outside)) * (mine @ c.basis) @ c.basis.T
            )
        return out

    def __call__(self, x: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "k rows"]:
        """Of signatures."""
        return self._off(np.pad(self.weighted(x), ((0, 0), (0, len(self.offset)))))

    def residual(self, r: Float[np.ndarray, " N"]) -> Float[np.ndarray, " rows"]:
        """Of a residual, with what the prior says of the nominal parameters as they are."""
        return self._off(np.concatenate([self.weighted(r[None])[0], -self.offset])[None])[0]

    def _off(self, x):
        return x - (x @ self.Q) @ self.Q.T

    def nominal_step(self, r: Float[np.ndarray, " N"]) -> Float[np.ndarray, " p"]:
        """What the nominal parameters move by to absorb r."""
        return self.T @ (self.Q.T @ np.concatenate([self.weighted(r[None])[0], -self.offset]))


def orthonormalised(A: Float[np.ndarray, "N p"]) -> tuple[Float[np.ndarray, "N k"], Float[np.ndarray, "p k"]]:
    """Q and T, Q = A T with Qᵀ Q = I, spanning the columns of A as far as they stand out of rounding.

    From the products of columns, which cost a quarter of Householder's QR where rows are many. The first pass leaves Q
    oblique where A is ill-conditioned; the second one mends that (as in CholeskyQR2: Yamamoto et al., ETNA 44 (2015)).
    """
    Q, T = A, np.eye(A.shape[1])
    for _ in range(2):
        variance, V = np.linalg.eigh(Q.T @ Q)
        kept = variance > ROUNDING * variance.max(initial=0.0)
        step = V[:, kept] / np.sqrt(variance[kept])
        Q, T = Q @ step, T @ step
    return Q, T


def fitted(
    baseline: Baseline,
    problem: Problem,
    variants: Sequence[Variant],
    start: Sequence[dict[str, float]],
    weights: Weights,
) -> SearchState:
    """The causes together, from amplitudes `start` (in their own units), at the nominal model that they lead to."""
    finger = problem.nominal.finger
    effects = [within_bounds(v.at(finger, s), v.scales) for v, s in zip(variants, start, strict=True)]
    best: SearchState | None = None
    for _ in range(ROUNDS):
        found = at_one_model(baseline, problem, effects, weights)
        if best is not None and found.score < best.score + SETTLED:
            return max(best, found, key=lambda s: s.score)
        best, effects, weights = found, list(found.effects), found.linear_fit.weights
        problem = _led(baseline, found, weights)
    assert best is not None
    return best


def led_plainly(baseline: Baseline, state: SearchState) -> SearchState:
    """The causes together where plain least squares leads from a state, if the formula says more for that.

    The formula gives a column that is open little weight. Where it takes a large step in the nominal model to close it,
    `fitted` ends before, since each small step wins less than it loses in the columns that are closed.
    """
    plain = Weights.plain(baseline.columns)
    problem, effects, there = state.problem, list(state.effects), state
    for _ in range(PLAIN):
        there = at_one_model(baseline, problem, effects, plain)
        problem, effects = _led(baseline, there, plain), list(there.effects)
    variants, starts = [as_variant(e, problem.scales) for e in effects], [amplitudes_of(e) for e in effects]
    return max(state, fitted(baseline, problem, variants, starts, there.linear_fit.weights), key=lambda s: s.score)


def amplitudes_of(effect: CatalogueEffect) -> dict[str, float]:
    """By name, in their own units."""
    return {n: float(getattr(effect, n)) for n in effect.amplitudes()}


def as_variant(effect: CatalogueEffect, scales: Scales) -> Variant:
    """What an effect is but for its amplitudes."""
    shapes = tuple((n, float(getattr(effect, n))) for n in effect.shape_parameters())
    return Variant(type(effect), effect.site, shapes, scales=scales)


def _led(baseline: Baseline, state: SearchState, weights: Weights) -> Problem:
    """The problem at the nominal model that a set leads to; a part of the step where a whole one loses what it won."""
    project = Projector(state.problem, baseline.columns, weights)
    step = project.nominal_step(state.r)
    here = state.problem
    for _ in range(HALVINGS):
        here = moved(state.problem, step)
        left = here.r - np.sum([Signatures(here).white_changes([e])[0] for e in state.effects], axis=0)
        if _cost(Projector(here, baseline.columns, weights), left) < 2.0 * _cost(project, state.r) + 100.0:
            return here
        step = step / 3.0
    return here


def _cost(project: Projector, r: np.ndarray) -> float:
    x = project.residual(r)
    return float(x @ x)


def at_one_model(baseline: Baseline, problem: Problem, effects: list[CatalogueEffect], weights: Weights) -> SearchState:
    """Amplitudes and shapes at the problem's nominal model, its parameters eliminated by projection."""
    signatures, project = Signatures(problem), Projector(problem, baseline.columns, weights)
    coordinates = _coordinates(effects, problem.scales)
    reach = np.full(len(coordinates), STEP)
    changes, slopes = _evaluate(signatures, effects, coordinates, reach)
    # An amplitude is measured in the gap: one prior standard deviation changes as much as is missed in all. One that
    # changes nothing here keeps its own unit, as the warmth of a friction that there is none of.
    plain = Projector(problem, baseline.columns, Weights.plain(baseline.columns))
    norm = np.linalg.norm(plain(slopes), axis=1)
    grow = np.array(
        [baseline.gap / n if c.amplitude and n > 0.0 else 1.0 for c, n in zip(coordinates, norm, strict=True)]
    )
    coordinates = [replace(c, unit=c.unit * g) if c.amplitude else c for c, g in zip(coordinates, grow, strict=True)]
    slopes = slopes * grow[:, None]
    r = problem.r - changes.sum(axis=0)
    sizes = _sizes(effects, coordinates)
    cost = _cost(project, r) + float(sizes @ sizes)
    for _ in range(STEPS):
        rt, St = project.residual(r), project(slopes)
        A, b = np.vstack([St.T, np.eye(len(coordinates))]), np.concatenate([-rt, sizes])
        delta = bounded_least_squares(A, b, *_room(effects, coordinates))
        reach = np.clip(1.0 / np.maximum(np.linalg.norm(St, axis=1), 1e-300), STEP / 20.0, STEP)
        for _ in range(HALVINGS):
            trial = _moved(effects, coordinates, delta)
            new, new_slopes = _evaluate(signatures, trial, coordinates, reach)
            new_r, new_sizes = problem.r - new.sum(axis=0), _sizes(trial, coordinates)
            new_cost = _cost(project, new_r) + float(new_sizes @ new_sizes)
            if new_cost < cost:
                break
            delta = delta / 3.0
        else:
            break
        gain = cost - new_cost
        effects, changes, slopes, r, sizes, cost = trial, new, new_slopes, new_r, new_sizes, new_cost
        if gain < 0.1 + 1e-3 * cost:
            break
    nominal = ByColumn.of(baseline.columns, problem.J.T)
    judged = baseline.fit_linear(problem, nominal, r, slopes, sizes, _room(effects, coordinates))
    return SearchState(problem, baseline.columns, nominal, tuple(effects), tuple(coordinates), changes, slopes, judged)


def derivatives(signatures: Signatures, state: SearchState) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "k N"]]:
    """White change of other rows by a set's causes, and its derivatives by their coordinates."""
    reach = np.full(len(state.coordinates), STEP / 20.0)
    changes, slopes = _evaluate(signatures, state.effects, state.coordinates, reach)
    return changes.sum(axis=0), slopes


def _sizes(effects, coordinates) -> Float[np.ndarray, " k"]:
    """Amplitudes in standard deviations of their prior; zero for shapes, whose middle is where they are."""
    return np.array([float(getattr(effects[c.effect], c.name)) / c.unit if c.amplitude else 0.0 for c in coordinates])


def _coordinates(effects: Sequence[CatalogueEffect], scales: Scales) -> list[Coordinate]:
    out = []
    for i, effect in enumerate(effects):
        out += [Coordinate(i, n, True, unit, True, scales) for n, unit in effect.sizes(scales, effect.site).items()]
        for n, values in effect.worth_trying(scales, effect.site).items():
            moves = effect.shape_parameters()[n].moves
            if moves != "not" and len(values) > 1:
                shifts = moves == "by differences"
                unit = float(np.mean(np.abs(np.diff(np.sort(values))))) / 2 if shifts else 1.0
                out.append(Coordinate(i, n, False, unit, shifts, scales))
    return out


def _shifted(effect: CatalogueEffect, c: Coordinate, by: float) -> CatalogueEffect:
    value = float(getattr(effect, c.name))
    value = value + by * c.unit if c.shifts else value * float(np.exp(np.clip(by, -FACTOR, FACTOR)))
    return within_bounds(replace(effect, **{c.name: jax.device_put(value)}), c.scales)


def within_bounds(effect: CatalogueEffect, scales: Scales) -> CatalogueEffect:
    """The effect with every number within its bounds."""
    values = {n: np.clip(float(getattr(effect, n)), *ends) for n, ends in effect.bounds(scales).items()}
    return replace(effect, **jax.device_put(values))


def _room(effects, coordinates) -> Room:
    """How far each coordinate may move, back and forth."""
    out = []
    for c in coordinates:
        value, ends = float(getattr(effects[c.effect], c.name)), effects[c.effect].bounds(c.scales)[c.name]
        ways = [(end - value) / c.unit if c.shifts else np.log(end / value) for end in ends]
        most = np.inf if c.shifts else FACTOR
        out.append((max(min(ways[0], 0.0), -most), min(max(ways[1], 0.0), most)))
    low, high = np.array(out).T if out else (np.empty(0), np.empty(0))
    return low, high


def _moved(effects, coordinates, delta):
    out = list(effects)
    for c, d in zip(coordinates, delta, strict=True):
        out[c.effect] = _shifted(out[c.effect], c, float(d))
    return out


def _evaluate(signatures: Signatures, effects, coordinates, reach: Float[np.ndarray, " k"]):
    """White change by each effect, and its derivatives by every coordinate, as differences over its `reach`."""
    size = signatures.problem.r.size
    changes, slopes = np.zeros((len(effects), size)), np.zeros((len(coordinates), size))
    for i, effect in enumerate(effects):
        mine = [k for k, c in enumerate(coordinates) if c.effect == i]
        # A difference of an amplitude is one of its plausible size: its prior may be far wider.
        steps = [_beside(effect, coordinates[k], reach[k]) for k in mine]
        flat = signatures.white_changes([effect, *steps])
        changes[i] = flat[0]
        for row, k in enumerate(mine, start=1):
            step = _step_taken(effect, steps[row - 1], coordinates[k])
            slopes[k] = (flat[row] - flat[0]) / step if step else 0.0
    return changes, slopes


def _beside(effect: CatalogueEffect, c: Coordinate, h: float) -> CatalogueEffect:
    """A step for a difference: back where a bound leaves no way forward."""
    ahead = _shifted(effect, c, h)
    return ahead if float(getattr(ahead, c.name)) != float(getattr(effect, c.name)) else _shifted(effect, c, -h)


def _step_taken(before, after, c: Coordinate) -> float:
    a, b = float(getattr(before, c.name)), float(getattr(after, c.name))
    return (b - a) / c.unit if c.shifts else float(np.log(b / a))
