"""Diagnose the sim-to-real gap of a session: where, which causes, how far it shrinks, what next; as data."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxfinger.data import Predictions, Session
from jaxfinger.data.schema import channel_units
from jaxfinger.effects import CatalogueEffect, Changed
from jaxfinger.errors import UserError, did_you_mean
from jaxfinger.experiments import not_judged
from jaxfinger.gap.augment import Fitted, as_refitted, augmented_fit, nominal_fit, values_of
from jaxfinger.gap.budget import A_GAP, Budget, budget, held_out_gains
from jaxfinger.gap.closure import RESOLVABLE, closures
from jaxfinger.gap.exact import Baseline, Projector, SearchState
from jaxfinger.gap.formula import Parameters, Weights, unexplained
from jaxfinger.gap.next_experiment import next_experiment
from jaxfinger.gap.posterior import MIN_NAMED_PROBABILITY, Posterior, posterior
from jaxfinger.gap.problem import Problem, build, site
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
from jaxfinger.gap.smooth_laws import SmoothPart, smooth_parts
from jaxfinger.gap.where import where
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.parameters import describe, ravel, units_at
from jaxfinger.identify.stages import Progress
from jaxfinger.model import Finger

COARSE = 2  # times as long averages in a first look
NEARLY = 0.99  # of a signature that the nominal parameters imitate, from which on a cause is called absorbed
DEPENDS = 0.2  # share of what is left that a variable must carry to be named
HELD_OUT = 12  # candidates beside the named ones, the likeliest, that are tried on held-out trials
CONTRADICTED = 3.0  # standard deviations by which a simulator's parameter must be off


@dataclass(frozen=True)
class Verdict:
    """What the posterior says in a word, and whom it names."""

    status: Status
    named: tuple[tuple[str, tuple[str, ...]], ...]


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
    """Diagnose a session. `effects` adds a user's own, `without` withholds some of the catalogue by id.

    With `predictions` the gap is that between the measurements and another simulator's predictions. `tolerance`: by
    channel, the share of its signal up to which a gap does not matter. With `against` it is what an earlier fit of the
    same finger misses: its nominal parameters, each within its interval, are candidates for what has changed.

    The servo axis with a model that leaves Coulomb's friction out:

    >>> import jaxfinger as jf
    >>> jf.diagnose(jf.read("session.h5"), jf.recipe("emps-no-coulomb"), quick=True)
    Diagnosis('session.h5': explained; joint_coulomb at axis)

    Raises:
        UserError: an effect to leave out is unknown; the earlier fit is of another finger or recipe, or holds effects.
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
    kept = set(problem.fit.recipe.model.terms) | set(without)
    laws = {law for c in changed.values() for law in c.__mro__}  # an effect whose law a change has would be its copy
    catalogue = {k: c for k, c in catalogue.items() if k not in kept and (k in changed or c not in laws)}
    search, state = searched(problem, catalogue, progress)
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
        whole = found.unlisted <= 0.5
        augmented = as_refitted(problem, chosen) if quick else augmented_fit(problem, chosen, not whole)
    progress("refitting without each third of the trials")
    lines = closures(problem, augmented, not quick)
    status = _closed(verdict.status, found, lines, relevance, tolerance)
    shares = budget(baseline, chosen, problem, _open(baseline))
    suggestion: NextExperiment | None = None
    if status is Status.AMBIGUOUS and not quick:
        progress("looking for the trial that would tell them apart")
        suggestion = next_experiment(problem, search.rivals(state, found.ambiguous[0]))
    fit = augmented.fit if augmented else nominal.fit
    causes = _causes(chosen, found, shares, fit)
    none, unlisted = agreeing(status, found, bool(relevance))
    left = smooth_parts(chosen.problem, chosen.r)
    return Diagnosis(
        status=status,
        named=tuple(Key(*k) for k in _by_share(verdict.named, chosen, shares)),
        data=Path(session.file).name if session.file else "",
        specimen=session.specimen,
        against=None if against is None else against.data or against.specimen,
        quick=quick,
        tolerance=tolerance,
        budget=causes,
        unexplained=_unexplained(chosen, shares, left, status, progress),
        channels=_channels(problem, baseline, chosen, causes, shares),
        relevance=relevance,
        not_judged=_not_judged(problem),
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
        problem=problem,
    )


