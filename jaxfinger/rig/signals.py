"""Signals that end a program, taken as a wish to stop the rig."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType
from typing import Any

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)  # Ctrl-C, kill, closed terminal, Ctrl-\
INTERRUPTED = "the run was interrupted"  # said after one of them


class Interrupts:
    """While it is entered, the first of the ENDING signals sets `requested`, and a second raises KeyboardInterrupt.

    An exception that strikes at any line of the main thread can leave a lock taken for ever (that of the reader's
    queue, or that of the connection over which STOP goes) and a thread not started. Only the main thread gets signals;
    in another one nothing is taken. Once the rig is being stopped, which sets `stopping`, signals change nothing: who
    presses Ctrl-C again and again must not cut off the look whether tension falls. It takes a few seconds at most.

    `continued` is when the program last went on after it was suspended, as by Ctrl-Z (s, monotonic; 0: never).
    """

    def __init__(self):
        self.requested = self.stopping = False
        self.continued = 0.0
        self._handlers: dict[int, Any] = {}  # handlers from before, by signal

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is threading.main_thread():
            self._handlers = {number: signal.signal(number, self._take) for number in ENDING}
            self._handlers[signal.SIGCONT] = signal.signal(signal.SIGCONT, self._go_on)
        return self

    def __exit__(self, *_) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.requested and not self.stopping:
            raise KeyboardInterrupt
        self.requested = True

    def _go_on(self, number: int, frame: FrameType | None) -> None:
        self.continued = time.monotonic()
