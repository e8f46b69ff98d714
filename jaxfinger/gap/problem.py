"""The gap as one whitened regression: residuals of all trials after a refit of the nominal parameters to all of them.

    r = y − ŷ(θ̂),   r̃ = (I − Q Qᵀ) W r,   z̃ = (I − Q Qᵀ) W Δŷ

W whitens by the noise of each channel. Δŷ is the change of the predictions by a cause. Q spans the whitened Jacobian of
the nominal parameters: the projection removes what they can absorb, which is no evidence (theorem of Frisch, Waugh and
Lovell). This module makes W r and the whitened Jacobian; `signatures` makes W Δŷ; `projector` projects.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import block_diag, csr_array

from jaxfinger.compilation import quick_jit
from jaxfinger.data import Predictions, Session
from jaxfinger.data.schema import CHANNELS
from jaxfinger.effects import Scales
from jaxfinger.errors import UserError
from jaxfinger.experiments import Stack
from jaxfinger.gap.merged_trials import MergedTrials, merged_trials
from jaxfinger.gap.simulator import emulate
from jaxfinger.identify import Fit, Recipe, identify
from jaxfinger.identify.dead_zone import clear_of_dead_zones
from jaxfinger.identify.fit_with_noise import residuals_for_noise
from jaxfinger.identify.intervals import stretches
from jaxfinger.identify.linearise import NO_REVERSALS, White
from jaxfinger.identify.noise import Noise, estimate, history, without_recurring_laws
from jaxfinger.identify.nominal import cad_prior, free_groups, nominal_model
from jaxfinger.identify.parameters import Free, Parameter, describe, ravel
from jaxfinger.identify.prior import Prior, prior_of
from jaxfinger.identify.readings import readings_of
from jaxfinger.identify.reversals import torque_changes, with_reversals
from jaxfinger.identify.solve import ROUGH_TOLERANCE, solve
from jaxfinger.identify.sources import Source, sources_of, white_tangents
from jaxfinger.identify.start import start_values
from jaxfinger.identify.trial_coverage import Coverage, can_determine, coverage_of
from jaxfinger.model import Model, Terms, terms_without_effects
from jaxfinger.progress import Progress

MAX_ROUNDS = 8  # of refits to all trials, each with the noise that the one before leaves
NOISE_CHANGE = 0.2  # relative, of a channel's standard deviation: less changes no interval by as much as a tenth
Noises = dict[tuple[str, str], Noise]  # by experiment and channel


@dataclass(frozen=True)
class Rows:
    """Channel, column, trial and time of each whitened row of one experiment. Masked samples have no row."""

    experiment: str
    start: int  # position of the first row in the vector of all experiments' rows
    keep: Int[np.ndarray, " rows"]  # positions in the flattened block (B, columns of all channels, T) of white rows
    channel: Int[np.ndarray, " rows"]  # index of the channel among the experiment's
    column: Int[np.ndarray, " rows"]  # index of the joint, tendon or axis
    trial: Int[np.ndarray, " rows"]  # index of the trial in the stack
    time: Int[np.ndarray, " rows"]  # index of the sample
    history: Int[np.ndarray, " rows"]  # number of preceding samples that the whitening filter reads
    reversals: dict[str, csr_array]  # (rows, rows) C of `identify.reversals`, of channels that have any

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.keep)


@dataclass(frozen=True)
class Problem:
    """Recordings, nominal model, whitened residuals and Jacobian: the input of the search for effects.

    N rows, p free nominal parameters. Dictionaries are keyed by experiment, or by experiment and channel.
    """

    session: Session
    stacks: dict[str, Stack]
    noise: Noises
    nominal: Model
    free: Int[np.ndarray, " p"]  # positions of the free nominal parameters in the flat vector
    rows: dict[str, Rows]
    groups: list[MergedTrials]  # the same trials, merged by what predicts them
    r: Float[np.ndarray, " N"]  # whitened residuals of the nominal model
    J: Float[np.ndarray, "N p"]  # whitened ∂ŷ/∂θ
    root: Float[np.ndarray, "k p"]  # square root of the prior precision of the free parameters
    offset: Float[np.ndarray, " k"]  # root (θ̂ − prior mean)
    predicted: dict[tuple[str, str], Float[np.ndarray, "_columns _B _T"]]  # ŷ of the nominal model
    fit: Fit  # the staged fit
    sources: dict[str, Source]
    prior: Prior
    scales: Scales  # of the specimen
    simulator: Model | None = None  # the emulator, where another simulator's predictions are diagnosed

    @property
    def trial_of_row(self) -> Int[np.ndarray, " N"]:
        """Number of each row's trial, counted over all experiments."""
        out, first = np.empty(self.r.size, int), 0
        for rows in self.rows.values():
            out[rows.start : rows.start + rows.size] = rows.trial + first
            first += len(self.stacks[rows.experiment].trials)
        return out

    @property
    def column_of_row(self) -> Int[np.ndarray, " N"]:
        """Number of each row's column, counted over all channels of all experiments."""
        kinds = [np.stack([np.full(r.size, e), r.channel, r.column]) for e, r in enumerate(self.rows.values())]
        return np.unique(np.concatenate(kinds, axis=1), axis=1, return_inverse=True)[1]

    @property
    def stretch_of_row(self) -> Int[np.ndarray, " N"]:
        """Number of the stretch of a trial to which each row belongs (`intervals.stretches`)."""
        times = []
        for e, rows in self.rows.items():
            source = self.sources[e]
            times.append(np.asarray(source.batch.x.time)[rows.trial, rows.time] / source.pace)
        return stretches(self.trial_of_row, np.concatenate(times))

    @cached_property
    def without_effects(self) -> dict[tuple[str, bool], tuple[list, list[Terms | None]]]:
        """Predictions of the nominal model by channel and whether joints are held, block by block of the group.

        Each value holds `predicted` (columns, B, T) of every block and, for torques and forces, the terms of
        equation (1) that it is computed from.
        """

        def terms(group: MergedTrials) -> list[Terms | None]:
            return [
                None if group.channel == "tendon_excursion" else _terms_without_effects(self.nominal, x)
                for x in group.x
            ]

        return {(g.channel, g.held): (g.merged(self.predicted), terms(g)) for g in self.groups}

    @property
    def trial_names(self) -> list[str]:
        """Names of the trials, in the order of the numbers in `trial_of_row`."""
        return [t for e in self.rows for t in self.stacks[e].trials]


