"""The gap as one whitened regression: every trial's residuals after the nominal parameters are refitted to all of them.

    r = y − ŷ(θ̂),   r̃ = (I − Q Qᵀ) W r,   z̃ = (I − Q Qᵀ) W ∂ŷ/∂a

Q spans the whitened Jacobian of the nominal parameters: what they can absorb is no evidence (Frisch–Waugh–Lovell).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxfinger.data import Predictions, Session
from jaxfinger.effects import Scales
from jaxfinger.errors import UserError
from jaxfinger.experiments import Stack, prepare
from jaxfinger.gap.merged_trials import MergedTrials, merged_trials
from jaxfinger.gap.simulator import emulate
from jaxfinger.identify import Fit, Recipe, identify
from jaxfinger.identify.cluster_robust import stretches
from jaxfinger.identify.linearise import Linearised
from jaxfinger.identify.noise import Noise, estimate, history
from jaxfinger.identify.parameters import Free, Parameter, describe, ravel
from jaxfinger.identify.prior import Prior, prior_of
from jaxfinger.identify.solve import Source, linearise_each, solve
from jaxfinger.identify.stages import (
    Progress,
    cad_prior,
    can_determine,
    coverage_of,
    free_groups,
    nominal_model,
    residuals_for_noise,
    sources_of,
)
from jaxfinger.identify.start import start_values
from jaxfinger.model import Model, Terms, plain_terms


@dataclass(frozen=True)
class Rows:
    """Where the rows of one experiment come from: indices into (columns of its channels, trial, time)."""

    experiment: str
    start: int  # first row in the stacked vector
    keep: np.ndarray  # (rows,) positions in the flattened (B, channels × T) block
    channel: np.ndarray  # (rows,) index of the channel among the experiment's
    column: np.ndarray  # (rows,) joint, tendon or axis
    trial: np.ndarray  # (rows,) index of the trial in the stack
    time: np.ndarray  # (rows,) index of the sample
    history: np.ndarray  # (rows,) samples before it that the whitening reads

    @property
    def size(self) -> int:
        """Number of rows."""
        return len(self.keep)


@dataclass(frozen=True)
class Problem:
    """Everything that the search for effects reads."""

    session: Session
    stacks: dict[str, Stack]
    noise: dict[tuple[str, str], Noise]
    nominal: Model
    free: np.ndarray  # positions of the nominal parameters in the flat vector
    rows: dict[str, Rows]
    groups: list[MergedTrials]  # the trials of the rows, merged
    r: Float[np.ndarray, " N"]  # whitened residuals of the nominal model
    J: Float[np.ndarray, "N p"]  # their Jacobian, whitened
    root: Float[np.ndarray, "k p"]  # prior rows on the nominal parameters
    offset: Float[np.ndarray, " k"]  # root (θ̂ − μ)
    predicted: dict[tuple[str, str], np.ndarray]  # ŷ of the nominal model, (columns, B, T)
    fit: Fit  # the staged fit
    sources: dict[str, Source]
    prior: Prior
    scales: Scales  # of the specimen
    simulator: Model | None = None  # the emulator, where another simulator's predictions are diagnosed

    @property
    def trial_of_row(self) -> np.ndarray:
        """(N,) running number of each row's trial over all experiments."""
        out, first = np.empty(self.r.size, int), 0
        for rows in self.rows.values():
            out[rows.start : rows.start + rows.size] = rows.trial + first
            first += len(self.stacks[rows.experiment].trials)
        return out

    @property
    def block_of_row(self) -> np.ndarray:
        """(N,) running number of the stretch of a trial that a row lies in (`cluster_robust.stretches`)."""
        times = []
        for e, rows in self.rows.items():
            source = self.sources[e]
            times.append(np.asarray(source.batch.x.time)[rows.trial, rows.time] / source.pace)
        return stretches(self.trial_of_row, np.concatenate(times))

    @cached_property
    def columns(self) -> list[tuple[str, str, int]]:
        """Experiment, channel and column of every measured column."""
        return [
            (e, c, k)
            for e, stack in self.stacks.items()
            for c in stack.experiment.channels
            for k in range(len(stack.batch.y[c]))
        ]

    @cached_property
    def column_of_row(self) -> np.ndarray:
        """(N,) position in `columns` of every row."""
        position = {key: i for i, key in enumerate(self.columns)}
        out = np.empty(self.r.size, int)
        for e, rows in self.rows.items():
            channels = self.stacks[e].experiment.channels
            keys = zip(rows.channel, rows.column, strict=True)
            out[rows.start : rows.start + rows.size] = [position[e, channels[c], int(k)] for c, k in keys]
        return out

    @cached_property
    def without_effects(self) -> dict[tuple[str, bool], tuple[list, list[Terms | None]]]:
        """What the nominal model says of every block of the groups, by channel and whether joints are held:
        `predicted`, (columns, B, T), and the terms of (1) behind a torque or a force.
        """

        def behind(group: MergedTrials) -> list[Terms | None]:
            return [None if group.channel == "tendon_excursion" else _plain(self.nominal, x) for x in group.x]

        return {(g.channel, g.held): (g.merged(self.predicted), behind(g)) for g in self.groups}

    @property
    def trial_names(self) -> list[str]:
        """Names in the order of `trial_of_row`."""
        return [t for e in self.rows for t in self.stacks[e].trials]


