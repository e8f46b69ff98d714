"""The augmented model: the effects of the verdict and every nominal parameter, together."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxfinger.effects import CatalogueEffect, Scales
from jaxfinger.experiments import affected_channels
from jaxfinger.gap.exact import Projector, SearchState
from jaxfinger.gap.formula import Weights
from jaxfinger.gap.problem import Problem, assemble, moved
from jaxfinger.gap.result import Value
from jaxfinger.gap.signatures import Signatures
from jaxfinger.identify import Fit
from jaxfinger.identify.cluster_robust import growth, stretch_scores
from jaxfinger.identify.fit import StageReport
from jaxfinger.identify.parameters import describe, ravel, units_at
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import Solution, Source, linearise_each, residuals_each, solve
from jaxfinger.model import Model

WITH_EFFECTS = "with the effects of the diagnosis"
Missed = dict[tuple[str, str], Float[np.ndarray, "_columns _B _T"]]  # measured − predicted, by experiment and channel


class Fitted(NamedTuple):
    """A model fitted to all trials of a problem, at its optimum."""

    fit: Fit
    r: Float[np.ndarray, " N"]  # white residuals
    J: Float[np.ndarray, "N p"]  # their Jacobian by the fit's estimated parameters
    missed: Callable[[Model], Missed]  # of a model with the same effects


def nominal_fit(problem: Problem) -> Fitted:
    """The nominal model refitted to all trials, with no effect."""
    covariance = _covariance(problem, problem.r, problem.J, problem.root)
    fit = _fit(problem, problem.nominal, problem.free, covariance, problem.r, "all trials")
    return Fitted(fit, problem.r, problem.J, partial(missed_by, problem.sources))


def augmented_fit(problem: Problem, chosen: SearchState, hold: bool = False) -> Fitted:
    """Nominal parameters, amplitudes and moving shapes, fitted exactly, with their covariance.

    With `hold` the causes stay where the formula has put them, since what is open would pull at them; the nominal
    parameters alone are refitted.
    """
    model, moving = _with_effects(chosen.problem.nominal, chosen.effects)
    free, prior = np.concatenate([problem.free, moving]), _prior(problem, model, moving)
    sources = {e: _seeing_effects(problem, s, chosen.effects, moving, e) for e, s in problem.sources.items()}
    if hold:
        fitted, solution = solve(model, problem.free, sources, problem.prior)
        linearised = linearise_each(fitted, sources)
    else:
        fitted, solution = solve(model, free, sources, prior, limits=limits(model, free, problem.scales))
        linearised = solution.linearised
    r, J = assemble(linearised, sources, problem.rows, free, ravel(model).size)
    fit = _fit(problem, fitted, free, _covariance(problem, r, J, prior.root, chosen), r, WITH_EFFECTS, solution)
    return Fitted(fit, r, J, partial(missed_by, sources))


def as_refitted(problem: Problem, chosen: SearchState) -> Fitted:
    """The same where the search has led, with no fit of its own, and by the programs of the nominal model and of
    signatures, which are compiled already. Its intervals leave out the products of effects with the nominal parameters.
    """
    ones = Weights.plain(chosen.columns)
    there = moved(chosen.problem, Projector(chosen.problem, chosen.columns, ones).nominal_step(chosen.r))
    model, moving = _with_effects(there.nominal, chosen.effects)
    labels = [p.name for p in describe(model)]
    columns = {}
    for c, column in zip(chosen.coordinates, chosen.slopes, strict=True):
        effect = chosen.effects[c.effect]
        unit = c.unit if c.by_differences else float(getattr(effect, c.name))
        columns[f"{effect.ID} {'-'.join(effect.site)} {c.name}"] = column / unit
    moving = np.array([i for i in moving if labels[i] in columns], int)
    r = there.r - chosen.changes.sum(axis=0)
    J = np.column_stack([there.J, *(columns[labels[i]] for i in moving)])
    free, prior = np.concatenate([problem.free, moving]), _prior(problem, model, moving)
    fit = _fit(problem, model, free, _covariance(problem, r, J, prior.root, chosen), r, WITH_EFFECTS)
    return Fitted(fit, r, J, partial(_missed_apart, problem))


def missed_by(sources: dict[str, Source], model: Model) -> Missed:
    """Of a model, by the programs of fits."""
    return {(e, c): x for e, channels in residuals_each(model, sources).items() for c, x in channels.items()}


def _missed_apart(problem: Problem, model: Model) -> Missed:
    """Of a model with effects, by the programs of its nominal part and of their signatures."""
    nominal = eqx.tree_at(lambda m: m.effects, model, (), is_leaf=lambda v: isinstance(v, tuple))
    missed = missed_by(problem.sources, nominal)
    predicted = {(e, c): np.asarray(problem.sources[e].batch.y[c]) - x for (e, c), x in missed.items()}
    there = replace(problem, nominal=nominal, predicted=predicted)
    effects = [e for e in model.effects if isinstance(e, CatalogueEffect)]
    for effect in effects:
        for e, c, change in Signatures(there).changes([effect]):
            missed[e, c] = missed[e, c] - change[0]
    return missed


def _with_effects(nominal: Model, effects: tuple[CatalogueEffect, ...]) -> tuple[Model, Int[np.ndarray, " k"]]:
    """The model, and which of its effects' parameters a fit moves."""
    model = eqx.tree_at(lambda m: m.effects, nominal, effects, is_leaf=lambda v: isinstance(v, tuple))
    parameters, moves = describe(model), np.asarray(ravel(_on_effects(_moves, model)))
    first = ravel(nominal).size
    moving = [i for i in range(first, len(parameters)) if parameters[i].determinable and moves[i]]
    return model, np.array(moving, dtype=int)


