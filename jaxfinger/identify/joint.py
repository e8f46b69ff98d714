"""Joint refinement: every parameter of equation (1) from all trials at once.

    min_θ  Σ_trials Huber(white residuals(θ)) + ½ ‖Λ^½ (θ − μ)‖²

The prior, of mean μ and precision Λ, is an earlier fit of other recordings with its full covariance. Where the earlier
fit used these same recordings, alone or among others, it gives only the start, and the prior is the finger's
description, so that no data are counted twice. Masses and centres of mass are free wherever the description gives their
standard deviations. Masses stay positive, and the inertia of a link is proportional to its mass, since CAD gives its
shape.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Int

from jaxfinger.compilation import one_blas_thread
from jaxfinger.data import Session
from jaxfinger.errors import UserError, require
from jaxfinger.experiments import EXPERIMENTS, not_judged
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.fit_with_noise import estimate_with_noise
from jaxfinger.identify.nominal import cad_covariance, cad_prior, free_groups
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.predictions import model_for
from jaxfinger.identify.prior import Prior, prior_of
from jaxfinger.identify.propagate import propagate
from jaxfinger.identify.readings import name_constant, readings_of
from jaxfinger.identify.shooting import AHEAD, Shooting, shooting
from jaxfinger.identify.solve import Solution, solve, total_cost
from jaxfinger.identify.sources import Source, sources_of
from jaxfinger.identify.stages import name_doubtful, report_of
from jaxfinger.identify.start import start_values
from jaxfinger.identify.trial_coverage import can_determine, coverage_of
from jaxfinger.model import Model
from jaxfinger.progress import Progress

JOINT = "joint"  # name of the stage
# χ² per row above which another start is tried. Noise alone gives 1 to a few percent, as a fit reads thousands of rows.
RESTART_CHI2 = 1.3


@one_blas_thread
def refine(session: Session, fit: Fit, progress: Progress = lambda message: None, ahead: bool = False) -> Fit:
    """Refine a fit on all trials of the recipe's `joint_experiments` at once.

    The last stage report says by how much intervals have changed. With `ahead` the fit also reads VD.3, by the angles
    that it predicts a short time ahead (`shooting`).

    >>> import jaxfinger as jf
    >>> jf.refine(jf.read("session.h5"), jf.load("fit.json"))
    Fit('EMPS', recipe 'emps': 4 parameters; ID.3-dynamic fitted, joint fitted)

    Raises:
        UserError: the session has none of these trials, or is of another finger; or `ahead` is given and there is no
            VD.3 trial; or the fit has effects, whose shapes have bounds that the refinement does not know.
    """
    require(Session, session=session)
    require(Fit, fit=fit)
    recipe = fit.recipe
    if fit.model.effects:
        raise UserError(
            "a fit with effects cannot be refined; give one of the nominal model, or fit them by `fit effects`"
        )
    model = start = model_for(fit, session)
    starts = shooting(session) if ahead else None
    progress("reading the recordings")
    names = [t.name for t in session if t.experiment in recipe.fit.joint_experiments]
    stacks = readings_of(session, names, model=model)
    reads = {e: joint_channels(e) for e in stacks}
    if not reads:
        raise UserError(
            f"{session.file or 'the session'}: has no trial of {', '.join(recipe.fit.joint_experiments)}; "
            "name others in fit.joint_experiments of the recipe"
        )
    free, same = _free(fit, model, session, reads), fit.was_made_from(session)
    if same:
        prior = cad_prior(session, recipe, describe(model), free)
    else:
        prior = prior_of(np.asarray(ravel(fit.model)), fit.covariance, free)
    progress("refining on all trials at once")
    known, huber = (fit.noise if same else {}), recipe.fit.huber
    model, solution, sources, noise = estimate_with_noise(model, free, stacks, reads, known, prior, huber, fitted=True)
    better = None
    if not solution.converged or solution.invisible.size or solution.chi2_per_row(free.size) > RESTART_CHI2:
        progress("refining from a neutral start")
        better = _better_from_neutral_start(model, solution, sources, free, prior, huber)
    model, solution = better or (model, solution)

    warnings = name_constant(reads, session)
    warnings += [
        f"no sample of {x.channel} in {x.experiment} counts: {x.reason}"
        for x in not_judged(stacks)
        if x.channel in reads[x.experiment]
    ]
    if better:
        warnings.append("the earlier fit led to a poorer optimum")
    covariance = propagate(fit.covariance, model, solution, sources, free, prior, huber)
    warnings += name_doubtful(model, start, solution, sources, covariance, free)
    refined = replace(
        fit.made_from(session, alone=same),
        model=model,
        covariance=covariance,
        estimated=free,
        noise=noise if same else fit.noise | noise,
        specimen=session.specimen,
    )
    trials = tuple(t for s in stacks.values() for t in s.trials)
    how = "CAD is the prior, the trials are read once" if same else "the earlier fit of other data is the prior"
    report = report_of(JOINT, solution, free, trials, warnings, _gain(fit, refined, how))
    refined = replace(refined, stages=(*fit.stages, report))
    if starts is None:
        return refined
    progress("refining on the motion of VD.3")
    return _on_motion(refined, starts, sources, prior, fit.covariance)


def _free(fit: Fit, model: Model, session: Session, reads: dict[str, tuple[str, ...]]) -> Int[np.ndarray, " p"]:
    """Positions of what the fit estimated, of values of CAD with an uncertainty, and of what the trials determine."""
    parameters, groups, coverage = describe(model), free_groups(fit.recipe), coverage_of(reads, session)
    cad = np.flatnonzero(np.diag(cad_covariance(session, parameters)))
    seen = [i for i, p in enumerate(parameters) if p.group in groups and p.determinable and can_determine(p, coverage)]
    return np.union1d(np.union1d(fit.estimated, cad), seen).astype(int)


def _better_from_neutral_start(
    model: Model,
    solution: Solution,
    sources: dict[str, Source],
    free: Int[np.ndarray, " p"],
    prior: Prior,
    huber: float,
) -> tuple[Model, Solution] | None:
    """The optimum from a neutral start; None where its cost is not less than that of the given one."""
    parameters = describe(model)
    neutral = start_values(_neutral(model, free, parameters), free, parameters, sources)
    other = solve(neutral, free, sources, prior, huber)
    before, after = (total_cost(*x, free, prior) for x in ((model, solution), other))
    return other if after < before * (1 - 1e-6) else None  # beyond rounding


def _on_motion(fit: Fit, starts: Shooting, sources: dict[str, Source], prior: Prior, before: np.ndarray) -> Fit:
    """Refine a joint fit, made from `sources`, on VD.3 too; `before` is the covariance before the joint fit."""
    free, huber = fit.estimated, fit.recipe.fit.huber
    noise = {(AHEAD, "q"): starts.noise(fit.model)}
    sources = sources | sources_of({AHEAD: starts.stack}, {AHEAD: ("q",)}, noise, describe(fit.model))
    first, _ = solve(fit.model, free, sources, prior, huber)
    sources[AHEAD] = sources[AHEAD]._replace(batch=starts.corrected(first))
    model, solution = solve(first, free, sources, prior, huber)
    covariance = propagate(before, model, solution, sources, free, prior, huber)
    moved, corrected = (np.asarray(ravel(model)) - np.asarray(ravel(m)) for m in (fit.model, first))
    covariance += _contradiction(moved, fit.std**2, np.diag(covariance)) + np.outer(corrected, corrected)
    warnings = name_doubtful(model, fit.model, solution, sources, covariance, free)
    refined = replace(fit, model=model, covariance=covariance)
    report = report_of(
        AHEAD, solution, free, starts.stack.trials, warnings, _gain(fit, refined, "those of the joint refinement")
    )
    return replace(refined, stages=(*fit.stages, report))


def _contradiction(moved: np.ndarray, without: np.ndarray, together: np.ndarray) -> np.ndarray:
    """Covariance to add where further trials contradict the others.

    By chance, estimates move with the variance `without` these trials less that `together` with them. `moved` beyond
    that is an error.
    """
    with np.errstate(invalid="ignore"):  # infinite variances of undetermined parameters
        chance = np.maximum(np.nan_to_num(without - together, nan=np.inf), 0.0)
    beyond = np.sign(moved) * np.sqrt(np.maximum(moved**2 - chance, 0.0))
    return np.outer(beyond, beyond)


def joint_channels(experiment: str) -> tuple[str, ...]:
    """Channels of an experiment that a joint fit reads.

    The excursion at held joints is left out: there it measures the stretch of tendons, and not their moment arms.
    """
    e = EXPERIMENTS[experiment]
    return tuple(c for c in e.channels if not (e.held and c == "tendon_excursion"))


def _neutral(model: Model, free, parameters) -> Model:
    """Model whose free coefficients are zero, except masses and centres of mass: a start that no earlier fit biases."""
    flat = np.array(ravel(model))
    coefficients = [i for i in free if parameters[i].group not in ("mass", "com")]
    flat[coefficients] = 0.0
    return Free.at(model, free).set(model, flat[free])


def _gain(before: Fit, after: Fit, how: str) -> str:
    """Message on the ratio of standard deviations after and before, in the median; `how` names the prior."""
    common = before.estimated[(before.std[before.estimated] > 0) & np.isfinite(before.std[before.estimated])]
    if not common.size:
        return ""
    ratio = after.std[common] / before.std[common]
    return f"standard deviations are {np.median(ratio):.2f} of the earlier ones in the median ({how})"
