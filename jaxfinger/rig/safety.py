"""The host's own limits, in addition to the controller's: `admit` checks commands, `Supervisor` checks samples.

Neither talks to the rig, so the same code supervises a running rig and a recorded file. `admit` refuses a command
before it is sent. `Supervisor` only reports; the `Reader` stops the rig.

This is not a certified safety function. The drives' torque-off input and current limits come first, the controller's
limits second, these last.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

import numpy as np

from jaxfinger.rig.backend import Block, Command, CommandRefused, JointMove, TensionRamp
from jaxfinger.rig.channels import SI_UNITS, RigDescription, for_people
from jaxfinger.rig.contract import DRIVES_ON, FLAGGED, Flag, State, Trip
from jaxfinger.rig.trips import Drift, LeakyCount, RunLength, StillExcursion, UnexplainedExcursion, UnfollowedMove

# Samples over which the host takes joint velocity and tension rate: 20 ms at 1 kHz. One step of a 14-bit encoder
# (3.8e-4 rad) then reads as 0.02 rad/s; from one sample to the next it would read as 0.4 rad/s.
VELOCITY_SPAN = 20


@dataclass(frozen=True)
class Violation:
    """One broken limit: its trip code, the channel that broke it, the sample at which it tripped, the value in `unit`.

    `since` is the number of the first bad sample: data from there on do not belong to the trial. Its default is `seq`.
    `cause` is a sentence without a full stop, where no channel broke a limit.
    """

    trip: Trip
    channel: str
    seq: int
    value: float
    since: int = -1
    cause: str = ""
    unit: str = ""

    @classmethod
    def of_host(cls, trip: Trip, seq: int, cause: str) -> Violation:
        """Violation that the host states in a sentence of its own, found at sample `seq`."""
        return cls(trip, "host", seq, nan, cause=cause)

    def __post_init__(self):
        if self.since < 0:
            object.__setattr__(self, "since", max(self.seq, 0))

    @property
    def sentence(self) -> str:
        """Sentence for people, without a full stop: what happened, and where to look."""
        value = for_people(self.value, self.unit)
        return self.cause or self.trip.said(f"{self.channel} = {value} at sample {self.seq}")


def admit(command: Command, rig: RigDescription) -> None:
    """Check a command against the host's limits before it is sent.

    Raises:
        CommandRefused: a tension, angle, rate, speed or acceleration is not finite or out of range, or the tendon or
            joint does not exist. Nothing is sent then, so nothing moves.
    """
    limits, finger = rig.limits, rig.finger
    if isinstance(command, TensionRamp):
        if not 0 < command.rate <= limits.tension_rate:
            raise CommandRefused(f"a tension rate of {command.rate:g} N/s is outside 0 to {limits.tension_rate:g} N/s.")
        for tendon, tension in command.targets.items():
            if tendon not in finger.tendon_names or not finger.active[finger.tendon_names.index(tendon)]:
                raise CommandRefused(f"'{tendon}' is no active tendon of this finger.")
            if not 0 <= tension <= limits.tension_max:
                raise CommandRefused(f"{tension:g} N for {tendon} is outside 0 to {limits.tension_max:g} N.")
    elif isinstance(command, JointMove):
        if command.joint not in finger.joint_names:
            raise CommandRefused(f"'{command.joint}' is no joint of this finger.")
        low, high = finger.limits[finger.joint_names.index(command.joint)]
        low, high = low + limits.joint_margin, high - limits.joint_margin
        if not low <= command.target <= high:
            raise CommandRefused(
                f"{np.degrees(command.target):.1f}° for {command.joint} is outside "
                f"{np.degrees(low):.1f}° to {np.degrees(high):.1f}°."
            )
        for value, highest, unit in (
            (command.speed, limits.joint_velocity, "°/s"),
            (command.acceleration, limits.joint_acceleration, "°/s²"),
        ):
            if not 0 < value <= highest:
                given, most = np.degrees((value, highest))
                raise CommandRefused(f"{given:.1f}{unit} for {command.joint} is outside 0 to {most:.1f}{unit}.")


class Supervisor:
    """The host's limits on samples. Blocks must be given in order and without exception.

    State is kept from block to block, so that the size of blocks makes no difference.
    """

    def __init__(self, rig: RigDescription):
        self.rig = rig
        finger, limits, n = rig.finger, rig.limits, len(rig.channels)
        kind = np.array([c.kind for c in rig.channels])
        self._tension = np.flatnonzero(kind == "tension")
        self._angle = np.array(rig.columns("joint_position", finger.joint_names))
        self._high = np.full(n, np.inf)
        self._low = np.full(n, -np.inf)
        self._high[self._tension] = limits.tension_max
        self._high[kind == "external_torque"] = limits.joint_torque_max
        self._high[kind == "fingertip_force"] = limits.fingertip_force_max
        self._high[kind == "motor_temperature"] = limits.temperature_max
        # A tendon cannot push: a load cell that reads so is wired the wrong way, or broken.
        symmetric = (kind == "tension") | (kind == "external_torque") | (kind == "fingertip_force")
        self._low[symmetric] = -self._high[symmetric]
        self._high[self._angle] = finger.limits[:, 1]
        self._low[self._angle] = finger.limits[:, 0]
        self._trip = [_TRIPS[k] for k in kind]
        self._patience = np.array([c.frozen for c in rig.channels]) * rig.rate_hz
        self._patience[self._patience == 0] = np.inf
        # Columns (excursion, tension) of the tendons on which both are measured, for the check of frozen encoders.
        pairs = [(int(i), rig.index("tension", rig.channels[int(i)].of)) for i in np.flatnonzero(kind == "excursion")]
        self._excursion = np.array([(i, j) for i, j in pairs if j is not None], int).reshape(-1, 2)
        self._setpoint = np.flatnonzero(kind == "tension_setpoint")
        self._follower = np.array(rig.columns("tension", (rig.channels[int(i)].of for i in self._setpoint)), int)

        self._range_count = LeakyCount(n)
        self._flag_count = LeakyCount(1)
        self._velocity_count = LeakyCount(len(self._angle))
        self._tension_rate_count = LeakyCount(len(self._tension))
        late = int(limits.tension_error_s * rig.rate_hz) + 1 if len(self._setpoint) else 1
        self._tracking_count = LeakyCount(len(self._setpoint), late)
        self._repeats = RunLength(n)
        self._clock_drift = Drift(rig.deadlines.clock_rate)
        self._unexplained = UnexplainedExcursion(len(self._excursion))
        self._encoder_count = LeakyCount(len(self._excursion))
        rows = [finger.tendon_names.index(rig.channels[int(i)].of) for i in self._excursion[:, 0]]
        self._still_excursion = StillExcursion(finger.crosses[rows], np.ptp(finger.limits, 1))
        self._still_count = LeakyCount(len(self._excursion))
        self._move: UnfollowedMove | None = None
        self._first: tuple[int, int] | None = None  # number and device time (ns) of the first sample
        self._before: tuple[int, int] | None = None  # number and device time (ns) of the previous sample
        self._tail = np.empty((0, n))  # the last VELOCITY_SPAN samples of earlier blocks
        self._tail_seq = np.empty(0, np.int64)  # their numbers
        self._last: np.ndarray | None = None  # the last sample of the previous block
        self._read = np.full(n, np.nan)  # the last finite value of every channel

    def check(self, block: Block) -> list[Violation]:
        """Return the violations in a block, in the order of their samples."""
        if not len(block):
            return []
        seq = block.seq.astype(np.int64)
        found = [
            *self._codes(block, seq),
            *self._clock(block, seq),
            *self._values(block, seq),
            *self._frozen(block, seq),
            *self._rates(block, seq),
            *self._tracking(block, seq),
            *self._still(block, seq),
        ]
        found.sort(key=lambda v: v.seq)
        self._tail = np.concatenate([self._tail, block.x])[-VELOCITY_SPAN:]
        self._tail_seq = np.concatenate([self._tail_seq, seq])[-VELOCITY_SPAN:]
        self._last = block.x[-1]
        back = np.argmax(np.isfinite(block.x[::-1]), axis=0)  # samples since the last finite one; 0 where there is none
        value = block.x[len(block) - 1 - back, np.arange(block.x.shape[1])]
        self._read = np.where(np.isfinite(value), value, self._read)
        return found

    def _name(self, channel: int | np.intp) -> str:
        return self.rig.channels[int(channel)].name

    def _violation(self, trip: Trip, channel: int | np.intp, seq: int, value: float, since: int = -1, per: str = ""):
        """Violation by a channel; `per` divides its unit."""
        unit = SI_UNITS[self.rig.channels[int(channel)].kind] + per
        return Violation(trip, self._name(channel), seq, value, since, unit=unit)

    def _codes(self, block: Block, seq: np.ndarray) -> list[Violation]:
        """CONTRACT at the first sample whose state the contract does not define."""
        unknown = np.flatnonzero(block.state > max(State))
        return [Violation(Trip.CONTRACT, "state", int(seq[i]), float(block.state[i])) for i in unknown[:1]]

    def _clock(self, block: Block, seq: np.ndarray) -> list[Violation]:
        """CLOCK where the device's time does not increase, or departs from the count of samples by clock_offset_s."""
        t, allowed = block.t_ns.astype(np.int64), self.rig.deadlines.clock_offset_s
        if self._first is None:
            self._first = int(seq[0]), int(t[0])
            self._before = int(seq[0]) - 1, int(t[0]) - round(1e9 / self.rig.rate_hz)
        assert self._before is not None
        found = []
        rows = zip(seq.tolist(), t.tolist(), strict=True)
        for number, time in rows:
            step, self._before = (number - self._before[0], time - self._before[1]), (number, time)
            passed = (number - self._first[0]) / self.rig.rate_hz
            ahead = (time - self._first[1]) * 1e-9 - passed
            away = self._clock_drift(ahead, ahead, step[0] / self.rig.rate_hz)
            if not found and (step[1] <= 0 or abs(away) > allowed):
                what = "device time since the sample before" if step[1] <= 0 else "device time ahead"
                value = step[1] * 1e-9 if step[1] <= 0 else away
                found.append(Violation(Trip.CLOCK, what, number, value, unit="s"))
        return found

    def _values(self, block: Block, seq: np.ndarray) -> list[Violation]:
        """Channels that are out of their limits, not finite, or flagged by their terminal, with a full count."""
        bad = ~np.isfinite(block.x) | (block.x > self._high) | (block.x < self._low)
        found = []
        for channel, row, since in self._range_count(bad, seq):
            value = float(block.x[row, channel])
            trip = self._trip[channel] if np.isfinite(value) else Trip.INVALID
            found.append(self._violation(trip, channel, int(seq[row]), value, since))
        flagged = (block.flags & FLAGGED) != 0
        for _, row, since in self._flag_count(flagged[:, None], seq):
            flags = [flag.says for flag in Flag if block.flags[row] & int(flag)]
            cause = Trip.INVALID.said(f"{' and '.join(flags)} at sample {int(seq[row])}")
            found.append(Violation(Trip.INVALID, "terminal", int(seq[row]), nan, since, cause))
        return found

    def _frozen(self, block: Block, seq: np.ndarray) -> list[Violation]:
        """FROZEN where a channel has repeated one value for its `frozen` time."""
        last = self._last if self._last is not None else np.full(block.x.shape[1], np.nan)
        runs = self._repeats(block.x == np.concatenate([last[None], block.x[:-1]]))
        late = runs >= self._patience
        found = []
        for channel in np.flatnonzero(late.any(0)):
            row = int(np.argmax(late[:, channel]))
            value = float(block.x[row, channel])
            since = int(seq[row]) - int(runs[row, channel]) + 1
            found.append(self._violation(Trip.FROZEN, channel, int(seq[row]), value, max(since, 0)))
        return found

    def _rates(self, block: Block, seq: np.ndarray) -> list[Violation]:
        """VELOCITY and TENSION_RATE, each over VELOCITY_SPAN samples, with a full count."""
        x, number = np.concatenate([self._tail, block.x]), np.concatenate([self._tail_seq, seq])
        rows = len(x) - VELOCITY_SPAN  # samples of this block that have VELOCITY_SPAN samples before them
        if rows <= 0:
            return []
        seconds = (number[VELOCITY_SPAN:] - number[:-VELOCITY_SPAN]) / self.rig.rate_hz
        x = np.where(np.isfinite(x), x, np.nan)
        rate = (x[VELOCITY_SPAN:] - x[:-VELOCITY_SPAN]) / seconds[:, None]
        limits, found = self.rig.limits, []
        for count, channels, limit, trip in (
            (self._velocity_count, self._angle, limits.joint_velocity_max, Trip.VELOCITY),
            (self._tension_rate_count, self._tension, limits.tension_rate_max, Trip.TENSION_RATE),
        ):
            for k, row, since in count(np.abs(rate[:, channels]) > limit, seq[-rows:]):
                value = float(rate[row, channels[k]])
                at = int(seq[len(seq) - rows + row])
                found.append(self._violation(trip, channels[k], at, value, since, per="/s"))
        return found

    def _tracking(self, block: Block, seq: np.ndarray) -> list[Violation]:
        """TRACKING where a tension differs from its set-point by more than tension_error_max for tension_error_s.

        Samples count only where the drives are on: otherwise the tension follows no set-point.
        """
        on = np.isin(block.state, DRIVES_ON)
        error = block.x[:, self._setpoint] - block.x[:, self._follower]
        off_target = on[:, None] & (np.abs(error) > self.rig.limits.tension_error_max)
        found = []
        for k, row, _ in self._tracking_count(off_target, seq):
            what = f"set-point minus {self._name(self._follower[k])}"
            found.append(Violation(Trip.TRACKING, what, int(seq[row]), float(error[row, k]), unit="N"))
        return found

    def _still(self, block: Block, seq: np.ndarray) -> list[Violation]:
        """FROZEN where an encoder stays still although the external motor, a tendon or a joint must have moved it."""
        found = []
        if (move := self._move) is not None:
            angle = block.x[:, move.column]
            if (row := move(angle, block.state == State.MOVING)) is not None:
                self._move = None
                found.append(self._violation(Trip.FROZEN, move.column, int(seq[row]), float(angle[row])))
        channels, tensions = self._excursion.T
        angle, length, load = block.x[:, self._angle], block.x[:, channels], block.x[:, tensions]
        ran = self._unexplained(angle, length, load)
        for k, row, since in self._encoder_count(ran > UnexplainedExcursion.MAX_UNEXPLAINED, seq):
            name, far, at = self._name(channels[k]), float(ran[row, k]), int(seq[row])
            cause = Trip.FROZEN.said(f"a joint encoder, since {name} ran by {for_people(far, 'm')} up to sample {at}")
            found.append(Violation(Trip.FROZEN, name, at, far, since, cause, "m"))
        turned, since_change = self._still_excursion(angle, length, load, seq)
        for k, row, _ in self._still_count(turned > StillExcursion.MAX_TURN, seq):
            value, since = float(length[row, k]), int(since_change[row, k]) + 1
            found.append(self._violation(Trip.FROZEN, channels[k], int(seq[row]), value, since))
        return found

    def commanded(self, command: Command) -> None:
        """Take note of a command, to check that the joint's encoder follows a move of the external motor."""
        if isinstance(command, JointMove):
            column = self.rig.index("joint_position", command.joint)
            self._move = None  # An earlier move is over, and this one may come near its start again.
            if column is not None and abs(command.target - self._read[column]) > UnfollowedMove.DISTANCE:
                start, rate = float(self._read[column]), self.rig.rate_hz
                self._move = UnfollowedMove(column, start, command.speed, command.acceleration, rate)
        elif not isinstance(command, TensionRamp):
            self._move = None


def armed(block: Block) -> bool:
    """Whether any sample has the drives on (ARMED, MOVING), or a state that the contract does not define."""
    return bool((np.isin(block.state, DRIVES_ON) | (block.state > max(State))).any())


# The trip code of a finite value out of its limits, by kind of channel.
_TRIPS = {
    "tension": Trip.TENSION,
    "excursion": Trip.INVALID,
    "joint_position": Trip.POSITION,
    "external_torque": Trip.TORQUE,
    "fingertip_force": Trip.FORCE,
    "tension_setpoint": Trip.INVALID,
    "motor_temperature": Trip.TEMPERATURE,
}
