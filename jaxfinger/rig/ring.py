"""The host's side of the contract: pull samples from the controller's ring, send commands, read states.

A subclass only reads and writes the bytes of a symbol: over ADS, or in the memory of a simulated controller.
"""

from __future__ import annotations

import math
import secrets
import threading
import time
from abc import abstractmethod
from enum import IntEnum
from typing import TypeVar

import numpy as np

from jaxfinger.errors import UserError
from jaxfinger.rig import contract
from jaxfinger.rig.backend import (
    Block,
    Command,
    CommandRefused,
    ConnectionLost,
    ControllerRestarted,
    HeadReading,
    Hold,
    JointMove,
    Rig,
    RigError,
    Setup,
    Status,
    TensionRamp,
)
from jaxfinger.rig.channels import SI_UNITS, Filter, RigDescription
from jaxfinger.rig.contract import Kind, Mode, State, Trip
from jaxfinger.rig.safety import admit

# Oldest records of the ring that are not asked for: the controller may overwrite them while the answer is on its way.
# 64 ms at 1 kHz; a request takes about 1 ms.
OVERWRITE_MARGIN = 64
MAX_RECORDS = 100  # records in one request: 50 KiB. Copying them delays the controller's task.
# s that a STOP waits for another thread's command to be acknowledged; then it overwrites that command.
STOP_WAIT_S = 0.05
# s in which the heartbeat of another host would change: four times the 0.05 s after which one is due (watch.BEAT_S).
ALONE_S = 0.2
REMEDY = (
    "load the program of docs/plc-contract.md"  # of every message about a controller that differs from the contract
)
Code = TypeVar("Code", bound=IntEnum)


