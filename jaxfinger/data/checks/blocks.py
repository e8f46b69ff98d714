"""A trial of ID.3 as one joint's motor sees it: means over blocks, in which the joint goes on in one direction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxfinger.data.session import Trial
from jaxfinger.data.signals.motion import STILL_SHARE, directions

_BLOCKS = 300  # of a trial, of which means are taken: the protocol's quickest cycle still has ten of them.
# rad between two postures. A joint that turns by less shifts the curve of a weight over another joint's angle by no
# more, so that the two curves count as one.
MIN_POSTURE = 0.2


class Motion(NamedTuple):
    """Means over the blocks of a trial in which a motor moves one joint, without the blocks where it turns round."""

    q: np.ndarray  # (N, m)
    torque: np.ndarray  # (N,), of the motor
    dynamics: np.ndarray  # (N, 1 + k): speed, and accelerations of all joints that move
    direction: np.ndarray  # (N,): −1 or 1


def motion_of(trial: Trial, i: int, moving: Sequence[int]) -> list[Motion]:
    """The trial's motion as joint i sees it, where joints `moving` move.

    There is none where values are missing or too few, or the joint stands still.
    """
    if trial.joint_torque is None or len(trial.time) < _BLOCKS:
        return []
    size = len(trial.time) // _BLOCKS
    columns = np.column_stack([trial.time, trial.joint_torque[:, i], trial.q])[: _BLOCKS * size]
    time, torque, *angles = columns.reshape(_BLOCKS, size, -1).mean(axis=1).T
    q = np.column_stack(angles)
    rate = np.gradient(q[:, i], time)
    accelerations = [np.gradient(np.gradient(q[:, k], time), time) for k in moving]
    dynamics = np.column_stack([rate, *accelerations])
    if not (np.isfinite(columns).all() and np.isfinite(dynamics).all() and np.ptp(q[:, i]) > MIN_POSTURE):
        return []
    # Slow blocks count where the joint goes on in the direction in which it came.
    least = STILL_SHARE * np.percentile(np.abs(rate), 99, keepdims=True)
    before, after = (directions(rate[way, None], least)[way, 0] for way in (slice(None), slice(None, None, -1)))
    goes_on = (before == after) & (before != 0.0)
    return [Motion(q[goes_on], torque[goes_on], dynamics[goes_on], before[goes_on])] if goes_on.any() else []
