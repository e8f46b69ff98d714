"""`diagnose`: where the gap of a session lies, which causes explain it, how far it shrinks, and what to record next."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Real
from pathlib import Path

from jaxfinger.compilation import one_blas_thread
from jaxfinger.data import Predictions, Session
from jaxfinger.effects import CatalogueEffect, OwnEffects, own_effects
from jaxfinger.errors import UserError, did_you_mean, require
from jaxfinger.experiments import EXPERIMENTS
from jaxfinger.gap.augment import Fitted, as_refitted, augmented_fit, nominal_fit
from jaxfinger.gap.budget import budget
from jaxfinger.gap.closure import closures
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.exact import Baseline, SearchState
from jaxfinger.gap.formula import Parameters
from jaxfinger.gap.laws_of_time import without_laws_of_time
from jaxfinger.gap.next_experiment import next_experiment
from jaxfinger.gap.parts import (
    absorbed_causes,
    by_share,
    candidates_of,
    causes_of,
    changed_parameters,
    channel_budgets,
    channels_not_judged,
    columns_with_gap,
    relevance_of,
    retuned_parameters,
    unexplained_part,
)
from jaxfinger.gap.posterior import MIN_NAMED_PROBABILITY, Posterior, posterior
from jaxfinger.gap.predicted import CheckedPredictions, checked
from jaxfinger.gap.problem import Problem, build, site, without_recurring_noise
from jaxfinger.gap.result import (
    Diagnosis,
    Key,
    Left,
    NextExperiment,
    Relevance,
    Status,
    Unexplained,
)
from jaxfinger.gap.screening import read_parts
from jaxfinger.gap.sets import Search
from jaxfinger.gap.signature_table import table_of
from jaxfinger.gap.signatures import catalogue_for, changes_of, variants
from jaxfinger.gap.smooth_laws import measured_columns, smooth_parts
from jaxfinger.gap.verdict import confirmed, consistent_with, verdict_of
from jaxfinger.gap.where import where
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.recipe import checked as checked_recipe
from jaxfinger.model import Finger
from jaxfinger.progress import Progress

COARSE = 2  # A quick diagnosis averages over twice as many samples, which halves the rows.


@one_blas_thread
def diagnose(
    session: Session,
    recipe: Recipe | None = None,
    quick: bool = False,
    effects: OwnEffects | None = None,
    without: str | Sequence[str] = (),
    progress: Progress = lambda message: None,
    predictions: Predictions | CheckedPredictions | None = None,
    tolerance: Mapping[str, float] | None = None,
    against: Fit | None = None,
) -> Diagnosis:
    """Diagnose the gap between a session and the nominal model that is identified from it (docs/method/diagnosis.md).

    A servo axis with a model that leaves Coulomb friction out:

    >>> import jaxfinger as jf
    >>> jf.diagnose(jf.read("session.h5"), jf.recipe("emps-no-coulomb"), quick=True)
    Diagnosis('session.h5': explained; joint_coulomb at axis)

    Args:
        session: the recordings.
        recipe: the nominal model; a term that it leaves out is a candidate. Where its elastic torque is constant, the
            effects of a spring are not.
        quick: take a first look: half the samples, no joint fit of causes and nominal parameters, no forward simulation
            and no next experiment.
        effects: the user's own effects, candidates beside the catalogue's: a Python file, or classes by id
            (docs/add-an-effect.md).
        without: id or ids of effects that are no candidates.
        progress: called with a message before each step.
        predictions: of another simulator, checked or not; the gap is then that between the measurements and these.
        tolerance: by channel, the share of its signal up to which a gap does not matter, such as 0.02.
        against: an earlier fit of the same finger. Its recipe is the nominal model, and each of its parameters may have
            changed by more than its interval says: these changes are candidates too. The data of a fit of this session
            itself count twice, which the summary says.

    Raises:
        UserError: a value of the recipe is not allowed; an effect to leave out or a channel to tolerate is unknown; a
            tolerance is no share of a signal; one of the user's own effects is incomplete, fails in a prediction,
            changes none, or predicts no numbers; `predictions` has none of the session's trials, does not fit them,
            repeats the measurements, or can only be a mistake (`check_predictions`); `against` is of another finger or
            recipe, holds effects, or comes with `predictions`.
    """
    require(Session, session=session)
    require((Recipe, None), recipe=recipe)
    require((Fit, None), against=against)
    require((Mapping, None), tolerance=tolerance)
    require((Mapping, CheckedPredictions, None), predictions=predictions)
    without = (without,) if isinstance(without, str) else tuple(without)
    if against is not None and (predictions is not None or recipe not in (None, against.recipe)):
        raise UserError("an earlier fit brings its own recipe and no other simulator; leave the other one out")
    recipe = checked_recipe(recipe) if recipe else against.recipe if against else Recipe()
    tolerance = dict(tolerance or {})
    changed = changes_of(against) if against else {}
    catalogue = catalogue_for(recipe, own_effects(effects), Finger.from_description(session.finger)) | changed
    _refuse_unknown(without, catalogue)
    _refuse_odd_tolerance(tolerance)
    if predictions is not None and not isinstance(predictions, CheckedPredictions):
        predictions = checked(session, predictions, session.file or "the session")
    told, doubts = predictions or (None, ())

    # The nominal model, and what it misses.
    problem = build(session, recipe, progress, told, COARSE if quick else 1, against)
    sentences = [x.sentence for x in doubts]
    if against is not None and against.was_made_from(session):
        sentences.append(
            "the earlier fit was made from this session, whose data then count twice; give a fit of an earlier session"
        )
    diagnosis = partial(
        Diagnosis,
        data=Path(session.file).name if session.file else "",
        specimen=session.specimen,
        against=None if against is None else against.data or against.specimen,
        quick=quick,
        tolerance=tolerance,
        doubts=tuple(sentences),
    )
    if next(measured_columns(problem), None) is None:
        return _nothing_judged(problem, partial(diagnosis, problem=problem))

    candidates = candidate_effects(problem, catalogue, changed, without)
    problem = without_laws_of_time(problem, candidates, against)

    def judged(problem: Problem) -> Diagnosis:
        record = partial(diagnosis, problem=problem)
        return _judged(problem, candidates, record, quick, tolerance, against, progress)

    found = judged(problem)
    if found.status is Status.NO_GAP and (quieter := without_recurring_noise(problem, against)) is not None:
        progress("looking for a gap that counted as noise")
        found = judged(quieter)
    return found


def _judged(
    problem: Problem,
    candidates: dict[str, type[CatalogueEffect]],
    diagnosis: Callable[..., Diagnosis],
    quick: bool,
    tolerance: Mapping[str, float],
    against: Fit | None,
    progress: Progress,
) -> Diagnosis:
    """Search for the causes among the candidates, confirm them, and say what they explain.

    `diagnosis`: makes the record, of the results. The other arguments are those of `diagnose`.
    """
    # Signatures of the candidates, sets of them, and their probabilities.
    search, best = search_for_causes(problem, candidates, progress)
    baseline, found = search.baseline, posterior(search, best)
    verdict = verdict_of(problem, found, _gaps(problem, baseline, baseline.null, tolerance)[1])

    # The causes that the verdict blames, fitted together with the nominal parameters.
    best = search.likeliest(best, found.ambiguous)
    chosen = search.only(best, verdict.blamed) if verdict.blamed else baseline.null
    nominal = nominal_fit(problem)
    augmented = _with_causes(problem, baseline, chosen, found, quick, progress) if chosen.effects else None
    fit = (augmented or nominal).fit

    # Confirmation on held-out trials. Without causes, what is left of another simulator is what retuning leaves.
    progress("refitting without each third of the trials")
    lines = closures(problem, augmented or (nominal if problem.simulator is not None else None), not quick)
    with_gap, relevance = _gaps(problem, baseline, chosen, tolerance)
    status = confirmed(verdict.status, found, lines, relevance, tolerance)
    shares = budget(baseline, chosen, problem, with_gap)

    # The trial that separates rivals best, and what is left.
    suggestion: NextExperiment | None = None
    if status is Status.AMBIGUOUS and not quick:
        progress("looking for the trial that would tell them apart")
        suggestion = next_experiment(problem, search.rivals(best, found.ambiguous[0]))
    causes = causes_of(chosen, found, shares, fit)
    none, unlisted = consistent_with(status, found, bool(relevance))
    left = smooth_parts(chosen.problem, chosen.r)
    return diagnosis(
        status=status,
        named=tuple(Key(*k) for k in by_share(verdict.named, chosen, shares)),
        budget=causes,
        unexplained=unexplained_part(chosen, shares, left, status, progress),
        channels=channel_budgets(problem, baseline, chosen, causes, shares),
        relevance=relevance,
        not_judged=channels_not_judged(problem, baseline.columns),
        closures=lines,
        where=tuple(where(problem)) if status is not Status.NO_GAP else (),
        candidates=candidates_of(problem, search, chosen, found, shares, fit),
        none=none,
        unlisted=unlisted,
        ambiguous_sets=tuple(tuple(Key(*k) for k in s) for s in found.ambiguous),
        next_experiment=suggestion,
        absorbed=absorbed_causes(problem, search.table, verdict.blamed),
        changes=retuned_parameters(problem, fit) if against is None else changed_parameters(against, found, fit),
        left=tuple(
            Left(x.experiment, x.channel, site(problem, x.channel, x.column), x.energy, x.by_variable) for x in left
        ),
        nominal=nominal.fit,
        augmented=fit,
    )


def _refuse_unknown(without: tuple[str, ...], catalogue: Mapping[str, type[CatalogueEffect]]) -> None:
    """Refuse to leave out an effect that is in no catalogue."""
    if unknown := sorted(set(without) - set(catalogue)):
        named = f"{', '.join(unknown)} to leave out{did_you_mean(unknown[0], catalogue)}"
        raise UserError(f"the catalogue has no effect {named}; it has {', '.join(sorted(catalogue))}")


def _refuse_odd_tolerance(tolerance: Mapping[str, float]) -> None:
    """Refuse a tolerance of a channel that no experiment predicts, and one that is no share of a signal."""
    channels = dict.fromkeys(c for e in EXPERIMENTS.values() for c in e.channels)
    for channel, share in tolerance.items():
        if channel not in channels:
            near, known = did_you_mean(channel, channels), ", ".join(channels)
            raise UserError(f"tolerance of {channel}{near}: is of no channel that is judged; these are {known}")
        if not isinstance(share, Real) or not 0.0 <= share < 1.0:
            said = f"{share:g}" if isinstance(share, Real) else repr(share)
            raise UserError(f"tolerance of {channel}: is {said}; say a share of its signal, such as 0.02")


def _nothing_judged(problem: Problem, diagnosis: Callable[..., Diagnosis]) -> Diagnosis:
    """The diagnosis of a session in which no column has enough samples: every probability is one half."""
    fit = nominal_fit(problem).fit
    return diagnosis(
        status=Status.NOT_JUDGED,
        named=(),
        budget=(),
        unexplained=Unexplained(0.0, (0.0, 0.0), (), None, None),
        channels=(),
        relevance=(),
        not_judged=channels_not_judged(problem, Columns(())),
        closures=(),
        where=(),
        candidates=(),
        none=0.5,
        unlisted=0.5,
        ambiguous_sets=(),
        next_experiment=None,
        absorbed=(),
        changes=(),
        left=(),
        nominal=fit,
        augmented=fit,
    )


def candidate_effects(
    problem: Problem,
    catalogue: Mapping[str, type[CatalogueEffect]],
    changed: Mapping[str, type[CatalogueEffect]],
    without: tuple[str, ...],
) -> dict[str, type[CatalogueEffect]]:
    """Effects of the catalogue that the nominal model lacks; `changed` are changes of an earlier fit's parameters."""
    excluded = set(problem.fit.recipe.model.terms) | set(without)
    if problem.nominal.joint_torque.elastic.shape[1] == 1:  # A constant elastic torque is no spring.
        excluded |= {k for k, c in catalogue.items() if c.OF_SPRING}
    laws = {law for c in changed.values() for law in c.__mro__}  # An effect that a change inherits from is its copy.
    return {k: c for k, c in catalogue.items() if k not in excluded and (k in changed or c not in laws)}


