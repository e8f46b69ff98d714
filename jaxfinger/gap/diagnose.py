"""`diagnose`: where the gap of a session lies, which causes explain it, how far it shrinks, and what to record next."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from jaxfinger.data import Predictions, Session
from jaxfinger.data.schema import channel_units
from jaxfinger.effects import CatalogueEffect, Changed
from jaxfinger.errors import UserError, did_you_mean
from jaxfinger.experiments import not_judged
from jaxfinger.gap.augment import Fitted, as_refitted, augmented_fit, nominal_fit, values_of
from jaxfinger.gap.budget import MIN_GAP_EVIDENCE, Budget, budget, held_out_gains
from jaxfinger.gap.closure import MIN_RESOLVABLE_RATIO, centred, closures
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.costs import CauseKey
from jaxfinger.gap.exact import Baseline, SearchState
from jaxfinger.gap.formula import Parameters, Weights
from jaxfinger.gap.next_experiment import next_experiment
from jaxfinger.gap.posterior import MIN_NAMED_PROBABILITY, Posterior, posterior
from jaxfinger.gap.problem import Problem, build, site
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.propose import propose
from jaxfinger.gap.result import (
    Absorbed,
    Candidate,
    Cause,
    Change,
    ChannelBudget,
    Closure,
    Diagnosis,
    ExperimentChannel,
    Key,
    Left,
    NextExperiment,
    NotJudged,
    Reason,
    Relevance,
    Status,
    Unexplained,
    Value,
    still_open,
    tolerated,
)
from jaxfinger.gap.screening import read_parts
from jaxfinger.gap.sets import Search
from jaxfinger.gap.signature_table import Offer, SignatureTable, table_of
from jaxfinger.gap.signatures import catalogue_for, changes_of, variants
from jaxfinger.gap.smooth_laws import SmoothPart, measured_columns, smooth_parts
from jaxfinger.gap.where import where
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.parameters import describe, ravel, units_at
from jaxfinger.identify.stages import Progress
from jaxfinger.model import Finger

COARSE = 2  # A quick diagnosis averages over twice as many samples, which halves the rows.
# The thresholds of this module decide what a report mentions, and no verdict.
# Share of a signature's energy that the nominal parameters imitate, from which a cause is listed as absorbed: of what
# it changes, a tenth in rms is then left to see.
MIN_ABSORBED = 0.99
MIN_VARIABLE_SHARE = 0.2  # Share of the smooth law's energy that one variable must explain to be listed.
MAX_HELD_OUT = 12  # Candidates outside of the chosen set, most probable first, that are tried on held-out trials.
MIN_DEVIATION = 3.0  # Standard deviations: the usual three sigma, by which a simulator's parameter must be off.


@dataclass(frozen=True)
class Verdict:
    """Status and named causes (effect and site) that follow from the posterior alone, without held-out trials."""

    status: Status
    named: tuple[CauseKey, ...]


def diagnose(
    session: Session,
    recipe: Recipe | None = None,
    quick: bool = False,
    effects: dict[str, type[CatalogueEffect]] | None = None,
    without: tuple[str, ...] = (),
    progress: Progress = lambda message: None,
    predictions: Predictions | None = None,
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
        recipe: the nominal model; a term that it leaves out is a candidate.
        quick: take a first look: half the samples, no joint fit of causes and nominal parameters, no forward simulation
            and no next experiment.
        effects: the user's own effects by id, candidates beside the catalogue's.
        without: ids of effects that are no candidates.
        progress: called with a message before each step.
        predictions: of another simulator; the gap is then that between the measurements and these.
        tolerance: by channel, the share of its signal up to which a gap does not matter.
        against: an earlier fit of the same finger. Its recipe is the nominal model, and each of its parameters may have
            changed by more than its interval says: these changes are candidates too.

    Raises:
        UserError: an effect to leave out is unknown; one of the user's own fails in a prediction or changes none;
            `predictions` has none of the session's trials; `against` is of another finger or recipe, holds effects, or
            comes with `predictions`.
    """
    if against is not None and (predictions is not None or recipe not in (None, against.recipe)):
        raise UserError("an earlier fit brings its own recipe and no other simulator; leave the other one out")
    recipe, tolerance = recipe or (against.recipe if against else Recipe()), dict(tolerance or {})
    changed = changes_of(against) if against else {}
    catalogue = catalogue_for(recipe, effects, Finger.from_description(session.finger)) | changed
    if unknown := set(without) - set(catalogue):
        raise UserError(
            f"the catalogue has no effect {', '.join(sorted(unknown))} to leave out"
            f"{did_you_mean(min(unknown), catalogue)}; "
            f"it has {', '.join(sorted(catalogue))}"
        )
    problem = build(session, recipe, progress, predictions, COARSE if quick else 1, against)
    diagnosed = partial(
        Diagnosis,
        data=Path(session.file).name if session.file else "",
        specimen=session.specimen,
        against=None if against is None else against.data or against.specimen,
        quick=quick,
        tolerance=tolerance,
        problem=problem,
    )
    if next(measured_columns(problem), None) is None:
        return _nothing_judged(problem, diagnosed)
    kept = set(problem.fit.recipe.model.terms) | set(without)
    laws = {law for c in changed.values() for law in c.__mro__}  # An effect that a change inherits from is its copy.
    catalogue = {k: c for k, c in catalogue.items() if k not in kept and (k in changed or c not in laws)}
    search, state = search_for_causes(problem, catalogue, progress)
    baseline, table, found = search.baseline, search.table, posterior(search, state)
    relevance = _relevance(problem, baseline, tolerance)
    verdict = _verdict(problem, baseline, state, found, relevance)
    nominal = nominal_fit(problem)
    chosen = baseline.null
    if verdict.status in (Status.PARTLY, Status.AMBIGUOUS):
        chosen = search.only(state, (*verdict.named, *(k for s in found.ambiguous for k in s)))
    augmented: Fitted | None = None
    if chosen.effects:
        progress("fitting the effects and all nominal parameters together")
        something_open = found.unlisted > MIN_NAMED_PROBABILITY
        augmented = as_refitted(problem, chosen) if quick else augmented_fit(problem, chosen, hold=something_open)
    progress("refitting without each third of the trials")
    lines = closures(problem, augmented, not quick)
    status = _explained_or_partly(verdict.status, found, lines, relevance, tolerance)
    shares = budget(baseline, chosen, problem, _columns_with_gap(baseline))
    suggestion: NextExperiment | None = None
    if status is Status.AMBIGUOUS and not quick:
        progress("looking for the trial that would tell them apart")
        suggestion = next_experiment(problem, search.rivals(state, found.ambiguous[0]))
    fit = augmented.fit if augmented else nominal.fit
    causes = _causes(chosen, found, shares, fit)
    none, unlisted = consistent_with(status, found, bool(relevance))
    left = smooth_parts(chosen.problem, chosen.r)
    return diagnosed(
        status=status,
        named=tuple(Key(*k) for k in _by_share(verdict.named, chosen, shares)),
        budget=causes,
        unexplained=_unexplained(chosen, shares, left, status, progress),
        channels=_channels(problem, baseline, chosen, causes, shares),
        relevance=relevance,
        not_judged=_not_judged(problem, baseline.columns),
        closures=lines,
        where=tuple(where(problem)) if status is not Status.NO_GAP else (),
        candidates=_candidates(problem, search, chosen, found, shares, fit),
        none=none,
        unlisted=unlisted,
        ambiguous_sets=tuple(tuple(Key(*k) for k in s) for s in found.ambiguous),
        next_experiment=suggestion,
        absorbed=_absorbed(problem, table),
        changes=_retuned(problem, fit) if against is None else _changed(against, found, fit),
        left=tuple(
            Left(x.experiment, x.channel, site(problem, x.channel, x.column), x.energy, x.by_variable) for x in left
        ),
        nominal=nominal.fit,
        augmented=fit,
    )


