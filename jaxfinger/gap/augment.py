"""Fits of the augmented model: the effects of a verdict and the nominal parameters, fitted together to all trials."""

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
from jaxfinger.gap.exact import Baseline, SearchState, derivatives, settled_plainly
from jaxfinger.gap.problem import Problem, assemble
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.result import Value
from jaxfinger.gap.signatures import Signatures
from jaxfinger.identify import Fit
from jaxfinger.identify.fit import StageReport
from jaxfinger.identify.intervals import evidence, laplace
from jaxfinger.identify.parameters import describe, effect_parameter, ravel, units_at
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import Solution, solve
from jaxfinger.identify.sources import Source, residuals_each, white_tangents
from jaxfinger.model import Model

WITH_EFFECTS = "with the effects of the diagnosis"
Residuals = dict[tuple[str, str], Float[np.ndarray, "_columns _B _T"]]  # y − ŷ by experiment and channel


class Fitted(NamedTuple):
    """A model fitted to all trials of a problem, with residuals and Jacobian at its optimum."""

    fit: Fit
    r: Float[np.ndarray, " N"]  # whitened residuals
    J: Float[np.ndarray, "N p"]  # whitened derivatives of the predictions by the fit's estimated parameters
    residuals_of: Callable[[Model], Residuals]  # for any model with the same effects


def nominal_fit(problem: Problem) -> Fitted:
    """The nominal model of a problem as a fit: the optimum is the problem's own, the covariance is computed here."""
    covariance = _covariance(problem, problem.r, problem.J, problem.root)
    fit = _fit(problem, problem.nominal, problem.free, covariance, problem.r, "all trials")
    return Fitted(fit, problem.r, problem.J, partial(residuals_by, problem.sources))


def augmented_fit(problem: Problem, chosen: SearchState, hold: bool = False) -> Fitted:
    """Fit nominal parameters, amplitudes and shapes of the chosen set together by nonlinear least squares.

    With `hold` amplitudes and shapes stay at the optimum of the formula, and the nominal parameters alone are refitted.
    That is for a gap which the set leaves open: plain least squares would bend the causes to explain it.
    """
    model, moving = _with_effects(chosen.problem.nominal, chosen.effects)
    free, prior = np.concatenate([problem.free, moving]), _prior(problem, model, moving)
    sources = {e: _seeing_effects(problem, s, chosen.effects, moving, e) for e, s in problem.sources.items()}
    if hold:
        fitted, solution = solve(model, problem.free, sources, problem.prior)
        white = white_tangents(fitted, sources)
    else:
        fitted, solution = solve(model, free, sources, prior, limits=limits(model, free, problem.scales))
        white = solution.linearised
    r, J = assemble(white, sources, problem.rows, free, ravel(model).size)
    fit = _fit(problem, fitted, free, _covariance(problem, r, J, prior.root, chosen), r, WITH_EFFECTS, solution)
    return Fitted(fit, r, J, partial(residuals_by, sources))


def as_refitted(baseline: Baseline, problem: Problem, chosen: SearchState, hold: bool = False) -> Fitted:
    """The augmented model after a few linear refits (`settled_plainly`), for a quick diagnosis.

    `hold` is that of `augmented_fit`. The fit needs only the compiled functions of the nominal model and of signatures.
    Derivatives of an effect by a nominal parameter are left out of the Jacobian, so that beside a large effect
    intervals are biased.
    """
    state = settled_plainly(baseline, chosen, hold)
    there = state.problem
    model, moving = _with_effects(there.nominal, state.effects)
    change, slopes = derivatives(Signatures(there), state)
    labels = [p.name for p in describe(model)]
    columns = {}
    for c, column in zip(state.coordinates, slopes, strict=True):
        effect = state.effects[c.effect]
        unit = c.unit if c.by_differences else float(getattr(effect, c.name))
        columns[effect_parameter(effect, c.name)] = column / unit
    moving = np.array([i for i in moving if labels[i] in columns], int)
    r = there.r - change
    J = np.column_stack([there.J, *(columns[labels[i]] for i in moving)])
    free, prior = np.concatenate([problem.free, moving]), _prior(problem, model, moving)
    fit = _fit(problem, model, free, _covariance(problem, r, J, prior.root, chosen), r, WITH_EFFECTS)
    return Fitted(fit, r, J, partial(_residuals_in_parts, problem))


