"""The reader pulls every block from the rig, supervises it, hands it to the recorder, and queues it for the runner.

The reader stops the rig itself on a violation, without waiting for the runner. The watch (watch.py) looks after the
reader: a reader that is silent for `thread_s`, or gets no new sample for `stale_s`, ends the run.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from jaxfinger.errors import UserError
from jaxfinger.rig import wal
from jaxfinger.rig.backend import Block, HeadReading, Rig, StaleRig, stale
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.safety import Supervisor, Violation, armed
from jaxfinger.rig.trips import Drift

EPOCH_NS = 946_684_800 * 10**9  # Unix time of 2000-01-01, ns: zero of the controller's clock
# Blocks that may wait for the runner: 150 s at one every 50 ms (poll_s). Limits memory; recorder and supervisor have
# had the blocks that are dropped.
MAX_WAITING_BLOCKS = 3000
JOIN_S = 1.0  # s that closing waits for a thread; one that hangs in a call is then left behind


class Reader:
    """Reads the rig in a thread of its own; a synchronous rig is read by the thread that calls `next`.

    `violation` holds the cause for which the rig was stopped, `error` why it cannot be read. The first of each stays;
    either ends the run, and with either the watch sends no more heartbeats.
    """

    def __init__(self, rig: Rig, recorder: Recorder, supervisor: Supervisor):
        self.rig, self.recorder, self.supervisor = rig, recorder, supervisor
        self.first_seq = self.latest_seq = self.latest_t = -1
        self.violation: Violation | None = None
        self.error: Exception | None = None
        self.unarmed_violation: Violation | None = None  # the newest one found while nothing was armed
        self.samples = self.lost = 0
        self.latest: Block | None = None
        self.lag_s = 0.0
        self._host = HostClock(rig)
        # Host's minus device's clock, and device's clock, both ns, of the block of this trial that came quickest.
        self._clocks: tuple[int, int] | None = None
        self._recording = False
        self._blocks: deque[Block] = deque(maxlen=MAX_WAITING_BLOCKS)
        self._news = threading.Condition()
        self._first_cause = threading.Lock()
        self._running = False
        self._thread: threading.Thread | None = None

    def start(self, prepare: Callable[[], None] = lambda: None) -> None:
        """Start reading. The reader's own thread calls `prepare` first; a synchronous rig has no such thread."""
        self._running = True
        if not self.rig.synchronous:
            arguments = {"target": self._loop, "args": (prepare,), "name": "jaxfinger-reader", "daemon": True}
            self._thread = threading.Thread(**arguments)
            self._thread.start()

    def close(self) -> None:
        """Stop reading. A thread that hangs in a call to the controller is left behind."""
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
            self.rig.report_alive()
            news = time.monotonic() if read else news
            head = self.rig.head_reading
            if head is None or head.head <= self.latest_seq + 1:  # The ring is empty; otherwise read on at once.
                time.sleep(max(0.0, poll - (time.monotonic() - started)))

    def _read(self, news: float) -> Block | None:
        """Read a block, or None where there is no new sample; `news` is when the last one came (s, monotonic).

        Raises StaleRig once none has come for `stale_s`.
        """
        patience = self.rig.description.deadlines.stale_s
        if self.rig.simulated_time:
            return self.rig.read_block(patience)
        late = time.monotonic() - news > patience  # Before the poll: a thread that was held up polls once more.
        block = self.rig.poll()
        if block is None and late:
            raise StaleRig(stale(patience))
        return block

    def _step(self, news: float) -> bool:
        """Read, supervise, record and queue one block; stop the rig where a violation is found while it is armed.

        Return whether there was a block. No exception leaves this function: it becomes `error`.
        """
        try:
            if (block := self._read(news)) is None:
                return False
            arrived = time.time_ns() - EPOCH_NS
            found = [*self.supervisor.check(block), *self._host.check(block)]
            self.lag_s = self._host.lag_s
            with self._news:
                if self._recording:
                    self.recorder.block(block)
                    # Delay on the way only adds to the difference of the clocks, so the smallest is the nearest.
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
                    self.stop(Violation.of_host(Trip.RECORDER, self.latest_seq, self.recorder.failure))
            elif found:
                self.unarmed_violation = found[0]
            return True
        except Exception as error:  # Of any kind: without a reader nothing supervises the rig, so the run must end.
            with self._news:
                known = isinstance(error, UserError)
                self.error = error if known else UserError(f"the rig cannot be read: {type(error).__name__}: {error}")
                self._news.notify_all()
            return False

    def stop(self, violation: Violation) -> None:
        """Stop the rig for this cause. Only the first call has an effect.

        The controller gets STOP. It also gets no more heartbeats, so it releases the finger by itself where STOP does
        not arrive.
        """
        with self._first_cause:
            if self.violation is not None:
                return
            self.violation = violation
        self.note("stop", violation.sentence)
        try:
            self.rig.stop(violation.trip)
        except Exception as error:  # Of any kind: without a heartbeat the controller releases the finger by itself.
            self.note("stop", f"the stop was not acknowledged: {error}")

    def note(self, kind: str, text: str) -> None:
        """Log an event, with the number of the newest sample."""
        self.recorder.put(wal.EVENT, {"seq": self.latest_seq, "kind": kind, "text": text})

    def begin(self, start: dict[str, Any]) -> None:
        """Begin a trial in the log: samples are recorded from the next one on."""
        with self._news:
            self.recorder.put(wal.TRIAL, {**start, "seq": self.latest_seq + 1})
            self._recording, self._clocks = True, None

    def mark(self, mark: dict[str, Any]) -> None:
        """Log a mark; it holds from the next sample on."""
        with self._news:
            self.recorder.put(wal.MARK, {**mark, "seq": self.latest_seq + 1})

    def end(self, end: dict[str, Any]) -> int:
        """End the trial in the log. Samples before number `end["seq"]` belong to it, by default all. Return it."""
        with self._news:
            clocks = {"clocks": self._clocks} if self._clocks and not self.rig.synchronous else {}
            end = {"seq": self.latest_seq + 1, **clocks, **end}
            self.recorder.put(wal.END, end)
            self._recording = False
            return end["seq"]

    def amend(self, name: str, end: dict[str, Any]) -> None:
        """Replace the end of the trial `name`, the last one of the log: what has shown since decides."""
        self.recorder.put(wal.END, {"trial": name, **end})

    @property
    def reads(self) -> bool:
        """Whether samples can still come: it was started, and neither an error nor `close` has ended it."""
        return self._running and self.error is None

    @property
    def recording(self) -> bool:
        """Whether a trial is being recorded."""
        return self._recording

    def quiet(self, samples: int) -> bool:
        """Whether at least this many samples have come since the start and since the newest violation."""
        bad = self.unarmed_violation
        since = max(self.first_seq, bad.seq + 1 if bad is not None else 0)
        return self.latest is not None and self.latest_seq - since + 1 >= samples

    def forget(self) -> None:
        """Drop the queued blocks, so that the next wait starts with samples from now on."""
        with self._news:
            self._blocks.clear()

    def next(self, timeout: float = 0.1) -> Block | None:
        """Return the next queued block, or None after `timeout` s without one, or at an error."""
        if self.rig.synchronous and not self._blocks and self.error is None:
            self._step(0.0)
        with self._news:
            if not self._blocks and self.error is None:
                self._news.wait(timeout)
            return self._blocks.popleft() if self._blocks else None


