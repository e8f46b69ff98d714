"""Guess of a trial's experiment by what moves in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from jaxfinger.data.importing.logs import Log
from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.importing.survey import ColumnSurvey, values_of
from jaxfinger.data.units import TO_SI

_MIN_TRAVEL = {"rad": 0.1, "m": 1e-3}  # Less is the yield of a fixture.
_PARTS = 400  # of a recording: a step of a protocol lasts several of them, and each averages noise.
_MAX_STILL_CHANGE = 0.1  # of the quickest change between parts: with less a joint stands still.
_MIN_STILL_SHARE = 0.4  # of the parts: a stepped joint stands still in more of them, a swinging one in a sixteenth.
_MIN_TENSION_CHANGE = 0.5  # of the highest tension: larger where tendons drive the finger (VD.3), smaller in VD.1.


def guessed_experiment(
    log: Log, channels: Mapping[str, Sequence[ColumnSurvey]], names: Mapping[str, Sequence[str]]
) -> tuple[str, str, str]:
    """Guess experiment, joint and tendon (empty where there is none) from what moves.

    No motion shows which joint a torque sensor holds. It is the only joint, or the one in the file's name, or else `?`,
    which import refuses.
    """
    q, force, excursion, torque = (
        channels.get(c, ()) for c in ("q", "tendon_force", "tendon_excursion", "joint_torque")
    )
    units = [s.units or "rad" for s in q]
    spans = [
        (s.high - s.low) * TO_SI[u].factor / _MIN_TRAVEL.get(TO_SI[u].si, np.inf) for s, u in zip(q, units, strict=True)
    ]
    moved = [k for k, span in enumerate(spans) if span > 1.0]
    most = int(np.nanargmax(spans)) if moved else 0
    joint = names["q"][most] if q and most < len(names["q"]) else ""
    pulls = [s.high - s.low for s in force]
    pulled = int(np.nanargmax(pulls)) if force and np.isfinite(pulls).any() else 0
    tendon = names["tendon_force"][pulled] if force and pulled < len(names["tendon_force"]) else ""
    if q and not moved:  # The joints are held, and a tendon is pulled.
        if not torque and channels.get("fingertip_force"):
            return "VD.2", "", tendon
        stem = log.title.lower()
        named = [name for name in names["q"] if name.lower() in stem] if len(names["q"]) > 1 else names["q"]
        return "ID.4", named[0] if len(named) == 1 else "?", tendon
    if torque or not moved or not (force or excursion):  # A motor moves a joint, or several do, each with its torque.
        joint = joint if len(moved) <= 1 or len(torque) == 1 else ""
        return ("ID.3-static" if moved and _stepped(log.recording, q[most]) else "ID.3-dynamic"), joint, ""
    if len(moved) == 1:
        return "ID.2", joint, ""
    # Several joints are moved, by hand or by the tendons.
    high = max((s.high for s in force), default=0.0)
    return ("VD.3" if max(pulls, default=0.0) > _MIN_TENSION_CHANGE * high else "VD.1"), "", ""


def _stepped(recording: Recording, seen: ColumnSurvey) -> bool:
    """Whether a joint stands still for much of the time between its moves."""
    x = values_of(recording, seen)
    x = x[np.isfinite(x)]
    steps = np.abs(np.diff([part.mean() for part in np.array_split(x, min(len(x), _PARTS))]))
    return float(np.mean(steps < _MAX_STILL_CHANGE * np.percentile(steps, 95.0))) > _MIN_STILL_SHARE