def _prior(problem: Problem, model: Model, moving: Int[np.ndarray, " k"]) -> Prior:
    """The problem's, and a weak one on amplitudes and shapes, so that a flat direction stays put."""
    mean = np.concatenate([problem.prior.mean, np.asarray(ravel(model))[moving]])
    (rows, p), wide = problem.root.shape, np.asarray(ravel(_on_effects(partial(_widths, problem.scales), model)))
    root = np.zeros((rows + len(moving), p + len(moving)))
    root[:rows, :p], root[rows:, p:] = problem.root, np.diag(1.0 / wide[moving])
    return Prior(mean, root)


def _on_effects(change: Callable[[CatalogueEffect], CatalogueEffect], model: Model) -> Model:
    changed = tuple(change(e) for e in model.effects if isinstance(e, CatalogueEffect))
    return eqx.tree_at(lambda m: m.effects, model, changed, is_leaf=lambda v: isinstance(v, tuple))


def _moves(effect: CatalogueEffect) -> CatalogueEffect:
    """Of every parameter 1 where a fit may move it: not a choice, nor a share that is at its most."""
    stays = {n for n, p in effect.shape_parameters().items() if p.moves == "not" or len(p.values) == 1}
    stays |= {n for n, p in effect.amplitudes().items() if getattr(effect, n) >= p.most}
    return replace(effect, **{n: jnp.asarray(float(n not in stays)) for n in effect.values()})


