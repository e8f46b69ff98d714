"""One cell of the fault matrix over the wire: record from the stand-in in real time and let a fault strike.

The stand-in's own clock gives the times of the stop and of no tension. Cells run in processes of their own, several at
a time. A machine that stands still for longer than STALL_S proves nothing about the rig, so such a cell is run again.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import matrix, parse_plan, parse_rig, run, wal
from jaxfinger.rig.backends.ads import AdsRig
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.operator import STOP_KEY
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.examples import rig_toml

PLAN = '[plan]\nname = "hold"\noperator = "tester"\n[[trial]]\nexperiment = "VD.1"\npretension = 8.0\nseconds = 30.0\n'
STALL_S = 0.03  # s; a tenth of matrix.STOP_S
ATTEMPTS = 5
READ_HANGS_S = 0.1  # s until a read of the ring waits for its answer: twice `poll_s`, and before the heartbeat is due
# Deadlines of all rows but the one under test: long, so that a loaded machine keeps them.
CALM = {"stale_s": 3.0, "lag_s": 3.0, "thread_s": 3.0, "disk_s": 5.0, "clock_offset_s": 3.0}
# The deadline that a row tests; it keeps its default.
TESTED_DEADLINE = {
    "slow": "clock_offset_s", "stall": "stale_s", "lag": "lag_s", "reader": "thread_s", "runner": "thread_s",
    "disk": "disk_s", "clock slow": "clock_offset_s", "call": "thread_s", "beat": "thread_s",
}  # fmt: skip


@dataclass(frozen=True)
class Cell:
    """A row of the matrix, the phase in which it strikes, the pause between two reads, and faults from the start."""

    row: str
    phase: str = "hold"
    poll_s: float = 0.05
    also: tuple[str, ...] = ()


@dataclass
class Found:
    """Result of a cell, with times in s since the fault struck; `stall_s` is how long the machine stood still."""

    cell: Cell
    cause: str
    trip: int
    stop_s: float | None
    off_s: float | None
    end_s: float
    missing_s: float | None  # s of samples before the fault that are not in the file
    stall_s: float


class Host:
    """Operator and faults on the host's side: stop key, threads that hang, disk."""

    def __init__(self, monkey: contextlib.ExitStack):
        self.pressed = False
        self.hangs: set[str] = set()
        self.go = threading.Event()
        monkey.callback(self.go.set)
        write = wal.LogWriter.write

        def on_disk(log, tag, payload):
            self.hang("disk")
            if "full" in self.hangs:
                raise OSError(errno.ENOSPC, "No space left on device")
            write(log, tag, payload)

        wal.LogWriter.write = on_disk
        monkey.callback(setattr, wal.LogWriter, "write", write)

    def hang(self, name: str) -> None:
        if name in self.hangs:
            self.go.wait(60.0)

    def ask(self, text, keep_waiting):
        raise AssertionError("the stand-in prepares itself")

    def stop_request(self) -> str:
        self.hang("watch")
        return STOP_KEY if self.pressed else ""

    def strike(self, bench: standin.StandIn, what: str) -> dict[str, Any]:
        if what in ("key", "deaf", "mute"):
            report = bench.report() if what == "key" else bench.strike(what)
            if what == "mute":
                time.sleep(READ_HANGS_S)
                report = bench.report()
            self.pressed = True
        elif what in HANGS:
            report = bench.report()
            self.hangs.add(what)
        else:
            return bench.strike(what)
        return {**report, "fault_seq": report["head"]}


def stalls(stop: threading.Event, worst: list[float]) -> None:
    """Measure how long this machine keeps a thread waiting that wants to run."""
    while not stop.is_set():
        asked = time.monotonic()
        time.sleep(0.005)
        worst.append(time.monotonic() - asked - 0.005)


class Recording:
    """A recording in a thread of its own. Its calls and views pass by `host`, where they may hang.

    `armed` and `reached` are set once a sample has shown the drives on, and once the cell's phase has begun. `begun` is
    the number of the first sample of the trial, `ended` holds the run's sentence and when it came (s, monotonic).
    """

    def __init__(self, cell: Cell, rig: AdsRig, host: Host, path: Path):
        self._cell, self._rig, self._host, self._path = cell, rig, host, path
        self.armed, self.reached = threading.Event(), threading.Event()
        self.begun: int | None = None
        self.ended: tuple[str, float] | None = None
        self._views = 0
        self._poll, self._call = rig.poll, rig._call
        rig.poll, rig._call = self._polled, self._called
        self.thread = threading.Thread(target=self._work, daemon=True)
        self.thread.start()

    def _polled(self):
        self._host.hang("reader")
        block = self._poll()
        if block is not None and (block.state == State.ARMED).any():
            self.armed.set()
        return block

    def _called(self, request, mend=True, urgent=False):
        caller = {"jaxfinger-reader": "call", "jaxfinger-heartbeat": "beat"}.get(threading.current_thread().name, "")
        return self._call(lambda port: (self._host.hang(caller), request(port))[1], mend, urgent)

    def _observe(self, view) -> None:
        if view.recording:
            self.begun = int(view.block.seq[0]) if self.begun is None else self.begun
            self._views += 1
        holds, moves = self._views > 5, view.trial == "01-VD.1" and view.block.state[-1] == State.MOVING
        if holds if self._cell.phase == "hold" else moves:
            self.reached.set()
        self._host.hang("runner")

    def _work(self) -> None:
        try:
            plan = parse_plan(PLAN, self._rig.description)
            said = run(plan, self._rig, self._path, operator=self._host, observe=self._observe).cause
        except UserError as error:
            said = str(error)
        self.ended = said, time.monotonic()

    def wait_for_phase(self) -> bool:
        """Wait until the cell's phase has begun. Return False where the run ended before."""
        begun = self.armed if self._cell.phase == "arming" else self.reached
        while not begun.wait(0.005) and self.thread.is_alive():
            pass
        return self.thread.is_alive()

    def missing_s(self, fault: int) -> float | None:
        """Seconds of samples before number `fault` that are not in the file; None where there is no file."""
        if self.begun is None or not self._path.exists():
            return None
        with h5py.File(self._path) as file:
            rest = file.get("rig/dropped/01-VD.1/seq", np.empty(0))[()]
        return max(fault - self.begun - len(read_session(self._path)["01-VD.1"].time) - len(rest), 0) * 1e-3


