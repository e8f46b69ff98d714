"""The trial that the nominal model misses most: measured, and predicted before and after the causes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxfinger.data.schema import CHANNELS, channel_units
from jaxfinger.gap.problem import Problem, site
from jaxfinger.gap.result import Diagnosis
from jaxfinger.identify.linearise import residuals_of
from jaxfinger.model import Model
from jaxfinger.report.names import channel_name
from jaxfinger.report.numbers import HALF_95, scaled


@dataclass(frozen=True)
class Trace:
    """One column of one channel in one trial, in units for people; NaN where no sample counts."""

    experiment: str
    trial: str
    name: str  # of the channel and its column
    units: str
    time: Float[np.ndarray, " T"]  # s
    measured: Float[np.ndarray, " T"]
    before: Float[np.ndarray, " T"]  # predicted by the nominal model, or by the other simulator
    after: Float[np.ndarray, " T"]  # predicted by the augmented model
    half: float  # half of the noise's 95 % interval
    changed: bool  # whether `after` differs from `before`


def worst_trial(d: Diagnosis) -> Trace:
    """Trace of the column and trial with the most energy above noise; the diagnosis must hold its `problem`."""
    problem = d.problem
    assert problem is not None
    e, channel, column, b = _worst(problem)
    stack = problem.stacks[e]
    mask = np.asarray(stack.batch.mask[channel])[column, b] > 0
    seen = np.arange(mask.size) <= np.flatnonzero(mask).max()  # Later samples are padding.
    y = np.where(mask, np.asarray(stack.batch.y[channel])[column, b], np.nan)
    free_zero = CHANNELS[channel].free_zero
    residuals = [_residual(problem, e, channel, problem.simulator), _residual(problem, e, channel, None)]
    changed = d.augmented is not d.nominal
    if changed:
        residuals[1] = _residual(problem, e, channel, d.augmented.model)
    missed = [np.where(mask, r[column, b], np.nan) for r in residuals]
    if free_zero:
        missed = [m - np.nanmean(m) for m in missed]
    y = y - np.nanmean(y) if free_zero else y
    std = float(problem.noise[e, channel].std[column])
    units = channel_units(channel, problem.session.finger.prismatic)
    factor, unit = scaled(max(float(np.nanmax(np.abs(y))), float(np.nanmax(np.abs(missed[0])))), units)
    before, after = (factor * (y - m)[seen] for m in missed)
    return Trace(
        e,
        stack.trials[b],
        f"{channel_name(channel)} {site(problem, channel, column)}",
        unit,
        np.asarray(stack.batch.x.time)[b][seen],
        factor * y[seen],
        before,
        after,
        HALF_95 * factor * std,
        changed or problem.simulator is not None,
    )


def _residual(problem: Problem, experiment: str, channel: str, model: Model | None) -> np.ndarray:
    """Measured less predicted, (columns, B, T), by a model or for None by the nominal one."""
    batch = problem.stacks[experiment].batch
    if model is None:
        return np.asarray(batch.y[channel]) - problem.predicted[experiment, channel]
    return np.asarray(residuals_of(model, batch, (channel,))[channel])


def _worst(problem: Problem) -> tuple[str, str, int, int]:
    """Experiment, channel, column and trial (index in its stack) with the most energy above noise."""
    best, most = None, -np.inf
    for e, rows in problem.rows.items():
        excess = problem.r[rows.start : rows.start + rows.size] ** 2 - 1.0
        kinds, which = np.unique(np.stack([rows.channel, rows.column, rows.trial]), axis=1, return_inverse=True)
        if not kinds.size:
            continue
        energy = np.bincount(which.ravel(), excess)
        if energy.max() > most:
            most = energy.max()
            number, column, trial = kinds[:, energy.argmax()]
            best = e, problem.stacks[e].experiment.channels[number], int(column), int(trial)
    if best is None:
        raise ValueError("no sample of any channel counts")
    return best
