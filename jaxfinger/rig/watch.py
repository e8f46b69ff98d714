"""Sees that the whole host is well, and only then says so to the controller.

One thread polls the stop key, looks at every other thread and at the disk, and writes the heartbeat. Where anything is
silent for too long it stops the rig and beats no more; where it hangs itself, beats end by themselves.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress

from jaxfinger.errors import UserError
from jaxfinger.rig.backend import Rig
from jaxfinger.rig.contract import Trip
from jaxfinger.rig.operator import Operator
from jaxfinger.rig.reader import Reader
from jaxfinger.rig.safety import Violation

PERIOD_S = 0.02  # between two looks at the key
BEAT_S = 0.05  # between two heartbeats: a fifth of the time after which the controller lets go
STALL_S = 0.1  # the most that one look adds to a thread's silence: where this thread was late, so may others have been
JOIN_S = 1.0


class Watch:
    """`join`, `guard` and `alive` are called by the threads that are watched; `look` once per period."""

    def __init__(self, rig: Rig, reader: Reader, operator: Operator):
        self.rig, self.reader, self.operator = rig, reader, operator
        self._names: dict[int, str] = {}
        self._signs: dict[int, int] = {}
        self._seen: dict[int, int] = {}
        self._silent: dict[int, float] = {}
        self._looked = self._beaten = time.monotonic()
        self.guards = False  # from just before the drives are switched on
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        rig.alive = self.alive

    def start(self) -> None:
        """Start looking; synchronous rigs have no second thread, and whoever reads them looks."""
        if not self.rig.synchronous:
            self._thread = threading.Thread(target=self._loop, name="jaxfinger-watch", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop looking, and beat no more."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(JOIN_S)

    def join(self, name: str) -> None:
        """Watch the calling thread from now on."""
        me = threading.get_ident()
        self._silent[me], self._seen[me], self._signs[me] = 0.0, 0, 1
        self._names[me] = name

    def guard(self) -> None:
        """From now on nothing may be silent: the calling thread is about to arm the rig."""
        self.join("runner")
        self.guards = True

    def alive(self) -> None:
        """A sign of life of the calling thread."""
        me = threading.get_ident()
        if me in self._signs:
            self._signs[me] += 1

    def _loop(self) -> None:
        while not self._closing.wait(PERIOD_S):
            self.look()

    def look(self) -> None:
        """Look at the key, the threads and the disk; beat where all is well."""
        now = time.monotonic()
        passed, self._looked = min(now - self._looked, STALL_S), now
        if self.reader.violation is not None or self.reader.error is not None:
            return  # the rig is being stopped
        if (cause := self._key() or self._wrong(passed)) is not None:
            self.reader.stop(cause)
        elif not self.rig.simulated_time and now - self._beaten >= BEAT_S:
            self._beaten = now
            with suppress(UserError):  # who reads the rig will say what is wrong
                self.rig.beat()

    def _key(self) -> Violation | None:
        if self.operator.stop_requested():
            return Violation(Trip.OPERATOR, "stop key", self.reader.latest_seq, float("nan"))
        return None

    def _wrong(self, passed: float) -> Violation | None:
        if self.rig.simulated_time or not self.guards:
            return None
        deadlines, seq = self.rig.description.deadlines, self.reader.latest_seq
        for me, name in list(self._names.items()):
            signs = self._signs[me]
            self._silent[me] = self._silent[me] + passed if signs == self._seen[me] else 0.0
            self._seen[me] = signs
            if self._silent[me] > deadlines.thread_s:
                return Violation(Trip.HOST, f"s of silence of the {name}", seq, self._silent[me])
        if (waited := self.reader.recorder.waiting_s) > deadlines.disk_s:
            return Violation(Trip.RECORDER, "s that the disk has not answered", seq, waited)
        return None
