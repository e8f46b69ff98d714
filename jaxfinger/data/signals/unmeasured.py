"""Values that no sensor has measured: columns that read the same throughout, and numbers that stand for a missing one.

Every sensor has noise, so that the readings of none are the same at every sample of a motion.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.session import FingerDescription, Trial

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_TAUT = ("ID.2", "VD.1", "VD.3")  # experiments that keep all tendons taut
_FREE, _PULLS = ("VD.1", "VD.3"), ("ID.4", "VD.2")  # that move all joints, and that pull one tendon
_MIN_SAMPLES = 20  # A coarse sensor may read the same in a few samples, and a few show no typical range.


def constant_columns(trial: Trial, finger: FingerDescription) -> dict[str, Bool[np.ndarray, " columns"]]:
    """Which columns of each measured channel never change although the trial's motion changes what they measure."""
    if len(trial.time) < _MIN_SAMPLES:
        return {}
    moved = np.array([name == trial.joint for name in finger.joint_names])
    pulled = np.array([name == trial.tendon for name in finger.tendon_names], bool) & (trial.experiment in _PULLS)
    crossed = finger.crosses[:, moved].any(axis=1) if moved.any() else finger.crosses.any(axis=1)
    looked_at = {
        "q": np.full(finger.m, trial.experiment in _FREE),
        "joint_torque": moved if moved.any() else np.ones(finger.m, bool),
        "tendon_excursion": finger.active & crossed if trial.experiment != "ID.4" else np.zeros(finger.n, bool),
        "fingertip_force": np.ones(3, bool),
        "tendon_force": finger.active if trial.experiment in _TAUT else pulled,
    }
    out = {}
    for name, columns in looked_at.items():
        values = getattr(trial, name)
        if values is None:
            continue
        still = columns & np.array([np.ptp(column) == 0.0 for column in values.T], bool)  # False for NaN.
        if name == "tendon_force":
            still &= (values[0] == 0.0) | pulled | (trial.experiment == "VD.3")
        if name == "fingertip_force" and not still.all():
            continue  # A planar finger presses along one axis only.
        out[name] = still
    return out


def placeholder(x: Float[np.ndarray, " N"]) -> float | None:
    """Value of some samples that lies twice as far from the others as they span; None where there is none."""
    if len(x) < _MIN_SAMPLES or not np.isfinite(x).all():
        return None
    for end in (x.min(), x.max()):
        is_other = x != end
        if 1 < len(x) - np.count_nonzero(is_other) < 0.5 * len(x):
            others = x[is_other]
            if np.abs(others - end).min() > 2.0 * np.ptp(others) > 0.0:
                return float(end)
    return None