_terms_without_effects = quick_jit(terms_without_effects)


def build(
    session: Session,
    recipe: Recipe,
    progress: Progress = lambda message: None,
    predictions: Predictions | None = None,
    coarse: int = 1,
    against: Fit | None = None,
) -> Problem:
    """Identify the nominal model, refit it to all trials together, and stack the whitened residuals.

    Args:
        session: the recordings.
        recipe: the nominal model; with `against`, the recipe of that fit.
        progress: called with a message before each step.
        predictions: of another simulator, which then takes the nominal model's place (see `simulator`).
        coarse: factor by which averages are longer, as in `experiments.prepare`.
        against: an earlier fit of the same finger. Its values start the identification, and its covariance is the
            prior of the refit.

    Raises:
        UserError: `predictions` has none of the session's trials, or does not fit them; `against` is of another finger
            or holds effects.
    """
    progress("reading the recordings")
    measured = stacks = readings_of(session, coarse=coarse, reversals=True)
    simulator = None
    if predictions is not None:
        progress("imitating the simulator")
        simulator, recipe, stacks = emulate(session, recipe, stacks, predictions, coarse)
    earlier = None if against is None else _start_from(session, against)
    fit = identify(session, recipe, start=earlier, progress=progress, stacks=measured)
    stacks = clear_of_dead_zones(stacks, fit.model, session)
    progress("refitting the nominal model to all trials")
    return Problem(
        session=session,
        stacks=stacks,
        fit=fit,
        scales=Scales.of(fit.model.finger, [s.batch for s in measured.values()]),
        simulator=simulator,
        **_refitted_to_all(session, fit, stacks, fit.noise, against),
    )


