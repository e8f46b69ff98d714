"""What every rig offers to the recorder and the protocols: blocks of samples, set-points, state. One file a backend."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt

from jaxfinger.errors import UserError
from jaxfinger.rig.channels import Filter, RigDescription
from jaxfinger.rig.contract import State, Trip


class RigError(UserError):
    """The rig cannot go on; the trial under way ends, what was recorded stays."""


class ConnectionLost(RigError):
    """The controller does not answer any more."""


class StaleRig(RigError):
    """The controller answers but writes no new samples."""


class ControllerRestarted(RigError):
    """The controller's program was restarted: its samples start a new count and are never spliced to the old."""


class CommandRefused(RigError):
    """Host or controller refused a set-point; nothing moved."""


class EndOfReplay(RigError):
    """The recording that is replayed is at its end."""


@dataclass(frozen=True)
class Block:
    """N consecutive samples in SI units; `lost_before` counts the samples lost between this block and the one before.

    `t_ns` is the device's clock, `x` the channels in the order of the rig file.
    """

    seq: UInt[np.ndarray, " N"]
    t_ns: UInt[np.ndarray, " N"]
    x: Float[np.ndarray, "N C"]
    state: UInt[np.ndarray, " N"]
    flags: UInt[np.ndarray, " N"]
    lost_before: int = 0

    def __len__(self) -> int:
        return len(self.seq)

    @property
    def acknowledged(self) -> Int[np.ndarray, " N"]:
        """Id, modulo 65536, of the last command that the controller had seen at each sample."""
        return (self.flags >> 16).astype(np.int64)


@dataclass(frozen=True)
class Look:
    """A look at the head of the controller's ring: `head` samples were written at some time from `asked` to `answered`.

    Times are of the host's monotonic clock, in s.
    """

    asked: float
    answered: float
    head: int


@dataclass(frozen=True)
class Status:
    """State of the controller and the first cause of a trip."""

    state: State
    trip: Trip = Trip.NONE
    trip_seq: int = 0
    trip_value: float = 0.0
    trip_channel: str = ""
    head: int = 0
    acknowledged: int = 0

    @property
    def cause(self) -> str:
        """The trip in words, with channel and value where one channel is to blame."""
        where = f" ({self.trip_channel} = {self.trip_value:.4g})" if self.trip_channel else ""
        return self.trip.sentence + where


@dataclass(frozen=True)
class TensionRamp:
    """Ramp tendons to new tensions (N by tendon; others stay) at `rate` (N/s)."""

    targets: dict[str, float]
    rate: float


@dataclass(frozen=True)
class JointMove:
    """Move a joint with the external motor to `target` (rad) at `speed` (rad/s), with bounded acceleration (rad/s²)."""

    joint: str
    target: float
    speed: float
    acceleration: float = 20.0


@dataclass(frozen=True)
class Hold:
    """Freeze every ramp where it is."""


Command = TensionRamp | JointMove | Hold


@dataclass(frozen=True)
class Setup:
    """What the operator prepares: joints fixed at an angle (rad), one on the external motor, joints moved by hand, the
    fingertip on its force sensor. Joints that are not named are free.
    """

    text: str
    fixed: dict[str, float] = field(default_factory=dict)
    motor: str | None = None
    hand: tuple[str, ...] = ()
    contact: bool = False


class Rig(ABC):
    """A rig, connected inside a `with`. It is never armed by connecting, and releases the finger on leaving.

    `synchronous` rigs make samples when they are read and need no thread of their own. Where time is simulated, reading
    makes it pass, and the host's clock has nothing to do with the controller's.
    """

    description: RigDescription
    synchronous: bool = False
    simulated_time: bool = False
    look: Look | None = None  # the newest, where the rig has a ring
    alive: Callable[[], None] = staticmethod(lambda: None)  # called while a call waits: its thread is well

    @abstractmethod
    def connect(self) -> None:
        """Connect, and verify versions, sizes and limits; raises UserError with the mend."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect; safe to call twice."""

    @abstractmethod
    def poll(self) -> Block | None:
        """The samples since the last call, or the first of them; None where there is no new one.

        Raises ConnectionLost, ControllerRestarted.
        """

    @abstractmethod
    def beat(self) -> None:
        """Tell the controller that the whole host is well; without it, it lets go."""

    def _pause(self, seconds: float) -> None:
        """Let time pass until the next look."""
        time.sleep(seconds)

    def read_block(self, timeout: float) -> Block:
        """The samples since the last call, at least one; whoever waits here is well, and the controller is told so.

        Raises StaleRig after `timeout` s without a new one, and what `poll` raises. Who stood still looks again.
        """
        deadline = time.monotonic() + timeout
        while True:
            late = time.monotonic() > deadline
            with suppress(ConnectionLost):  # `poll` mends it, or says so
                self.beat()
            if (block := self.poll()) is not None:
                return block
            if late:
                raise StaleRig(stale(timeout))
            self._pause(self.description.poll_s)

    @abstractmethod
    def rewind(self, seq: int) -> None:
        """Let the next block start at sample `seq`, as far as the controller's ring still holds it."""

    @abstractmethod
    def command(self, command: Command) -> int:
        """Send a set-point; returns its id, which samples echo once it is seen. Raises CommandRefused."""

    @abstractmethod
    def arm(self) -> int:
        """Switch the drives on at the present set-points; the only call after which something may move."""

    @abstractmethod
    def disarm(self) -> int:
        """Switch the drives off."""

    @abstractmethod
    def release(self) -> int:
        """Release tension in the right order: motor torque off, all tendons together, then drives off."""

    @abstractmethod
    def stop(self, cause: Trip) -> None:
        """Release and latch; only `reset` leads out."""

    @abstractmethod
    def reset(self, operator: str) -> int:
        """Clear a latched stop, in the name of an operator."""

    @abstractmethod
    def status(self) -> Status:
        """State and trip now."""

    @abstractmethod
    def filters(self) -> dict[str, Filter]:
        """The filter that each channel's terminal really runs, by channel name."""

    @abstractmethod
    def fingerprint(self) -> dict[str, str]:
        """What identifies controller and program, for the file."""

    def prepare(self, setup: Setup) -> bool:
        """Let a simulated operator prepare the finger; False where a person must do it."""
        return False

    def __enter__(self) -> Rig:
        try:
            self.connect()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind, error, trace) -> None:
        with suppress(UserError):  # a rig that does not answer any more misses our heartbeat, and lets go by itself
            if self.status().state in (State.ARMED, State.MOVING):
                self.release()
        self.close()


def stale(seconds: float) -> str:
    """What is wrong where no sample comes."""
    return f"the controller answers but wrote no sample for {seconds:g} s; see whether its task runs."
