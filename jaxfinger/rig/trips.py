"""State machines that decide when a fault has lasted long enough to stop the rig.

Each keeps its state from block to block, so the result depends only on the samples and their times: the same samples in
blocks of another size trip at the same sample.
"""

from __future__ import annotations

from math import isfinite, nan

import numpy as np
from jaxtyping import Bool, Float, Int

# Consecutive bad samples that trip a limit, as on the controller (docs/plc-contract.md, Trips). One odd sample must not
# drop the finger.
FULL_COUNT = 3
# A good sample lowers the count by this much. A share p of bad samples fills the count where p > LEAK (1 - p), so a
# fault in more than one sample of five trips in the end.
LEAK = 0.25


class Hit(tuple[int, int, int]):
    """Full count: (column, row of the block at which it fills, number of the sample at which its bad samples began)."""


class LeakyCount:
    """One count per column. A bad sample adds 1, a good one subtracts LEAK down to 0; at `need` the count is full."""

    def __init__(self, width: int, need: int = FULL_COUNT):
        self.need = need
        self._level = np.zeros(width)
        self._since = np.zeros(width, np.int64)

    def __call__(self, bad: Bool[np.ndarray, "N C"], seq: Int[np.ndarray, " N"]) -> list[Hit]:
        """Return the first sample of the block at which each column's count is full."""
        if not bad.any() and not self._level.any():
            return []
        # Multiples of a quarter add without rounding, so the result does not depend on where a block ends.
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


class RunLength:
    """Number of consecutive True samples up to and including each sample, column by column."""

    def __init__(self, width: int):
        self._length = np.zeros(width, np.int64)

    def __call__(self, true: Bool[np.ndarray, "N C"]) -> Int[np.ndarray, "N C"]:
        """Run lengths in samples. A run that began in an earlier block counts from its beginning."""
        index = np.arange(len(true))[:, None]
        last_false = np.maximum.accumulate(np.where(true, -1, index), 0)
        runs = np.where(last_false >= 0, index - last_false, index + 1 + self._length) * true
        self._length = runs[-1]
        return runs


class Drift:
    """Change of a clock's lead over another clock that a rate error of at most `rate` (s/s) does not explain.

    A reference follows the lead by at most `rate` seconds per second. A clock whose rate is wrong by less stays near
    its reference. The lead of a clock whose rate is wrong by more leaves the reference behind, beyond every bound. A
    jump shows at once.
    """

    def __init__(self, rate: float):
        self._rate = rate
        self._reference: float | None = None

    def __call__(self, low: float, high: float, elapsed: float) -> float:
        """Signed distance in s from the reference to the interval [low, high] in which the lead (s) lies.

        It is zero where the reference lies in the interval. `elapsed` is the time in s since the last call.
        """
        if self._reference is None:
            self._reference = (low + high) / 2
        away = min(high - self._reference, 0.0) + max(low - self._reference, 0.0)
        slack = self._rate * max(elapsed, 0.0)
        self._reference += min(max(away, -slack), slack)
        return away


class UnexplainedExcursion:
    """Excursion of tendons under steady tension while no joint encoder moves.

    More than MAX_UNEXPLAINED of it means that an encoder is frozen. The thresholds are proposals, to be tuned on the
    bench.
    """

    MIN_TENSION = 1.0  # N. A tendon with less may be slack, and may then run without moving a joint.
    MAX_TENSION_CHANGE = 0.5  # N. A larger change stretches tendon and spool: excursion counts anew from there.
    # rad, 1.1°. An encoder that changes by less counts as still. With moment arms up to 10.5 mm (Table I of the paper)
    # one such joint explains at most 0.2 mm of excursion.
    MAX_STILL_ANGLE = 0.02
    MAX_UNEXPLAINED = 1.5e-3  # m: seven times these 0.2 mm, which leaves room for several joints and for noise.

    def __init__(self, tendons: int):
        self._angle: list[float] | None = None
        self._length, self._load = [0.0] * tendons, [0.0] * tendons

    def __call__(
        self, angle: Float[np.ndarray, "N m"], length: Float[np.ndarray, "N n"], load: Float[np.ndarray, "N n"]
    ) -> Float[np.ndarray, "N n"]:
        """Unexplained excursion in m of each tendon at each sample.

        `angle` holds the joint encoders in rad, `length` and `load` the tendons' excursions in m and tensions in N.
        Nothing is counted at or from a value that is not finite.
        """
        ran = np.zeros(length.shape)
        if not length.shape[1]:
            return ran
        for row, (q, l, f) in enumerate(zip(angle.tolist(), length.tolist(), load.tolist(), strict=True)):
            if not all(map(isfinite, q)):
                continue
            at = self._angle
            if at is None or any(abs(a - b) > self.MAX_STILL_ANGLE for a, b in zip(q, at, strict=True)):
                self._angle, self._load = q, [nan] * len(f)  # Every tendon counts anew.
            for k, tension in enumerate(f):
                if not (isfinite(tension) and isfinite(l[k])):
                    continue
                if tension < self.MIN_TENSION or not abs(tension - self._load[k]) <= self.MAX_TENSION_CHANGE:
                    self._length[k], self._load[k] = l[k], tension
                else:
                    ran[row, k] = abs(l[k] - self._length[k])
        return ran