def without_recurring_noise(problem: Problem, against: Fit | None = None) -> Problem | None:
    """The problem with the noise of passes through the same states, where no trial repeats a motion.

    The noise of such trials is otherwise that of residuals, in which a quick law of the state counts as noise. None
    where no standard deviation becomes less by the share `NOISE_CHANGE`. `against`: as in `build`.
    """
    if _settled(problem.noise, _noise_of_all(problem.noise, problem.stacks, problem.nominal, recurring=True)):
        return None
    known = problem.fit.noise | {key: n for key, n in problem.noise.items() if n.of_repeats}
    return replace(problem, **_refitted_to_all(problem.session, problem.fit, problem.stacks, known, against, True))


def with_noise(problem: Problem, noise: Noises, against: Fit | None = None) -> Problem:
    """The problem with other noise in some channels; itself where no standard deviation changes by `NOISE_CHANGE`.

    `against`: as in `build`.
    """
    if _settled(problem.noise, noise):
        return problem
    known = problem.fit.noise | noise
    return replace(problem, **_refitted_to_all(problem.session, problem.fit, problem.stacks, known, against))


def _refitted_to_all(
    session: Session,
    fit: Fit,
    stacks: dict[str, Stack],
    known: Noises,
    against: Fit | None,
    recurring: bool = False,
) -> dict[str, Any]:
    """Refit what the stages have estimated, and what they have not but some trial shows, to all trials together.

    `known`, `recurring`: as in `_noise_of_all`. Returns the fields of a `Problem` that follow from the refit.
    """
    parameters, coverage = describe(fit.model), coverage_of(stacks, session)
    variance = np.diag(fit.covariance)
    cad = np.flatnonzero((variance > 0.0) & np.isfinite(variance))  # what the description gives with an uncertainty
    free = np.union1d(fit.estimated, cad).astype(int)
    reads = {e: stack.experiment.channels for e, stack in stacks.items()}
    changes = {e: torque_changes(stack, fit.model) for e, stack in stacks.items()}

    def prior_on(free: Int[np.ndarray, " _p"]) -> Prior:
        if against is None:
            return cad_prior(session, fit.recipe, parameters, free)
        return prior_of(np.asarray(ravel(against.model)), against.covariance, free)

    nominal, latest, shown = fit.model, _noise_of_all(known, stacks, fit.model, recurring), free
    for _ in range(MAX_ROUNDS):
        noise, before = latest, shown
        sources = sources_of(stacks, reads, noise, parameters)
        sources = {e: with_reversals(source, changes[e]) for e, source in sources.items()}
        # Some parameters show only after a refit: a tendon whose moment arms are zero shows no friction.
        nominal, shown = _with_unfitted(nominal, free_groups(fit.recipe), free, sources, parameters, coverage)
        prior = prior_on(shown)
        nominal, solution = solve(nominal, shown, sources, prior, tolerance=ROUGH_TOLERANCE)
        if shown.size == free.size:
            break
        # Residuals held what the added parameters explain, so noise estimated from them was too large.
        latest = _noise_of_all(known, stacks, nominal, recurring)
        if shown.size == before.size and _settled(noise, latest):
            break
    rows = _layouts(sources)
    return {
        "noise": noise,
        "free": shown,
        "rows": rows,
        "groups": _groups(stacks, rows, nominal),
        "root": np.asarray(prior.root),
        "sources": sources,
        "prior": prior,
        **_at(nominal, solution.linearised, sources, rows, shown, prior),
    }


def _start_from(session: Session, against: Fit) -> Fit:
    """A start for `identify`: the session's own finger with the nominal parameters and covariance of an earlier fit.

    Raises:
        UserError: the fit is of another finger, or holds effects.
    """
    theirs, file = against.model.finger, session.file or "the session"
    model = nominal_model(session, against.recipe)
    ours = model.finger
    if (theirs.joint_names, theirs.tendon_names) != (ours.joint_names, ours.tendon_names):
        raise UserError(f"{file}: is of another finger than the fit; both need the same joints and tendons")
    if against.model.effects:
        raise UserError(
            f"{file}: the fit to compare it with holds effects; give one of the nominal model, as `identify` writes it"
        )
    known = np.union1d(against.estimated, np.flatnonzero(np.diag(against.covariance))).astype(int)
    model = Free.at(model, known).set(model, np.asarray(ravel(against.model))[known])
    before = Fit.before(session, against.recipe, model)
    return replace(before, covariance=against.covariance, estimated=against.estimated)


