"""Joint refinement: every parameter of equation (1) from all trials at once.

    min_θ  Σ_trials ‖white residuals(θ)‖² + ‖Σ^(−1/2) (θ − μ)‖²

(μ, Σ) is a fit of other recordings, with all that it knew. A fit of these very recordings is no more than the start:
then the prior is what CAD and scale say, and nothing is counted twice. Masses and centres of mass are free wherever
CAD states how well it knows them; masses stay positive, and a link's inertia follows its mass: CAD knows its shape.
"""

from dataclasses import replace

import jax
import numpy as np

from jaxfinger.data import Session, data_hash
from jaxfinger.errors import UserError
from jaxfinger.experiments import EXPERIMENTS, prepare
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.identifiability import name_invisible
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.plausible import implausible
from jaxfinger.identify.predictions import model_for
from jaxfinger.identify.prior import prior_of
from jaxfinger.identify.propagate import propagate
from jaxfinger.identify.shooting import AHEAD, Shooting, shooting
from jaxfinger.identify.solve import solve, within
from jaxfinger.identify.stages import (
    Progress,
    cad_covariance,
    cad_prior,
    estimate_with_noise,
    free_groups,
    report_of,
    seen_by,
    total_cost,
    touched_by,
)
from jaxfinger.identify.start import start_values
from jaxfinger.model import Model

STAGE = "joint"
MISFIT = 1.3  # χ² a row above which another start is tried


def refine(session: Session, fit: Fit, progress: Progress = lambda message: None, ahead: bool = False) -> Fit:
    """The fit refined on all trials of `recipe.fit.joint_experiments`; its last stage report says what it gained. With
    `ahead` on those of VD.3 too, by the angles that it predicts a moment ahead (`shooting`).

    >>> import jaxfinger as jf
    >>> jf.refine(jf.read("session.h5"), jf.load("fit.json"))
    Fit('EMPS', recipe 'emps': 4 parameters; ID.3-dynamic fitted, joint fitted)

    Raises:
        UserError: the session has none of these trials, with `ahead` no VD.3 either, or its finger is another one.
    """
    recipe = fit.recipe
    model = start = model_for(fit, session)
    progress("reading the recordings")
    stacks = prepare(session, [t.name for t in session if t.experiment in recipe.fit.joint_experiments])
    reads = {e: channels_of(e) for e in stacks}
    given: dict[tuple[str, str], Noise] = {}
    shots: Shooting | None = None
    if ahead:
        progress("simulating VD.3")
        shots, stacks[AHEAD] = shooting(model, session)
        reads[AHEAD], given[AHEAD, "q"] = ("q",), shots.noise(model)
    if not reads:
        raise UserError(
            f"{session.file or 'the session'}: has no trial of {', '.join(recipe.fit.joint_experiments)}; "
            "name others in fit.joint_experiments of the recipe"
        )
    parameters = describe(model)
    cad = np.flatnonzero(np.diag(cad_covariance(session, parameters)))
    touched = touched_by(reads, session)
    groups = free_groups(recipe)
    seen = [i for i, p in enumerate(parameters) if p.group in groups and p.determinable and seen_by(p, touched)]
    free = np.union1d(np.union1d(fit.estimated, cad), seen).astype(int)

    same = fit.data_hash == (data_hash(session.file) if session.file else "")
    if same:
        prior = cad_prior(session, recipe, parameters, free)
    else:
        prior = prior_of(np.asarray(ravel(fit.model)), fit.covariance, free)
    progress("refining on all trials at once")
    known, huber = (fit.noise if same else {}), recipe.fit.huber
    model, solution, sources, noise = estimate_with_noise(model, free, stacks, reads, known, prior, huber, given=given)
    noise = {key: n for key, n in noise.items() if key not in given}
    warnings = name_invisible(parameters, free, solution.invisible)
    if not solution.converged or warnings or solution.chi2_per_row(free.size) > MISFIT:
        progress("refining from a neutral start")
        neutral = start_values(_neutral(model, free, parameters), free, parameters, sources)
        other, second = solve(neutral, free, sources, prior, huber)
        if total_cost(other, second, free, prior) < total_cost(model, solution, free, prior) * (1 - 1e-6):
            model, solution = other, second
            warnings = [
                *name_invisible(parameters, free, solution.invisible),
                "the earlier fit led to a poorer optimum",
            ]

    if shots is not None:
        progress("refining without what noise bends")
        sources[AHEAD] = sources[AHEAD]._replace(batch=shots.straightened(model))
        bent = np.asarray(ravel(model))
        model, solution = solve(model, free, sources, prior, huber)
    covariance = propagate(fit.covariance, solution, sources, free, prior, huber)
    if ahead:
        theta = np.asarray(ravel(model))
        covariance += _contradicted(refine(session, fit), theta, covariance) + np.outer(theta - bent, theta - bent)
    warnings += implausible(model, covariance, free, within(start, free)[0])
    refined = replace(
        fit,
        model=model,
        covariance=covariance,
        estimated=free,
        noise=noise if same else fit.noise | noise,
        specimen=session.specimen,
    )
    trials = tuple(t for s in stacks.values() for t in s.trials)
    report = report_of(STAGE, solution, free, trials, warnings, _gain(fit, refined, same))
    return replace(refined, stages=(*fit.stages, report))


def _contradicted(without: Fit, theta: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """What an estimate's covariance grows by where VD.3 moves it further from that `without` it than chance does: the
    variance of such a move is the difference of both.
    """
    moved = theta - np.asarray(ravel(without.model))
    with np.errstate(invalid="ignore"):  # of what neither sees
        chance = np.maximum(np.nan_to_num(without.std**2 - np.diag(covariance), nan=np.inf), 0.0)
    beyond = np.sign(moved) * np.sqrt(np.maximum(moved**2 - chance, 0.0))
    return np.outer(beyond, beyond)


def channels_of(experiment: str) -> tuple[str, ...]:
    """What a held joint's tendons show of their excursion is stretch, not moment arm."""
    e = EXPERIMENTS[experiment]
    return tuple(c for c in e.channels if not (e.held and c == "tendon_excursion"))


def _neutral(model: Model, free, parameters) -> Model:
    """Every coefficient zero, the links as they are: most of (1) is linear, and a few steps lead to the data."""
    flat = np.array(ravel(model))
    linear = [i for i in free if parameters[i].group not in ("mass", "com")]
    flat[linear] = 0.0
    return Free.at(model, free).set(model, jax.device_put(flat[free]))


def _gain(before: Fit, after: Fit, same: bool) -> str:
    """How much narrower the intervals are than those of the earlier fit."""
    common = before.estimated[(before.std[before.estimated] > 0) & np.isfinite(before.std[before.estimated])]
    if not common.size:
        return ""
    ratio = after.std[common] / before.std[common]
    prior = "CAD is the prior, the trials are read once" if same else "the earlier fit of other data is the prior"
    return f"standard deviations are {np.median(ratio):.2f} of the earlier ones in the median ({prior})"
