"""Reads the rig without pause: every block goes to the recorder, past the supervisor, and on to who waits for it."""

from __future__ import annotations

import threading
import time
from collections import deque
from typing import Any

from jaxfinger.errors import UserError
from jaxfinger.rig import wal
from jaxfinger.rig.backend import Block, Rig
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.safety import Supervisor, Violation, armed

BACKLOG = 100  # samples in a block from which on the controller is ahead
EPOCH_NS = 946_684_800 * 10**9  # 2000-01-01 in Unix time: where a controller's clock starts
KEEP = 3000  # blocks that a busy runner may lag behind


class Reader:
    """One thread (or, for synchronous rigs, none) from the rig to the log.

    `violation` and `error` latch the first reason to end the run; the rig is stopped here, at once, not by the runner.
    """

    def __init__(self, rig: Rig, recorder: Recorder, supervisor: Supervisor):
        self.rig, self.recorder, self.supervisor = rig, recorder, supervisor
        self.latest_seq, self.latest_t = -1, 0
        self.violation: Violation | None = None
        self.error: Exception | None = None
        self.samples = self.lost = 0
        self.latest: Block | None = None
        self._clocks: tuple[int, int] | None = None  # host minus device, and device time (ns), of the quickest block
        self._recording = False
        self._blocks: deque[Block] = deque(maxlen=KEEP)
        self._news = threading.Condition()
        self._running = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start reading."""
        self._running = True
        if not self.rig.synchronous:
            self._thread = threading.Thread(target=self._loop, name="jaxfinger-reader", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop reading."""
        self._running = False
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _loop(self) -> None:
        poll = self.rig.description.poll_s
        while self._running and self.error is None:
            started = time.monotonic()
            count = self._step()
            if count < BACKLOG:  # else there is more to fetch at once
                time.sleep(max(0.0, poll - (time.monotonic() - started)))

    def _step(self) -> int:
        try:
            block = self.rig.read_block(self.rig.description.stale_s)
            arrived = time.time_ns() - EPOCH_NS
            found = self.supervisor.check(block)
            with self._news:
                if self._recording:
                    self.recorder.block(block)
                    # every delay on the way adds to the difference of the clocks, so the smallest is the truest
                    clocks = arrived - int(block.t_ns[-1]), int(block.t_ns[-1])
                    self._clocks = min(self._clocks or clocks, clocks)
                self.latest, self.latest_seq, self.latest_t = block, int(block.seq[-1]), int(block.t_ns[-1])
                self.samples += len(block)
                self.lost += block.lost_before
                if block.lost_before:
                    self.note("gap", f"{block.lost_before} samples lost before sample {int(block.seq[0])}")
                self._blocks.append(block)
                self._news.notify_all()
            if self.violation is None and armed(block):
                if found:
                    self.stop(found[0])
                elif self.recorder.failure is not None:
                    self.stop(Violation(Trip.RECORDER, "recorder", self.latest_seq, float("nan")))
            return len(block)
        except Exception as error:  # whatever it is, nobody would watch the rig any more: the trial must end
            with self._news:
                known = isinstance(error, UserError)
                self.error = error if known else UserError(f"the rig cannot be read: {type(error).__name__}: {error}")
                self._news.notify_all()
            return 0

    def stop(self, violation: Violation) -> None:
        """Stop the rig for this cause; the first cause counts."""
        if self.violation is None:
            self.violation = violation
            self.note("stop", violation.sentence)
            self.rig.stop(violation.trip)

    def note(self, kind: str, text: str) -> None:
        """Log an event with the present sample."""
        self.recorder.put(wal.EVENT, {"seq": self.latest_seq, "kind": kind, "text": text})

    def begin(self, start: dict[str, Any]) -> None:
        """Record from the next sample on."""
        with self._news:
            self.recorder.put(wal.TRIAL, {**start, "seq": self.latest_seq + 1})
            self._recording, self._clocks = True, None

    def mark(self, mark: dict[str, Any]) -> None:
        """Log a mark that counts from the next sample on."""
        with self._news:
            self.recorder.put(wal.MARK, {**mark, "seq": self.latest_seq + 1})

    def end(self, end: dict[str, Any]) -> None:
        """Stop recording; without a `seq`, every sample so far belongs to the trial."""
        with self._news:
            clocks = {"clocks": self._clocks} if self._clocks and not self.rig.synchronous else {}
            self.recorder.put(wal.END, {"seq": self.latest_seq + 1, **clocks, **end})
            self._recording = False

    @property
    def recording(self) -> bool:
        """Whether samples go to the log."""
        return self._recording

    def forget(self) -> None:
        """Drop blocks that nobody waited for: what is waited for next starts now."""
        with self._news:
            self._blocks.clear()

    def next(self, timeout: float = 0.1) -> Block | None:
        """The next block, or None after `timeout` s without one or at an error."""
        if self.rig.synchronous and not self._blocks and self.error is None:
            self._step()
        with self._news:
            if not self._blocks and self.error is None:
                self._news.wait(timeout)
            return self._blocks.popleft() if self._blocks else None

    def tripped(self) -> bool:
        """Whether the newest sample says that the controller is stopped."""
        return self.latest is not None and int(self.latest.state[-1]) == State.TRIPPED