def site(problem: Problem, channel: str, column: int) -> str:
    """Name of the joint, tendon or axis that is column number `column` of a channel."""
    return CHANNELS[channel].columns(problem.session.finger)[column]


def moved(problem: Problem, by: Float[np.ndarray, " p"]) -> Problem:
    """The problem at another nominal model, whose free parameters differ by `by`; residuals and Jacobian are exact."""
    at = Free.at(problem.nominal, problem.free)
    nominal = at.set(problem.nominal, np.asarray(at.get(problem.nominal)) + by)
    white = white_tangents(nominal, problem.sources)
    return replace(problem, **_at(nominal, white, problem.sources, problem.rows, problem.free, problem.prior))


def imagined(problem: Problem, stacks: dict[str, Stack]) -> Problem:
    """The problem with trials that nobody has run: rows, predictions and Jacobian hold, measured channels are filler.

    A channel of an experiment that the session lacks gets the noise of `_noise_elsewhere`.
    """
    known = dict(problem.noise)
    for e, stack in stacks.items():
        for c in stack.experiment.channels:
            if (e, c) not in known:
                known[e, c] = _noise_elsewhere(problem, c, len(stack.batch.y[c]))
    sources = {
        e: problem.sources[e]._replace(batch=stack.batch, reversals=NO_REVERSALS)
        if e in problem.sources
        else sources_of({e: stack}, {e: stack.experiment.channels}, known, describe(problem.nominal))[e]
        for e, stack in stacks.items()
    }
    rows, white = _layouts(sources), white_tangents(problem.nominal, sources)
    at = _at(problem.nominal, white, sources, rows, problem.free, problem.prior)
    groups = _groups(stacks, rows, problem.nominal)
    return replace(problem, stacks=stacks, sources=sources, rows=rows, groups=groups, noise=known, **at)


def _noise_elsewhere(problem: Problem, channel: str, columns: int) -> Noise:
    """White noise with the largest standard deviation that the channel has in any experiment.

    A force sensor that was never recorded is assumed to be as good as the torque sensor at the length of the finger.
    Where no torque was recorded either, 1e-3 N m stands in, a guess at a small torque sensor.
    """

    def largest(c: str) -> float | None:
        return max((float(n.std.max()) for (_, k), n in problem.noise.items() if k == c), default=None)

    length = problem.session.finger.length
    std = np.full(columns, largest(channel) or (largest("joint_torque") or 1e-3) / length)
    return Noise.white(std, "elsewhere")


def _at(nominal: Model, white: Mapping[str, White], sources, rows, free, prior: Prior) -> dict[str, Any]:
    """The fields of a problem that depend on its nominal model."""
    r, J = assemble(white, sources, rows, free, ravel(nominal).size)
    return {
        "nominal": nominal,
        "r": r,
        "J": J,
        "offset": np.asarray(prior.root) @ (np.asarray(ravel(nominal))[free] - np.asarray(prior.mean)),
        "predicted": {
            (e, c): np.asarray(sources[e].batch.y[c]) - np.asarray(residuals)
            for e, x in white.items()
            for c, residuals in x.residuals.items()
        },
    }


def _groups(stacks: dict[str, Stack], rows: dict[str, Rows], nominal: Model) -> list[MergedTrials]:
    return merged_trials({e: stack for e, stack in stacks.items() if rows[e].size}, nominal)


def _layouts(sources: dict[str, Source]) -> dict[str, Rows]:
    """Rows of all experiments, each experiment's after those of the one before."""
    rows, start = {}, 0
    for e, source in sources.items():
        rows[e] = _layout(e, source, start)
        start += rows[e].size
    return rows


