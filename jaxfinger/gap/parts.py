"""Parts of a diagnosis beside its verdict, from the results of the search, of the fits and on held-out trials."""

from collections.abc import Collection, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from jaxfinger.data.schema import channel_units
from jaxfinger.effects import Changed
from jaxfinger.experiments import EXPERIMENTS, not_judged
from jaxfinger.gap.augment import prior_std, values_of
from jaxfinger.gap.budget import MIN_GAP_EVIDENCE, Budget, held_out_gains
from jaxfinger.gap.closure import centred
from jaxfinger.gap.columns import Columns, Counts
from jaxfinger.gap.costs import CauseKey
from jaxfinger.gap.exact import Baseline, SearchState
from jaxfinger.gap.formula import Evidence, Parameters, Weights, likelihood_gain, unexplained
from jaxfinger.gap.posterior import Posterior
from jaxfinger.gap.problem import Problem, site
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.propose import propose
from jaxfinger.gap.result import (
    MIN_SHARE,
    Absorbed,
    Candidate,
    Cause,
    Change,
    ChannelBudget,
    ExperimentChannel,
    Key,
    NotJudged,
    Reason,
    Relevance,
    Status,
    Unexplained,
    Value,
)
from jaxfinger.gap.sets import Alone, Search
from jaxfinger.gap.signature_table import Offer, SignatureTable
from jaxfinger.gap.smooth_laws import SmoothPart
from jaxfinger.identify import Fit
from jaxfinger.identify.parameters import Parameter, describe, effect_parameter, ravel, units_at
from jaxfinger.progress import Progress

# The thresholds of this module decide what a report mentions, and no verdict.
# Share of a signature's energy that the nominal parameters imitate, from which a cause is listed as absorbed: of what
# it changes, a tenth in rms is then left to see.
MIN_ABSORBED = 0.99
MIN_VARIABLE_SHARE = 0.2  # Share of the smooth law's energy that one variable must explain to be listed.
MAX_HELD_OUT = 12  # Candidates outside of the chosen set, most probable first, that are tried on held-out trials.
MIN_DEVIATION = 3.0  # Standard deviations: the usual three sigma, by which a simulator's parameter must be off.


def columns_with_gap(counts: Counts, null: Evidence, chosen: Evidence, p: Parameters) -> frozenset[int]:
    """Numbers of the columns in which the nominal model alone leaves a gap.

    There smooth features alone, or the causes of the chosen set, bring evidence that something is at work. Causes that
    act within short times, as friction does at reversals, show outside of the features.
    """
    found = np.maximum(unexplained(counts, null, p), likelihood_gain(counts, null, chosen, p))
    return frozenset(np.flatnonzero(found > MIN_GAP_EVIDENCE).tolist())


def by_share(named: Iterable[CauseKey], chosen: SearchState, shares: Budget) -> list[CauseKey]:
    """Named causes, largest share of the gap first."""
    order = dict(zip(chosen.keys, shares.overall.of_causes, strict=True))
    return sorted(named, key=lambda k: -order.get(k, 0.0))


def causes_of(chosen: SearchState, found: Posterior, shares: Budget, fit: Fit) -> tuple[Cause, ...]:
    """One line for each effect of the chosen set, its sites together, largest share first."""
    value, ends = shares.overall.of_causes, shares.overall.of_causes_ci95
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
                    if lost[at].sum() > MIN_SHARE
                },
                tuple(v for i in at for v in values_of(fit, i)),
            )
        )
    return tuple(sorted(out, key=lambda c: -c.share))


def unexplained_part(
    chosen: SearchState, shares: Budget, left: list[SmoothPart], status: Status, progress: Progress
) -> Unexplained:
    """Share of the gap that the chosen set leaves, the variables that it depends on, and a closed form for it."""
    share, ends = shares.overall.left, shares.overall.left_ci95
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


def channel_budgets(
    problem: Problem, baseline: Baseline, chosen: SearchState, causes: tuple[Cause, ...], shares: Budget
) -> tuple[ChannelBudget, ...]:
    """One line for each column with a gap; gap and noise are rms values in physical units at the fit's sample rate."""
    found = []
    lines = [[i for i, (e, _) in enumerate(chosen.keys) if e == cause.effect] for cause in causes]
    for c in sorted(shares.open):
        column = baseline.columns.items[c]
        missed, noise = mean_squares(problem, column.experiment, column.channel, column.column)
        lost, after = shares.of([c])
        found.append(
            ChannelBudget(
                column.experiment,
                column.channel,
                site(problem, column.channel, column.column),
                channel_units(column.channel, problem.session.finger.prismatic, column.column),
                noise**0.5,
                max(missed - noise, 0.0) ** 0.5,
                tuple(float(lost[at].sum()) for at in lines),
                after,
            )
        )
    return tuple(found)


