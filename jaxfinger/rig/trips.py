"""The state machines behind the trips. What they say of a sample depends on samples and their times alone: cut the same
samples into other blocks, and they trip at the same sample.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

PERSIST = 3  # bad samples: one odd sample must not drop the finger
LEAK = 0.25  # what a good sample takes off the count: what is bad more often than in one sample of five ends in a trip


class Hit(tuple[int, int, int]):
    """(column, row at which its count is full, number of the sample at which its bad samples began)."""


class Count:
    """A leaking count a column: a bad sample adds 1, a good one takes off LEAK; at `need` it is full."""

    def __init__(self, width: int, need: int = PERSIST):
        self.need = need
        self._level = np.zeros(width)
        self._since = np.zeros(width, np.int64)

    def __call__(self, bad: Bool[np.ndarray, "N C"], seq: Int[np.ndarray, " N"]) -> list[Hit]:
        """The first sample of each column at which the count is full."""
        if not bad.any() and not self._level.any():
            return []
        # sums of quarters are exact in floating point, so that no rounding depends on where a block ends
        total = self._level + np.cumsum(np.where(bad, 1.0, -LEAK), 0)
        level = total - np.minimum(np.minimum.accumulate(total, 0), 0.0)
        hits = []
        for column in np.flatnonzero(bad.any(0) | (self._level > 0)):
            if level[:, column].max() >= self.need:
                hits += self._one_by_one(int(column), bad[:, column], seq)
                continue
            empty = np.flatnonzero(level[:, column] == 0.0)
            began = np.flatnonzero(bad[:, column])
            if len(empty):
                began = began[began > empty[-1]]
            if len(began) and (len(empty) or self._level[column] == 0.0):
                self._since[column] = seq[began[0]]
            self._level[column] = level[-1, column]
        return hits

    def _one_by_one(self, column: int, bad: Bool[np.ndarray, " N"], seq: Int[np.ndarray, " N"]) -> list[Hit]:
        level, since, hit = float(self._level[column]), int(self._since[column]), None
        for row, wrong in enumerate(bad.tolist()):
            if wrong and level == 0.0:
                since = int(seq[row])
            level = min(level + 1.0, float(self.need)) if wrong else max(level - LEAK, 0.0)
            if hit is None and wrong and level >= self.need:
                hit = Hit((column, row, since))
        self._level[column], self._since[column] = level, since
        return [hit] if hit is not None else []


class Run:
    """Length of the run of True that ends at each sample, column by column."""

    def __init__(self, width: int):
        self._length = np.zeros(width, np.int64)

    def __call__(self, true: Bool[np.ndarray, "N C"]) -> Int[np.ndarray, "N C"]:
        """Run lengths, those of earlier blocks included."""
        index = np.arange(len(true))[:, None]
        last_false = np.maximum.accumulate(np.where(true, -1, index), 0)
        runs = np.where(last_false >= 0, index - last_false, index + 1 + self._length) * true
        self._length = runs[-1]
        return runs


class Drift:
    """How far a clock is from where it should be: the reference follows it, at most at `rate`.

    A clock that differs by less than `rate` is followed for ever; one that differs by more is left behind until it is
    farther away than any offset that is allowed.
    """

    def __init__(self, rate: float):
        self._rate = rate
        self._reference: float | None = None

    def __call__(self, low: float, high: float, elapsed: float) -> float:
        """Distance of the clock, known to lie in [low, high], from its reference, after `elapsed` s more."""
        if self._reference is None:
            self._reference = (low + high) / 2
        away = min(high - self._reference, 0.0) + max(low - self._reference, 0.0)
        slack = self._rate * max(elapsed, 0.0)
        self._reference += min(max(away, -slack), slack)
        return away


class Excursion:
    """Tendons that run under steady load while no joint encoder moves: an encoder is frozen."""

    LOADED = 1.0  # N: a slack tendon may run
    STEADY = 0.5  # N: a change of load stretches tendon and spool
    STILL = 0.02  # rad: an encoder that counts as not moving
    UNEXPLAINED = 1.5e-3  # m of excursion

    def __init__(self, tendons: int):
        self._angle: list[float] | None = None
        self._length, self._load = [0.0] * tendons, [0.0] * tendons

    def __call__(
        self, angle: Float[np.ndarray, "N m"], length: Float[np.ndarray, "N n"], load: Float[np.ndarray, "N n"]
    ) -> Float[np.ndarray, "N n"]:
        """Excursion, m, that no encoder explains, at each sample."""
        ran = np.zeros(length.shape)
        if not length.shape[1]:
            return ran
        for row, (q, l, f) in enumerate(zip(angle.tolist(), length.tolist(), load.tolist(), strict=True)):
            at = self._angle
            if at is None or any(abs(a - b) > self.STILL for a, b in zip(q, at, strict=True)):
                self._angle, self._length, self._load = q, l, f
                continue
            for k, tension in enumerate(f):
                if not tension >= self.LOADED or abs(tension - self._load[k]) > self.STEADY:
                    self._length[k], self._load[k] = l[k], tension
                else:
                    ran[row, k] = abs(l[k] - self._length[k])
        return ran


class Driven:
    """An encoder that does not follow the external motor."""

    def __init__(self, column: int, start: float, speed: float, rate_hz: float):
        self.column = column
        self._start, self._need = start, 5 * Excursion.STILL / speed * rate_hz
        self._still = 0

    def __call__(self, angle: Float[np.ndarray, " N"], moving: Bool[np.ndarray, " N"]) -> int | None:
        """Row at which the motor must have moved the joint by five times what counts as not moving."""
        still = self._still + np.cumsum(moving & (np.abs(angle - self._start) < Excursion.STILL))
        self._still = int(still[-1])
        return int(np.argmax(still > self._need)) if self._still > self._need else None