def residuals_by(sources: dict[str, Source], model: Model) -> Residuals:
    """Residuals of a model, computed with the compiled functions of the fits."""
    return {(e, c): x for e, channels in residuals_each(model, sources).items() for c, x in channels.items()}


def _residuals_in_parts(problem: Problem, model: Model) -> Residuals:
    """Residuals of a model with effects, computed with the compiled functions of its nominal part and of signatures."""
    nominal = eqx.tree_at(lambda m: m.effects, model, (), is_leaf=lambda v: isinstance(v, tuple))
    residuals = residuals_by(problem.sources, nominal)
    predicted = {(e, c): np.asarray(problem.sources[e].batch.y[c]) - x for (e, c), x in residuals.items()}
    there = replace(problem, nominal=nominal, predicted=predicted)
    effects = [e for e in model.effects if isinstance(e, CatalogueEffect)]
    for effect in effects:
        for e, c, change in Signatures(there).changes([effect]):
            residuals[e, c] = residuals[e, c] - change[0]
    return residuals


def _with_effects(nominal: Model, effects: tuple[CatalogueEffect, ...]) -> tuple[Model, Int[np.ndarray, " k"]]:
    """The nominal model with effects, and the positions of the effects' parameters that a refit moves."""
    model = eqx.tree_at(lambda m: m.effects, nominal, effects, is_leaf=lambda v: isinstance(v, tuple))
    parameters, moves = describe(model), np.asarray(ravel(_on_effects(_moving, model)))
    first = ravel(nominal).size
    moving = [i for i in range(first, len(parameters)) if parameters[i].determinable and moves[i]]
    return model, np.array(moving, dtype=int)


def _prior(problem: Problem, model: Model, moving: Int[np.ndarray, " k"]) -> Prior:
    """The problem's prior, and a weak one on amplitudes and shapes about their values, which holds flat directions."""
    mean = np.concatenate([problem.prior.mean, np.asarray(ravel(model))[moving]])
    (rows, p), std = problem.root.shape, np.asarray(ravel(_on_effects(partial(prior_std, problem.scales), model)))
    root = np.zeros((rows + len(moving), p + len(moving)))
    root[:rows, :p], root[rows:, p:] = problem.root, np.diag(1.0 / std[moving])
    return Prior(mean, root)


def _on_effects(change: Callable[[CatalogueEffect], CatalogueEffect], model: Model) -> Model:
    """The model with `change` applied to each of its effects.

    The functions below return an effect whose parameters are replaced by a mark, bound or width, so that `ravel` lays
    these out in the order of the flat parameter vector.
    """
    changed = tuple(change(e) for e in model.effects if isinstance(e, CatalogueEffect))
    return eqx.tree_at(lambda m: m.effects, model, changed, is_leaf=lambda v: isinstance(v, tuple))


def _moving(effect: CatalogueEffect) -> CatalogueEffect:
    """Mark with 1 the parameters that a refit moves, with 0 the others.

    Fixed are choices (form, side, place) and amplitudes of the largest magnitude.
    """
    stays = {n for n, p in effect.shape_parameters().items() if p.fixed}
    stays |= {n for n, p in effect.amplitudes().items() if abs(float(getattr(effect, n))) >= p.most}
    return replace(effect, **{n: jnp.asarray(n not in stays, dtype=float) for n in effect.values()})