def searched(
    problem: Problem, catalogue: Mapping[str, type[CatalogueEffect]], progress: Progress = lambda message: None
) -> tuple[Search, SearchState]:
    """All sets of the catalogue's effects that the evidence led to, and the best of them."""
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
    """The word for the posterior; whether named causes are all of the gap is for held-out trials to say. A channel
    whose mean square is surely above its noise's is no «no gap», however few features tell of it.
    """
    if not baseline.columns.items:
        return Verdict(Status.NOT_JUDGED, ())
    if found.named:
        return Verdict(Status.PARTLY, found.named)
    if found.ambiguous:
        return Verdict(Status.AMBIGUOUS, found.ambiguous[0][:1])
    matters = [x for x in relevance if not x.tolerated]
    seen = any(
        missed > RESOLVABLE * noise
        for missed, noise in (_mean_squares(problem, x.experiment, x.channel) for x in matters)
    )
    return Verdict(Status.UNEXPLAINED if seen or (matters and found.unlisted > 0.5) else Status.NO_GAP, ())


def _closed(
    status: Status,
    found: Posterior,
    lines: tuple[Closure, ...],
    relevance: tuple[Relevance, ...],
    tolerance: Mapping[str, float],
) -> Status:
    """Whether the named causes are all: nothing unlisted is likely, and every channel comes down to its noise; or what
    is left in every channel with a gap is tolerated.
    """
    if status is not Status.PARTLY or found.ambiguous or still_open(lines, relevance, tolerance):
        return status
    with_gap = {(x.experiment, x.channel) for x in relevance}
    minded = [x for x in lines if (x.experiment, x.channel) in with_gap and not tolerated(x, relevance, tolerance)]
    return Status.EXPLAINED if found.unlisted <= 0.5 or not minded else status


def agreeing(status: Status, found: Posterior, gaps: bool) -> tuple[float, float]:
    """Probabilities that nothing is at work, and that something is which the catalogue lacks, as far as the verdict's
    words allow. A channel with a gap of which no cause is named, or that the named causes leave open on held-out
    trials, makes the second one half at least. Traces in many columns, none of which has a gap, make it one half at
    most.
    """
    if status is Status.NO_GAP and not gaps:
        unlisted = min(found.unlisted, 1.0 - MIN_NAMED_PROBABILITY)
        return max(found.none, 1.0 - unlisted), unlisted
    left_open = status is Status.UNEXPLAINED or (status is Status.PARTLY and not found.ambiguous)
    unlisted = max(found.unlisted, MIN_NAMED_PROBABILITY) if left_open else found.unlisted
    return min(found.none, 1.0 - unlisted), unlisted


def _open(baseline: Baseline) -> frozenset[int]:
    """Columns in which the nominal model alone leaves a gap."""
    null = baseline.null.linear_fit.evidence
    return frozenset(np.flatnonzero(unexplained(baseline.columns.counts, null, baseline.parameters) > A_GAP).tolist())


def _by_share(named, chosen: SearchState, shares: Budget) -> list:
    value, _, _, _ = shares.overall()
    order = {k: v for k, v in zip(chosen.keys, value, strict=True)}
    return sorted(named, key=lambda k: -order.get(k, 0.0))


def _causes(chosen: SearchState, found: Posterior, shares: Budget, fit: Fit) -> tuple[Cause, ...]:
    """One line an effect, with all of its sites that are in."""
    value, ends, _, _ = shares.overall()
    by_channel: dict[tuple[str, str], set[int]] = {}
    for c in sorted(shares.open):
        by_channel.setdefault(shares.channels[c], set()).add(c)
    of_channel = {k: shares.of(cs)[1] for k, cs in by_channel.items()}
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
    _, _, share, ends = shares.overall()
    if status in (Status.NO_GAP, Status.NOT_JUDGED) or not left or left[0].energy <= 0:
        return Unexplained(share, ends, (), None, None)
    worst = left[0]
    variables = sorted(worst.by_variable.items(), key=lambda kv: -kv[1])[:2]
    depends = tuple(k for k, v in variables if v > DEPENDS * worst.energy)
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
    """One line a column with a gap. Its gap in physical units is what is missed beyond the noise at the fit's rate."""
    found = []
    lines = [[i for i, (e, _) in enumerate(chosen.keys) if e == cause.effect] for cause in causes]
    for c in sorted(shares.open):
        column = baseline.columns.items[c]
        missed, noise = _mean_squares(problem, column.experiment, column.channel, column.column)
        _, lost, after = shares.of({c})
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
    """Of what the nominal model misses and of the noise, over the samples that count."""
    stack, noise = problem.stacks[e], problem.noise[e, c]
    mask, y = (np.asarray(a[c]) for a in (stack.batch.mask, stack.batch.y))
    pick = slice(None) if column is None else slice(column, column + 1)
    missed = _about_start((y - problem.predicted[e, c])[pick], mask[pick], c)
    count = max(float(mask[pick].sum()), 1.0)
    of_noise = float((mask[pick] * noise.std[pick, None, None] ** 2).sum()) / count
    return float((missed**2).sum()) / count, of_noise


