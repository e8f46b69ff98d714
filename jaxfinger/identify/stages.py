"""The paper's staged identification, ID.2 → ID.3-static → ID.3-dynamic → ID.4.

Each stage fits equation (1) to experiments in which some of its terms vanish, and estimates the parameters of the
others. The parameters of earlier stages stay fixed, and their errors are propagated (`propagate`).
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.compilation import one_blas_thread
from jaxfinger.data import Session
from jaxfinger.data.signals.sizes import sizes_of
from jaxfinger.errors import UserError, chosen, require
from jaxfinger.experiments import Stack, not_judged
from jaxfinger.identify.fit import Fit, StageReport
from jaxfinger.identify.fit_with_noise import estimate_with_noise
from jaxfinger.identify.identifiability import name_invisible, name_traded
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.nominal import cad_prior, covariance_before, free_groups, nominal_model
from jaxfinger.identify.parameters import Parameter, describe, ravel
from jaxfinger.identify.plausible import implausible, name_bounded
from jaxfinger.identify.predictions import model_for
from jaxfinger.identify.propagate import propagate
from jaxfinger.identify.readings import name_constant, readings_of
from jaxfinger.identify.recipe import Recipe, checked
from jaxfinger.identify.solve import Solution, Tangents, parameter_bounds
from jaxfinger.identify.sources import DRIVEN, Source
from jaxfinger.identify.start import bounded_losses, highest_tensions
from jaxfinger.identify.trial_coverage import Coverage, can_determine, coverage_of, name_missing, name_unseen
from jaxfinger.model import Model
from jaxfinger.progress import Progress


@dataclass(frozen=True)
class Stage:
    """Experiments and channels that a stage reads, and the groups of parameters that it frees."""

    name: str
    reads: dict[str, tuple[str, ...]]
    frees: tuple[str, ...]


STAGES = {
    s.name: s
    for s in (
        Stage("ID.2", {"ID.2": ("tendon_excursion",)}, ("moment_arm",)),
        # Between holds the joint moves slowly, so that the stage determines damping, too, though less well.
        Stage("ID.3-static", {"ID.3-static": ("joint_torque",)}, DRIVEN),
        # Both phases are read, so that the sweeps refine the estimates from the holds.
        Stage(
            "ID.3-dynamic",
            {"ID.3-static": ("joint_torque",), "ID.3-dynamic": ("joint_torque",)},
            DRIVEN,
        ),
        Stage("ID.4", {"ID.4": ("joint_torque",)}, ("tendon_friction",)),
    )
}


@one_blas_thread
def identify(
    session: Session,
    recipe: Recipe | None = None,
    stages: str | Sequence[str] | None = None,
    start: Fit | None = None,
    progress: Progress = lambda message: None,
    stacks: dict[str, Stack] | None = None,
) -> Fit:
    """Run the staged fits on a session. A stage whose trials are missing is reported as skipped.

    `recipe`: by default that of `start`, else the paper's. `stages`: name or names of those to run (`STAGES`), by
    default the recipe's.
    `start`: a fit with the parameters of earlier stages; its recipe is the recipe of its terms. `progress`: called with
    a sentence at each step. `stacks`: the session's trials, where `prepare` has read them already.

    The published mass of the servo axis (Janot, Gautier, Brunot 2019) is 95.11 kg:

    >>> import jaxfinger as jf
    >>> fit = jf.identify(jf.read("session.h5"), jf.recipe("emps"))
    >>> mass = fit.table()[0]
    >>> f"{mass['value']:.0f} ± {1.96 * mass['std']:.1f} {mass['units']}"
    '95 ± 0.9 kg'

    Raises:
        UserError: `recipe` is another than that of `start`, or one of its values is not allowed; `start` is a fit of
            another finger; or there is no such stage.
    """
    require(Session, session=session)
    require((Recipe, None), recipe=recipe)
    require((Fit, None), start=start)
    if start is not None and recipe not in (None, start.recipe):
        raise UserError("a fit to start from brings its own recipe; leave out `recipe` or `start`")
    recipe = checked(recipe) if recipe else start.recipe if start else Recipe()
    wanted = chosen(stages or recipe.fit.stages, STAGES, "stage")
    if start is None:
        fit = Fit.before(session, recipe, nominal_model(session, recipe))
        fit = replace(fit, covariance=covariance_before(session, recipe, describe(fit.model)))
    else:
        fit = replace(start, model=model_for(start, session), noise=_noise_here(start, session, wanted))
        fit = fit.made_from(session)
    with ThreadPoolExecutor(1) as pool:  # a stage is compiled while the recordings of the next are filtered
        experiments = dict.fromkeys(e for s in wanted for e in STAGES[s].reads) if stacks is None else ()
        named = {e: [t.name for t in session if t.experiment == e] for e in experiments}
        sizes = sizes_of(session) if named else None
        pending = {e: pool.submit(readings_of, session, names, sizes) for e, names in named.items()}
        ready, tangents = dict(stacks or {}), Tangents()
        for name in wanted:
            progress(f"fitting {name}")
            for experiment in STAGES[name].reads.keys() & pending.keys():
                ready |= pending.pop(experiment).result()
            fit = run_stage(fit, STAGES[name], ready, session, tangents)
    return fit


def _noise_here(start: Fit, session: Session, stages: Sequence[str]) -> dict[tuple[str, str], Noise]:
    """Noise of a fit to start from, without that which other sensors may have had in trials that these stages read."""
    if start.was_made_from(session):
        return start.noise
    read = {e for s in stages for e in STAGES[s].reads} & {t.experiment for t in session}
    return {of: noise for of, noise in start.noise.items() if of[0] not in read}


def run_stage(
    fit: Fit, stage: Stage, stacks: dict[str, Stack], session: Session, tangents: Tangents | None = None
) -> Fit:
    """Run one stage: noise, estimates, covariance, and warnings of undetermined or implausible parameters."""

    def skipped(message: str) -> Fit:
        return replace(fit, stages=(*fit.stages, StageReport(stage.name, "skipped", message)))

    recipe = fit.recipe
    if stage.name not in stacks:
        return skipped(f"the session has no {stage.name} trial")
    reads = {e: c for e, c in stage.reads.items() if e in stacks}
    constant = name_constant(reads, session)
    lost = [x for x in not_judged({stage.name: stacks[stage.name]}) if x.channel in stage.reads[stage.name]]
    if lost:
        return skipped("; ".join([f"no sample of {lost[0].channel} counts: {lost[0].reason}", *constant]))
    parameters = describe(fit.model)
    groups = set(stage.frees) & free_groups(recipe)
    coverage = coverage_of(reads, session)
    free = stage_free(fit, stage, parameters, coverage)
    if not free.size:
        if not groups:
            return skipped("the recipe leaves its terms out of the nominal model")
        return skipped("; ".join(name_unseen(parameters, groups, free)) or "the finger has no active tendon")
    prior = cad_prior(session, recipe, parameters, free)
    model, solution, sources, noise = estimate_with_noise(
        fit.model, free, stacks, reads, fit.noise, prior, recipe.fit.huber, tangents
    )
    covariance = propagate(fit.covariance, model, solution, sources, free, prior, recipe.fit.huber)
    fitted = np.union1d(fit.estimated, free).astype(int)
    determined = fitted[np.isfinite(np.diag(covariance)[fitted])]
    read = np.unique(np.concatenate([s.positions for s in sources.values()]))
    needed = read[[parameters[i].group in free_groups(recipe) for i in read]]
    warnings = constant + name_missing(parameters, np.asarray(ravel(model)), determined, needed, coverage)
    warnings += name_unseen(parameters, groups, free)
    warnings += name_doubtful(model, fit.model, solution, sources, covariance, free)
    trials = tuple(t for e in reads for t in stacks[e].trials)
    report = report_of(stage.name, solution, free, trials, warnings)
    return replace(fit, model=model, covariance=covariance, estimated=fitted, noise=noise, stages=(*fit.stages, report))


def name_doubtful(
    model: Model,
    start: Model,
    solution: Solution,
    sources: dict[str, Source],
    covariance: Float[np.ndarray, "P P"],
    free: Int[np.ndarray, " p"],
) -> list[str]:
    """Warnings of estimates that the trials do not show, or only together, and of those that no machine can have.

    `start`: the model from which the fit went, whose masses bound those of `model`. `sources`: what was fitted.
    """
    parameters, values = describe(model), np.asarray(ravel(model))
    lightest, _ = parameter_bounds(start, free)
    ends = bounded_losses(model, free, parameters, highest_tensions(model, sources, parameters))
    armed = {p.tendon for p, value in zip(parameters, values, strict=True) if p.group == "moment_arm" and value != 0.0}
    # `name_missing` speaks of tendons without a moment arm, and `name_bounded` of those at an end of their friction.
    unlike = {p.tendon for p in parameters if p.tendon in ends or p.tendon not in armed}
    told = [i for i in free.tolist() if parameters[i].group == "tendon_friction" and parameters[i].tendon in unlike]
    return [
        *name_invisible(parameters, free, solution.invisible, told),
        *name_bounded({tendon: end for tendon, end in ends.items() if tendon in armed}),
        *name_traded(parameters, values, covariance, free),
        *implausible(model, covariance, free, lightest),
    ]


def report_of(
    name: str,
    solution: Solution,
    free: Int[np.ndarray, " p"],
    trials: tuple[str, ...],
    warnings: list[str],
    message: str = "",
) -> StageReport:
    """Report of a stage from its solution; `message` is used where the search converged."""
    return StageReport(
        name,
        "fitted" if solution.converged else "not converged",
        solution.message or message,
        trials=trials,
        rows=solution.rows,
        chi2_per_row=solution.chi2_per_row(free.size),
        outliers=solution.outliers,
        warnings=tuple(warnings),
    )


def stage_free(fit: Fit, stage: Stage, parameters: list[Parameter], coverage: Coverage) -> Int[np.ndarray, " p"]:
    """Positions of the parameters that a stage estimates: those of its groups that its trials can determine."""
    groups = set(stage.frees) & free_groups(fit.recipe)
    prior_groups = {"mass", "com"} if fit.recipe.fit.free_inertia and stage.name.startswith("ID.3") else set()
    free = [
        i
        for i, p in enumerate(parameters)
        if (p.group in groups and p.determinable and (p.joint or p.tendon) is not None and can_determine(p, coverage))
        or (p.group in prior_groups and fit.covariance[i, i] > 0)
    ]
    return np.array(free, dtype=int)
