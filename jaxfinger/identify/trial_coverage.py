"""What the trials of a fit can determine, and which terms a stage takes as zero since no stage determines them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.data import Session, Trial, constant_columns, joints_of, moving_joints
from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.sizes import Sizes
from jaxfinger.errors import UserError, counted, listed
from jaxfinger.experiments import EXPERIMENTS, Stack, prepare
from jaxfinger.identify.identifiability import REMEDIES
from jaxfinger.identify.parameters import Parameter


class Coverage(NamedTuple):
    """Joints and tendons that the trials of a fit show."""

    joints: set[str]  # that are instrumented or move
    moved: set[tuple[str, str]]  # pairs (tendon, joint) recorded together
    tendons: set[str]  # that are pulled
    together: list[set[str]]  # joints that move in each trial that is not held


def coverage_of(reads: Collection[str], session: Session) -> Coverage:
    """Coverage of the session's trials of the experiments `reads`."""
    trials = [t for t in session if t.experiment in reads and len(t.time) > 1]
    joints = {joint for t in trials for joint in joints_of(t, session.finger)}
    moved = {(k, joint) for joint in joints for k in session.finger.tendon_names}
    free = [set(moving_joints(t, session.finger)) for t in trials if not EXPERIMENTS[t.experiment].held]
    return Coverage(joints, moved, {t.tendon for t in trials if t.tendon}, free)


def readings_of(
    session: Session, names: list[str] | None = None, sizes: Sizes | None = None, coarse: int = 1
) -> dict[str, Stack]:
    """The named trials as `prepare` reduces them for a fit; columns that never change count as not measured.

    Such a column would be fitted exactly, with noise of zero: its parameters would have intervals of zero width.

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
    stacks = prepare(session, names, coarse=coarse, sizes=sizes)
    return {e: _without_constant(stack, session) for e, stack in stacks.items()}


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
    """`constant_columns`, without the torque of VD.3, which is zero: nothing but tendons drives the finger."""
    found = constant_columns(trial, session.finger)
    return {c: still for c, still in found.items() if (trial.experiment, c) != ("VD.3", "joint_torque")}


def name_constant(reads: Mapping[str, Collection[str]], session: Session) -> list[str]:
    """One sentence for each column of the channels `reads`, by experiment, that never changes in some trials."""
    found: dict[tuple[str, str, float], list[str]] = {}
    for t in session:
        for channel, still in _constant(t, session).items():
            for k in np.flatnonzero(still) if channel in reads.get(t.experiment, ()) else ():
                column, value = CHANNELS[channel].columns(session.finger)[k], getattr(t, channel)[0, k] + 0.0
                found.setdefault((channel, column, float(value)), []).append(t.name)
    return [
        f"{channel} {column} is {value:.4g} at every sample of {listed(names)}, as no sensor is, and is not read "
        "there: check its cable and its column"
        for (channel, column, value), names in found.items()
    ]


def can_determine(p: Parameter, coverage: Coverage) -> bool:
    """Whether trials can determine a parameter."""
    if p.group == "moment_arm" and len(p.spans) > 1:  # a term of two joints needs a trial that moves both
        return any(joints.issuperset(p.spans) for joints in coverage.together)
    if p.group == "moment_arm":
        return (p.tendon, p.joint) in coverage.moved
    if p.group == "tendon_friction":
        return p.tendon in coverage.tendons
    return p.joint in coverage.joints


def name_unseen(
    parameters: list[Parameter], groups: set[str], free: Int[np.ndarray, " p"], coverage: Coverage
) -> list[str]:
    """One sentence on the parameters of `groups` that are not `free`, since no trial shows them."""
    known = set(free.tolist())
    names = [p.name for i, p in enumerate(parameters) if p.group in groups and p.determinable and i not in known]
    pairs = {" and ".join(p.spans) for p in parameters if p.name in names and len(p.spans) > 1}
    mend = f"; record a trial that moves {' together, and '.join(sorted(pairs))} together" if pairs else ""
    return [f"no trial shows {', '.join(names)}: left as given, or at zero{mend}"] if names else []


def name_missing(
    parameters: list[Parameter],
    values: Float[np.ndarray, " P"],
    determined: Int[np.ndarray, " d"],
    needed: Int[np.ndarray, " k"],
    coverage: Coverage,
) -> list[str]:
    """One sentence for each law that a stage needs at its joints, and that stands at zero since no trial shows it.

    `needed`: positions of the parameters of the recipe on which the stage's channels depend. `determined`: those that
    some stage has estimated and its trials determine. A law with a value that is not zero is given by the description.
    """
    known = {*determined.tolist(), *np.flatnonzero(values).tolist()}
    missing: dict[tuple[str, str | None, str], list[bool]] = {}
    for i in needed.tolist():
        p = parameters[i]
        pulled = p.group != "moment_arm" or p.tendon in coverage.tendons
        if p.joint in coverage.joints and pulled and p.determinable:
            missing.setdefault((p.group, p.tendon, p.joint), []).append(i in known)
    return [
        f"{_law(*law)} is taken as zero, since no stage determines it, and what rests on it has no interval (± ?): "
        f"record {REMEDIES[law[0]].format(tendon=law[1], joint=law[2])}, start from a fit that has it, or "
        f"{'describe it in the finger file' if law[0] == 'moment_arm' else 'leave its term out of the recipe'}"
        for law, has in missing.items()
        if not any(has)
    ]


def _law(group: str, tendon: str | None, joint: str) -> str:
    if group == "moment_arm":
        return f"the moment arm of tendon {tendon} at joint {joint}"
    return f"the {group} torque of joint {joint}"
