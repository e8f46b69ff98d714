"""The recorder writes the log in a thread of its own behind a queue, so that a slow disk never holds up the reader.

The watch stops the rig where a frame waits for longer than `disk_s`, the reader where `failure` is set.
"""

from __future__ import annotations

import queue
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxfinger.errors import UserError
from jaxfinger.rig import wal
from jaxfinger.rig.backend import Block
from jaxfinger.rig.contract import Trip

POLL_S = 0.002  # s between two looks whether the queue is empty: a frame is written within milliseconds.
# s between two fdatasync: a power cut costs at most as much of the recording. Ends of trials are forced at once.
SYNC_S = 1.0
# Samples that may wait for a slow disk before the run ends: 17 min at 1 kHz, 0.5 GB of memory with 60 channels.
QUEUE_LIMIT = 1_000_000
# Free bytes that a new session demands: 17 min at 1 kHz with 60 channels, 0.5 MB/s.
MIN_FREE_BYTES = 500 * 2**20
# Free bytes without which nothing is armed: 20 s at that rate, in which a stop and its release end. A full disk may
# still take a short frame, in the file's last block.
ARM_FREE_BYTES = 10 * 2**20


class Recorder:
    """Takes frames without waiting.

    `failure` says why the log cannot be written (None: it can), `unwritten` holds the frames of JSON that failed,
    `waiting` counts the samples that are queued and not yet written, `trials` those begun, and after `close` `hangs` is
    true where the disk did not answer.

    Raises:
        UserError: the disk has less than MIN_FREE_BYTES, or the log exists or cannot be created.
    """

    def __init__(self, path: Path, header: dict[str, Any], resume: bool = False, opener: Callable | None = None):
        self.path = path
        _refuse_full_disk(path.parent)
        self._log = opener(path) if opener else wal.LogWriter.append(path) if resume else wal.LogWriter.create(path)
        self._queue: queue.SimpleQueue[tuple[bytes, Any] | None] = queue.SimpleQueue()
        self._since: deque[float] = deque()  # when each waiting frame was queued (s, monotonic)
        self.waiting = 0
        self._lock = threading.Lock()
        self.failure: str | None = None
        self.hangs = False
        self.trials = 0
        self.unwritten: list[tuple[bytes, dict[str, Any]]] = []
        self._thread = threading.Thread(target=self._work, name="jaxfinger-writer", daemon=True)
        self._thread.start()
        if not resume:
            self.put(wal.HEADER, header)

    def put(self, tag: bytes, value: Any) -> None:
        """Queue a frame: a block for `wal.DATA`, a dictionary of JSON for the other tags. Never waits."""
        self.trials += tag == wal.TRIAL
        self._since.append(time.monotonic())
        self._queue.put((tag, value))

    def block(self, block: Block) -> None:
        """Queue a block of samples. Never waits."""
        with self._lock:
            self.waiting += len(block)
            if self.waiting > QUEUE_LIMIT and self.failure is None:
                self.failure = f"the disk is too slow: {self.waiting} samples wait to be written to {self.path.name}"
        self.put(wal.DATA, block)

    @property
    def waiting_s(self) -> float:
        """Time in s for which the oldest queued frame has waited for the disk."""
        try:
            return time.monotonic() - self._since[0]
        except IndexError:
            return 0.0

    def lacks(self, timeout: float) -> str:
        """Why the log cannot be written, or an empty string. Waits at most `timeout` s for the frames queued so far."""
        limit = time.monotonic() + timeout
        while self._since and self.failure is None and time.monotonic() < limit:
            time.sleep(POLL_S)
        if self._since and self.failure is None:
            return f"{self.path.name}: the disk does not answer within {timeout:g} s"
        return self.failure or _full(self.path.parent, ARM_FREE_BYTES)

    def close(self, timeout: float = 5.0) -> None:
        """Write what is queued, force it to the disk, and end the thread.

        Where the disk does not answer for `timeout` s, the thread is left behind and `hangs` is true. Then a second
        call does nothing.
        """
        if self.hangs:
            return
        self._queue.put(None)
        self._thread.join(timeout)
        self.hangs = self._thread.is_alive()
        if self.hangs:
            self.failure = self.failure or f"the disk does not answer: {self.path.name} is not whole"

    def _work(self) -> None:
        self._synced = time.monotonic()
        while (item := self._queue.get()) is not None:
            self._write(*item)
            self._since.popleft()
        try:
            self._log.sync()
        except Exception as error:
            self._fail(error)
        self._log.close()

    def _write(self, tag: bytes, value: Any) -> None:
        if tag == wal.END and value.get("complete") and self.failure is not None:  # Samples before it were not written.
            value = {**value, "complete": False, "cause": self.failure, "trip": int(Trip.RECORDER)}
        try:
            if self.failure is None or tag != wal.DATA:
                self._log.write(tag, wal.pack_block(value) if tag == wal.DATA else wal.pack_json(value))
                if tag == wal.END or time.monotonic() - self._synced > SYNC_S:
                    self._log.sync()
                    self._synced = time.monotonic()
        except Exception as error:  # Of any kind: a thread that ends here would leave every later frame unwritten.
            self._fail(error)
            if tag != wal.DATA:
                self.unwritten.append((tag, value))
        if tag == wal.DATA:
            with self._lock:
                self.waiting -= len(value)

    def _fail(self, error: Exception) -> None:
        said = (isinstance(error, OSError) and error.strerror) or f"{type(error).__name__}: {error}"
        self.failure = self.failure or f"{self.path.name} cannot be written: {said}"


def _refuse_full_disk(folder: Path) -> None:
    """Raise UserError where a folder's disk has less than MIN_FREE_BYTES, or where there is no such folder."""
    if full := _full(folder, MIN_FREE_BYTES):
        raise UserError(f"{full}; a session needs {MIN_FREE_BYTES >> 20} MiB.")


def _full(folder: Path, least: int) -> str:
    """How little a folder's disk has free where it is less than `least` bytes, or an empty string.

    Raises:
        UserError: there is no such folder.
    """
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise UserError(f"{folder}: cannot be written ({error.strerror}); choose a folder that exists.") from None
    return f"{folder}: only {free / 2**20:.0f} MiB are free" if free < least else ""