def limits(model: Model, free: np.ndarray, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
    """Least and most of every free parameter: those of effects keep within bounds."""
    of_effect = np.array([p.group == "effects" for p in describe(model)])[free]
    low, high = (np.asarray(ravel(_on_effects(partial(_limit, side, scales), model)))[free] for side in (0, 1))
    return np.where(of_effect, low, -np.inf), np.where(of_effect, high, np.inf)


def without_shapes(model: Model, free: np.ndarray) -> np.ndarray:
    """The free parameters but those of effects that are no amplitudes."""
    shapes = np.asarray(ravel(_on_effects(_shapes, model))) > 0.0
    of_effect = np.array([p.group == "effects" for p in describe(model)])
    return free[~(of_effect & shapes)[free]]


def _shapes(effect: CatalogueEffect) -> CatalogueEffect:
    """Of every parameter 1 where it is no amplitude."""
    return replace(effect, **{n: jnp.asarray(float(n in effect.shape_parameters())) for n in effect.values()})


def _limit(side: int, scales: Scales, effect: CatalogueEffect) -> CatalogueEffect:
    """Of every parameter, the bound below or above (`side` 0 or 1) that refits keep to."""
    ends = effect.bounds(scales)
    free = (-np.inf, np.inf)
    return replace(effect, **{n: jnp.asarray(ends.get(n, free)[side], dtype=float) for n in effect.values()})


def _widths(scales: Scales, effect: CatalogueEffect) -> CatalogueEffect:
    """Of the prior: three times an amplitude's own or plausible size, three times a factor, the range of a place."""
    size = {n: abs(v) for n, v in effect.values().items()}
    amplitudes = {n: 3.0 * max(size[n], unit) for n, unit in effect.sizes(scales, effect.site).items()}
    grids, shapes = effect.worth_trying(scales, effect.site), effect.shape_parameters()
    factors = {n: 3.0 * max(size[n], 1e-12) for n in shapes}
    places = {n: np.ptp(v) or factors[n] for n, v in grids.items() if shapes[n].moves == "by differences"}
    return replace(effect, **{n: jnp.asarray(w, dtype=float) for n, w in (amplitudes | factors | places).items()})


def _seeing_effects(problem: Problem, source: Source, effects: tuple[CatalogueEffect, ...], moving, experiment: str):
    """The source, reading the effects' parameters too where one of them shows."""
    if not any(experiment in affected_channels(type(e), problem.nominal.finger) for e in effects):
        return source._replace(effects=False)
    return source._replace(positions=np.union1d(source.positions, moving).astype(int))


def _covariance(
    problem: Problem, r: np.ndarray, J: np.ndarray, root: np.ndarray, chosen: SearchState | None = None
) -> Float[np.ndarray, "p p"]:
    """Laplace's, in the weights of the formula where there are causes, and wider where the residuals pull a parameter
    to and fro by more than the noise explains.
    """
    if chosen is not None:
        project = Projector(problem, chosen.columns, chosen.linear_fit.weights)
        r, J = project.weighted(r[None])[0], project.weighted(J.T).T
    information = J.T @ J + root.T @ root
    diagonal = np.diag(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    inverse = np.linalg.pinv(information * np.outer(scale, scale), rcond=1e-13, hermitian=True) * np.outer(scale, scale)
    grow = growth(inverse, stretch_scores(r, J, problem.block_of_row), root)
    return inverse * np.outer(grow, grow)


def _fit(problem: Problem, model: Model, free, block, r, what: str, solution: Solution | None = None) -> Fit:
    covariance = np.zeros((ravel(model).size,) * 2)
    covariance[np.ix_(free, free)] = block
    report = StageReport(
        what,
        "fitted" if solution is None or solution.converged else "not converged",
        solution.message if solution else "",
        tuple(problem.trial_names),
        r.size,
        float(r @ r) / max(1, r.size - len(free)),
    )
    return replace(
        problem.fit,
        model=model,
        covariance=covariance,
        estimated=np.asarray(free),
        noise=problem.noise,
        stages=(*problem.fit.stages, report),
    )


def values_of(fit: Fit, index: int) -> tuple[Value, ...]:
    """Every parameter of the fit's effect number `index`."""
    effect = fit.model.effects[index]
    assert isinstance(effect, CatalogueEffect)
    label = f"{effect.ID} {'-'.join(effect.site)} "
    std = {p.name: s for p, s in zip(describe(fit.model), fit.std, strict=True)}
    units = units_at(fit.model.finger, type(effect), effect.site)
    return tuple(Value(effect.site, n, v, float(std.get(label + n, 0.0)), units[n]) for n, v in effect.values().items())