def search_for_causes(
    problem: Problem, catalogue: Mapping[str, type[CatalogueEffect]], progress: Progress = lambda message: None
) -> tuple[Search, SearchState]:
    """Search sets of the catalogue's effects; return the search, which holds all visited sets, and the best set."""
    baseline = Baseline.of(problem, Parameters())
    progress("reading the signatures of all effects")
    items = variants(catalogue, problem.nominal.finger, problem.scales)
    parts = read_parts(problem, items, baseline.columns, progress)
    search = Search(baseline, table_of(problem, baseline, parts), progress)
    progress("weighing the evidence")
    return search, search.run()


def _gaps(
    problem: Problem, baseline: Baseline, chosen: SearchState, tolerance: Mapping[str, float]
) -> tuple[frozenset[int], tuple[Relevance, ...]]:
    """Columns in which the nominal model alone leaves a gap, as far as the chosen set shows it, and each gap's size."""
    columns, null = baseline.columns, baseline.null.linear_fit.evidence
    found = columns_with_gap(columns.counts, null, chosen.linear_fit.evidence, baseline.parameters)
    return found, relevance_of(problem, columns, found, tolerance)


def _with_causes(
    problem: Problem, baseline: Baseline, chosen: SearchState, found: Posterior, quick: bool, progress: Progress
) -> Fitted:
    """The model with the chosen causes in; these keep their sizes where something unlisted is probable beside them."""
    progress("fitting the effects and all nominal parameters together")
    hold = found.unlisted > MIN_NAMED_PROBABILITY
    return as_refitted(baseline, problem, chosen, hold) if quick else augmented_fit(problem, chosen, hold)
