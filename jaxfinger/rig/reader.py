"""Reads the rig without pause: every block goes to the recorder, past the supervisor, and on to who waits for it."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from jaxfinger.errors import UserError
from jaxfinger.rig import wal
from jaxfinger.rig.backend import Block, Look, Rig, StaleRig, stale
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.safety import Supervisor, Violation, armed
from jaxfinger.rig.trips import Drift

EPOCH_NS = 946_684_800 * 10**9  # 2000-01-01 in Unix time: where a controller's clock starts
KEEP = 3000  # blocks that a busy runner may lag behind
JOIN_S = 1.0  # that a reader which hangs in a call is waited for


class Reader:
    """One thread (or, for synchronous rigs, none) from the rig to the log.

    `violation` and `error` latch the first reason to end the run; the rig is stopped here, at once, not by the runner.
    """

    def __init__(self, rig: Rig, recorder: Recorder, supervisor: Supervisor):
        self.rig, self.recorder, self.supervisor = rig, recorder, supervisor
        self.first_seq = self.latest_seq = self.latest_t = -1
        self.violation: Violation | None = None
        self.error: Exception | None = None
        self.trouble: Violation | None = None  # the newest violation while nothing was armed
        self.samples = self.lost = 0
        self.latest: Block | None = None
        self.lag_s = 0.0
        self._host = HostClock(rig)
        self._clocks: tuple[int, int] | None = None  # host minus device, and device time (ns), of the quickest block
        self._recording = False
        self._blocks: deque[Block] = deque(maxlen=KEEP)
        self._news = threading.Condition()
        self._first_cause = threading.Lock()
        self._running = False
        self._thread: threading.Thread | None = None

    def start(self, prepare: Callable[[], None] = lambda: None) -> None:
        """Start reading; a thread of its own calls `prepare` first."""
        self._running = True
        if not self.rig.synchronous:
            arguments = {"target": self._loop, "args": (prepare,), "name": "jaxfinger-reader", "daemon": True}
            self._thread = threading.Thread(**arguments)
            self._thread.start()

    def close(self) -> None:
        """Stop reading; a thread that hangs in a call to a dead network is left behind."""
        self._running = False
        if self._thread is not None:
            self._thread.join(JOIN_S)
            self._thread = None

    def _loop(self, prepare: Callable[[], None]) -> None:
        prepare()
        poll, news = self.rig.description.poll_s, time.monotonic()
        while self._running and self.error is None:
            started = time.monotonic()
            read = self._step(news)
            self.rig.alive()
            news = time.monotonic() if read else news
            if self.rig.look is None or self.rig.look.head <= self.latest_seq + 1:  # else there is more to fetch
                time.sleep(max(0.0, poll - (time.monotonic() - started)))

    def _read(self, news: float) -> Block | None:
        patience = self.rig.description.deadlines.stale_s
        if self.rig.simulated_time:
            return self.rig.read_block(patience)
        block = self.rig.poll()
        if block is None and time.monotonic() - news > patience:
            raise StaleRig(stale(patience))
        return block

    def _step(self, news: float) -> bool:
        """Read what is there; whether there was anything."""
        try:
            if (block := self._read(news)) is None:
                return False
            arrived = time.time_ns() - EPOCH_NS
            found = [*self.supervisor.check(block), *self._host.check(block)]
            self.lag_s = self._host.lag_s
            with self._news:
                if self._recording:
                    self.recorder.block(block)
                    # every delay on the way adds to the difference of the clocks, so the smallest is the truest
                    clocks = arrived - int(block.t_ns[-1]), int(block.t_ns[-1])
                    self._clocks = min(self._clocks or clocks, clocks)
                self.latest, self.latest_seq, self.latest_t = block, int(block.seq[-1]), int(block.t_ns[-1])
                self.first_seq = int(block.seq[0]) if self.first_seq < 0 else self.first_seq
                self.samples += len(block)
                self.lost += block.lost_before
                if block.lost_before:
                    self.note("gap", f"{block.lost_before} samples lost before sample {int(block.seq[0])}")
                self._blocks.append(block)
                self._news.notify_all()
            if armed(block):
                if found:
                    self.stop(found[0])
                elif self.recorder.failure is not None:
                    self.stop(Violation(Trip.RECORDER, "recorder", self.latest_seq, float("nan")))
            elif found:
                self.trouble = found[0]
            return True
        except Exception as error:  # whatever it is, nobody would watch the rig any more: the trial must end
            with self._news:
                known = isinstance(error, UserError)
                self.error = error if known else UserError(f"the rig cannot be read: {type(error).__name__}: {error}")
                self._news.notify_all()
            return False

    def stop(self, violation: Violation) -> None:
        """Stop the rig for this cause; the first cause counts. Whether or not it arrives, heartbeats end."""
        with self._first_cause:
            if self.violation is not None:
                return
            self.violation = violation
        self.note("stop", violation.sentence)
        try:
            self.rig.stop(violation.trip)
        except UserError as error:
            self.note("stop", f"the stop was not acknowledged: {error}")

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

    def quiet(self, samples: int) -> bool:
        """Whether the newest so many samples were read, and nothing was wrong in them."""
        since = max(self.first_seq, self.trouble.seq + 1 if self.trouble is not None else 0)
        return self.latest is not None and self.latest_seq - since + 1 >= samples

    def forget(self) -> None:
        """Drop blocks that nobody waited for: what is waited for next starts now."""
        with self._news:
            self._blocks.clear()

    def next(self, timeout: float = 0.1) -> Block | None:
        """The next block, or None after `timeout` s without one or at an error."""
        if self.rig.synchronous and not self._blocks and self.error is None:
            self._step(0.0)
        with self._news:
            if not self._blocks and self.error is None:
                self._news.wait(timeout)
            return self._blocks.popleft() if self._blocks else None


class HostClock:
    """What only the host's clock tells: how many samples there should be by now, and how late they are supervised."""

    def __init__(self, rig: Rig):
        self._rig, self._deadlines = rig, rig.description.deadlines
        self._drift = Drift(self._deadlines.clock_rate)
        self._look: Look | None = None
        self.lag_s = 0.0

    def check(self, block: Block) -> list[Violation]:
        """Violations once a block has been supervised; `lag_s` is the greatest age that its first sample may have."""
        look, rate = self._rig.look, self._rig.description.rate_hz
        if look is None or self._rig.simulated_time:
            return []
        seq, found = int(block.seq[-1]), []
        if look is not self._look:
            passed = look.asked - self._look.asked if self._look is not None else 0.0
            # at some time from `asked` to `answered`, samples had gone on for head to head + 1 periods
            away = self._drift(look.head / rate - look.answered, (look.head + 1) / rate - look.asked, passed)
            self._look = look
            if abs(away) > self._deadlines.clock_offset_s:
                found.append(Violation(Trip.CLOCK, "samples ahead of the host's clock, in s", seq, away))
        self.lag_s = (look.head - int(block.seq[0])) / rate + time.monotonic() - look.asked
        if self.lag_s > self._deadlines.lag_s:
            found.append(Violation(Trip.LAG, "s from a sample to its supervision", seq, self.lag_s))
        return found


def tripped(block: Block | None) -> bool:
    """Whether the newest sample says that the controller is stopped."""
    return block is not None and int(block.state[-1]) == State.TRIPPED