def rig_of(cell: Cell, where: str) -> AdsRig:
    """The rig of a cell, with calm deadlines but for the one that its row tests."""
    deadlines = {k: v for k, v in CALM.items() if k != TESTED_DEADLINE.get(cell.row)}
    address = {"net_id": standin.NET_ID, "ip": where, "port": 851, "reconnect_s": 3}
    return AdsRig(parse_rig(rig_toml("ads", address, poll_s=cell.poll_s, **deadlines)))


def once(cell: Cell) -> Found | str:
    """Run a cell. Return only the run's sentence where it ended before the fault struck: the machine was too busy."""
    row = next(r for r in matrix.MATRIX if r.name == cell.row)
    with contextlib.ExitStack() as stack:
        bench = stack.enter_context(standin.started(faults=cell.also))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        host = Host(stack)
        recording = Recording(cell, rig_of(cell, bench.where), host, folder / "s.h5")
        if not recording.wait_for_phase():
            assert recording.ended is not None
            return recording.ended[0]
        quiet, worst = threading.Event(), [0.0]
        stack.callback(quiet.set)
        threading.Thread(target=stalls, args=(quiet, worst), daemon=True).start()
        if cell.phase == "letting go":
            host.pressed = True
            while bench.report()["state"] not in (State.RELEASING, State.TRIPPED):
                time.sleep(0.001)
        struck_at = time.monotonic()
        report = host.strike(bench, row.wire)
        boot, fault = report["boot"], report["fault_seq"]
        while recording.thread.is_alive() and time.monotonic() - struck_at < 15.0:
            recording.thread.join(0.02)
            if "runner" in host.hangs and bench.report()["off_seq"] >= 0:
                host.go.set()  # Let the runner go on, so that the run can end.
        report = bench.report()
        if row.wire not in HOSTS:
            fault = report["head"] if report["fault_seq"] is None else report["fault_seq"]
        restarted = report["boot"] != boot
        stopped = report["trip"] and not restarted
        cause, ended = recording.ended or ("", time.monotonic())
        return Found(
            cell, cause, report["trip"], (report["trip_seq"] - fault) * 1e-3 if stopped else None,
            0.0 if restarted else (report["off_seq"] - fault) * 1e-3 if report["off_seq"] >= 0 else None,
            ended - struck_at, recording.missing_s(fault), max(worst),
        )  # fmt: skip


HANGS = ("reader", "call", "beat", "runner", "watch", "disk", "full")
HOSTS = ("key", "deaf", "mute", *HANGS)


def judge(found: Found) -> list[str]:
    """Return the faults of a cell's result."""
    row = next(r for r in matrix.MATRIX if r.name == found.cell.row)
    rig = parse_rig(rig_toml())
    shows, faults = row.shows(rig), []
    stops = row.off and found.cell.phase != "letting go" and row.wire != "restart"
    if stops and (found.stop_s is None or not found.stop_s <= shows + matrix.STOP_S):
        faults.append(f"stopped after {found.stop_s} s")
    if row.off and (found.off_s is None or not found.off_s <= shows + matrix.OFF_S):
        faults.append(f"tension off after {found.off_s} s")
    # By the controller's watchdog, or by STOP on its own port; the stop key is heard in any case.
    told = row.by == matrix.CONTROLLER or row.name in ("key", "mute")
    if told and found.cell.phase != "letting go" and found.trip not in row.causes:
        faults.append(f"stopped by trip {found.trip}")
    if found.end_s > matrix.END_S:
        faults.append(f"ended after {found.end_s} s")
    if found.missing_s is not None and found.missing_s > matrix.LOST_S:
        faults.append(f"{found.missing_s} s missing")
    causes = [STOP_KEY if trip is Trip.OPERATOR else trip.sentence for trip in row.causes]
    causes += SAYS.get(found.cell.row, [])
    if found.cell.phase != "letting go" and not any(cause in found.cause for cause in causes):
        faults.append(f"cause: {found.cause}")
    return faults


# Sentences by which a run may also name the cause.
SAYS = {
    "stall": ["wrote no sample"],
    "slow": ["wrote no sample"],
    "restart": ["program was restarted"],
    "cut": ["connection to the controller is lost"],
    "reader": ["the host's reader was silent"],
    "runner": ["the host's runner was silent"],
    "call": ["a call to the controller hangs", "the host's reader was silent"],
    "beat": ["a call to the controller hangs", "the host's heartbeat was silent"],
    "disk": ["disk does not answer"],
    "full": ["No space left"],
    "deaf": [STOP_KEY],
    "watch": ["connection to the controller"],
}


@functools.cache
def _silence() -> None:
    """Send stderr to nowhere: AdsLib writes to it when a connection closes."""
    import os

    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def try_cell(cell: Cell) -> tuple[Found | str, list[str]]:
    """Run a cell until the machine keeps up, at most ATTEMPTS times. Return the last result and its faults."""
    _silence()
    for _ in range(ATTEMPTS):
        found = once(cell)
        faults = judge(found) if isinstance(found, Found) else [f"before the fault: {found}"]
        if not faults or (isinstance(found, Found) and found.stall_s < STALL_S):
            break
    return found, faults
