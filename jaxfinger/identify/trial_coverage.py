"""What the trials of a fit can determine, and which terms a stage takes as zero since no stage determines them."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.data import Session, joints_of, moving_joints
from jaxfinger.errors import listed
from jaxfinger.experiments import EXPERIMENTS
from jaxfinger.identify.identifiability import REMEDIES
from jaxfinger.identify.parameters import Parameter

_WORDS = {"moment_arm": "moment arms", "elastic": "elastic torque"}  # of groups that their names do not say


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


def can_determine(p: Parameter, coverage: Coverage) -> bool:
    """Whether trials can determine a parameter."""
    if p.group == "moment_arm" and len(p.spans) > 1:  # a term of two joints needs a trial that moves both
        return any(joints.issuperset(p.spans) for joints in coverage.together)
    if p.group == "moment_arm":
        return (p.tendon, p.joint) in coverage.moved
    if p.group == "tendon_friction":
        return p.tendon in coverage.tendons
    return p.joint in coverage.joints


def name_unseen(parameters: list[Parameter], groups: set[str], free: Int[np.ndarray, " p"]) -> list[str]:
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


def name_unfitted(
    parameters: list[Parameter],
    values: Float[np.ndarray, " P"],
    estimated: Int[np.ndarray, " k"],
    groups: Collection[str],
) -> list[str]:
    """One sentence on the laws of `groups` that predictions take as zero, since no trial of the fit showed them.

    `estimated`: positions of the fit's estimates. A law with a value that is not zero is given by the description.
    """
    known = {*estimated.tolist(), *np.flatnonzero(values).tolist()}
    laws: dict[tuple[str, str], list[bool]] = {}
    for i, p in enumerate(parameters):
        name = p.tendon or p.joint
        if p.group in groups and p.determinable and name is not None:
            laws.setdefault((p.group, name), []).append(i in known)
    missing: dict[str, list[str]] = {}
    for (group, name), has in laws.items():
        if not any(has):
            missing.setdefault(_WORDS.get(group, group.replace("_", " ")), []).append(name)
    said = ", and the ".join(f"{words} of {listed(names)}" for words, names in missing.items())
    return [f"no trial of the fit showed the {said}, and predictions take them as zero"] if said else []


def _law(group: str, tendon: str | None, joint: str) -> str:
    if group == "moment_arm":
        return f"the moment arm of tendon {tendon} at joint {joint}"
    return f"the {group} torque of joint {joint}"
