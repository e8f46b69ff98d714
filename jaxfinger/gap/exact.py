"""Exact fits of sets of causes: amplitudes, shapes and nominal parameters, in the weights of the formula.

With nominal parameters θ and causes i of amplitudes and shapes p_i, the white residual left is

    x(θ, p) = W (y − ŷ(θ)) − Σ_i Δ_i(θ, p_i),

where Δ_i is the white change of every row by cause i. A fit alternates two steps until the log evidence settles:

1. Gauss–Newton on p (`fit_at_nominal`), in the weights of the formula. θ is refitted with every p to first order
   (`LinearModel`), as in variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413). Changes and
   their derivatives are evaluated at every p.
2. θ moves by the step that this refit implies, and residual and Jacobian are evaluated exactly there
   (`_with_nominal_refitted`).

A column that the causes leave unexplained has low weights (`formula`), so that it hardly biases p and θ.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from jaxfinger.effects import CatalogueEffect, Scales
from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.costs import CauseKey
from jaxfinger.gap.formula import LinearFit, LinearModel, Parameters, Weights, unexplained
from jaxfinger.gap.problem import Problem, moved
from jaxfinger.gap.signatures import Signatures, Variant

MAX_ROUNDS = 5  # moves of the nominal model in one fit
MIN_SCORE_GAIN = 0.5  # nats. A round that gains less ends the fit: sets differ by several nats where it matters.
MAX_STEPS = 6  # Gauss–Newton steps on amplitudes and shapes at one nominal model
# A step that gains less than this, plus this share of the cost, is the last one. The cost is in squared standard
# deviations, of which a tenth is 0.05 nats.
MIN_COST_GAIN, MIN_RELATIVE_COST_GAIN = 0.1, 1e-3
MAX_TRIES = 3  # of a step, each a third as long as the one before
MAX_LOG_FACTOR = 0.7  # A step changes a shape by a factor of two at most, since linearisations hold no further.
# A finite difference changes the white rows by one standard deviation of the noise, within these bounds in units of its
# coordinate: a longer one would be nonlinear, a shorter one rounding.
MAX_DIFFERENCE, MIN_DIFFERENCE = 0.05, 0.0025
# Rounds of ordinary least squares. With a gain error of a fifth, each leaves a fifth of the error that the one before
# left (`tests/gap/test_problem.py`).
PLAIN_ROUNDS = 3

Bounds = tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]  # lower, upper


@dataclass(frozen=True)
class Coordinate:
    """One amplitude or one shape of one effect of a set, which a fit moves."""

    effect: int  # position in the set
    name: str
    amplitude: bool
    # Change of the parameter per unit of a coordinate that moves by differences: prior standard deviation of an
    # amplitude, half a step of a shape's grid. For a shape that moves by factors, the coordinate is their logarithm.
    unit: float
    by_differences: bool
    scales: Scales


@dataclass(frozen=True)
class SearchState:
    """A set of causes at its optimum, linearised there."""

    problem: Problem  # at the nominal model refitted with the set
    columns: Columns
    nominal: ByColumn  # rows ∂ŷ/∂θ of the nominal parameters, white
    effects: tuple[CatalogueEffect, ...]
    coordinates: tuple[Coordinate, ...]
    changes: Float[np.ndarray, "effects N"]  # white change of every row by each effect
    slopes: Float[np.ndarray, "k N"]  # derivatives of the changes by the coordinates
    linear_fit: LinearFit

    @property
    def score(self) -> float:
        """Log evidence, comparable between sets of one problem."""
        return self.linear_fit.score

    @property
    def keys(self) -> tuple[CauseKey, ...]:
        """The causes: effect and site of each."""
        return tuple((e.ID, e.site) for e in self.effects)

    def sizes(self) -> Float[np.ndarray, " k"]:
        """Amplitudes in prior standard deviations, zero for shapes."""
        return _sizes(self.effects, self.coordinates)

    def step_bounds(self, at: list[int]) -> Bounds:
        """Bounds of a further step of the coordinates `at`."""
        low, high = _step_bounds(self.effects, self.coordinates)
        return low[at], high[at]

    @property
    def r(self) -> Float[np.ndarray, " N"]:
        """White residual that the causes leave."""
        return self.problem.r - self.changes.sum(axis=0)


@dataclass(frozen=True)
class Baseline:
    """The nominal model without causes, which all sets of one problem are compared with."""

    columns: Columns
    parameters: Parameters
    null: SearchState  # no cause, at the best fit of the nominal parameters: what causes explain counts from it
    start: SearchState  # no cause, near the least squares of the nominal parameters: a search begins here

    @classmethod
    def of(cls, problem: Problem, parameters: Parameters) -> "Baseline":
        """Refit the nominal parameters in the weights of the formula.

        Where the gap is large, the best fit gives up the channels of a large cause for the others, and from there a
        search does not find that cause. Where the best fit brings less than MIN_SCORE_GAIN, it is the start itself.
        """
        columns = Columns.of(problem)
        nominal = ByColumn.of(columns, problem.J.T)
        start = _without_causes(problem, columns, nominal, parameters)
        baseline = cls(columns, parameters, start, start)
        best = fit_set(baseline, problem, [], [], start.linear_fit.weights)
        null = _without_causes(best.problem, columns, best.nominal, parameters, best.linear_fit.weights)
        if null.score < start.score + MIN_SCORE_GAIN:
            return baseline
        baseline = replace(baseline, null=null)
        from_null = baseline.linear_model(problem, nominal, problem.r, start.slopes)
        fit = from_null.fit(np.empty(0, int), start=Weights.plain(columns))
        return replace(baseline, start=replace(start, linear_fit=fit))

    @property
    def unexplained(self) -> Float[np.ndarray, " C"]:
        """Log evidence that something is at work in each column, u_c, nats."""
        return unexplained(self.columns.counts, self.null.linear_fit.evidence, self.parameters)

    @property
    def gap(self) -> float:
        """Norm of the white residual at the start, the unit of all amplitudes."""
        evidence = self.start.linear_fit.evidence
        return float(np.sqrt(np.sum(evidence.e + evidence.o)))

    def linear_model(
        self, problem: Problem, nominal: ByColumn, r: Float[np.ndarray, " N"], slopes: Float[np.ndarray, "k N"]
    ) -> LinearModel:
        """A set linearised where it leaves the white residual `r`, with `slopes` by its coordinates."""
        return LinearModel(
            self.columns,
            (ByColumn.of(self.columns, r[None]), nominal),
            prior_products(problem, 0),
            ByColumn.of(self.columns, slopes),
            self.parameters,
            self.null.linear_fit,
        )


def _without_causes(
    problem: Problem, columns: Columns, nominal: ByColumn, parameters: Parameters, start: Weights | None = None
) -> SearchState:
    """The empty set, linearised at the problem's nominal model; weights begin at `start`, or at one."""
    empty = np.empty((0, problem.r.size))
    rows, none = (ByColumn.of(columns, problem.r[None]), nominal), ByColumn.of(columns, empty)
    fit = LinearModel(columns, rows, prior_products(problem, 0), none, parameters, start=start).null
    assert fit is not None
    return SearchState(problem, columns, nominal, (), (), empty, empty, fit)