class StillExcursion:
    """Joints that turn while the encoder of a loaded tendon that crosses them repeats one value.

    A turn by more than MAX_TURN means that the tendon's encoder is frozen. One that works repeats no value for long,
    since the drive that holds the tension follows the joint. `crosses` tells which tendons cross which joints, `span`
    (rad) is the joints' range.
    """

    MAX_TURN = 0.25  # of a joint's range; the moment arm of a tendon may be zero within a part of it

    def __init__(self, crosses: Bool[np.ndarray, "n m"], span: Float[np.ndarray, " m"]):
        self._share = crosses / span
        self._length = np.full(len(crosses), nan)
        self._angle = np.full(crosses.shape, nan)  # of the joints when each encoder last changed, rad
        self._since = np.zeros(len(crosses), np.int64)  # number of that sample

    def __call__(
        self,
        angle: Float[np.ndarray, "N m"],
        length: Float[np.ndarray, "N n"],
        load: Float[np.ndarray, "N n"],
        seq: Int[np.ndarray, " N"],
    ) -> tuple[Float[np.ndarray, "N n"], Int[np.ndarray, "N n"]]:
        """Turn of the crossed joints, as a share of their range, since each encoder last changed; and sample of that.

        `angle` (rad), `length` (m) and `load` (N) are as for UnexplainedExcursion, `seq` numbers the samples.
        """
        before = np.concatenate([self._length[None], length[:-1]])
        repeats = (length == before) & (load >= UnexplainedExcursion.MIN_TENSION)
        last = np.maximum.accumulate(np.where(repeats, -1, np.arange(len(seq))[:, None]), 0)
        since = np.where(last >= 0, seq[last], self._since)
        at = np.where(last[..., None] >= 0, angle[last], self._angle)
        self._length, self._angle, self._since = length[-1], at[-1], since[-1]
        return np.nan_to_num(np.abs(angle[:, None] - at) * self._share).max(-1, initial=0.0), since


class UnfollowedMove:
    """Watch over one commanded move of the external motor: its joint's encoder must follow, or it is frozen.

    `column` is the encoder's column, `start` its angle (rad) at the command, `speed` (rad/s) and `acceleration`
    (rad/s²) those of the command. The encoder must leave `start` by MAX_STILL_ANGLE before the motor, which starts from
    rest, has covered DISTANCE.
    """

    # rad. A motor that only accelerates covers it in √5 times the time that it needs for MAX_STILL_ANGLE: the rest is
    # for delays of drive and encoder, 75 ms at 10 rad/s².
    DISTANCE = 5 * UnexplainedExcursion.MAX_STILL_ANGLE

    def __init__(self, column: int, start: float, speed: float, acceleration: float, rate_hz: float):
        self.column = column
        self._start, self._need = start, time_to_cover(self.DISTANCE, speed, acceleration) * rate_hz
        self._still = 0

    def __call__(self, angle: Float[np.ndarray, " N"], moving: Bool[np.ndarray, " N"]) -> int | None:
        """Row of the block at which the encoder is found frozen, or None. `moving` marks samples in state MOVING."""
        still = self._still + np.cumsum(moving & (np.abs(angle - self._start) < UnexplainedExcursion.MAX_STILL_ANGLE))
        self._still = int(still[-1])
        return int(np.argmax(still > self._need)) if self._still > self._need else None


def time_to_cover(distance: float, speed: float, acceleration: float) -> float:
    """Time (s) in which a motor covers `distance` (rad) from rest, with constant acceleration up to `speed`."""
    while_accelerating = speed**2 / (2.0 * acceleration)
    if distance <= while_accelerating:
        return float(np.sqrt(2.0 * distance / acceleration))
    return distance / speed + speed / (2.0 * acceleration)