def mean_squares(problem: Problem, e: str, c: str, column: int | None = None) -> tuple[float, float]:
    """Mean squares of the nominal model's residual and of the noise, over the samples that count, in squared units."""
    stack, noise = problem.stacks[e], problem.noise[e, c]
    mask, y = (np.asarray(a[c]) for a in (stack.batch.mask, stack.batch.y))
    pick = slice(None) if column is None else slice(column, column + 1)
    missed = centred((y - problem.predicted[e, c])[pick], mask[pick], c)
    count = max(float(mask[pick].sum()), 1.0)
    of_noise = float((mask[pick] * noise.std[pick, None, None] ** 2).sum()) / count
    return float((missed**2).sum()) / count, of_noise


def relevance_of(
    problem: Problem, columns: Columns, with_gap: Collection[int], tolerance: Mapping[str, float]
) -> tuple[Relevance, ...]:
    """Size of each channel's gap, and relative to the channel's signal in the experiment that moves it most."""
    items = [columns.items[c] for c in sorted(with_gap)]
    out = []
    for e, c in dict.fromkeys((x.experiment, x.channel) for x in items):
        missed, noise = mean_squares(problem, e, c)
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


def channels_not_judged(problem: Problem, columns: Columns) -> tuple[NotJudged, ...]:
    """Channels of which no sample counts, and channels of which too few count to make a column."""
    out = [NotJudged(x.experiment, x.channel, _why_nothing(problem, *x[:2])) for x in not_judged(problem.stacks)]
    # Of another simulator, experiments without any prediction have no stack.
    for e in dict.fromkeys(t.experiment for t in problem.session if t.experiment not in problem.stacks):
        channels = EXPERIMENTS[e].channels if problem.simulator is not None and e in EXPERIMENTS else ()
        out += [NotJudged(e, c, Reason.NOT_PREDICTED) for c in channels if _recorded(problem, e, c)]
    known = {(x.experiment, x.channel) for x in (*out, *columns.items)}
    few = [(e, c) for e, s in problem.stacks.items() for c in s.experiment.channels if (e, c) not in known]
    return (*out, *(NotJudged(e, c, Reason.FEW_SAMPLES) for e, c in few))


def _why_nothing(problem: Problem, e: str, c: str) -> Reason:
    """Why no sample of a channel counts. With another simulator a stack lacks what it does not predict, too."""
    if problem.stacks[e].measured[c]:
        return Reason.NOTHING_COUNTS
    return Reason.NOT_PREDICTED if problem.simulator is not None and _recorded(problem, e, c) else Reason.NOT_MEASURED


def _recorded(problem: Problem, e: str, c: str) -> bool:
    """Whether any trial holds a channel. The torque of a free finger is zero, and known without a sensor."""
    if c == "joint_torque" and EXPERIMENTS[e].unloaded:
        return True
    values = (getattr(t, c) for t in problem.session if t.experiment == e)
    return any(v is not None and bool(np.isfinite(v).any()) for v in values)


def candidates_of(
    problem: Problem, search: Search, chosen: SearchState, found: Posterior, shares: Budget, fit: Fit
) -> tuple[Candidate, ...]:
    """All candidates, most probable first.

    Values and held-out share of a member of the chosen set are those in the set, of others those alone on top of the
    nominal model.
    """
    order = sorted(found.causes, key=lambda k: (-found.causes[k], -found.gains[k]))
    inside = {k: values_of(fit, i) for i, k in enumerate(chosen.keys)}
    gain = dict(zip(chosen.keys, shares.overall.of_causes.tolist(), strict=True))
    others = search.alone(k for k in order if k not in inside)
    likely = [k for k in order if k in others][:MAX_HELD_OUT]
    signatures = [search.table.signatures.dense(others[k].offer.rows, problem.r.size) for k in likely]
    gain |= dict(zip(likely, held_out_gains(problem, signatures), strict=True))
    values = inside | {k: _alone(problem, search.table, x) for k, x in others.items()}
    return tuple(Candidate(Key(*k), found.causes[k], gain.get(k, 0.0), values.get(k, ())) for k in order)


def _alone(problem: Problem, table: SignatureTable, x: Alone) -> tuple[Value, ...]:
    """Values of a cause alone on top of the nominal model: amplitudes by linear least squares, and the best shape.

    An amplitude that the trials cannot see, and a shape that was tried at one value, are as uncertain as before them.
    """
    (variant,), names = x.offer.variants, list(x.offer.variants[0].sizes)
    units = units_at(problem.nominal.finger, variant.effect, variant.site)
    found = dict.fromkeys(names, 0.0)
    std: dict[str, float] = {}
    of_row = dict(zip(table.rows[variant].tolist(), names, strict=True))
    for row, a, s in zip(x.offer.rows.tolist(), x.amplitudes, x.std, strict=True):
        unit = table.units[row] * variant.sizes[of_row[row]]
        found[of_row[row]], std[of_row[row]] = float(a * unit), float(s * unit)
    unknown = prior_std(problem.scales, variant.at(problem.nominal.finger, found)).values()
    fixed = {n: 0.0 for n, p in variant.effect.shape_parameters().items() if p.moves == "not"}
    std = unknown | {n: min(s, unknown[n]) for n, s in _shape_spread(x.tried, x.net).items()} | std | fixed
    return tuple(Value(variant.site, n, v, std[n], units[n]) for n, v in (found | dict(variant.shape)).items())