def _nothing_judged(problem: Problem, diagnosed: Callable[..., Diagnosis]) -> Diagnosis:
    """The diagnosis of a session in which no column has enough samples: every probability is one half."""
    fit = nominal_fit(problem).fit
    return diagnosed(
        status=Status.NOT_JUDGED,
        named=(),
        budget=(),
        unexplained=Unexplained(0.0, (0.0, 0.0), (), None, None),
        channels=(),
        relevance=(),
        not_judged=_not_judged(problem, Columns(())),
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


def _verdict(
    problem: Problem, baseline: Baseline, state: SearchState, found: Posterior, relevance: tuple[Relevance, ...]
) -> Verdict:
    """Verdict of the posterior; held-out trials decide later between `partly` and `explained`.

    Without a cause to name it is `unexplained` if some channel's mean square is surely above that of its noise,
    whatever the evidence, or if there is a gap and something unlisted is probable.
    """
    if found.named:
        return Verdict(Status.PARTLY, found.named)
    if found.ambiguous:
        return Verdict(Status.AMBIGUOUS, found.ambiguous[0][:1])
    matters = [x for x in relevance if not x.tolerated]
    seen = any(
        missed > MIN_RESOLVABLE_RATIO * noise
        for missed, noise in (_mean_squares(problem, x.experiment, x.channel) for x in matters)
    )
    return Verdict(
        Status.UNEXPLAINED if seen or (matters and found.unlisted > MIN_NAMED_PROBABILITY) else Status.NO_GAP, ()
    )


def _explained_or_partly(
    status: Status,
    found: Posterior,
    lines: tuple[Closure, ...],
    relevance: tuple[Relevance, ...],
    tolerance: Mapping[str, float],
) -> Status:
    """`explained` in place of `partly` where every channel closes to its noise, or to the user's tolerance.

    If something unlisted is probable, only the tolerance counts: what is left of every gap must be within it.
    """
    if status is not Status.PARTLY or found.ambiguous or still_open(lines, relevance, tolerance):
        return status
    with_gap = {(x.experiment, x.channel) for x in relevance}
    matter = [x for x in lines if (x.experiment, x.channel) in with_gap and not tolerated(x, relevance, tolerance)]
    return Status.EXPLAINED if found.unlisted <= MIN_NAMED_PROBABILITY or not matter else status


def consistent_with(status: Status, found: Posterior, gaps: bool) -> tuple[float, float]:
    """Probabilities of «nothing» and «something unlisted» at work, bounded so that they agree with the verdict.

    `gaps` says whether any channel has a gap. Where a gap has no named cause, or the named causes leave it open on
    held-out trials, «unlisted» is at least one half. Under `no_gap`, where many columns have traces and none has a gap,
    it is at most one half.
    """
    if status is Status.NO_GAP and not gaps:
        unlisted = min(found.unlisted, 1.0 - MIN_NAMED_PROBABILITY)
        return max(found.none, 1.0 - unlisted), unlisted
    left_open = status is Status.UNEXPLAINED or (status is Status.PARTLY and not found.ambiguous)
    unlisted = max(found.unlisted, MIN_NAMED_PROBABILITY) if left_open else found.unlisted
    return min(found.none, 1.0 - unlisted), unlisted


def _columns_with_gap(baseline: Baseline) -> frozenset[int]:
    """Numbers of the columns in which the nominal model alone leaves a gap."""
    return frozenset(np.flatnonzero(baseline.unexplained > MIN_GAP_EVIDENCE).tolist())


def _by_share(named, chosen: SearchState, shares: Budget) -> list:
    """Named causes, largest share of the gap first."""
    value, _, _, _ = shares.overall()
    order = {k: v for k, v in zip(chosen.keys, value, strict=True)}
    return sorted(named, key=lambda k: -order.get(k, 0.0))


def _causes(chosen: SearchState, found: Posterior, shares: Budget, fit: Fit) -> tuple[Cause, ...]:
    """One line for each effect of the chosen set, its sites together, largest share first."""
    value, ends, _, _ = shares.overall()
    by_channel: dict[tuple[str, str], set[int]] = {}
    for c in sorted(shares.open):
        by_channel.setdefault(shares.channels[c], set()).add(c)
    of_channel = {k: shares.of(cs)[0] for k, cs in by_channel.items()}
    out = []
    for effect in dict.fromkeys(e for e, _ in chosen.keys):
        at = [i for i, (e, _) in enumerate(chosen.keys) if e == effect]
        out.append(
            Cause(
                effect,
                tuple(chosen.keys[i][1] for i in at),
                min(found.causes.get(chosen.keys[i], 0.0) for i in at),
                float(np.clip(value[at].sum(), 0.0, 1.0)),
                (float(min(ends[at, 0].sum(), 1.0)), float(min(ends[at, 1].sum(), 1.0))),
                {
                    ExperimentChannel(e, c): float(min(lost[at].sum(), 1.0))
                    for (e, c), lost in of_channel.items()
                    if lost[at].sum() > 0.005
                },
                tuple(v for i in at for v in values_of(fit, i)),
            )
        )
    return tuple(sorted(out, key=lambda c: -c.share))


def _unexplained(chosen: SearchState, shares: Budget, left: list[SmoothPart], status: Status, progress) -> Unexplained:
    """Share of the gap that the chosen set leaves, the variables that it depends on, and a closed form for it."""
    _, _, share, ends = shares.overall()
    if status is Status.NO_GAP or not left or left[0].energy <= 0:
        return Unexplained(share, ends, (), None, None)
    worst = left[0]
    variables = sorted(worst.by_variable.items(), key=lambda kv: -kv[1])[:2]
    depends = tuple(k for k, v in variables if v > MIN_VARIABLE_SHARE * worst.energy)
    proposal = None
    if status in (Status.PARTLY, Status.UNEXPLAINED):
        progress("looking for a closed form of what remains")
        plain = Projector(chosen.problem, chosen.columns, Weights.plain(chosen.columns))
        proposal = propose(chosen.problem, plain, chosen.r, left)
    there = ExperimentChannel(worst.experiment, worst.channel, site(chosen.problem, worst.channel, worst.column))
    return Unexplained(share, ends, depends, there, proposal)


def _channels(
    problem: Problem, baseline: Baseline, chosen: SearchState, causes: tuple[Cause, ...], shares: Budget
) -> tuple[ChannelBudget, ...]:
    """One line for each column with a gap; gap and noise are rms values in physical units at the fit's sample rate."""
    found = []
    lines = [[i for i, (e, _) in enumerate(chosen.keys) if e == cause.effect] for cause in causes]
    for c in sorted(shares.open):
        column = baseline.columns.items[c]
        missed, noise = _mean_squares(problem, column.experiment, column.channel, column.column)
        lost, after = shares.of({c})
        found.append(
            ChannelBudget(
                column.experiment,
                column.channel,
                site(problem, column.channel, column.column),
                channel_units(column.channel, problem.session.finger.prismatic),
                noise**0.5,
                max(missed - noise, 0.0) ** 0.5,
                tuple(float(lost[at].sum()) for at in lines),
                after,
            )
        )
    return tuple(found)


def _mean_squares(problem: Problem, e: str, c: str, column: int | None = None) -> tuple[float, float]:
    """Mean squares of the nominal model's residual and of the noise, over the samples that count, in squared units."""
    stack, noise = problem.stacks[e], problem.noise[e, c]
    mask, y = (np.asarray(a[c]) for a in (stack.batch.mask, stack.batch.y))
    pick = slice(None) if column is None else slice(column, column + 1)
    missed = centred((y - problem.predicted[e, c])[pick], mask[pick], c)
    count = max(float(mask[pick].sum()), 1.0)
    of_noise = float((mask[pick] * noise.std[pick, None, None] ** 2).sum()) / count
    return float((missed**2).sum()) / count, of_noise


def _relevance(problem: Problem, baseline: Baseline, tolerance: Mapping[str, float]) -> tuple[Relevance, ...]:
    """Size of each channel's gap, and relative to the channel's signal in the experiment that moves it most."""
    items = [baseline.columns.items[c] for c in _columns_with_gap(baseline)]
    out = []
    for e, c in dict.fromkeys((x.experiment, x.channel) for x in items):
        missed, noise = _mean_squares(problem, e, c)
        if missed <= noise:  # The evidence is in some features alone: the channel as a whole misses no more than noise.
            continue
        signal = max(_signal(problem, other, c) for other, s in problem.stacks.items() if c in s.experiment.channels)
        gap = (missed - noise) ** 0.5
        relative = gap / max(signal, 1e-300)
        units = channel_units(c, problem.session.finger.prismatic)
        out.append(Relevance(e, c, units, gap, signal, relative, c in tolerance and relative <= tolerance[c]))
    return tuple(sorted(out, key=lambda x: -x.relative))


def _signal(problem: Problem, e: str, c: str) -> float:
    """rms of a channel about each column's mean, over the samples that count."""
    batch = problem.stacks[e].batch
    mask, y = np.asarray(batch.mask[c]), np.asarray(batch.y[c])
    x = np.where(mask > 0, y, 0.0)
    x = (x - x.sum(axis=(1, 2), keepdims=True) / np.maximum(mask.sum(axis=(1, 2), keepdims=True), 1.0)) * (mask > 0)
    return float(np.sqrt((centred(x, mask, c) ** 2).sum() / max(float(mask.sum()), 1.0)))


def _not_judged(problem: Problem, columns: Columns) -> tuple[NotJudged, ...]:
    """Channels of which no sample counts, and channels of which too few count to make a column."""
    why = Reason.NOTHING_COUNTS if problem.simulator is None else Reason.NOT_PREDICTED
    out = [NotJudged(x.experiment, x.channel, why) for x in not_judged(problem.stacks)]
    known = {(x.experiment, x.channel) for x in (*out, *columns.items)}
    few = [(e, c) for e, s in problem.stacks.items() for c in s.experiment.channels if (e, c) not in known]
    return (*out, *(NotJudged(e, c, Reason.FEW_SAMPLES) for e, c in few))


def _candidates(problem: Problem, search: Search, chosen: SearchState, found: Posterior, shares: Budget, fit: Fit):
    """All candidates, most probable first.

    Values and held-out share of a member of the chosen set are those in the set, of others those alone on top of the
    nominal model.
    """
    order = sorted(found.causes, key=lambda k: (-found.causes[k], -found.gains[k]))
    inside = {k: values_of(fit, i) for i, k in enumerate(chosen.keys)}
    gain = dict(zip(chosen.keys, shares.overall()[0].tolist(), strict=True))
    others = search.alone(k for k in order if k not in inside)
    likely = [k for k in order if k in others][:MAX_HELD_OUT]
    signatures = [search.table.signatures.dense(others[k][0].rows, problem.r.size) for k in likely]
    gain |= dict(zip(likely, held_out_gains(problem, signatures), strict=True))
    values = inside | {k: _alone(problem, search.table, *x) for k, x in others.items()}
    return tuple(
        Candidate(Key(*k), found.causes[k], found.gains[k], gain.get(k, 0.0), values.get(k, ())) for k in order
    )


def _alone(
    problem: Problem, table: SignatureTable, offer: Offer, amplitudes: np.ndarray, std: np.ndarray
) -> tuple[Value, ...]:
    """Values of a cause alone on top of the nominal model: amplitudes by linear least squares, and the best shape."""
    (variant,), names = offer.variants, list(offer.variants[0].sizes)
    units = units_at(problem.nominal.finger, variant.effect, variant.site)
    found = dict.fromkeys(names, (0.0, 0.0))
    of_row = dict(zip(table.rows[variant].tolist(), names, strict=True))
    for row, a, s in zip(offer.rows.tolist(), amplitudes, std, strict=True):
        unit = table.units[row] * variant.sizes[of_row[row]]
        found[of_row[row]] = (float(a * unit), float(s * unit))
    values = [Value(variant.site, n, a, s, units[n]) for n, (a, s) in found.items()]
    return tuple([*values, *(Value(variant.site, n, v, 0.0, units[n]) for n, v in variant.shape)])


def _absorbed(problem: Problem, table: SignatureTable) -> tuple[Absorbed, ...]:
    """Causes whose signatures the nominal parameters imitate, with the amplitudes that could stay hidden."""
    out = []
    for key, share in table.absorbed.items():
        if share > MIN_ABSORBED:
            hidden = table.hidden.get(key, {})
            effect = next(v.effect for v in table.rows if v.key == key)
            units = units_at(problem.nominal.finger, effect, key[1])
            values = tuple(Value(key[1], n, 0.0, s, units[n]) for n, s in hidden.items())
            out.append(Absorbed(Key(*key), share, values))
    return tuple(out)


def _changed(against: Fit, found: Posterior, fit: Fit) -> tuple[Change, ...]:
    """Nominal parameters that have changed since an earlier fit: values before, and after with the change added."""
    old, new, parameters = np.asarray(ravel(against.model)), np.asarray(ravel(fit.model)), describe(fit.model)
    at = {p.name: i for i, p in enumerate(parameters)}
    out = []
    for effect in fit.model.effects:
        if not isinstance(effect, Changed):
            continue
        mine = [i for i, p in enumerate(parameters) if p.group == effect.GROUP]
        mine = [i for i in mine if {parameters[i].joint, parameters[i].tendon} - {None} == set(effect.site)]
        label = f"{effect.ID} {'-'.join(effect.site)} "
        for i, name in zip(mine, effect.amplitudes(), strict=False):
            pair = [i, at[label + name]]
            std = float(np.sqrt(max(fit.covariance[np.ix_(pair, pair)].sum(), 0.0)))
            p, probability = parameters[i], found.causes[effect.ID, effect.site]
            after = float(new[pair].sum())
            out.append(Change(p.name, p.group, p.units, float(old[i]), float(against.std[i]), after, std, probability))
    return tuple(out)


def _retuned(problem: Problem, fit: Fit) -> tuple[Change, ...]:
    """Parameters of another simulator that the measurements contradict; the one that changes predictions most first."""
    if problem.simulator is None:
        return ()
    old, new = (np.asarray(ravel(model))[problem.free] for model in (problem.simulator, fit.model))
    std = fit.std[problem.free]
    off = np.abs(new - old)
    weight = off * np.linalg.norm(problem.J, axis=0) * (off > MIN_DEVIATION * std)
    parameters = describe(problem.nominal)
    return tuple(
        Change(p.name, p.group, p.units, float(old[i]), 0.0, float(new[i]), float(std[i]), 1.0)
        for i in np.argsort(-weight)
        if weight[i] > 0
        for p in [parameters[problem.free[i]]]
    )