def _about_start(x: Float[np.ndarray, "columns B T"], mask, channel: str) -> Float[np.ndarray, "columns B T"]:
    """Of excursions, which start anywhere, what is about their mean."""
    x = np.where(mask > 0, x, 0.0)
    if channel == "tendon_excursion":
        x = (x - x.sum(axis=-1, keepdims=True) / np.maximum(mask.sum(axis=-1, keepdims=True), 1.0)) * (mask > 0)
    return x


def _relevance(problem: Problem, baseline: Baseline, tolerance: Mapping[str, float]) -> tuple[Relevance, ...]:
    """Every channel with a gap, in the world: beside what the channel shows in the experiment that moves it most."""
    channels = dict.fromkeys(
        (baseline.columns.items[c].experiment, baseline.columns.items[c].channel) for c in _open(baseline)
    )
    out = []
    for e, c in channels:
        missed, noise = _mean_squares(problem, e, c)
        if missed <= noise:  # what features tell of is too small to be seen beside the noise
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
    return float(np.sqrt((_about_start(x, mask, c) ** 2).sum() / max(float(mask.sum()), 1.0)))


def _not_judged(problem: Problem) -> tuple[NotJudged, ...]:
    why = Reason.NOTHING_COUNTS if problem.simulator is None else Reason.NOT_PREDICTED
    return tuple(NotJudged(x.experiment, x.channel, why) for x in not_judged(problem.stacks))


def _candidates(problem: Problem, search: Search, chosen: SearchState, found: Posterior, shares: Budget, fit: Fit):
    """Every candidate tried, most probable first: as it is in the set, or alone on top of the nominal model."""
    order = sorted(found.causes, key=lambda k: (-found.causes[k], -found.gains[k]))
    inside = {k: values_of(fit, i) for i, k in enumerate(chosen.keys)}
    gain = dict(zip(chosen.keys, shares.overall()[0].tolist(), strict=True))
    others = search.alone(k for k in order if k not in inside)
    likely = [k for k in order if k in others][:HELD_OUT]
    signatures = [search.table.signatures.dense(others[k][0].rows, problem.r.size) for k in likely]
    gain |= dict(zip(likely, held_out_gains(problem, signatures), strict=True))
    values = inside | {k: _alone(problem, search.table, *x) for k, x in others.items()}
    return tuple(
        Candidate(Key(*k), found.causes[k], found.gains[k], gain.get(k, 0.0), values.get(k, ())) for k in order
    )


def _alone(
    problem: Problem, table: SignatureTable, offer: Offer, amplitudes: np.ndarray, std: np.ndarray
) -> tuple[Value, ...]:
    """Amplitudes of a cause on top of the nominal model, linearly, and the shape that suits best."""
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
    out = []
    for key, share in table.absorbed.items():
        if share > NEARLY:
            hidden = table.hidden.get(key, {})
            effect = next(v.effect for v in table.rows if v.key == key)
            units = units_at(problem.nominal.finger, effect, key[1])
            values = tuple(Value(key[1], n, 0.0, s, units[n]) for n, s in hidden.items())
            out.append(Absorbed(Key(*key), share, values))
    return tuple(out)


def _changed(against: Fit, found: Posterior, fit: Fit) -> tuple[Change, ...]:
    """Nominal parameters that are others than an earlier fit found: as that has them, and with what they changed by."""
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
    """For another simulator: the parameters that the measurements contradict most."""
    if problem.simulator is None:
        return ()
    old, new = (np.asarray(ravel(model))[problem.free] for model in (problem.simulator, fit.model))
    std = fit.std[problem.free]
    off = np.abs(new - old)
    weight = off * np.linalg.norm(problem.J, axis=0) * (off > CONTRADICTED * std)
    parameters = describe(problem.nominal)
    return tuple(
        Change(p.name, p.group, p.units, float(old[i]), 0.0, float(new[i]), float(std[i]), 1.0)
        for i in np.argsort(-weight)
        if weight[i] > 0
        for p in [parameters[problem.free[i]]]
    )