_plain = eqx.filter_jit(plain_terms)


def build(
    session: Session,
    recipe: Recipe,
    progress: Progress = lambda message: None,
    predictions: Predictions | None = None,
    coarse: int = 1,
    against: Fit | None = None,
) -> Problem:
    """Identify the nominal model, refit it to all trials together, and stack the whitened residuals.

    With `predictions` another simulator takes the nominal model's place (see `simulator`); `coarse` as in `prepare`.
    With `against` an earlier fit is where the search starts, and its covariance the prior: `recipe` is that fit's.
    """
    progress("reading the recordings")
    measured = stacks = prepare(session, coarse=coarse)
    simulator = None
    if predictions is not None:
        progress("imitating the simulator")
        simulator, recipe, stacks = emulate(session, recipe, stacks, predictions, coarse)
    earlier = None if against is None else _as_found(session, against)
    fit = identify(session, recipe, start=earlier, progress=progress, stacks=measured)
    parameters = describe(fit.model)
    progress("refitting the nominal model to all trials")
    cad = [i for i, p in enumerate(parameters) if p.group in ("mass", "com") and fit.covariance[i, i] > 0]
    cad = np.setdiff1d(cad, fit.estimated)
    free = np.union1d(fit.estimated, cad).astype(int)

    def known(free: np.ndarray) -> Prior:
        if against is None:
            return cad_prior(session, recipe, parameters, free)
        return prior_of(np.asarray(ravel(against.model)), against.covariance, free)

    noise = _with_unknown(fit.noise, stacks, fit.model)
    reads = {e: stack.experiment.channels for e, stack in stacks.items()}
    sources = sources_of(stacks, reads, noise, parameters)
    start, more = _with_missing_stages(fit, free, sources, parameters, coverage_of(stacks, session))
    if more.size > free.size:  # what no stage had fitted was no noise
        start, _ = solve(start, more, sources, known(more))
        noise = _with_unknown(fit.noise, stacks, start)
        sources, free = sources_of(stacks, reads, noise, parameters), more
    prior = known(free)
    nominal, solution = solve(start, free, sources, prior)

    rows = layouts(stacks, sources)
    return Problem(
        session=session,
        stacks=stacks,
        noise=noise,
        free=free,
        rows=rows,
        groups=_groups(stacks, rows, nominal),
        root=np.asarray(prior.root),
        fit=fit,
        sources=sources,
        prior=prior,
        scales=Scales.of(nominal.finger, [s.batch for s in measured.values()]),
        simulator=simulator,
        **_at(nominal, solution.linearised, sources, rows, free, prior),
    )


def _as_found(session: Session, against: Fit) -> Fit:
    """The session's own finger, and in it what the earlier fit says of its nominal parameters.

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
    model = Free.at(model, known).set(model, jax.device_put(np.asarray(ravel(against.model))[known]))
    before = Fit.before(session, against.recipe, model)
    return replace(before, covariance=against.covariance, estimated=against.estimated)


def site(problem: Problem, channel: str, column: int) -> str:
    """Name of a channel's column."""
    finger = problem.nominal.finger
    names = {"joint_torque": finger.joint_names, "tendon_excursion": finger.tendon_names}.get(channel, ("x", "y", "z"))
    return names[column]


def moved(problem: Problem, by: Float[np.ndarray, " p"]) -> Problem:
    """The same rows at another nominal model: its free parameters moved, residuals and Jacobian exact there."""
    at = Free.at(problem.nominal, problem.free)
    nominal = at.set(problem.nominal, jax.device_put(np.asarray(at.get(problem.nominal)) + by))
    linearised = linearise_each(nominal, problem.sources)
    return replace(problem, **_at(nominal, linearised, problem.sources, problem.rows, problem.free, problem.prior))


def imagined(problem: Problem, stacks: dict[str, Stack]) -> Problem:
    """Trials that nobody has run, as the nominal model sees them; their measured channels mean nothing.

    Noise of an experiment that the session lacks is that of the channel elsewhere. The force sensor is then taken to be
    as good as the torque sensor at the length of the finger.
    """
    known = dict(problem.noise)
    for e, stack in stacks.items():
        for c in stack.experiment.channels:
            if (e, c) not in known:
                known[e, c] = _noise_elsewhere(problem, c, len(stack.batch.y[c]))
    sources = {
        e: problem.sources[e]._replace(batch=stack.batch)
        if e in problem.sources
        else sources_of({e: stack}, {e: stack.experiment.channels}, known, describe(problem.nominal))[e]
        for e, stack in stacks.items()
    }
    rows, linearised = layouts(stacks, sources), linearise_each(problem.nominal, sources)
    at = _at(problem.nominal, linearised, sources, rows, problem.free, problem.prior)
    groups = _groups(stacks, rows, problem.nominal)
    return replace(problem, stacks=stacks, sources=sources, rows=rows, groups=groups, noise=known, **at)