def prior_products(problem: Problem, k: int) -> Float[np.ndarray, "d d"]:
    """Prior of a `LinearModel`'s base (d = 1 + p + k): residual, p nominal parameters, k amplitudes with N(0, I)."""
    rows = np.column_stack([-problem.offset, problem.root])
    out = np.zeros((rows.shape[1] + k,) * 2)
    out[: rows.shape[1], : rows.shape[1]] = rows.T @ rows
    out[rows.shape[1] :, rows.shape[1] :] = np.eye(k)
    return out


def fit_set(
    baseline: Baseline,
    problem: Problem,
    variants: Sequence[Variant],
    start: Sequence[dict[str, float]],
    weights: Weights,
) -> SearchState:
    """Fit a set of causes from amplitudes `start`, in their own units, and from the problem's nominal model."""
    finger = problem.nominal.finger
    effects = [within_bounds(v.at(finger, s), v.scales) for v, s in zip(variants, start, strict=True)]
    best = fit_at_nominal(baseline, problem, jax.device_put(effects), weights)
    for _ in range(MAX_ROUNDS - 1):
        weights = best.linear_fit.weights
        there = _with_nominal_refitted(baseline, best, weights)
        found = fit_at_nominal(baseline, there.problem, list(best.effects), weights, there.nominal)
        if found.score < best.score + MIN_SCORE_GAIN:
            # A score is that of the optimum of the linearisation. The later round starts from the weights of that
            # optimum, and its values are nearer to it: in low weights, the prior shrinks the amplitudes of the first.
            return found if found.score > best.score - MIN_SCORE_GAIN else best
        best = found
    return best