class HostClock:
    """Checks that need the host's clock: whether samples come at their rate, and how late they are supervised.

    The supervisor compares the device's clock with its samples; a controller that is slow as a whole passes that check.
    """

    def __init__(self, rig: Rig):
        self._rig, self._deadlines = rig, rig.description.deadlines
        self._drift = Drift(self._deadlines.clock_rate)
        self._last: HeadReading | None = None
        self.lag_s = 0.0

    def check(self, block: Block) -> list[Violation]:
        """Return CLOCK and LAG violations of a block that has just been supervised.

        Sets `lag_s`, the greatest age in s that the block's first sample can have.
        """
        now, rate = self._rig.head_reading, self._rig.description.rate_hz
        if now is None or self._rig.simulated_time:
            return []
        seq, found = int(block.seq[-1]), []
        if now is not self._last:
            passed = now.asked - self._last.asked if self._last is not None else 0.0
            # At some time between `asked` and `answered` the controller had run for head to head + 1 periods.
            away = self._drift(now.head / rate - now.answered, (now.head + 1) / rate - now.asked, passed)
            self._last = now
            if abs(away) > self._deadlines.clock_offset_s:
                found.append(Violation(Trip.CLOCK, "samples ahead of the host's clock", seq, away, unit="s"))
        self.lag_s = (now.head - int(block.seq[0])) / rate + time.monotonic() - now.asked
        if self.lag_s > self._deadlines.lag_s:
            found.append(Violation(Trip.LAG, "time from a sample to its supervision", seq, self.lag_s, unit="s"))
        return found


def tripped(block: Block | None) -> bool:
    """Whether the newest sample of a block has the controller in state TRIPPED."""
    return block is not None and int(block.state[-1]) == State.TRIPPED
