"""Safety on the host, on top of the controller's own: pure NumPy on blocks, so the same code runs online and on files.

Not a certified safety function: hardware (torque-off input, drive current limits) and the controller come first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxfinger.rig.backend import Block, Command, CommandRefused, JointMove, TensionRamp
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.contract import Flag, State, Trip

PERSIST = 3  # consecutive samples: one odd sample must not drop the finger
VELOCITY_SPAN = 20  # samples over which host-side velocity and tension rate are taken: encoder steps must not trip
UNEXPLAINED = 1.5e-3  # m of tendon excursion while no joint encoder moves
STILL = 0.02  # rad, an encoder that counts as not moving


@dataclass(frozen=True)
class Violation:
    """A limit that was broken: which, by which channel, at which sample, with what value (SI)."""

    trip: Trip
    channel: str
    seq: int
    value: float

    @property
    def sentence(self) -> str:
        """The violation in words."""
        return f"{self.trip.sentence} ({self.channel} = {self.value:.4g} at sample {self.seq})"


def admit(command: Command, rig: RigDescription) -> None:
    """Refuse a set-point that is not finite, out of range or too fast; raises CommandRefused, and nothing moves."""
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
        if not 0 < command.speed <= limits.joint_velocity or not 0 < command.acceleration < np.inf:
            raise CommandRefused(
                f"{np.degrees(command.speed):.1f}°/s for {command.joint} is outside "
                f"0 to {np.degrees(limits.joint_velocity):.1f}°/s."
            )


class Supervisor:
    """Checks every block in order, and remembers what it needs between blocks. The first violations latch it."""

    def __init__(self, rig: RigDescription):
        self.rig = rig
        finger, n = rig.finger, len(rig.channels)
        kind = np.array([c.kind for c in rig.channels])
        self._tension = np.flatnonzero(kind == "tension")
        self._excursion = np.flatnonzero(kind == "excursion")
        self._angle = np.array(rig.columns("joint_position", finger.joint_names))
        self._high = np.full(n, np.inf)
        self._low = np.full(n, -np.inf)
        self._high[self._tension] = rig.limits.tension_max
        self._high[kind == "external_torque"] = rig.limits.joint_torque_max
        self._high[kind == "fingertip_force"] = rig.limits.fingertip_force_max
        self._high[kind == "motor_temperature"] = rig.limits.temperature_max
        symmetric = (kind == "external_torque") | (kind == "fingertip_force")
        self._low[symmetric] = -self._high[symmetric]
        self._high[self._angle] = finger.limits[:, 1]
        self._low[self._angle] = finger.limits[:, 0]
        self._partner = [rig.index("tension", rig.channels[int(i)].of) for i in self._excursion]
        self._setpoint = np.flatnonzero(kind == "tension_setpoint")
        self._follower = np.array(rig.columns("tension", (rig.channels[int(i)].of for i in self._setpoint)), int)
        self._trip = [_TRIPS[k] for k in kind]
        self._patience = np.array([c.frozen for c in rig.channels]) * rig.rate_hz
        self.tripped: tuple[Violation, ...] = ()
        self.start()

    def start(self) -> None:
        """Forget the past: after a reset, a restart of the controller, or a gap."""
        n = len(self.rig.channels)
        self._last_t: int | None = None
        self._tail = np.empty((0, n))
        self._run = np.zeros(n, int)  # consecutive samples out of limits
        self._same = np.zeros(n, int)  # consecutive samples with an identical value
        self._astray = np.zeros(len(self._setpoint), int)  # consecutive samples away from the set-point
        self._moved: np.ndarray | None = None  # values when an encoder last moved
        self._last: np.ndarray | None = None
        self._driven: tuple[int, float, float] | None = None  # channel, angle at the command, speed
        self._driving = 0  # samples under way without the encoder moving

    def check(self, block: Block) -> list[Violation]:
        """Violations in this block, first ones first; they also latch in `tripped`."""
        if not len(block):
            return []
        if block.lost_before:
            self.start()
        found = [
            *self._clock(block),
            *self._values(block),
            *self._frozen(block),
            *self._rates(block),
            *self._tracking(block),
            *self._still(block),
        ]
        found.sort(key=lambda v: v.seq)
        if found and not self.tripped:
            self.tripped = tuple(found)
        keep = np.concatenate([self._tail, block.x])
        self._tail = keep[-VELOCITY_SPAN - PERSIST :]
        self._last = block.x[-1]
        return found

    def _name(self, channel: int | np.intp) -> str:
        return self.rig.channels[int(channel)].name

    def _clock(self, block: Block) -> list[Violation]:
        t = block.t_ns.astype(np.int64)
        before = np.concatenate([[self._last_t if self._last_t is not None else t[0] - 1], t[:-1]])
        self._last_t = int(t[-1])
        back = np.flatnonzero(t <= before)
        return [
            Violation(Trip.CLOCK, "device time in s", int(block.seq[i]), float(t[i] - before[i]) * 1e-9)
            for i in back[:1]
        ]

    def _values(self, block: Block) -> list[Violation]:
        finite = np.isfinite(block.x)
        flagged = (block.flags & int(Flag.BUS | Flag.ENCODER | Flag.ANALOG)) != 0
        bad = ~finite | (block.x > self._high) | (block.x < self._low)
        found = []
        for channel in np.flatnonzero(bad.any(0) | (self._run > 0)):
            runs = _runs(bad[:, channel], int(self._run[channel]))
            self._run[channel] = runs[-1]
            if (runs >= PERSIST).any():
                at = int(np.argmax(runs >= PERSIST))
                value = float(block.x[at, channel])
                trip = self._trip[channel] if np.isfinite(value) else Trip.INVALID
                found.append(Violation(trip, self._name(channel), int(block.seq[at]), value))
        if flagged.sum() >= PERSIST:
            at = int(np.flatnonzero(flagged)[PERSIST - 1])
            found.append(Violation(Trip.INVALID, "terminal flags", int(block.seq[at]), float(block.flags[at] & 0xFFFF)))
        return found

    def _frozen(self, block: Block) -> list[Violation]:
        last = self._tail[-1:] if len(self._tail) else block.x[:1] + np.nan
        x = np.concatenate([last, block.x])
        same = x[1:] == x[:-1]
        found = []
        for channel in np.flatnonzero(self._patience > 0):
            runs = _runs(same[:, channel], int(self._same[channel]))
            self._same[channel] = runs[-1]
            late = runs >= self._patience[channel]
            if late.any():
                at = int(np.argmax(late))
                found.append(
                    Violation(Trip.FROZEN, self._name(channel), int(block.seq[at]), float(block.x[at, channel]))
                )
        return found

    def _rates(self, block: Block) -> list[Violation]:
        """Joint velocity and tension rate over VELOCITY_SPAN samples."""
        x = np.concatenate([self._tail[-VELOCITY_SPAN:], block.x])
        if len(x) <= VELOCITY_SPAN:
            return []
        x = np.where(np.isfinite(x), x, np.nan)
        rate = (x[VELOCITY_SPAN:] - x[:-VELOCITY_SPAN]) * self.rig.rate_hz / VELOCITY_SPAN
        seq = block.seq[len(block) - len(rate) :]
        found = []
        for channels, limit, trip in (
            (self._angle, self.rig.limits.joint_velocity_max, Trip.VELOCITY),
            (self._tension, self.rig.limits.tension_rate_max, Trip.TENSION_RATE),
        ):
            for channel in channels:
                over = np.abs(rate[:, channel]) > limit
                if over.sum() >= PERSIST:
                    at = int(np.flatnonzero(over)[PERSIST - 1])
                    found.append(Violation(trip, self._name(int(channel)), int(seq[at]), float(rate[at, channel])))
        return found

    def _tracking(self, block: Block) -> list[Violation]:
        """Tensions that stay away from their set-points while the drives are on."""
        limits, on = self.rig.limits, np.isin(block.state, (State.ARMED, State.MOVING))
        error = block.x[:, self._setpoint] - block.x[:, self._follower]
        found = []
        for k, channel in enumerate(self._follower):
            runs = _runs(on & (np.abs(error[:, k]) > limits.tension_error_max), int(self._astray[k]))
            self._astray[k] = runs[-1]
            late = runs > limits.tension_error_s * self.rig.rate_hz
            if late.any():
                at = int(np.argmax(late))
                name = f"set-point minus {self._name(channel)}"
                found.append(Violation(Trip.TRACKING, name, int(block.seq[at]), float(error[at, k])))
        return found

    def _still(self, block: Block) -> list[Violation]:
        """A frozen encoder: a tendon under steady load runs, or the external motor drives, but no encoder moves."""
        end = block.x[-1]
        angles = end[self._angle]
        if self._driven is not None:
            channel, start, speed = self._driven
            self._driving += int((block.state == State.MOVING).sum()) if abs(end[channel] - start) < STILL else 0
            if self._driving / self.rig.rate_hz * speed > 5 * STILL:
                self._driven = None
                return [Violation(Trip.FROZEN, self._name(channel), int(block.seq[-1]), float(end[channel]))]
        moved = self._moved
        if moved is None or np.nanmax(np.abs(angles - moved[self._angle]), initial=0.0) > STILL:
            self._moved = end.copy()
            return []
        for channel, tension in zip(self._excursion, self._partner, strict=True):
            load = block.x[:, tension] if tension is not None else np.zeros(len(block))
            if tension is None:
                continue
            if load.min() < 1.0 or np.abs(load - moved[tension]).max() > 0.5:
                moved[channel], moved[tension] = end[channel], end[tension]  # slack, or stretched by a change of load
            elif abs(end[channel] - moved[channel]) > UNEXPLAINED:
                run, self._moved = abs(end[channel] - moved[channel]), end.copy()
                name = f"joint encoders, while {self._name(int(channel))} ran by m"
                return [Violation(Trip.FROZEN, name, int(block.seq[-1]), float(run))]
        return []

    def commanded(self, command: Command) -> None:
        """Tell which move was commanded, so that an encoder that does not follow is found."""
        if isinstance(command, JointMove) and self._last is not None:
            channel = self.rig.index("joint_position", command.joint)
            if channel is not None and abs(command.target - self._last[channel]) > 5 * STILL:
                self._driven, self._driving = (channel, float(self._last[channel]), command.speed), 0
        elif not isinstance(command, TensionRamp):
            self._driven = None


def armed(block: Block) -> bool:
    """Whether the controller holds or moves the finger anywhere in the block."""
    return bool(np.isin(block.state, (State.ARMED, State.MOVING)).any())


def _runs(bad: np.ndarray, before: int) -> np.ndarray:
    """Length of the run of True that ends at each sample, continuing a run of `before`."""
    index = np.arange(len(bad))
    last_good = np.maximum.accumulate(np.where(~bad, index, -1))
    return np.where(last_good >= 0, index - last_good, index + 1 + before) * bad


_TRIPS = {
    "tension": Trip.TENSION,
    "excursion": Trip.INVALID,
    "joint_position": Trip.POSITION,
    "external_torque": Trip.TORQUE,
    "fingertip_force": Trip.FORCE,
    "tension_setpoint": Trip.INVALID,
    "motor_temperature": Trip.TEMPERATURE,
}
