"""The interface of a rig: blocks of samples, commands, states. Each backend is one file that implements `Rig`."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int, UInt

from jaxfinger.errors import UserError
from jaxfinger.rig.channels import Filter, RigDescription, for_people
from jaxfinger.rig.contract import DRIVES_ON, State, Trip


class RigError(UserError):
    """The rig cannot go on. The trial under way ends; what was recorded stays."""


class ConnectionLost(RigError):
    """The controller does not answer."""


class StaleRig(RigError):
    """The controller answers but writes no samples."""


class ControllerRestarted(RigError):
    """The controller's program was restarted. Its samples count anew, so they cannot continue the recording."""


class CommandRefused(RigError):
    """Host or controller refused a command, so it had no effect."""


class EndOfReplay(RigError):
    """The replayed recording is at its end."""


@dataclass(frozen=True)
class Block:
    """N consecutive samples of C channels.

    `seq` numbers the samples, `t_ns` is the device's clock (ns since 2000-01-01), `x` the channels in SI units in the
    order of the rig file, `state` the controller's state, `flags` as in `contract.Flag`. `lost_before` samples between
    the previous block and this one were lost.
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
        """Id, modulo 65536, of the last command that the controller had processed at each sample."""
        return (self.flags >> 16).astype(np.int64)


@dataclass(frozen=True)
class HeadReading:
    """One reading of the head of the controller's ring.

    The controller had written `head` samples at some time between `asked` and `answered` (s, the host's monotonic
    clock).
    """

    asked: float
    answered: float
    head: int


@dataclass(frozen=True)
class Status:
    """State of the controller, with the first cause of a trip.

    `trip_seq` is the sample at which it tripped, `trip_value` the value in `trip_unit` (SI) of the channel
    `trip_channel`, which is empty where no single channel is the cause. `head` counts the samples written,
    `acknowledged` is the id of the last command processed.
    """

    state: State
    trip: Trip = Trip.NONE
    trip_seq: int = 0
    trip_value: float = 0.0
    trip_channel: str = ""
    trip_unit: str = ""
    head: int = 0
    acknowledged: int = 0

    @property
    def cause(self) -> str:
        """Sentence for people, with channel and value where one channel is the cause."""
        return self.trip.said(
            f"{self.trip_channel} = {for_people(self.trip_value, self.trip_unit)}" if self.trip_channel else ""
        )


@dataclass(frozen=True)
class TensionRamp:
    """Ramp the named tendons to `targets` (N) at `rate` (N/s). The other tendons keep their set-points."""

    targets: dict[str, float]
    rate: float


@dataclass(frozen=True)
class JointMove:
    """Move a joint with the external motor to `target` (rad) at `speed` (rad/s), with bounded acceleration (rad/s²)."""

    joint: str
    target: float
    speed: float
    acceleration: float = 20.0  # rad/s²: reaches the paper's fastest 1.5 rad/s in 75 ms


@dataclass(frozen=True)
class Hold:
    """Freeze every ramp and move where it is. Tension stays on."""


Command = TensionRamp | JointMove | Hold


@dataclass(frozen=True)
class Setup:
    """Preparation of the finger by the operator; `text` says what to do.

    Joints are `fixed` at an angle (rad), coupled to the external `motor`, or moved by `hand`; all others are free. With
    `contact` the fingertip rests on its force sensor. What is moved by hand is moved under tension; everything else is
    done with the drives off.
    """

    text: str
    fixed: dict[str, float] = field(default_factory=dict)
    motor: str | None = None
    hand: tuple[str, ...] = ()
    contact: bool = False

    @property
    def prompt(self) -> str:
        """Prompt for the operator. Unless the finger is to be moved by hand, the answer switches the drives on."""
        return self.text if self.hand else f"The drives are off. {self.text} Then hands off: Enter switches them on."


class Rig(ABC):
    """A rig. `with rig:` connects it, and on leaving releases the finger if it is armed, then disconnects.

    Connecting arms nothing. A `synchronous` rig makes samples when it is read, so nothing else runs beside the reading
    thread. With `simulated_time` time passes only as samples are read, so the host's clock says nothing about the
    controller's.
    """

    description: RigDescription
    synchronous: bool = False
    simulated_time: bool = False
    head_reading: HeadReading | None = None  # the newest one, on a rig with a ring
    # A call that waits calls this again and again: it tells the watch that the calling thread is alive (watch.py).
    report_alive: Callable[[], None] = staticmethod(lambda: None)

    @abstractmethod
    def connect(self) -> None:
        """Connect, and compare versions, sizes and limits with the rig file. Nothing is armed.

        Raises:
            UserError: the controller does not answer, or differs from what contract and rig file demand.
        """

    @abstractmethod
    def close(self) -> None:
        """Disconnect. A second call does nothing."""

    @abstractmethod
    def poll(self) -> Block | None:
        """Samples since the last call, or the first of them. None where there is no new sample.

        Raises:
            ConnectionLost: the controller does not answer.
            ControllerRestarted: its program was restarted.
        """

    @abstractmethod
    def beat(self) -> None:
        """Send one heartbeat. The controller releases the finger if none comes for its heartbeat time (`heartbeat_s`).

        It means that the whole host is well, so in a recording in real time only the watch has it sent (watch.py).
        """

    def _pause(self, seconds: float) -> None:
        """Wait; where time is simulated, let it pass."""
        time.sleep(seconds)

    def read_block(self, timeout: float) -> Block:
        """Wait for samples; return those since the last call, at least one. Heartbeats are sent while none is there.

        It serves before arming and where time is simulated. A recording in real time calls `poll` instead: heartbeats
        from this thread would go on while another thread hangs.

        Raises:
            StaleRig: no sample came for `timeout` s.
            ConnectionLost, ControllerRestarted: as `poll`.
        """
        deadline = time.monotonic() + timeout
        while True:
            late = time.monotonic() > deadline  # Before the poll: a thread that was held up polls once more.
            if (block := self.poll()) is not None:
                return block
            if late:
                raise StaleRig(stale(timeout))
            # Only where no sample waits: where a heartbeat lets time pass, time never runs ahead of the reading.
            with suppress(ConnectionLost):  # `poll` reconnects, or raises.
                self.beat()
            self._pause(self.description.poll_s)

    @abstractmethod
    def rewind(self, seq: int) -> None:
        """Make the next block start at sample `seq`, or at the oldest later sample that the ring still holds."""

    @abstractmethod
    def command(self, command: Command) -> int:
        """Send a command; return its id, which samples carry from when the controller has processed it.

        Raises:
            CommandRefused: host or controller refused it.
        """

    @abstractmethod
    def arm(self) -> int:
        """Switch the drives on at the present set-points. Only after this call can anything move."""

    @abstractmethod
    def release(self) -> int:
        """Release the finger: the external motor holds its joint, all tendons go down together, then drives go off.

        The controller does this by itself once it has the command; it takes 0.7 s (docs/plc-contract.md, Release).
        """

    @abstractmethod
    def stop(self, cause: Trip) -> None:
        """Stop the rig: release the finger and latch state TRIPPED with this cause. Only `reset` ends that state."""

    @abstractmethod
    def reset(self, operator: str) -> int:
        """Clear a latched stop in the name of an operator.

        Raises:
            CommandRefused: tension is still on, or the name is empty.
        """

    @abstractmethod
    def status(self) -> Status:
        """Present state and trip."""

    @abstractmethod
    def filters(self) -> dict[str, Filter]:
        """Filter settings of the terminals as the controller reads them, by channel name."""

    @abstractmethod
    def fingerprint(self) -> dict[str, str]:
        """Identity of controller, program and its present run, for the file."""

    def prepare(self, setup: Setup) -> bool:
        """Let a simulated operator prepare the finger. Return False where a person must do it."""
        return False

    def __enter__(self) -> Rig:
        try:
            self.connect()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, kind, error, trace) -> None:
        # A rig that does not answer cannot be told to release. It gets no heartbeat either, so it releases by itself.
        with suppress(Exception):
            if self.status().state in DRIVES_ON:
                self.release()
        self.close()


def stale(seconds: float) -> str:
    """Message of StaleRig."""
    return f"the controller answers but wrote no sample for {seconds:g} s; see whether its task runs."
