"""Columns of a log that are the speeds of others: they tell the sampling rate where the log has no clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

_MIN_ALIKE = 0.995  # correlation of a speed with the change of its angle; those of other motions are below
_WINDOWS = 200  # of a recording, over each of which changes and speeds are compared, so that noise averages out
_MAX_WINDOW = 50  # samples: longer ones may cover a reversal
_MIN_SAMPLES = 100  # fewer may be alike by chance


class Speed(NamedTuple):
    """Column `of` whose change over time is the column `speed`, where `rate` samples are taken in a second."""

    of: int
    speed: int
    rate: float  # Hz, where the speed's unit is that of the angle by second


def speeds(columns: Sequence[Float[np.ndarray, " N"]]) -> list[Speed]:
    """Find pairs of columns of which one goes as the change of the other: for each column its most similar speed."""
    moving = [k for k, x in enumerate(columns) if np.isfinite(x).all() and np.ptp(x) > 0.0]
    if not moving or len(columns[0]) < _MIN_SAMPLES:
        return []
    table = np.stack([columns[k] for k in moving])
    width = int(np.clip(table.shape[1] // _WINDOWS, 2, _MAX_WINDOW))
    sums = np.cumsum(np.pad(table, ((0, 0), (1, 0))), axis=1)
    mean = (sums[:, width:] - sums[:, :-width]) / width  # of each run of `width` samples
    # Centred as the mean of the trapezoids between the samples of a run.
    change = (table[:, width - 1 :] - table[:, : table.shape[1] - width + 1]) / (width - 1)
    size = np.linalg.norm(change, axis=1), np.linalg.norm(mean, axis=1)
    products = change @ mean.T
    alike = products / np.maximum(np.outer(*size), 1e-300)
    np.fill_diagonal(alike, 0.0)
    found = []
    for i, j in enumerate(np.argmax(alike, axis=1)):
        if alike[i, j] > _MIN_ALIKE and i == int(np.argmax(alike[:, j])):
            found.append(Speed(moving[i], moving[j], float(products[i, j] / size[0][i] ** 2)))
    return found
