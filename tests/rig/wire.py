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
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.examples import rig_toml

PLAN = '[plan]\nname = "hold"\noperator = "tester"\n[[trial]]\nexperiment = "VD.1"\npretension = 8.0\nseconds = 30.0\n'
STALL_S = 0.03  # s; a tenth of matrix.STOP_S
ATTEMPTS = 5
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

    def stop_requested(self) -> bool:
        self.hang("watch")
        return self.pressed

    def strike(self, bench: standin.StandIn, what: str) -> dict[str, Any]:
        if what in ("key", "deaf"):
            report = bench.strike("deaf") if what == "deaf" else bench.report()
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


def once(cell: Cell) -> Found | str:
    """Run a cell. Return only the run's sentence where it ended before the fault struck: the machine was too busy."""
    row = next(r for r in matrix.MATRIX if r.name == cell.row)
    deadlines = {k: v for k, v in CALM.items() if k != TESTED_DEADLINE.get(cell.row)}
    with contextlib.ExitStack() as stack:
        bench = stack.enter_context(standin.started(faults=cell.also))
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        host = Host(stack)
        address = {"net_id": standin.NET_ID, "ip": bench.where, "port": 851, "reconnect_s": 3}
        rig = AdsRig(parse_rig(rig_toml("ads", address, poll_s=cell.poll_s, **deadlines)))
        plan = parse_plan(PLAN, rig.description)
        poll, armed, began, done = rig.poll, threading.Event(), [], []

        def polled():
            host.hang("reader")
            block = poll()
            if block is not None and (block.state == State.ARMED).any():
                armed.set()
            return block

        call, in_call = rig._call, {"jaxfinger-reader": "call", "jaxfinger-heartbeat": "beat"}

        def called(request, mend=True):
            return call(lambda: (host.hang(in_call.get(threading.current_thread().name, "")), request())[1], mend)

        rig.poll, rig._call = polled, called
        reached, views = threading.Event(), []

        def observe(view):
            if view.recording and not began:
                began.append(int(view.block.seq[0]))
            ready = view.recording and len(views) > 4 if cell.phase == "hold" else view.block.state[-1] == State.MOVING
            if view.recording:
                views.append(view)
            if ready and (cell.phase == "hold" or view.trial == "01-VD.1"):
                reached.set()
            host.hang("runner")

        def record():
            try:
                outcome = run(plan, rig, folder / "s.h5", operator=host, observe=observe)
                done.append((outcome.cause, time.monotonic()))
            except UserError as error:
                done.append((str(error), time.monotonic()))

        recorder = threading.Thread(target=record, daemon=True)
        recorder.start()
        wait_for = armed if cell.phase == "arming" else reached
        while not wait_for.wait(0.005) and recorder.is_alive():
            pass
        if not recorder.is_alive():
            return done[0][0]
        quiet, worst = threading.Event(), [0.0]
        stack.callback(quiet.set)
        threading.Thread(target=stalls, args=(quiet, worst), daemon=True).start()
        if cell.phase == "letting go":
            host.pressed = True
            while bench.report()["state"] not in (State.RELEASING, State.TRIPPED):
                time.sleep(0.001)
        struck_at = time.monotonic()
        report = host.strike(bench, row.wire)
        boot = report["boot"]
        while recorder.is_alive() and time.monotonic() - struck_at < 15.0:
            recorder.join(0.02)
            if "runner" in host.hangs and bench.report()["off_seq"] >= 0:
                host.go.set()  # Let the runner go on, so that the run can end.
        report, fault = bench.report(), report["fault_seq"] if row.wire in HOSTS else bench.report()["fault_seq"]
        restarted = report["boot"] != boot
        fault = report["head"] if fault is None else fault
        stopped = report["trip"] and not restarted
        missing = None
        if began and (folder / "s.h5").exists():
            with h5py.File(folder / "s.h5") as file:
                trial = read_session(folder / "s.h5")["01-VD.1"]
                rest = file.get("rig/dropped/01-VD.1/seq", np.empty(0))[()]
            missing = max(fault - began[0] - len(trial.time) - len(rest), 0) * 1e-3
        cause, ended = done[0] if done else ("", time.monotonic())
        return Found(
            cell, cause, report["trip"], (report["trip_seq"] - fault) * 1e-3 if stopped else None,
            0.0 if restarted else (report["off_seq"] - fault) * 1e-3 if report["off_seq"] >= 0 else None,
            ended - struck_at, missing, max(worst),
        )  # fmt: skip


HANGS = ("reader", "call", "beat", "runner", "watch", "disk", "full")
HOSTS = ("key", "deaf", *HANGS)


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
    if row.by == matrix.CONTROLLER and found.cell.phase != "letting go" and found.trip != Trip.HEARTBEAT:
        faults.append(f"not stopped by the controller's watchdog but by trip {found.trip}")
    if found.end_s > matrix.END_S:
        faults.append(f"ended after {found.end_s} s")
    if found.missing_s is not None and found.missing_s > matrix.LOST_S:
        faults.append(f"{found.missing_s} s missing")
    causes = [trip.sentence for trip in row.causes] + SAYS.get(found.cell.row, [])
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
    "deaf": ["the operator pressed the stop key"],
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
