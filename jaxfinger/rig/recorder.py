"""The recorder: a queue and a thread that writes the log, so that a slow disk never holds up the reader of the rig."""

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

SYNC_S = 1.0  # between two fdatasync: what a power cut can cost
QUEUE_LIMIT = 1_000_000  # samples waiting for a slow disk before the run is ended
LEAST_FREE = 500 * 2**20  # bytes that must be free on the disk before a session starts


class Recorder:
    """Takes frames without waiting; `failure` says, from then on, why the log could not be written any more."""

    def __init__(self, path: Path, header: dict[str, Any], resume: bool = False, opener: Callable | None = None):
        self.path = path
        if not resume and (free := shutil.disk_usage(path.parent).free) < LEAST_FREE:
            raise UserError(
                f"{path.parent}: only {free / 2**20:.0f} MiB are free; a session needs {LEAST_FREE >> 20} MiB."
            )
        self._log = opener(path) if opener else wal.LogWriter.append(path) if resume else wal.LogWriter.create(path)
        self._queue: queue.SimpleQueue[tuple[bytes, Any] | None] = queue.SimpleQueue()
        self._since: deque[float] = deque()  # when each frame that waits for the disk was handed over
        self._waiting = 0
        self._lock = threading.Lock()
        self.failure: str | None = None
        self.hangs = False  # the disk did not answer until the end
        self.unwritten: list[tuple[bytes, dict[str, Any]]] = []  # frames of JSON that found no room
        self._thread = threading.Thread(target=self._work, name="jaxfinger-writer", daemon=True)
        self._thread.start()
        if not resume:
            self.put(wal.HEADER, header)

    def put(self, tag: bytes, value: dict[str, Any]) -> None:
        """Queue a frame of JSON."""
        self._put(tag, value)

    def _put(self, tag: bytes, value: Any) -> None:
        self._since.append(time.monotonic())
        self._queue.put((tag, value))

    def block(self, block: Block) -> None:
        """Queue a block of samples; never waits."""
        with self._lock:
            self._waiting += len(block)
            if self._waiting > QUEUE_LIMIT and self.failure is None:
                self.failure = f"the disk is too slow: {self._waiting} samples wait to be written to {self.path.name}"
        self._put(wal.DATA, block)

    @property
    def waiting_s(self) -> float:
        """How long the oldest frame has waited for the disk."""
        try:
            return time.monotonic() - self._since[0]
        except IndexError:
            return 0.0

    @property
    def waiting(self) -> int:
        """Samples that are not yet written."""
        return self._waiting

    def flush(self, timeout: float = 60.0) -> None:
        """Wait until all that was queued is written (or has failed)."""
        done = threading.Event()
        self._put(b"", done)
        done.wait(timeout)

    def close(self, timeout: float = 5.0) -> None:
        """Write the rest, force it to the disk, and stop the thread; a disk that answers no more is left behind."""
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
        except OSError as error:
            self._fail(error)
        self._log.close()

    def _write(self, tag: bytes, value: Any) -> None:
        if tag == b"":
            value.set()
            return
        try:
            if self.failure is None or tag != wal.DATA:
                self._log.write(tag, wal.pack_block(value) if tag == wal.DATA else wal.pack_json(value))
                if time.monotonic() - self._synced > SYNC_S:
                    self._log.sync()
                    self._synced = time.monotonic()
        except OSError as error:
            self._fail(error)
            if tag != wal.DATA:
                self.unwritten.append((tag, value))
        if tag == wal.DATA:
            with self._lock:
                self._waiting -= len(value)

    def _fail(self, error: OSError) -> None:
        self.failure = self.failure or f"{self.path.name} cannot be written: {error.strerror or error}"
