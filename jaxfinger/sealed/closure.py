"""How far the gap closes on fresh trials: rms of measurement minus prediction, by experiment and channel.

The predictions come from any tool in the predictions layout; nothing is assumed of the model.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from scipy.ndimage import minimum_filter1d

from jaxfinger.data import FingerDescription, Session, Trial, find_holds, read_predictions, read_session

CHANNELS = {
    "ID.2": ("tendon_excursion",),
    "VD.1": ("tendon_excursion",),
    "ID.3-static": ("joint_torque",),
    "ID.3-dynamic": ("joint_torque",),
    "ID.4": ("joint_torque", "tendon_excursion"),
    "VD.2": ("fingertip_force", "tendon_excursion"),
    "VD.3": ("tendon_excursion", "joint_torque"),
}
MOVING = 0.05  # rad/s, and that speed times 5 mm for a tendon: torque in motion is judged where both slide
CLEAR = 0.03  # s on either side of where one may stick: nobody knows its friction there


def gap_by_channel(
    measured: Session, predicted: Mapping[str, Mapping[str, np.ndarray]]
) -> dict[tuple[str, str], float]:
    """rms of measured minus predicted over all samples that both have, SI units; excursions less one constant a
    trial and tendon, torque of ID.3 and VD.3 where friction is known: in holds, and where joint and tendons slide.
    """
    squares: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    for trial in measured:
        if trial.name not in predicted:
            continue
        for channel in CHANNELS[trial.experiment]:
            said = predicted[trial.name].get(channel)
            seen = getattr(trial, channel)
            if said is None:
                continue
            if trial.experiment == "VD.3" and channel == "joint_torque":
                seen = np.zeros_like(said)  # nothing acts from outside on the free finger
            if seen is None:
                continue
            difference = np.asarray(seen, dtype=float) - said
            if channel == "joint_torque":
                difference = np.where(friction_known(trial, measured.finger), difference, np.nan)
            for column in difference.T:
                rest = column[np.isfinite(column)]
                if len(rest):
                    squares[trial.experiment, channel].append(
                        (rest - rest.mean() if channel == "tendon_excursion" else rest) ** 2
                    )
    return {key: float(np.sqrt(np.concatenate(parts).mean())) for key, parts in sorted(squares.items())}


def friction_known(trial: Trial, finger: FingerDescription) -> Bool[np.ndarray, "N m"] | Bool[np.ndarray, "N 1"]:
    """Where the direction of friction is known to the sample: the torque counts there."""
    if trial.experiment == "ID.3-static":
        return find_holds(trial)[:, None] >= 0
    if trial.experiment in ("ID.3-dynamic", "VD.3"):
        return _sliding(trial, finger)
    return np.ones((len(trial.time), 1), bool)


def _sliding(trial: Trial, finger: FingerDescription) -> Bool[np.ndarray, "N m"]:
    """Where a joint moves, and every tendon across it where tendons drive it, clear of where they stop."""
    rate = float(1.0 / np.median(np.diff(trial.time)))
    width = max(int(0.05 * rate), 3)
    speed = _slope(trial.q, trial.time, width)
    slides = np.abs(speed) > MOVING
    if trial.experiment == "VD.3" and trial.tendon_excursion is not None:
        tendon = np.abs(_slope(trial.tendon_excursion, trial.time, width)) > MOVING * 5e-3
        slides &= ~(~tendon @ (finger.crosses & finger.active[:, None]))
    return minimum_filter1d(slides, 2 * round(CLEAR * rate) + 1, axis=0)


def _slope(values: np.ndarray, time: np.ndarray, width: int) -> np.ndarray:
    """Central difference over ± width samples."""
    x = np.asarray(values, dtype=float)
    out = np.zeros_like(x)
    out[width:-width] = (x[2 * width :] - x[: -2 * width]) / (time[2 * width :] - time[: -2 * width])[:, None]
    return out


def fresh_rows(fresh: Path, predictions: Mapping[str, Path]) -> list[dict]:
    """Rows for `fresh.json`: rms on the fresh trials of each named prediction (before, after, best)."""
    measured = read_session(fresh)
    gaps = {name: gap_by_channel(measured, read_predictions(file)) for name, file in predictions.items()}
    first, *others = gaps.values()
    return [
        {"experiment": e, "channel": c} | {name: gap[e, c] for name, gap in gaps.items()}
        for e, c in first
        if all((e, c) in gap for gap in others)
    ]