class RingRig(Rig):
    """A rig whose controller has the symbols of the contract."""

    answer_s = 2.0  # s to wait for the acknowledgement of a command; the contract demands it in the cycle that reads it

    def __init__(self, description: RigDescription):
        self.description = description
        self.next_seq = 0
        self.ring = contract.RING
        self.boot = 0
        self._id = self._first_id = 0  # ids of the newest command, and before the first one
        self._found_id = 0  # id that the controller had acknowledged when it was connected
        self._sending = threading.Lock()  # Runner, reader and watch may command at the same time.
        self._unheeded: Trip | None = None  # cause of a STOP that the controller has not acknowledged
        self._beat = 0
        self._program = ""

    # bytes of a symbol ------------------------------------------------------------------------------------------
    @abstractmethod
    def _open(self) -> None:
        """Open the connection."""

    @abstractmethod
    def _read(self, symbol: str, offset: int, size: int, urgent: bool = False) -> bytes:
        """Read `size` bytes of a symbol from `offset` on. What is `urgent` overtakes other calls.

        Raises ConnectionLost.
        """

    @abstractmethod
    def _write(self, symbol: str, data: bytes, mend: bool = True, urgent: bool = False) -> None:
        """Write a whole symbol. With `mend`, a lost connection is first opened again; `urgent` is as for `_read`.

        Raises ConnectionLost.
        """

    @abstractmethod
    def _sizes(self) -> dict[str, int]:
        """Sizes in bytes of the symbols that the controller has."""

    def _has_bench(self) -> bool:
        """Whether the controller is a stand-in with a simulated operator."""
        return False

    # connect ----------------------------------------------------------------------------------------------------
    def connect(self) -> None:
        self._open()
        self._compare_sizes()
        info = self._record("stInfo", contract.INFO)
        for what, found, wanted in (
            ("contract version", int(info["version"]), contract.VERSION),
            ("size of ST_Sample", int(info["sample_size"]), contract.SAMPLE.itemsize),
            ("number of values in ST_Sample", int(info["values"]), contract.VALUES),
        ):
            if found != wanted:
                raise UserError(f"the controller's {what} is {found}, the adapter's is {wanted}; {REMEDY}.")
        cycle = 1e9 / self.description.rate_hz
        if abs(int(info["cycle_ns"]) - cycle) > 1e-3 * cycle:
            self.description.fail(
                "rig",
                "rate_hz",
                f"the controller samples every {int(info['cycle_ns'])} ns, which is not "
                f"{self.description.rate_hz:g} Hz; mend `rate_hz` or the task's cycle",
            )
        self.ring, self._program = int(info["ring_length"]), bytes(info["program"]).decode(errors="replace")
        least = math.ceil(self.description.deadlines.lag_s * self.description.rate_hz) + OVERWRITE_MARGIN + MAX_RECORDS
        if self.ring < least:
            raise UserError(
                f"the controller's ring holds {self.ring} samples, but a host that may lag by "
                f"{self.description.deadlines.lag_s:g} s needs {least}; {REMEDY}."
            )
        self._compare_limits()
        if self._has_bench():
            self.simulated_time = type(self).simulated_time or bool(self._record("stBench", contract.BENCH)["lockstep"])
        self.status()  # Refuses a state or trip code that the contract does not define.
        status = self._status()
        self.boot, self.next_seq, self._found_id = int(status["boot"]), int(status["head"]), int(status["acknowledged"])
        # At random, so that no other program has the same: the controller would take a STOP for a command that is done.
        self._id = self._first_id = secrets.randbits(32)
        self.head_reading = self._unheeded = None
        self._refuse_company()

    def _refuse_company(self) -> None:
        """Refuse a controller to which another program sends heartbeats: each would move what the other one holds."""
        if self.simulated_time:
            return
        before = self._read("nHostBeat", 0, 8)
        self._pause(ALONE_S)
        if self._read("nHostBeat", 0, 8) != before:
            raise UserError("another program sends heartbeats to the controller, so it records there; end it first.")

    def _compare_sizes(self) -> None:
        """Refuse a controller on which the size of a symbol is not the contract's: its fields would lie elsewhere."""
        sizes = self._sizes()
        for symbol, (dtype, count) in contract.SYMBOLS.items():
            size = sizes.get(symbol, 0)
            fits = size % dtype.itemsize == 0 if symbol == "aRing" else size == dtype.itemsize * count
            if not fits and not (symbol == "stBench" and symbol not in sizes):
                wanted = f"a multiple of {dtype.itemsize}" if symbol == "aRing" else f"{dtype.itemsize * count}"
                raise UserError(
                    f"{contract.PREFIX}{symbol} has {size} bytes on the controller, the contract has {wanted}; "
                    f"{REMEDY}."
                )
        (length,) = np.frombuffer(self._read("stInfo", 0, contract.INFO.itemsize), contract.INFO)["ring_length"]
        if (held := sizes["aRing"] // contract.SAMPLE.itemsize) != length:
            raise UserError(f"the controller's ring holds {held} samples, but stInfo says {length}; {REMEDY}.")

    def _compare_limits(self) -> None:
        """Refuse limits by which the controller would not be the backstop of the host.

        A limit of the host may not be looser than the controller's own, nor the controller's looser than `[controller]`
        allows.
        """
        found, limits = self._record("stLimits", contract.LIMITS), self.description.limits
        loosest = self.description.loosest_limits
        for name, suffix, unit in (  # A rig file gives velocities in degrees.
            ("tension_max", "", 1.0),
            ("tension_rate_max", "", 1.0),
            ("joint_velocity_max", "_deg_s", 180 / np.pi),
            ("joint_torque_max", "", 1.0),
            ("fingertip_force_max", "", 1.0),
            ("heartbeat_s", "", 1.0),
        ):
            key, theirs, most = f"{name}{suffix}", float(found[name]), getattr(loosest, name)
            ours = getattr(limits, name, None)  # The host has no limit of its own on the heartbeat.
            if ours is not None and not theirs >= ours - 1e-9:
                looser = f"is {ours * unit:g}, looser than the controller's {theirs * unit:g}; lower it"
                self.description.fail("limits", key, looser)
            if not 0 < theirs <= most + 1e-9:
                looser = f"may be {most * unit:g} on the controller, which runs {theirs * unit:g}"
                self.description.fail("controller", key, f"{looser}; mend stLimits there, or say here that it may")

    # samples ----------------------------------------------------------------------------------------------------
    def beat(self) -> None:
        self._beat += 1
        self._write("nHostBeat", np.uint64(self._beat).tobytes(), mend=False)

    def poll(self) -> Block | None:
        if self.head_reading is None or self.head_reading.head <= self.next_seq:
            self._head()
        assert self.head_reading is not None
        return self._pull(self.head_reading.head) if self.head_reading.head > self.next_seq else None

    def _head(self) -> int:
        """Read how many samples the controller has written.

        Raises:
            ControllerRestarted: its boot number changed, or the count fell.
            RigError: it has acknowledged a command of another program.
        """
        asked = time.monotonic()
        status = self._status()
        self.head_reading = HeadReading(asked, time.monotonic(), int(status["head"]))
        if int(status["boot"]) != self.boot or self.head_reading.head < self.next_seq:
            raise ControllerRestarted(
                "the controller's program was restarted, so this recording cannot go on; see its power and its task."
            )
        sent = (int(status["acknowledged"]) - self._first_id) % 2**32 <= (self._id - self._first_id) % 2**32
        if not sent and int(status["acknowledged"]) != self._found_id:
            raise RigError("another program commands the controller, so this recording cannot go on; end it first.")
        return self.head_reading.head

    def _pull(self, head: int) -> Block:
        """Read the next samples, at most MAX_RECORDS, up to `head`; count those that the ring does not hold any more.

        A record was torn, or overwritten by the controller, where one of its two numbers is not the expected one. The
        head is then read again, and the samples are read from where the ring now starts.

        Raises:
            ConnectionLost: ten reads in a row were torn.
        """
        lost = 0
        for _ in range(10):
            oldest = head - self.ring + OVERWRITE_MARGIN
            if self.next_seq < oldest:
                lost, self.next_seq = lost + oldest - self.next_seq, oldest
            count = min(head - self.next_seq, MAX_RECORDS)
            start = self.next_seq % self.ring
            first = min(count, self.ring - start)
            size = contract.SAMPLE.itemsize
            data = self._read("aRing", start * size, first * size)
            if first < count:
                data += self._read("aRing", 0, (count - first) * size)
            records = np.frombuffer(data, contract.SAMPLE)
            expected = self.next_seq + np.arange(count, dtype=np.uint64)
            good = (records["seq"] == expected) & (records["seq_end"] == expected)
            if good.all():
                self.next_seq += count
                return Block(
                    records["seq"].copy(), records["t_ns"].copy(), self.description.calibrate(records["value"]),
                    records["state"].copy(), records["flags"].copy(), lost,
                )  # fmt: skip
            head = self._head()
        raise ConnectionLost(
            "ten reads of the controller's ring were torn; its task writes records in the wrong order."
        )

    def rewind(self, seq: int) -> None:
        self.next_seq, self.head_reading = min(seq, int(self._status()["head"])), None

    # commands ---------------------------------------------------------------------------------------------------
    def command(self, command: Command) -> int:
        admit(command, self.description)
        finger = self.description.finger
        target = np.full(contract.TARGETS, np.nan)
        if isinstance(command, TensionRamp):
            for tendon, tension in command.targets.items():
                target[finger.tendon_names.index(tendon)] = tension
            return self._send(Kind.TENSION, rate=command.rate, target=target)
        if isinstance(command, JointMove):
            target[0] = command.target
            index = finger.joint_names.index(command.joint)
            return self._send(Kind.JOINT, index, command.speed, command.acceleration, target)
        assert isinstance(command, Hold)
        return self._send(Kind.HOLD)

    def arm(self) -> int:
        return self._send(Kind.ARM)

    def release(self) -> int:
        if self._unheeded is not None:  # RELEASE would overwrite the STOP, and the controller would not latch.
            return self._send(Kind.STOP, int(self._unheeded))
        return self._send(Kind.RELEASE)

    def stop(self, cause: Trip) -> None:
        self._unheeded = cause  # It stays where no acknowledgement comes.
        self._send(Kind.STOP, int(cause))
        self._unheeded = None

    def reset(self, operator: str) -> int:
        if not operator.strip():
            raise CommandRefused("a latched stop is cleared in the name of an operator; give the name.")
        return self._send(Kind.RESET)

    def _send(self, kind: Kind, index: int = 0, rate: float = 0.0, acceleration: float = 0.0, target=None) -> int:
        """Send a command, wait for its acknowledgement, return its id.

        Commands of other threads go first, but a STOP waits for them no longer than STOP_WAIT_S and then overwrites the
        command under way, which raises CommandRefused in its own thread. That command may still be on its way to the
        controller and overwrite the STOP in turn, so a STOP is written again until it is acknowledged.
        """
        patience = time.monotonic() + (STOP_WAIT_S if kind is Kind.STOP else self.answer_s)
        while not (mine := self._sending.acquire(timeout=0.02)) and time.monotonic() < patience:
            self.report_alive()
        try:
            return self._send_alone(kind, index, rate, acceleration, target)
        finally:
            if mine:
                self._sending.release()

    def _send_alone(self, kind: Kind, index: int, rate: float, acceleration: float, target) -> int:
        """Write a command and poll the status until it is acknowledged.

        A command that is not acknowledged within `answer_s` must not take effect later, when nobody expects it, so it
        is overwritten. RELEASE and STOP stay: they only take tension off.

        Raises:
            CommandRefused: the controller refused it, or it gave way to a STOP.
            ConnectionLost: no acknowledgement came.
        """
        if self._unheeded is not None and kind is not Kind.STOP:
            raise CommandRefused(f"{kind.name} gave way to a stop.")
        self._id, urgent = (self._id + 1) % 2**32, kind is Kind.STOP
        number = self._id
        order = np.zeros((), contract.COMMAND)
        order["id"], order["kind"], order["index"] = number, kind, index
        order["rate"], order["acceleration"] = rate, acceleration
        order["target"] = np.nan if target is None else target
        self._write("stCommand", order.tobytes(), urgent=urgent)
        deadline, asked = time.monotonic() + self.answer_s, 0.0
        while int((status := self._status(urgent))["acknowledged"]) != number:
            self.report_alive()
            if self._id != number and kind is not Kind.STOP:
                raise CommandRefused(f"{kind.name} gave way to a stop.")
            # Too late only if this status was asked for after the deadline: a host that was held up asks once more.
            late, asked = asked > deadline, time.monotonic()
            if late:
                if kind not in (Kind.RELEASE, Kind.STOP):
                    order["kind"] = Kind.NONE
                    self._write("stCommand", order.tobytes())
                raise ConnectionLost(f"the controller did not acknowledge {kind.name} within {self.answer_s:g} s.")
            if kind is Kind.STOP:
                self._write("stCommand", order.tobytes(), urgent=True)
            self._pause(0.002)
        if reason := int(status["refused"]):
            state = _known(State, int(status["state"]), "state").name
            why = {1: f"not in state {state}", 2: "beyond its limits", 3: "unknown to it"}
            raise CommandRefused(f"the controller refused {kind.name}: {why.get(reason, f'reason {reason}')}.")
        return number

    # states -----------------------------------------------------------------------------------------------------
    def _record(self, symbol: str, dtype: np.dtype, urgent: bool = False) -> np.void:
        return np.frombuffer(self._read(symbol, 0, dtype.itemsize, urgent), dtype)[0]

    def _status(self, urgent: bool = False) -> np.void:
        return self._record("stStatus", contract.STATUS, urgent)

    def status(self) -> Status:
        record = self._status()
        slot, value, unit = int(record["trip_slot"]), float(record["trip_value"]), ""
        trip = _known(Trip, int(record["trip"]), "trip")
        channel = next((c for c in self.description.channels if c.slot == slot), None)
        if channel is not None:
            rate = trip in (Trip.TENSION_RATE, Trip.VELOCITY)  # of the raw value: its offset does not count
            value = (value * channel.scale + (0.0 if rate else channel.offset)) * channel.factor
            unit = SI_UNITS[channel.kind] + ("/s" if rate else "")
        return Status(
            state=_known(State, int(record["state"]), "state"),
            trip=trip,
            trip_seq=int(record["trip_seq"]),
            trip_value=value,
            trip_channel=channel.name if channel else "",
            trip_unit=unit,
            head=int(record["head"]),
            acknowledged=int(record["acknowledged"]),
        )

    def filters(self) -> dict[str, Filter]:
        table = np.frombuffer(self._read("aFilter", 0, contract.FILTER.itemsize * contract.VALUES), contract.FILTER)
        return {
            c.name: Filter(bool(row["enabled"]), int(row["setting"]), _bandwidth(float(row["bandwidth"])))
            for c in self.description.channels
            for row in [table[c.slot]]
        }

    def fingerprint(self) -> dict[str, str]:
        return {"program": self._program, "contract": str(contract.VERSION), "boot": str(self.boot)}

    # the stand-in's operator and faults -----------------------------------------------------------------------------
    def prepare(self, setup: Setup) -> bool:
        if not self._has_bench():
            return False
        finger = self.description.finger
        order = np.zeros((), contract.BENCH)
        for j, name in enumerate(finger.joint_names):
            mode = Mode.MOTOR if name == setup.motor else Mode.HAND if name in setup.hand else Mode.FREE
            order["mode"][j] = Mode.FIXED if name in setup.fixed else mode
            order["pose"][j] = setup.fixed.get(name, 0.0)
        order["contact"] = setup.contact
        self._order(order)
        return True

    def inject(self, fault: str, slot: int = 0, after: int = 0, amount: float = math.nan) -> None:
        """Make the stand-in fail in `after` samples from now, for tests and drills.

        `fault` is one of contract.FAULTS, `slot` the value that it strikes. `simulated.faults` gives the meaning of
        `amount` and its default.
        """
        order = np.zeros((), contract.BENCH)
        order["fault"], order["fault_slot"] = contract.FAULTS.index(fault), slot
        order["fault_seq"], order["amount"] = int(self._status()["head"]) + after, amount
        self._order(order)

    def _order(self, order: np.ndarray) -> None:
        present = self._record("stBench", contract.BENCH)
        order["id"], order["lockstep"] = present["id"] + 1, present["lockstep"]
        self._write("stBench", order.tobytes())


def _known(codes: type[Code], code: int, what: str) -> Code:
    """Return the code as a member of `codes`. Raises RigError where the contract does not define it."""
    try:
        return codes(code)
    except ValueError:
        raise RigError(f"the controller's {what} is {code}, which the contract does not define; {REMEDY}.") from None


def _bandwidth(hertz: float) -> float | None:
    return hertz if 0 < hertz < math.inf else None
