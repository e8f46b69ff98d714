"""Columns that read the same at every sample of a trial. Every sensor has noise, so that none has measured them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.session import FingerDescription, Trial

if TYPE_CHECKING:
    from jaxtyping import Bool

_TAUT = ("ID.2", "VD.1", "VD.3")  # experiments that keep all tendons taut
_MIN_SAMPLES = 20  # A coarse sensor may read the same in a few samples.


def constant_columns(trial: Trial, finger: FingerDescription) -> dict[str, Bool[np.ndarray, " columns"]]:
    """Which columns of each measured channel never change although the trial's motion changes what they measure."""
    if len(trial.time) < _MIN_SAMPLES:
        return {}
    moved = np.array([name == trial.joint for name in finger.joint_names])
    crossed = finger.crosses[:, moved].any(axis=1) if moved.any() else finger.crosses.any(axis=1)
    looked_at = {
        "joint_torque": moved if moved.any() else np.ones(finger.m, bool),
        "tendon_excursion": finger.active & crossed if trial.experiment != "ID.4" else np.zeros(finger.n, bool),
        "fingertip_force": np.ones(3, bool),
        "tendon_force": finger.active if trial.experiment in _TAUT else np.zeros(finger.n, bool),
    }
    out = {}
    for name, columns in looked_at.items():
        values = getattr(trial, name)
        if values is None:
            continue
        still = columns & np.array([np.ptp(column) == 0.0 for column in values.T], bool)  # False for NaN.
        if name == "tendon_force":
            still &= values[0] == 0.0
        if name == "fingertip_force" and not still.all():
            continue  # A planar finger presses along one axis only.
        out[name] = still
    return out
