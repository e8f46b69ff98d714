"""TwinCAT over ADS through pyads: blocks are pulled from the controller's ring, no notification is ever registered.

Notifications lose samples silently once a client stalls (AdsLib throws frames away when its 4 MiB buffer is full), and
`Connection.close()` with a live one crashes the process; a ring with a counter does neither.
"""

from __future__ import annotations

import contextlib
import ctypes
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from jaxfinger.data.toml import Fault, Within
from jaxfinger.errors import UserError
from jaxfinger.rig import contract
from jaxfinger.rig.backend import ConnectionLost
from jaxfinger.rig.channels import RigDescription
from jaxfinger.rig.ring import RingRig

TIMEOUT_MS = 500
WAIT_S = 0.02  # between two looks at a wait for another thread's call: a fifth of the shortest, BUSY_S
CALL_S = 0.7  # longer than the time-out of any call
BUSY_S = 0.1  # that a heartbeat waits for other calls: two of its periods, `watch.BEAT_S`
PAUSE_S = 0.1  # between attempts to connect: a router needs some milliseconds to forget a program that was killed


@dataclass(frozen=True)
class Address:
    """`net_id`, `ip` (host, or host:port) and ADS `port` of the controller; patience to connect, and to mend a cut."""

    net_id: str
    ip: str
    port: Annotated[int, Within(1, 65535)] = 851
    reconnect_s: Annotated[int, Within(0, 60, "s")] = 5

    def __post_init__(self):
        parts = self.net_id.split(".")
        if len(parts) != 6 or not all(part.isdigit() for part in parts):
            raise Fault(f'must be six numbers such as "5.12.82.20.1.1", not {self.net_id!r}', "net_id")


class AdsRig(RingRig):
    """The controller behind one ADS connection; one request at a time, since AdsLib allows no second on a port."""

    def __init__(self, description: RigDescription):
        super().__init__(description)
        try:
            import pyads
        except ImportError as error:
            raise UserError("the backend 'ads' needs pyads; install it with: pip install 'jaxfinger[rig]'") from error
        self._pyads = pyads
        self._failures = (pyads.ADSError, RuntimeError)  # the latter where AdsLib opens no port or an answer is short
        self._connection = None
        self._lock = threading.Lock()
        self._places: dict[str, tuple[int, int, int]] = {}  # symbol: group, offset, size in bytes
        self.reconnects = 0
        self._calls = 0  # that took the connection
        self._given_up = self._mending = self._closed = False

    def _open(self) -> None:
        where, self._given_up, self._closed = self.description.address, False, False
        deadline = time.monotonic() + float(where["reconnect_s"])
        while True:  # a router may still hang up on the connection of a program that was killed a moment ago
            try:
                self._attach()
                return
            except (*self._failures, ConnectionLost) as error:
                self._detach()
                if time.monotonic() > deadline:
                    raise ConnectionLost(
                        f"no answer from {where['net_id']} port {where['port']} at {where['ip']} ({error}); check "
                        "cable, NetId, and that the controller has a route back to this computer."
                    ) from error
                time.sleep(PAUSE_S)

    def _attach(self) -> None:
        where = self.description.address
        connection = self._pyads.Connection(str(where["net_id"]), int(where["port"]), str(where["ip"]))
        connection.open()
        self._connection = connection
        port = connection._port
        assert port is not None
        connection.set_timeout(TIMEOUT_MS)  # belongs to the port, so it is lost with every close
        places = {}
        for symbol in contract.SYMBOLS:
            try:
                info = self._pyads.pyads_ex.adsGetSymbolInfo(port, connection._adr, contract.PREFIX + symbol)
            except self._pyads.ADSError as error:
                if error.err_code != 1808:  # symbol not found
                    raise
                if symbol == "stBench":
                    continue
                raise UserError(
                    f"the controller has no symbol {contract.PREFIX}{symbol}; load the program of docs/plc-contract.md."
                ) from error
            places[symbol] = (info.iGroup, info.iOffs, info.size)
        self._places = places  # as a whole: an earlier set stays where the controller is lost halfway

    def close(self) -> None:
        self._closed = self._given_up = True  # a thread that was left behind must not open it again
        if self._lock.acquire(timeout=CALL_S):  # else another thread hangs in a call, and closes when it comes back
            try:
                self._detach()
            finally:
                self._lock.release()

    def _detach(self) -> None:
        if self._connection is not None:
            with contextlib.suppress(*self._failures):
                self._connection.close()
            self._connection = None

    def _call(self, request: Callable[[], bytes], mend: bool = True) -> bytes:
        """Do a request; after a cut, close, open and do it again until `reconnect_s` is over."""
        patience = float(self.description.address["reconnect_s"])
        self._take(mend)
        try:
            return request()
        except self._failures as first:
            self._mending = mend
            deadline = time.monotonic() + patience
            while mend and not self._given_up and time.monotonic() < deadline:
                self.alive()
                self._detach()
                try:
                    self._attach()
                    answer = request()
                    self.reconnects += 1
                    return answer
                except self._failures:
                    time.sleep(PAUSE_S)
            self._given_up |= mend
            raise ConnectionLost(f"the connection to the controller is lost ({first}).") from first
        finally:
            self._mending = False
            if self._closed:
                self._detach()
            self._lock.release()

    def _take(self, patient: bool) -> None:
        """Wait for the connection, which another thread may be using, or mending for so long as that may take.

        One call hangs, not several in a row. Waits are counted, not clocked: where this thread stood still, so did the
        other's call.
        """
        call, waits = self._calls, 0
        while not self._lock.acquire(timeout=WAIT_S):
            self.alive()
            if patient and self._calls != call:
                call, waits = self._calls, 0
            waits += 1
            if waits * WAIT_S > (CALL_S if patient else BUSY_S) and not (patient and self._mending):
                raise ConnectionLost("a call to the controller hangs.")
        self._calls += 1

    def _read(self, symbol: str, offset: int, size: int) -> bytes:
        def request() -> bytes:
            if self._connection is None:
                raise self._pyads.ADSError(text="not connected")
            group, start, _ = self._places[symbol]
            # as ctypes, since pyads would turn every byte into a Python object: 0.06 ms against 1.6 ms for 25 KiB
            return bytes(self._connection.read(group, start + offset, ctypes.c_ubyte * size, return_ctypes=True))

        return self._call(request)

    def _write(self, symbol: str, data: bytes, mend: bool = True) -> None:
        def request() -> bytes:
            if self._connection is None:
                raise self._pyads.ADSError(text="not connected")
            group, start, _ = self._places[symbol]
            self._connection.write(group, start, list(data), ctypes.c_ubyte * len(data))
            return b""

        self._call(request, mend)

    def _sizes(self) -> dict[str, int]:
        return {symbol: size for symbol, (_, _, size) in self._places.items()}

    def _has_bench(self) -> bool:
        return "stBench" in self._places


def make(description: RigDescription) -> AdsRig:
    """The rig of a rig file."""
    return AdsRig(description)