def _noise_elsewhere(problem: Problem, channel: str, columns: int) -> Noise:
    """White, of the largest size that the channel has in any experiment."""

    def largest(c: str) -> float | None:
        return max((float(n.std.max()) for (_, k), n in problem.noise.items() if k == c), default=None)

    finger = problem.session.finger
    length = float(np.linalg.norm([*finger.origin[1:], finger.fingertip], axis=1).sum())
    std = np.full(columns, largest(channel) or (largest("joint_torque") or 1e-3) / length)
    return Noise.white(std, "elsewhere")


def _at(nominal: Model, linearised: dict[str, Linearised], sources, rows, free, prior: Prior) -> dict[str, Any]:
    """What of a problem depends on its nominal model."""
    r, J = assemble(linearised, sources, rows, free, ravel(nominal).size)
    return {
        "nominal": nominal,
        "r": r,
        "J": J,
        "offset": np.asarray(prior.root) @ (np.asarray(ravel(nominal))[free] - np.asarray(prior.mean)),
        "predicted": {
            (e, c): np.asarray(sources[e].batch.y[c]) - np.asarray(residuals)
            for e, lin in linearised.items()
            for c, residuals in lin.residuals.items()
        },
    }


def _groups(stacks: dict[str, Stack], rows: dict[str, Rows], nominal: Model) -> list[MergedTrials]:
    return merged_trials({e: stack for e, stack in stacks.items() if rows[e].size}, nominal)


def layouts(stacks: dict[str, Stack], sources: dict[str, Source]) -> dict[str, Rows]:
    """The rows that count, experiment by experiment, stacked."""
    rows, start = {}, 0
    for e in sources:
        rows[e] = _layout(stacks[e], sources[e].filters, start)
        start += rows[e].size
    return rows


def assemble(
    linearised: dict[str, Linearised], sources: dict[str, Source], rows: dict[str, Rows], free: np.ndarray, size: int
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N p"]]:
    """White residuals and the derivatives of the white predictions by the free parameters."""
    r, J = [], []
    for e, lin in linearised.items():
        keep = rows[e].keep
        r.append(np.asarray(lin.white).reshape(-1)[keep])
        full = np.zeros((keep.size, size))
        full[:, sources[e].positions] = -np.asarray(lin.jacobian).reshape(-1, lin.jacobian.shape[-1])[keep]
        J.append(full[:, free])
    return np.concatenate(r), np.concatenate(J)


def _with_unknown(known: dict[tuple[str, str], Noise], stacks: dict[str, Stack], model: Model):
    """The noise of every channel: where no stage has read it, of what the model leaves of it."""
    left = residuals_for_noise(model, stacks, {e: stack.experiment.channels for e, stack in stacks.items()}, known)
    return known | {(e, c): estimate(stacks[e], c, x) for (e, c), x in left.items()}


def _with_missing_stages(
    fit: Fit, free: np.ndarray, sources: dict[str, Source], parameters: list[Parameter], touched
) -> tuple[Model, np.ndarray]:
    """A start and the free parameters, with those terms of the recipe whose experiment is missing but which others see.

    Without ID.3-dynamic nobody estimates damping; VD.3 shows it all the same, and its lack is no gap.
    """
    groups = free_groups(fit.recipe)
    unknown = [i for i, p in enumerate(parameters) if p.group in groups and p.determinable and i not in set(free)]
    unknown = [i for i in unknown if len(parameters[i].spans) < 2 or can_determine(parameters[i], touched)]
    start = start_values(fit.model, np.array(unknown, dtype=int), parameters, sources)
    seen = set()
    for e, lin in linearise_each(start, sources if unknown else {}).items():
        seen |= set(sources[e].positions[np.any(lin.factor[..., :-1] != 0.0, axis=(0, 1))])
    added = np.array([i for i in unknown if i in seen], dtype=int)
    return start_values(fit.model, added, parameters, sources), np.union1d(free, added).astype(int)


def _layout(stack: Stack, filters, start: int) -> Rows:
    """Rows that count, in the order of `white_rows`: trial, channel's column, time."""
    counts, before, channel, column = [], [], [], []
    for number, c in enumerate(filters):
        mask = np.asarray(stack.batch.mask[c])
        counts.append(np.moveaxis(mask, 1, 0))
        before.append(np.moveaxis(np.asarray(history(mask, filters[c].shape[1] - 1), int), 1, 0))
        channel += [number] * len(mask)
        column += list(range(len(mask)))
    block = np.concatenate(counts, axis=1)  # (B, columns of all channels, T)
    keep = np.flatnonzero(block)
    trial, wide, time = np.unravel_index(keep, block.shape)
    return Rows(
        stack.experiment.name,
        start,
        keep,
        np.array(channel)[wide],
        np.array(column)[wide],
        trial,
        time,
        np.concatenate(before, axis=1).reshape(-1)[keep],
    )