def refit_from_plain(baseline: Baseline, state: SearchState) -> SearchState:
    """Fit a set from where ordinary least squares takes it, and return that fit or `state`, whichever scores higher.

    The formula gives a column that is left unexplained little weight. If only a large step of the nominal model would
    close that column, `fit_set` ends before, since every small step costs more in the closed columns than it gains.
    """
    there = settled_plainly(baseline, state)
    effects, scales = there.effects, there.problem.scales
    variants, starts = [as_variant(e, scales) for e in effects], [amplitudes_of(e) for e in effects]
    found = fit_set(baseline, there.problem, variants, starts, there.linear_fit.weights)
    return max(state, found, key=lambda s: s.score)


def settled_plainly(baseline: Baseline, state: SearchState, hold: bool = False) -> SearchState:
    """A set and the nominal model where PLAIN_ROUNDS rounds of ordinary least squares take them.

    With `hold` amplitudes and shapes stay as they are. Score, weights and slopes are those of the last fit of the set.
    """
    plain = Weights.plain(baseline.columns)
    for _ in range(PLAIN_ROUNDS):
        if not hold:
            state = fit_at_nominal(baseline, state.problem, list(state.effects), plain, state.nominal)
        state = _with_nominal_refitted(baseline, state, plain)
    return state


def amplitudes_of(effect: CatalogueEffect) -> dict[str, float]:
    """Amplitudes of an effect by name, in their own units."""
    return {n: float(getattr(effect, n)) for n in effect.amplitudes()}


def as_variant(effect: CatalogueEffect, scales: Scales) -> Variant:
    """Class, site and shapes of an effect."""
    shapes = tuple((n, float(getattr(effect, n))) for n in effect.shape_parameters())
    return Variant(type(effect), effect.site, shapes, scales=scales)


def _with_nominal_refitted(baseline: Baseline, state: SearchState, weights: Weights) -> SearchState:
    """The set where the nominal model is refitted with it, by one step of the linearisation.

    The step is cut to a third, and again, where its curvature more than doubles the cost. Score, weights and slopes are
    those before the step.
    """
    none = np.empty((0, state.problem.r.size))
    step, cost = baseline.linear_model(state.problem, state.nominal, state.r, none).base_step(weights)
    there = state
    for _ in range(MAX_TRIES):
        problem = moved(state.problem, step)
        changes = np.reshape([Signatures(problem).white_changes([e])[0] for e in state.effects], state.changes.shape)
        nominal = ByColumn.of(baseline.columns, problem.J.T)
        there = replace(state, problem=problem, nominal=nominal, changes=changes)
        # The constant keeps a cost near zero, as of a perfect fit, from refusing every step.
        if baseline.linear_model(problem, nominal, there.r, none).base_step(weights)[1] < 2.0 * cost + 100.0:
            break
        step = step / 3.0
    return there


@dataclass(frozen=True)
class _Point:
    """Effects of a set at one nominal model, linearised."""

    effects: Sequence[CatalogueEffect]
    changes: Float[np.ndarray, "effects N"]
    slopes: Float[np.ndarray, "k N"]
    sizes: Float[np.ndarray, " k"]
    linear: LinearModel
    cost: float  # weighted sum of squares, the nominal parameters refitted, and ‖sizes‖²


