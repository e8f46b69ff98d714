"""Check that each column of tendon_excursion belongs to the tendon of its name. No model is needed for three tests:

1. While one joint turns alone (ID.2), a tendon that crosses it travels, and one that does not stands still.
2. Where the finger's description holds excursions, ID.2 shows the same ones.
3. A tendon that is pulled at a held posture (ID.4) stretches, and no other does.

Two columns are reported only if each shows what the other should. What is wrong of one alone, `checks.arms` reports.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import combinations

import numpy as np

from jaxfinger.data.checks.arms import MIN_TRAVEL_ARM, check_arms
from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.arms import Arms, measured_arms, slope, thinned
from jaxfinger.data.signals.sizes import STRETCH_SHARE

_MAX_CAD_ERROR = 0.2  # of the known arms: CAD is good to a tenth, so columns that miss by less may be right.
_MAX_EXCHANGED_ERROR = 0.25  # of the error as named: exchanged columns must fit the known arms this much better.
_MIN_STRETCH_R2 = 0.9  # squared correlation of excursion with tension, from which the tendon is taken to stretch


def check_columns(session: Session, report: Report) -> None:
    """Report pairs of tendons whose columns look exchanged, each pair once, by the first test that shows it."""
    if any(session.finger.prismatic):
        return
    told: set[tuple[int, int]] = set()
    arms = measured_arms(session)
    for evidence in (_by_crossing(session.finger, arms), _by_description(session.finger, arms), _by_stretch(session)):
        for pair, why in evidence:
            if pair not in told:
                told.add(pair)
                first, second = (session.finger.tendon_names[k] for k in pair)
                message = f"columns {first} and {second} of tendon_excursion look exchanged: {why}"
                report.warning("/trials", f"{message}; exchange them, or correct what contradicts them")
    check_arms(session.finger, arms, {k for pair in told for k in pair}, report)


def _by_crossing(finger: FingerDescription, arms: dict[int, Arms]) -> Iterator[tuple[tuple[int, int], str]]:
    """Pairs of tendons of which one crosses a joint and stands still there, and the other the other way round."""
    for i, seen in ((i, at.seen) for i, at in arms.items()):
        size = np.abs(seen) / np.nanmax(np.abs(seen[finger.active]), initial=0.0)
        still = np.flatnonzero(finger.active & finger.crosses[:, i] & (size < STRETCH_SHARE))
        travel = np.flatnonzero(finger.active & ~finger.crosses[:, i] & (size > MIN_TRAVEL_ARM))
        if len(still) == len(travel) == 1:
            (a,), (b,) = still, travel
            names, joint = finger.tendon_names, finger.joint_names[i]
            yield (
                (int(min(a, b)), int(max(a, b))),
                f"where joint {joint} turns alone (ID.2), {names[b]}, which does not cross it, is pulled in by "
                f"{1e3 * abs(seen[b]):.3g} mm a radian, and {names[a]}, which does, by {1e3 * abs(seen[a]):.2g} mm",
            )


def _by_description(finger: FingerDescription, arms: dict[int, Arms]) -> Iterator[tuple[tuple[int, int], str]]:
    """Pairs of tendons whose measured arms fit the known excursions only if they are exchanged."""
    for a, b in combinations(np.flatnonzero(finger.active), 2):
        own, crossed, turned, size, said = 0.0, 0.0, 0.0, 0.0, ""
        for i, at in arms.items():
            seen, known = at.seen[[a, b]], at.known[[a, b]]
            if np.isfinite([*known, *seen]).all():
                own += np.abs(seen - known).sum()
                crossed += np.abs(seen[::-1] - known).sum()
                turned += np.abs(seen + known).sum()
                size += np.abs(known).sum()
                shown, told = (" and ".join(f"{1e3 * arm:.3g}" for arm in x) for x in (seen, known))
                joint = finger.joint_names[i]
                said = said or f"ID.2 shows {shown} mm a radian at {joint}, the finger's file says {told}"
        if own > _MAX_CAD_ERROR * size and crossed < min(_MAX_EXCHANGED_ERROR * own, turned):
            yield (int(a), int(b)), f"{said} (where both are the other way round for each tendon: correct the signs)"


def _by_stretch(session: Session) -> Iterator[tuple[tuple[int, int], str]]:
    """Pairs of tendons of which each alone stretches where the other is pulled."""
    finger = session.finger
    moves: dict[int, set[int]] = defaultdict(set)
    for trial in session.select("ID.4"):
        if (pulled := finger.tendon(trial.tendon)) is not None:
            moves[pulled] |= _stretched(trial, pulled, finger.active)
    for a, b in combinations(sorted(moves), 2):
        if moves[a] == {b} and moves[b] == {a}:
            names = finger.tendon_names
            yield (a, b), f"where {names[a]} is pulled (ID.4), {names[b]} gives way alone, and the other way round"


def _stretched(trial: Trial, pulled: int, active: np.ndarray) -> set[int]:
    """Tendons whose excursion follows the tension of the pulled one."""
    if trial.tendon_force is None or trial.tendon_excursion is None:
        return set()
    pull, l = thinned(trial.tendon_force[:, pulled]), thinned(trial.tendon_excursion)
    R2 = [slope(pull, x) * slope(x, pull) for x in l.T]
    return {int(k) for k in np.flatnonzero(active) if R2[k] > _MIN_STRETCH_R2}