def limits(
    model: Model, free: Int[np.ndarray, " p"], scales: Scales
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Lower and upper bounds of the free parameters: those of the effects, and none for nominal parameters."""
    of_effect = np.array([p.group == "effects" for p in describe(model)])[free]
    low, high = (np.asarray(ravel(_on_effects(partial(_limit, side, scales), model)))[free] for side in (0, 1))
    return np.where(of_effect, low, -np.inf), np.where(of_effect, high, np.inf)


def without_shapes(model: Model, free: Int[np.ndarray, " p"]) -> Int[np.ndarray, " q"]:
    """Positions of the free parameters without the effects' shapes."""
    shapes = np.asarray(ravel(_on_effects(_shapes, model))) > 0.0
    of_effect = np.array([p.group == "effects" for p in describe(model)])
    return free[~(of_effect & shapes)[free]]


def _shapes(effect: CatalogueEffect) -> CatalogueEffect:
    """Mark shapes with 1, amplitudes with 0."""
    return replace(effect, **{n: jnp.asarray(n in effect.shape_parameters(), dtype=float) for n in effect.values()})


def _limit(side: int, scales: Scales, effect: CatalogueEffect) -> CatalogueEffect:
    """Lower (`side` 0) or upper (1) bound of each parameter."""
    ends = effect.bounds(scales)
    free = (-np.inf, np.inf)
    return replace(effect, **{n: jnp.asarray(ends.get(n, free)[side], dtype=float) for n in effect.values()})


def prior_std(scales: Scales, effect: CatalogueEffect) -> CatalogueEffect:
    """Standard deviation of the prior of each parameter.

    For an amplitude three times the larger of its value and its plausible size; for a shape that moves by differences
    the range of its grid, for another three times its value.
    """
    size = {n: abs(v) for n, v in effect.values().items()}
    amplitudes = {n: 3.0 * max(size[n], unit) for n, unit in effect.sizes(scales, effect.site).items()}
    grids, shapes = effect.worth_trying(scales, effect.site), effect.shape_parameters()
    factors = {n: 3.0 * max(size[n], 1e-12) for n in shapes}
    places = {n: np.ptp(v) or factors[n] for n, v in grids.items() if shapes[n].moves == "by differences"}
    return replace(effect, **{n: jnp.asarray(w, dtype=float) for n, w in (amplitudes | factors | places).items()})


def _seeing_effects(problem: Problem, source: Source, effects: tuple[CatalogueEffect, ...], moving, experiment: str):
    """The source of an experiment, with the effects' parameters among its own if one of the effects shows in it."""
    if not any(experiment in affected_channels(type(e), problem.nominal.finger) for e in effects):
        return source._replace(effects=False)
    return source._replace(positions=np.union1d(source.positions, moving).astype(int))


def _covariance(
    problem: Problem,
    r: Float[np.ndarray, " N"],
    J: Float[np.ndarray, "N p"],
    root: Float[np.ndarray, "k p"],
    chosen: SearchState | None = None,
) -> Float[np.ndarray, "p p"]:
    """Laplace covariance (JᵀJ + prior precision)⁻¹, with causes in the weights of the formula.

    The variance of a parameter on which neither depends is infinite, as in any fit. Standard deviations grow where the
    scores of successive stretches vary more than the noise explains (`intervals`).
    """
    unseen = np.flatnonzero(~J.any(axis=0) & ~root.any(axis=0))
    if chosen is not None:
        project = Projector(problem, chosen.columns, chosen.linear_fit.weights)
        r, J = project.weighted(r[None])[0], project.weighted(J.T).T
    covariance = laplace([evidence(r, J, problem.column_of_row, problem.stretch_of_row)], root).covariance
    covariance[unseen, unseen] = np.inf
    return covariance


def _fit(problem: Problem, model: Model, free, block, r, what: str, solution: Solution | None = None) -> Fit:
    """A fit of the model whose free parameters have the covariance `block`, with one more stage, named `what`."""
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
    """Values and standard deviations of all parameters of the fit's effect number `index`."""
    effect = fit.model.effects[index]
    assert isinstance(effect, CatalogueEffect)
    every = {p.name: s for p, s in zip(describe(fit.model), fit.std, strict=True)}
    std = {n: float(every[effect_parameter(effect, n)]) for n in effect.values()}
    units = units_at(fit.model.finger, type(effect), effect.site)
    return tuple(Value(effect.site, n, v, std[n], units[n]) for n, v in effect.values().items())