def _shape_spread(tried: Sequence[Offer], net: Float[np.ndarray, " tried"]) -> dict[str, float]:
    """Standard deviation of each shape about its best value, over the values tried of one cause, by their evidence.

    A value stands for the cell of the grid around it, over which the shape is evenly spread. Shapes that were tried at
    one value are left out.
    """
    weight = np.exp(net - net.max())
    weight /= weight.sum()
    shapes = [dict(offer.variants[0].shape) for offer in tried]
    best, out = shapes[int(np.argmax(weight))], {}
    for name, middle in best.items():
        values = np.array([s[name] for s in shapes])
        grid = np.unique(values)
        if len(grid) > 1:
            cell = float(np.gradient(grid)[np.searchsorted(grid, middle)])
            out[name] = float(np.sqrt(weight @ (values - middle) ** 2 + cell**2 / 12.0))
    return out


def absorbed_causes(problem: Problem, table: SignatureTable, blamed: Collection[CauseKey]) -> tuple[Absorbed, ...]:
    """Causes whose signatures the nominal parameters imitate, with the amplitudes that could stay hidden.

    `blamed` are causes that the verdict names or cannot tell apart: these trials do show them.
    """
    out = []
    for key, share in table.absorbed.items():
        if share > MIN_ABSORBED and key not in blamed:
            hidden = table.hidden.get(key, {})
            effect = next(v.effect for v in table.rows if v.key == key)
            units = units_at(problem.nominal.finger, effect, key[1])
            values = tuple(Value(key[1], n, 0.0, s, units[n]) for n, s in hidden.items())
            out.append(Absorbed(Key(*key), share, values))
    return tuple(out)


def changed_parameters(against: Fit, found: Posterior, fit: Fit) -> tuple[Change, ...]:
    """Nominal parameters that have changed since an earlier fit: values before, and after with the change added."""
    old, new, parameters = np.asarray(ravel(against.model)), np.asarray(ravel(fit.model)), describe(fit.model)
    at = {p.name: i for i, p in enumerate(parameters)}
    out = []
    for effect in fit.model.effects:
        if not isinstance(effect, Changed):
            continue
        for i, name in zip(altered_by(effect, parameters), effect.amplitudes(), strict=False):
            pair = [i, at[effect_parameter(effect, name)]]
            std = float(np.sqrt(max(fit.covariance[np.ix_(pair, pair)].sum(), 0.0)))
            p, probability = parameters[i], found.causes[effect.ID, effect.site]
            after = float(new[pair].sum())
            out.append(Change(p.name, p.group, p.units, float(old[i]), float(against.std[i]), after, std, probability))
    return tuple(out)


def altered_by(effect: Changed, parameters: Sequence[Parameter]) -> list[int]:
    """Positions of the nominal parameters that a change alters, in the order of its amplitudes."""
    mine = [i for i, p in enumerate(parameters) if p.group == effect.GROUP and p.determinable]
    return [i for i in mine if {parameters[i].joint, parameters[i].tendon} - {None} == set(effect.site)][effect.FIRST :]


def retuned_parameters(problem: Problem, fit: Fit) -> tuple[Change, ...]:
    """Parameters of another simulator that the measurements contradict; the law that changes predictions most first.

    A law's coefficients trade off: what it changes is the change by all of them together.
    """
    if problem.simulator is None:
        return ()
    old, new = (np.asarray(ravel(model))[problem.free] for model in (problem.simulator, fit.model))
    change, std, every = new - old, fit.std[problem.free], describe(problem.nominal)
    parameters = [every[i] for i in problem.free]
    laws = [(p.group, p.joint, p.tendon) for p in parameters]
    moves = problem.J * change  # the predictions, by each parameter alone
    alone = np.linalg.norm(moves, axis=0)
    together = {law: np.linalg.norm(moves[:, [x == law for x in laws]].sum(axis=1)) for law in set(laws)}
    contradicted = np.flatnonzero((np.abs(change) > MIN_DEVIATION * std) & (alone > 0.0))
    return tuple(
        Change(p.name, p.group, p.units, float(old[k]), 0.0, float(new[k]), float(std[k]), 1.0)
        for k in sorted(contradicted, key=lambda k: (together[laws[k]], alone[k]), reverse=True)
        for p in [parameters[k]]
    )
