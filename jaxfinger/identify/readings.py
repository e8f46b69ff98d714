"""The recordings that fits read: reduced and stacked, without columns that no sensor has measured."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.data import Session, Trial, constant_columns
from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.signals.sizes import Sizes
from jaxfinger.errors import UserError, counted, listed
from jaxfinger.experiments import Stack, prepare
from jaxfinger.identify.dead_zone import clear_of_dead_zones
from jaxfinger.model import Model


def readings_of(
    session: Session,
    names: list[str] | None = None,
    sizes: Sizes | None = None,
    coarse: int = 1,
    model: Model | None = None,
    reversals: bool = False,
) -> dict[str, Stack]:
    """The named trials as `prepare` reduces them for a fit; columns that never change count as not measured.

    Such a column would be fitted exactly, with noise of zero: its parameters would have intervals of zero width. With
    an earlier fit's `model` no torque counts whose tensions are near the end of a dead zone (`clear_of_dead_zones`).
    `reversals`: as in `prepare`.

    Raises:
        UserError: an angle of a trial is not finite, or its trials are sampled at rates too different to be stacked.
    """
    for t in session if names is None else (session[name] for name in names):
        lost = ~np.isfinite(t.q).all(axis=1)
        if lost.any():
            raise UserError(
                f"{session.file or 'the session'}: trial {t.name}: q is not finite at "
                f"{counted(int(lost.sum()), 'sample')}, the first at {t.time[np.argmax(lost)]:.4g} s; fill them in, "
                "cut them off, or leave the trial out"
            )
    stacks = prepare(session, names, coarse=coarse, sizes=sizes, reversals=reversals)
    stacks = {e: _without_constant(stack, session) for e, stack in stacks.items()}
    return stacks if model is None else clear_of_dead_zones(stacks, model, session, sizes)


def _without_constant(stack: Stack, session: Session) -> Stack:
    """Stack without columns that never change in some trial, in all trials in which they do not change."""
    trials = [session[name] for name in stack.trials]
    constant = [_constant(t, session) for t in trials]
    mask, measured = dict(stack.batch.mask), dict(stack.measured)
    for c in mask:
        dead = np.any([x.get(c, np.zeros(len(mask[c]), bool)) for x in constant], axis=0)
        if dead.any():
            before = np.asarray(mask[c])
            still = dead[:, None] & np.stack([_still(getattr(t, c), len(dead)) for t in trials], axis=1)
            after = np.where(still[..., None], 0.0, before)
            mask[c], measured[c] = jax.device_put(after), measured[c] and bool(after.any() or not before.any())
    return replace(stack, batch=replace(stack.batch, mask=mask), measured=measured)


def _still(values: Float[np.ndarray, "N columns"] | None, columns: int) -> Bool[np.ndarray, " columns"]:
    """Columns that never change; false for those that are not measured."""
    return np.zeros(columns, bool) if values is None else np.ptp(values, axis=0) == 0.0


def _constant(trial: Trial, session: Session) -> dict[str, Bool[np.ndarray, " columns"]]:
    """`constant_columns`, but for angles, and for the torque of VD.3, which is zero: tendons alone drive the finger."""
    found = constant_columns(trial, session.finger)
    return {c: x for c, x in found.items() if c != "q" and (trial.experiment, c) != ("VD.3", "joint_torque")}


def name_constant(reads: Mapping[str, Collection[str]], session: Session) -> list[str]:
    """One sentence for the columns of each channel that `reads` has that never change in the same trials."""
    found: dict[tuple[str, str, float], list[str]] = {}
    for t in (t for t in session if t.experiment in reads):
        for channel, still in _constant(t, session).items():
            for k in np.flatnonzero(still) if channel in reads[t.experiment] else ():
                column, value = CHANNELS[channel].columns(session.finger)[k], getattr(t, channel)[0, k] + 0.0
                found.setdefault((channel, column, float(value)), []).append(t.name)
    alike: dict[tuple, list[str]] = {}
    for (channel, column, value), names in found.items():
        alike.setdefault((channel, value, tuple(names)), []).append(column)
    return [
        f"{channel} {listed(columns)} {'is' if len(columns) == 1 else 'are'} {value:.4g} at every sample of "
        f"{listed(names)}, as no sensor is, and not read there: check cable and column"
        for (channel, value, names), columns in alike.items()
    ]
