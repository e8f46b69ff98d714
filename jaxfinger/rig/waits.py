"""Conditions that a step of a protocol waits for. Each is called with every new block and returns whether it is met."""

from __future__ import annotations

import numpy as np

from jaxfinger.rig.backend import Block, Setup
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.contract import State
from jaxfinger.rig.protocols import POSE_SHARE, Covered, Settled, swept
from jaxfinger.rig.reader import Reader

# N of measured tension, up to which a tendon counts as released. In 0.7 s the controller ramps to 2 N, then to 0.5 N
# (docs/plc-contract.md); what lies between is for zeros of load cells and for friction that holds a tendon.
RELEASED_TENSION = 2.0


def tensions(block: Block | None, rig: RigDescription) -> dict[str, float]:
    """Newest tension in N of every tendon that a drive pulls, by name of the channel; empty without a block."""
    if block is None:
        return {}
    active = [name for name, active in zip(rig.finger.tendon_names, rig.finger.active, strict=True) if active]
    return {rig.channels[column].name: float(block.x[-1, column]) for column in rig.columns("tension", active)}


def pulled(tension: dict[str, float]) -> str:
    """What a channel reads beyond RELEASED_TENSION, or an empty string.

    A load cell that reads NaN, or that a tendon pushes, sees no tension fall.
    """
    return next((f"'{k}' reads {v:.3g} N" for k, v in tension.items() if not abs(v) <= RELEASED_TENSION), "")


class Pulls:
    """A driven tendon has read more than RELEASED_TENSION at every look for `seconds` of samples."""

    def __init__(self, rig: RigDescription, seconds: float):
        self._rig, self._need = rig, round(seconds * rig.rate_hz)
        self._since: int | None = None  # number of the sample at which it was first seen

    def __call__(self, block: Block | None) -> bool:
        if block is None or not pulled(tensions(block, self._rig)):
            self._since = None
            return False
        newest = int(block.seq[-1])
        self._since = newest if self._since is None else self._since
        return newest - self._since >= self._need


def elsewhere(block: Block | None, rig: RigDescription, angles: dict[str, float]) -> str:
    """Which joint's encoder reads another angle than `angles` (rad) by POSE_SHARE of its range; "" where none does."""
    for name, angle in angles.items():
        column = rig.index("joint_position", name)
        low, high = rig.finger.limits[rig.finger.joint_names.index(name)]
        assert column is not None  # The rig file is refused without one.
        read = np.nan if block is None else float(block.x[-1, column])
        if not abs(read - angle) <= POSE_SHARE * (high - low):
            return f"'{rig.channels[column].name}' reads {np.degrees(read):.1f}°, not {np.degrees(angle):.1f}°"
    return ""


class Elapsed:
    """`seconds` of device time have passed since now."""

    def __init__(self, reader: Reader, seconds: float):
        self._until = reader.latest_t + int(seconds * 1e9)

    def __call__(self, block: Block) -> bool:
        return int(block.t_ns[-1]) >= self._until


def reached(block: Block, number: int) -> bool:
    """Whether the controller has carried out command `number`: a sample has processed it and is ARMED, not MOVING."""
    return bool(np.any((block.acknowledged == number & 0xFFFF) & (block.state == State.ARMED)))


class Steady:
    """Every tension of the step has stayed within its band for `step.seconds`."""

    def __init__(self, rig: RigDescription, step: Settled):
        self._columns = rig.columns("tension", step.tensions)
        self._targets = np.array(list(step.tensions.values()))
        self._names = [rig.channels[column].name for column in self._columns]
        self._within, self._need = step.within, round(step.seconds * rig.rate_hz)
        self._good = 0
        self.lacks = ""  # which tension was last outside of its band

    def __call__(self, block: Block) -> bool:
        off = ~(np.abs(block.x[:, self._columns] - self._targets) < self._within)
        good = ~off.any(1)
        bad = np.flatnonzero(~good)
        if len(bad):
            k = int(np.argmax(off[bad[-1]]))
            self.lacks = f": '{self._names[k]}' reads {block.x[bad[-1], self._columns[k]]:.3g} N, not "
            self.lacks += f"{self._targets[k]:.3g} N; see its unit, scale and offset"
        self._good = self._good + len(block) if not len(bad) else len(block) - 1 - int(bad[-1])
        return self._good >= self._need


class Passes:
    """Every joint of the step has gone through `step.share` of its range `step.passes` times each way."""

    def __init__(self, rig: RigDescription, step: Covered):
        self._columns = rig.columns("joint_position", step.joints)
        self._joints = step.joints
        self._low, self._high = np.transpose([swept(rig.finger, name, step.share) for name in step.joints])
        self._side, self._turns = [0] * len(step.joints), [0] * len(step.joints)
        self._need = 2 * step.passes

    def __call__(self, block: Block) -> bool:
        for j, column in enumerate(self._columns):
            for side, hit in ((1, block.x[:, column] >= self._high[j]), (-1, block.x[:, column] <= self._low[j])):
                if self._side[j] != side and hit.any():
                    self._turns[j] += self._side[j] != 0
                    self._side[j] = side
        return min(self._turns) >= self._need

    @property
    def lacks(self) -> str:
        """Which joint has gone through its range too seldom, and where it must go."""
        j = int(np.argmin(self._turns))
        low, high = np.degrees((self._low[j], self._high[j]))
        times = f"{self._turns[j]} times of {self._need}"
        return f": {self._joints[j]} went between {low:.1f}° and {high:.1f}° {times}; see that it reaches both"


class AtPose:
    """Every fixed joint is within TOLERANCE of the angle at which its fixture holds it."""

    TOLERANCE = 0.02  # rad, 1.1°: fifty steps of a 14-bit encoder

    def __init__(self, rig: RigDescription, setup: Setup):
        self._columns = rig.columns("joint_position", setup.fixed)
        self._pose = np.array(list(setup.fixed.values()))

    def __call__(self, block: Block) -> bool:
        return not self._columns or bool((np.abs(block.x[-1, self._columns] - self._pose) < self.TOLERANCE).all())
