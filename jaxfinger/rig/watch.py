"""The watch: checks that the whole host is well, and allows heartbeats to the controller only while it is.

Who watches whom, in a recording in real time:

- The watch is one thread. Every PERIOD_S it checks the stop key and the signals that end a program (signals.py), and
  from just before the rig is armed also reader, runner and heartbeat (a sign of life within `thread_s`) and the disk
  (no frame waits for `disk_s`).
- A second thread sends the heartbeats, each after the watch has allowed it. No call to the controller, which may hang,
  ever holds up the watch; a heartbeat that hangs in its call is a silent thread like any other.
- If a check fails, the watch stops the rig with the cause and allows no more heartbeats.
- If the watch itself hangs, or the whole process, the heartbeats end too.
- The controller releases the finger by itself when no heartbeat has come for `heartbeat_s` (0.25 s).

The reader supervises the samples (reader.py); the watch supervises the host.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress

from jaxfinger.errors import UserError
from jaxfinger.rig.backend import Rig
from jaxfinger.rig.contract import Trip
from jaxfinger.rig.operator import Operator
from jaxfinger.rig.reader import JOIN_S, Reader
from jaxfinger.rig.safety import Violation
from jaxfinger.rig.signals import INTERRUPTED, Interrupts

PERIOD_S = 0.02  # s between two checks: the most that it adds to the time from stop key to STOP
# s between two heartbeats: a fifth of the 0.25 s after which the controller releases the finger, so that one that comes
# late does no harm.
BEAT_S = 0.05
# s, the most that one check adds to a thread's silence. If the watch itself ran late, the machine was busy, and the
# other threads may have been late for the same reason.
MAX_COUNTED_S = 0.1


class Watch:
    """The watch over one run. The watched threads call `join` or `guard` once, and `report_alive` again and again.

    `guards` is true from just before the drives are switched on: from then on silence stops the rig.
    """

    def __init__(self, rig: Rig, reader: Reader, operator: Operator, interrupts: Interrupts):
        self.rig, self.reader, self.operator, self.interrupts = rig, reader, operator, interrupts
        self._names: dict[int, str] = {}
        self._signs: dict[int, int] = {}  # signs of life so far, by thread
        self._seen: dict[int, int] = {}  # signs at the last check
        self._silent: dict[int, float] = {}  # s without a new sign
        self._checked = self._beaten = time.monotonic()  # when it last checked, and last allowed a heartbeat
        self._pauses: list[tuple[float, float]] = []  # when it stood still for longer than `heartbeat_s` (s, monotonic)
        self.guards = False
        self._allowed = threading.Event()  # one heartbeat
        self._closing = threading.Event()
        self._threads: list[threading.Thread] = []
        rig.report_alive = self.report_alive

    def start(self) -> None:
        """Start the threads. A synchronous rig has none: the runner calls `check` between blocks."""
        if not self.rig.synchronous:
            for work, name in ((self._loop, "watch"), (self._beat, "heartbeat")):
                self._threads.append(threading.Thread(target=work, name=f"jaxfinger-{name}", daemon=True))
                self._threads[-1].start()

    def close(self) -> None:
        """Stop checking. No heartbeat follows."""
        self._closing.set()
        for thread in self._threads:
            thread.join(JOIN_S)

    def join(self, name: str) -> None:
        """Watch the calling thread from now on."""
        me = threading.get_ident()
        self._silent[me], self._seen[me], self._signs[me] = 0.0, 0, 1
        self._names[me] = name

    def guard(self) -> None:
        """Watch the calling thread, the runner, and stop the rig from now on where a thread or the disk is silent.

        The runner calls it just before it arms the rig.
        """
        self.join("runner")
        self.guards = True

    def report_alive(self) -> None:
        """Record a sign of life of the calling thread."""
        me = threading.get_ident()
        if me in self._signs:
            self._signs[me] += 1

    def _loop(self) -> None:
        while not self._closing.wait(PERIOD_S):
            self.check()

    def _beat(self) -> None:
        self.join("heartbeat")
        while not self._closing.is_set():
            if self._allowed.wait(PERIOD_S):
                with suppress(UserError):  # A lost connection is the reader's to report.
                    self.rig.beat()
                # What was allowed during a slow call is old, and the reader waits for the connection.
                self._allowed.clear()
            self.report_alive()

    def check(self) -> None:
        """Check stop key, signals, threads, disk: stop the rig where one fails, else allow a heartbeat if it is due."""
        now = time.monotonic()
        if now - self._checked > self.rig.description.loosest_limits.heartbeat_s:
            self._pauses.append((self._checked, now))
        passed, self._checked = min(now - self._checked, MAX_COUNTED_S), now
        if self.reader.violation is not None or self.reader.error is not None:
            return  # The rig is being stopped, or nothing reads it: no heartbeat.
        if (cause := self.stop_request() or self._silence(passed)) is not None:
            self.reader.stop(cause)
        elif not self.rig.simulated_time and now - self._beaten >= BEAT_S:
            self._beaten = now
            self._allowed.set()

    def stop_request(self) -> Violation | None:
        """Violation OPERATOR once the stop key was pressed or a signal asked the run to end."""
        if self.interrupts.requested:
            return Violation.of_host(Trip.OPERATOR, self.reader.latest_seq, INTERRUPTED)
        if cause := self.operator.stop_request():
            return Violation.of_host(Trip.OPERATOR, self.reader.latest_seq, cause)
        return None

    def suspended_s(self, since: float) -> float:
        """Time in s for which the program was suspended (Ctrl-Z) after `since` (s, monotonic); 0 where it was not.

        Only what is longer than `heartbeat_s` counts: after that the controller has released the finger by itself. A
        busy computer makes such pauses too, but SIGCONT ends none of them. The main thread must ask, which gets it.
        """
        if self.rig.simulated_time:
            return 0.0
        shortest = self.rig.description.loosest_limits.heartbeat_s
        pauses = [*self._pauses, (self._checked, time.monotonic())]  # The watch may not have checked since.
        after = [end - start for start, end in pauses if end > since and start <= self.interrupts.continued]
        return max((length for length in after if length > shortest), default=0.0)

    def _silence(self, passed: float) -> Violation | None:
        """HOST where a watched thread was silent for `thread_s`, RECORDER where a frame has waited for `disk_s`.

        `passed` is the time in s since the last check. Simulated time says nothing about threads, so there it is None.
        """
        if self.rig.simulated_time or not self.guards:
            return None
        deadlines, seq = self.rig.description.deadlines, self.reader.latest_seq
        for me, name in list(self._names.items()):
            signs = self._signs[me]
            self._silent[me] = self._silent[me] + passed if signs == self._seen[me] else 0.0
            self._seen[me] = signs
            if self._silent[me] > deadlines.thread_s:
                said = f"the host's {name} was silent for {self._silent[me]:.2g} s"
                cause = f"{said}; see what else this computer does, and the network"
                return Violation.of_host(Trip.HOST, seq, cause)
        if (waited := self.reader.recorder.waiting_s) > deadlines.disk_s:
            return Violation.of_host(
                Trip.RECORDER, seq, Trip.RECORDER.said(f"no answer of the disk for {waited:.2g} s")
            )
        return None
