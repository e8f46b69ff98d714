"""Check each tendon's moment arms in ID.2 against the finger's description: which joints it crosses, and its excursion.

A tendon that crosses a joint may stand still there, if it passes through the axis. One that does not cross it has no
reason to travel.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.signals.arms import Arms

# Share of the largest moment arm, from which a tendon travels. Smaller arms may be those of tendons that are dragged
# along, or of sensors that feel each other.
MIN_TRAVEL_ARM = 0.25
# Ratio of measured arms to those of the finger's file. CAD is good to a tenth; a diameter for a radius gives 2. The
# limit is half-way between 1 and 2, as ratios count.
_MAX_RATIO = np.sqrt(2.0)
_RATIO_ERROR = 1.2  # a tenth, with room: up to this factor a ratio is that of a mistake
_RATIOS = {2.0: "as a diameter for a radius gives", np.degrees(1.0): "as degrees for rad give"}


def check_arms(finger: FingerDescription, arms: dict[int, Arms], exchanged: Collection[int], report: Report) -> None:
    """Report tendons that contradict `crosses` or `excursion`, except those whose columns look exchanged."""
    rest = [int(k) for k in np.flatnonzero(finger.active) if k not in exchanged]
    crossing = [np.abs(at.seen[finger.active & finger.crosses[:, i]]) for i, at in arms.items()]
    largest = max((float(np.nanmax(size, initial=0.0)) for size in crossing), default=0.0)
    for i, at in arms.items() if largest > 0.0 else ():
        for k in (k for k in rest if not finger.crosses[k, i] and abs(at.seen[k]) > MIN_TRAVEL_ARM * largest):
            tendon, joint = finger.tendon_names[k], finger.joint_names[i]
            report.warning(
                "/finger/tendons/crosses",
                f"tendon {tendon} does not cross joint {joint}, yet is pulled in by {1e3 * at.seen[k]:.3g} mm a radian "
                f"where {joint} turns alone (ID.2); add {joint} to its `crosses`, or correct its column of "
                "tendon_excursion",
            )
    _ratios(finger, arms, rest, report)


def _ratios(finger: FingerDescription, arms: dict[int, Arms], tendons: Collection[int], report: Report) -> None:
    """Report tendons whose arms differ from the known ones by a sign or by a factor."""
    if not arms or finger.excursion is None:
        return
    seen, known = (np.stack([getattr(at, key) for at in arms.values()], axis=1) for key in ("seen", "known"))
    std = np.zeros_like(known) if finger.excursion_std is None else finger.excursion_std[:, list(arms), 0]
    wrong: dict[str, list[str]] = defaultdict(list)
    for k in tendons:
        good = np.isfinite(seen[k]) & np.isfinite(known[k])
        # A small arm is the difference of large ones, and may be wrong by all of its size.
        if not np.any(np.abs(known[k]) > MIN_TRAVEL_ARM * np.nanmax(np.abs(known), axis=0, initial=0.0), where=good):
            continue
        x, y = known[k, good], seen[k, good]
        ratio, spread = x @ y / (x @ x), 3.0 * np.nan_to_num(np.abs(x) @ std[k, good]) / (x @ x)
        if not 1.0 / _MAX_RATIO - spread < ratio < _MAX_RATIO + spread:
            wrong[_mend(ratio)].append(f"{finger.tendon_names[k]} ({ratio:.2g} times)")
    for mend, names in wrong.items():
        report.warning(
            "/finger/tendons/excursion",
            f"ID.2 shows other moment arms than the finger's file: {', '.join(names)}; {mend} of `excursion` in the "
            "finger's file, or of tendon_excursion",
        )


def _mend(ratio: float) -> str:
    """What to correct, given measured over known moment arms."""
    if ratio < 0.0:
        return "correct the sign"
    factor = max(ratio, 1.0 / ratio)
    hint = next((f", {said}," for f, said in _RATIOS.items() if 1 / _RATIO_ERROR < factor / f < _RATIO_ERROR), "")
    return f"correct the scale{hint}"