def fit_at_nominal(
    baseline: Baseline,
    problem: Problem,
    effects: list[CatalogueEffect],
    weights: Weights,
    nominal: ByColumn | None = None,
) -> SearchState:
    """Fit amplitudes and shapes from `effects` around the problem's nominal model, which is refitted to first order.

    `nominal`: the problem's derivatives by column, where the caller has them already.
    """
    signatures = Signatures(problem)
    nominal = nominal or ByColumn.of(baseline.columns, problem.J.T)
    coordinates = _coordinates(effects, problem.scales)
    changes, slopes = _evaluate(signatures, effects, coordinates, np.full(len(coordinates), MAX_DIFFERENCE))
    factors = _units_of_the_gap(baseline, baseline.linear_model(problem, nominal, problem.r, slopes), coordinates)
    coordinates = [replace(c, unit=c.unit * f) for c, f in zip(coordinates, factors, strict=True)]

    def point(effects: Sequence[CatalogueEffect], changes, slopes) -> _Point:
        linear = baseline.linear_model(problem, nominal, problem.r - changes.sum(axis=0), slopes)
        sizes = _sizes(effects, coordinates)
        return _Point(effects, changes, slopes, sizes, linear, linear.base_step(weights)[1] + float(sizes @ sizes))

    def step(now: _Point) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """The next step, and the finite differences that suit its precision."""
        delta, information = now.linear.step(weights, *_step_bounds(now.effects, coordinates), now.sizes)
        std = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        return delta, np.clip(std, MIN_DIFFERENCE, MAX_DIFFERENCE)

    def gauss_newton(now: _Point) -> _Point | None:
        """The point after one step within the bounds, cut until the cost falls; None where it never does."""
        delta, difference = step(now)
        for _ in range(MAX_TRIES):
            there = _stepped(now.effects, coordinates, delta)
            new = point(there, *_evaluate(signatures, there, coordinates, difference))
            if new.cost < now.cost:
                return new
            delta = delta / 3.0
        return None

    here = point(effects, changes, slopes * factors[:, None])
    if not all(c.amplitude for c in coordinates):
        # A fit that starts at its optimum makes no step. With the first, long differences of a law with kinks its
        # evidence would be off by nats.
        here = point(effects, *_evaluate(signatures, effects, coordinates, step(here)[1]))
    for _ in range(MAX_STEPS):
        new = gauss_newton(here)
        if new is None:
            break
        gain, here = here.cost - new.cost, new
        if gain < MIN_COST_GAIN + MIN_RELATIVE_COST_GAIN * here.cost:
            break
    bounds = _step_bounds(here.effects, coordinates)
    return SearchState(
        problem,
        baseline.columns,
        nominal,
        tuple(here.effects),
        tuple(coordinates),
        here.changes,
        here.slopes,
        here.linear.fit(np.arange(len(coordinates)), *bounds, sizes=here.sizes),
    )


def _units_of_the_gap(
    baseline: Baseline, linear: LinearModel, coordinates: Sequence[Coordinate]
) -> Float[np.ndarray, " k"]:
    """Factor of every coordinate's unit with which an amplitude of one changes as much as is missed in all.

    Shapes keep their units, and so does an amplitude that changes nothing here, as the warm-up of a friction of zero.
    """
    k = len(coordinates)
    _, information = linear.step(Weights.plain(baseline.columns), np.zeros(k), np.zeros(k), np.zeros(k))
    norm = np.sqrt(np.maximum(np.diag(information), 0.0))
    return np.array(
        [baseline.gap / n if c.amplitude and n > 0.0 else 1.0 for c, n in zip(coordinates, norm, strict=True)]
    )


def derivatives(signatures: Signatures, state: SearchState) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "k N"]]:
    """White change of the rows of `signatures` by a set's causes, and its derivatives by their coordinates."""
    difference = np.full(len(state.coordinates), MIN_DIFFERENCE)
    changes, slopes = _evaluate(signatures, state.effects, state.coordinates, difference)
    return changes.sum(axis=0), slopes


def _sizes(effects: Sequence[CatalogueEffect], coordinates: Sequence[Coordinate]) -> Float[np.ndarray, " k"]:
    """Amplitudes in prior standard deviations. Shapes are zero, since their prior is centred where they are."""
    return np.array([float(getattr(effects[c.effect], c.name)) / c.unit if c.amplitude else 0.0 for c in coordinates])


