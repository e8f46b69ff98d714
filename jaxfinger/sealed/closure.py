"""Gap on fresh trials: rms of measurement minus prediction, by experiment and channel.

Predictions are files in the predictions layout, from any tool. Nothing is assumed of the model behind them.
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
SLIDING_SPEED = 0.05  # rad/s, over ten times the speed that an encoder's noise shows over `SLOPE_TIME`
TYPICAL_ARM = 5e-3  # m, turns the speed of a joint into that of a tendon
SLOPE_TIME = 0.05  # s on either side for the speed's difference
CLEARANCE = 0.03  # s on either side of a joint or tendon that may stick, where friction may take any value


def gap_by_channel(
    measured: Session, predicted: Mapping[str, Mapping[str, np.ndarray]]
) -> dict[tuple[str, str], float]:
    """rms of measured minus predicted by (experiment, channel), over the samples that both have, SI.

    Excursions count less a constant for each trial and tendon. Torques of ID.3 and VD.3 count where friction is known.
    """
    squares: dict[tuple[str, str], list[np.ndarray]] = defaultdict(list)
    for trial in measured:
        if trial.name not in predicted:
            continue
        for channel in CHANNELS[trial.experiment]:
            prediction = predicted[trial.name].get(channel)
            measurement = getattr(trial, channel)
            if prediction is None:
                continue
            if trial.experiment == "VD.3" and channel == "joint_torque":
                measurement = np.zeros_like(prediction)  # No external torque acts on the free finger.
            if measurement is None:
                continue
            difference = np.asarray(measurement, dtype=float) - prediction
            if channel == "joint_torque":
                difference = np.where(friction_known(trial, measured.finger), difference, np.nan)
            for column in difference.T:
                finite = column[np.isfinite(column)]
                if len(finite):
                    squares[trial.experiment, channel].append(
                        (finite - finite.mean() if channel == "tendon_excursion" else finite) ** 2
                    )
    return {key: float(np.sqrt(np.concatenate(parts).mean())) for key, parts in sorted(squares.items())}


def friction_known(trial: Trial, finger: FingerDescription) -> Bool[np.ndarray, "N m"] | Bool[np.ndarray, "N 1"]:
    """Samples at which the direction of friction is known: in holds of ID.3, and where joint and tendons slide."""
    if trial.experiment == "ID.3-static":
        return find_holds(trial)[:, None] >= 0
    if trial.experiment in ("ID.3-dynamic", "VD.3"):
        return _sliding(trial, finger)
    return np.ones((len(trial.time), 1), bool)


def _sliding(trial: Trial, finger: FingerDescription) -> Bool[np.ndarray, "N m"]:
    """Samples at which a joint slides, and in VD.3 every tendon across it, clear of their stops."""
    rate = float(1.0 / np.median(np.diff(trial.time)))
    width = max(int(SLOPE_TIME * rate), 3)
    speed = _slope(trial.q, trial.time, width)
    slides = np.abs(speed) > SLIDING_SPEED
    if trial.experiment == "VD.3" and trial.tendon_excursion is not None:
        tendon = np.abs(_slope(trial.tendon_excursion, trial.time, width)) > SLIDING_SPEED * TYPICAL_ARM
        slides = sliding_with_tendons(slides, tendon, finger)
    return minimum_filter1d(slides, 2 * round(CLEARANCE * rate) + 1, axis=0)


def sliding_with_tendons(
    joint: Bool[np.ndarray, "N m"], tendon: Bool[np.ndarray, "N n"], finger: FingerDescription
) -> Bool[np.ndarray, "N m"]:
    """Mark the joints that slide together with every active tendon across them. `joint`, `tendon`: those that slide."""
    return joint & ~(~tendon @ (finger.crosses & finger.active[:, None]))


def _slope(values: np.ndarray, time: np.ndarray, width: int) -> np.ndarray:
    """Central difference over ± width samples; zero within `width` of the ends."""
    x = np.asarray(values, dtype=float)
    out = np.zeros_like(x)
    out[width:-width] = (x[2 * width :] - x[: -2 * width]) / (time[2 * width :] - time[: -2 * width])[:, None]
    return out


def fresh_rows(fresh: Path, predictions: Mapping[str, Path]) -> list[dict]:
    """Rows for `fresh.json`: the rms on the fresh trials of each prediction, by its name (before, after, best)."""
    measured = read_session(fresh)
    gaps = {name: gap_by_channel(measured, read_predictions(file)) for name, file in predictions.items()}
    first, *others = gaps.values()
    return [
        {"experiment": e, "channel": c} | {name: gap[e, c] for name, gap in gaps.items()}
        for e, c in first
        if all((e, c) in gap for gap in others)
    ]
