"""Preparation of recordings for a model: trials are reduced by their kind of motion, and stacked with padding."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.data import Predictions, Session, Trial, quantisation
from jaxfinger.data.signals.quantiles import median
from jaxfinger.data.signals.sizes import Sizes, sizes_of
from jaxfinger.errors import UserError
from jaxfinger.experiments import driven, held, path, stepped
from jaxfinger.experiments.reduction import Reversals, Row, prepared, runs_of_holds
from jaxfinger.experiments.table import EXPERIMENTS, Experiment
from jaxfinger.model import Motion

KINDS = {"path": path, "driven": driven, "stepped": stepped, "held": held}
# Samples of a trial above which it is filtered in a thread of its own; filters release the interpreter's lock.
MIN_THREADED_SAMPLES = 10_000
LENGTH_MULTIPLE = 64  # samples; trials are padded to multiples of it, so that few lengths have to be compiled


class Batch(eqx.Module):
    """B trials of one experiment, reduced and padded to T samples."""

    x: Motion  # (…, B, T)
    y: dict[str, Float[Array, "_columns *B T"]]  # measured channels, zero where nothing is measured
    mask: dict[str, Float[Array, "_columns *B T"]]  # 1 where a sample is valid, else 0


class Coarseness(NamedTuple):
    """Error of the converter of each column of a channel (`quantisation`)."""

    std: Float[np.ndarray, " _columns"]  # in the channel's unit
    lasts: Float[np.ndarray, " _columns"]  # s


@dataclass(frozen=True)
class Stack:
    """A batch with the names, motions and holds of its trials."""

    experiment: Experiment
    batch: Batch
    trials: tuple[str, ...]
    motions: tuple[str | None, ...]  # trials of the same name of a motion repeat it
    holds: Int[np.ndarray, "B T"]  # index of the static hold, −1 between holds
    dt: float  # s, between samples
    measured: dict[str, bool]  # by channel: whether any trial measured it
    coarseness: dict[str, Coarseness] = field(default_factory=dict)  # by channel
    reversals: Reversals | None = None  # (m, B, T); None where they are not looked for

    def samples_of_holds(self, trial: int, counts: np.ndarray) -> list[np.ndarray]:
        """Indices of the valid samples of each hold of a trial; `counts` (T,) is nonzero where a sample is valid."""
        return runs_of_holds(np.where(counts, self.holds[trial], -1))


class NotJudged(NamedTuple):
    """Channel of an experiment without a single valid sample, and the reason."""

    experiment: str
    channel: str
    reason: str


def prepare(
    session: Session,
    names: list[str] | None = None,
    reduced: bool = True,
    minus: Predictions | None = None,
    coarse: int = 1,
    sizes: Sizes | None = None,
    reversals: bool = False,
) -> dict[str, Stack]:
    """Reduce and stack the named trials (default all), one stack for each experiment.

    `reduced`: whether trials are averaged to the experiment's rate, for a fit; otherwise every sample is kept.
    `coarse`: factor on the length of the averaging blocks. `minus`: predictions that are subtracted from the
    measurements; samples without a prediction are invalid. `sizes`: those of the session (`sizes_of`), where the caller
    has them already. `reversals`: whether to find the times of reversals (`Stack.reversals`), for reduced trials.

    Raises:
        UserError: trials of one experiment are sampled at rates too different to be stacked.
    """
    sizes, stacks = sizes or sizes_of(session), {}
    for experiment in (e.at(sizes) for e in EXPERIMENTS.values()):
        chosen = [t for t in session if t.experiment == experiment.name and (names is None or t.name in names)]
        trials = [t for t in chosen if len(t.time) > 1]

        def row(trial: Trial, experiment: Experiment = experiment) -> _Reduced:
            r = prepared(experiment, trial, session, sizes, reduced, minus, coarse, reversals)
            measured = {c: bool(s.any()) for c, s in r.sound.items()}
            there = [c for c in experiment.channels if reduced and getattr(trial, c) is not None]
            return _Reduced(KINDS[experiment.kind].reduce(r), measured, {c: _coarseness(trial, c) for c in there})

        long = any(len(t.time) > MIN_THREADED_SAMPLES for t in trials)
        with ThreadPoolExecutor(os.cpu_count() if long else 1) as pool:
            rows = list(pool.map(row, trials))
        if rows:
            stacks[experiment.name] = _stack(experiment, trials, rows, reduced)
    return stacks


def not_judged(stacks: dict[str, Stack]) -> list[NotJudged]:
    """Channels without a valid sample in any trial, in which no gap can be found."""
    out = []
    for name, stack in stacks.items():
        for c in stack.experiment.channels:
            if not np.asarray(stack.batch.mask[c]).any():
                kind = KINDS[stack.experiment.kind]
                out.append(NotJudged(name, c, kind.NONE_VALID if stack.measured[c] else "no trial measured it"))
    return out


class _Reduced(NamedTuple):
    row: Row
    measured: dict[str, bool]  # by channel
    coarseness: dict[str, Coarseness]  # by channel that is measured


def _coarseness(trial: Trial, channel: str) -> Coarseness:
    std, samples = np.transpose([quantisation(x) for x in getattr(trial, channel).T])
    return Coarseness(std, samples * median(np.diff(trial.time)))


def _mean_coarseness(members: list[Coarseness]) -> Coarseness:
    """Root mean square over several trials."""
    return Coarseness(*(np.sqrt(np.mean(np.square(values), axis=0)) for values in zip(*members, strict=True)))


def _stack(experiment: Experiment, trials: list[Trial], reduced_trials: list[_Reduced], reduced: bool) -> Stack:
    rows = [x.row for x in reduced_trials]
    steps = {round(r.dt, 6) for r in rows}
    # One noise model serves all trials of a stack, so that their sampling times must be alike.
    if reduced and max(steps) > 1.5 * min(steps):
        raise UserError(
            f"the {experiment.name} trials are sampled at different rates ({min(steps):g} s and {max(steps):g} s a "
            f"sample after reduction): resample trial {trials[int(np.argmax([r.dt for r in rows]))].name} to at least "
            f"{experiment.rate:g} Hz"
        )
    T = max(r.motion["time"].size for r in rows)
    T = -(-T // LENGTH_MULTIPLE) * LENGTH_MULTIPLE

    def pad(arrays, constant=False):
        out = np.zeros((*arrays[0].shape[:-1], len(arrays), T))
        for b, a in enumerate(arrays):
            out[..., b, : a.shape[-1]] = a
            if not constant:
                out[..., b, a.shape[-1] :] = a[..., -1:]
        return jax.device_put(out)

    x = Motion(**{k: pad([r.motion[k] for r in rows]) for k in rows[0].motion}, held=experiment.held)
    y = {c: pad([r.y[c] for r in rows], constant=True) for c in experiment.channels}
    mask = {c: pad([r.mask[c] for r in rows], constant=True) for c in experiment.channels}
    return Stack(
        experiment,
        Batch(x, y, mask),
        tuple(t.name for t in trials),
        tuple(t.motion for t in trials),
        np.stack([np.pad(r.hold, (0, T - r.hold.size), constant_values=-1) for r in rows]),
        float(np.median([r.dt for r in rows])),
        {c: any(x.measured[c] for x in reduced_trials) for c in experiment.channels},
        {
            c: _mean_coarseness(members)
            for c in experiment.channels
            if (members := [x.coarseness[c] for x in reduced_trials if c in x.coarseness])
        },
        _stacked(found, T) if (found := [r.reversals for r in rows if r.reversals is not None]) else None,
    )


def _stacked(reversals: list[Reversals], T: int) -> Reversals:
    """Reversals of all trials, padded to T samples."""
    padded = (
        np.stack([np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, T - a.shape[-1])]) for a in arrays], axis=-2)
        for arrays in zip(*reversals, strict=True)
    )
    return Reversals(*padded)