def _coordinates(effects: Sequence[CatalogueEffect], scales: Scales) -> list[Coordinate]:
    """Coordinates of all amplitudes, in plausible sizes, and of all shapes that a fit moves."""
    out = []
    for i, effect in enumerate(effects):
        out += [Coordinate(i, n, True, unit, True, scales) for n, unit in effect.sizes(scales, effect.site).items()]
        for n, values in effect.worth_trying(scales, effect.site).items():
            moves = effect.shape_parameters()[n].moves
            if moves != "not" and len(values) > 1:
                by_differences = moves == "by differences"
                unit = float(np.mean(np.abs(np.diff(np.sort(values))))) / 2 if by_differences else 1.0
                out.append(Coordinate(i, n, False, unit, by_differences, scales))
    return out


def _shifted(effect: CatalogueEffect, c: Coordinate, by: float) -> CatalogueEffect:
    """The effect with one coordinate moved, within its bounds."""
    value = float(getattr(effect, c.name))
    if c.by_differences:
        value = value + by * c.unit
    else:
        value = value * float(np.exp(np.clip(by, -MAX_LOG_FACTOR, MAX_LOG_FACTOR)))
    return within_bounds(effect.with_values(**{c.name: value}), c.scales)


def within_bounds(effect: CatalogueEffect, scales: Scales) -> CatalogueEffect:
    """Clip every parameter of an effect to its bounds; the result has arrays of NumPy."""
    values = {n: np.clip(float(getattr(effect, n)), *ends) for n, ends in effect.bounds(scales).items()}
    return effect.with_values(**values)


def _step_bounds(effects: Sequence[CatalogueEffect], coordinates: Sequence[Coordinate]) -> Bounds:
    """Bounds of a step of every coordinate; they hold zero."""
    out = []
    for c in coordinates:
        value, ends = float(getattr(effects[c.effect], c.name)), effects[c.effect].bounds(c.scales)[c.name]
        low, high = [(end - value) / c.unit if c.by_differences else np.log(end / value) for end in ends]
        most = np.inf if c.by_differences else MAX_LOG_FACTOR
        out.append((max(min(low, 0.0), -most), min(max(high, 0.0), most)))
    low, high = np.array(out).T if out else (np.empty(0), np.empty(0))
    return low, high


def _stepped(
    effects: Sequence[CatalogueEffect], coordinates: Sequence[Coordinate], delta: Float[np.ndarray, " k"]
) -> list[CatalogueEffect]:
    """Effects with every coordinate moved by `delta`, within its bounds."""
    out = list(effects)
    for c, d in zip(coordinates, delta, strict=True):
        out[c.effect] = _shifted(out[c.effect], c, float(d))
    return jax.device_put(out)


def _evaluate(
    signatures: Signatures,
    effects: Sequence[CatalogueEffect],
    coordinates: Sequence[Coordinate],
    difference: Float[np.ndarray, " k"],
) -> tuple[Float[np.ndarray, "effects N"], Float[np.ndarray, "k N"]]:
    """White change of every row by each effect, and its derivatives by the coordinates as differences."""
    size = signatures.problem.r.size
    changes, slopes = np.zeros((len(effects), size)), np.zeros((len(coordinates), size))
    for i, effect in enumerate(effects):
        mine = [k for k, c in enumerate(coordinates) if c.effect == i]
        neighbours = [_neighbour(effect, coordinates[k], difference[k]) for k in mine]
        change, *beside = signatures.white_changes([effect, *neighbours])
        changes[i] = change
        for k, neighbour, there in zip(mine, neighbours, beside, strict=True):
            step = _distance(effect, neighbour, coordinates[k])
            slopes[k] = (there - change) / step if step else 0.0
    return changes, slopes


def _neighbour(effect: CatalogueEffect, c: Coordinate, h: float) -> CatalogueEffect:
    """The effect with one coordinate moved by h, or by −h where its upper bound holds it."""
    ahead = _shifted(effect, c, h)
    return ahead if float(getattr(ahead, c.name)) != float(getattr(effect, c.name)) else _shifted(effect, c, -h)


def _distance(before: CatalogueEffect, after: CatalogueEffect, c: Coordinate) -> float:
    """Distance between two effects along one coordinate."""
    a, b = float(getattr(before, c.name)), float(getattr(after, c.name))
    return (b - a) / c.unit if c.by_differences else float(np.log(b / a))