def assemble(
    white: Mapping[str, White],
    sources: dict[str, Source],
    rows: dict[str, Rows],
    free: Int[np.ndarray, " p"],
    size: int,
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N p"]]:
    """Stack white residuals, and the derivatives of white predictions by the free parameters.

    `size` is the length of the flat vector of all parameters, of which `free` are positions.
    """
    N, column = sum(rows[e].size for e in white), np.full(size, -1)
    column[free] = np.arange(free.size)
    r, J = np.empty(N), np.zeros((N, free.size))
    for e, x in white.items():
        keep, at = rows[e].keep, slice(rows[e].start, rows[e].start + rows[e].size)
        r[at] = x.white.reshape(-1)[keep]
        mine = np.flatnonzero(column[sources[e].positions] >= 0)
        J[at, column[sources[e].positions[mine]]] = -x.jacobian.reshape(-1, x.jacobian.shape[-1])[keep[:, None], mine]
    return r, J


def _noise_of_all(known: Noises, stacks: dict[str, Stack], model: Model, recurring: bool) -> Noises:
    """Noise of all channels: as known, and estimated from the model's residuals where no stage has read the channel.

    `recurring`: what comes from residuals is without the laws that recur with the state.
    """
    sure = {key: n for key, n in known.items() if not (recurring and n.source == "residuals")}
    left = residuals_for_noise(model, stacks, {e: stack.experiment.channels for e, stack in stacks.items()}, sure)
    noise = known | {(e, c): estimate(stacks[e], c, x) for (e, c), x in left.items() if (e, c) not in known}
    if recurring:
        noise |= {(e, c): without_recurring_laws(noise[e, c], stacks[e], c, x) for (e, c), x in left.items()}
    return noise


def _settled(before: Noises, now: Noises) -> bool:
    """Whether no standard deviation of noise has changed by more than `NOISE_CHANGE`."""
    return all(np.allclose(n.std, before[key].std, rtol=NOISE_CHANGE, atol=0.0) for key, n in now.items())


def _with_unfitted(
    model: Model,
    groups: set[str],
    free: Int[np.ndarray, " p"],
    sources: dict[str, Source],
    parameters: list[Parameter],
    coverage: Coverage,
) -> tuple[Model, Int[np.ndarray, " q"]]:
    """Add to `free` the other parameters of `groups` that some trial shows; return model and positions.

    A stage is skipped where its experiment is missing: without ID.3-dynamic none estimates damping, though VD.3 shows
    it. Left at zero, such a parameter would pass for a gap. The model holds start values of the added parameters.
    """
    unfitted = [i for i, p in enumerate(parameters) if p.group in groups and p.determinable and i not in set(free)]
    unfitted = [i for i in unfitted if len(parameters[i].spans) < 2 or can_determine(parameters[i], coverage)]
    start = start_values(model, np.array(unfitted, dtype=int), parameters, sources)
    seen = set()
    for e, x in white_tangents(start, sources if unfitted else {}).items():
        seen |= set(sources[e].positions[np.any(x.jacobian != 0.0, axis=(0, 1))])
    added = np.array([i for i in unfitted if i in seen], dtype=int)
    return start_values(model, added, parameters, sources), np.union1d(free, added).astype(int)


def _layout(experiment: str, source: Source, start: int) -> Rows:
    """Rows of the samples that count, in the order of `white_rows`: trial, column of a channel, time."""
    counts, before, channel, column = [], [], [], []
    for number, (c, filters) in enumerate(source.filters.items()):
        mask = np.asarray(source.batch.mask[c])
        counts.append(np.moveaxis(mask, 1, 0))
        before.append(np.moveaxis(np.asarray(history(mask, filters.shape[1] - 1), int), 1, 0))
        channel += [number] * len(mask)
        column += list(range(len(mask)))
    block = np.concatenate(counts, axis=1)  # (B, columns of all channels, T)
    keep = np.flatnonzero(block)
    trial, wide, time = np.unravel_index(keep, block.shape)
    rows = Rows(
        experiment,
        start,
        keep,
        np.array(channel)[wide],
        np.array(column)[wide],
        trial,
        time,
        np.concatenate(before, axis=1).reshape(-1)[keep],
        {},
    )
    return replace(rows, reversals=_reversals(source, rows))


def _reversals(source: Source, rows: Rows) -> dict[str, csr_array]:
    """C of `identify.reversals`, by channel, in the order of the rows."""
    out = {}
    for c, columns in source.reversals.items():
        mine = np.flatnonzero(rows.channel == list(source.filters).index(c))
        where = rows.column[mine], rows.trial[mine], rows.time[mine]
        at = np.ravel_multi_index(where, source.batch.mask[c].shape)
        place = csr_array((np.ones(at.size), (mine, at)), (rows.size, source.batch.mask[c].size))
        out[c] = csr_array(place @ block_diag(columns, "csr") @ place.T)
    return out
