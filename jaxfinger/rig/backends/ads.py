"""TwinCAT over ADS through pyads. Samples are pulled from the controller's ring; no notification is ever registered.

Notifications lose samples without a word when a client stalls: AdsLib throws frames away once its 4 MiB buffer is full.
`Connection.close()` with a live notification crashes the process. A ring with a counter does neither.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import hashlib
import socket
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

# ms after which AdsLib gives up a request. A request takes about 1 ms, and after 0.25 s without a heartbeat the
# controller has released the finger anyway.
TIMEOUT_MS = 500
LOCK_POLL_S = 0.02  # s between two attempts to get the connection: a fifth of the shortest wait, MAX_BEAT_WAIT_S
MAX_CALL_S = 0.7  # s after which another thread's call counts as hanging: longer than TIMEOUT_MS
MAX_BEAT_WAIT_S = 0.1  # s that a heartbeat waits for other calls: two of its periods, `watch.BEAT_S`
ADS_PORT = 48898  # TCP port of a router where `ip` gives none
CLAIM_PORTS = range(20_000, 32_768)  # UDP ports of claims: below those that systems give to programs that ask for any
CLAIM_S = 1.0  # s to wait for a program that is being killed: it keeps its claim for some milliseconds
RETRY_S = 0.1  # s between attempts to connect: a router needs some milliseconds to forget a program that was killed


@dataclass(frozen=True)
class Address:
    """Keys of `[address]`: `net_id`, `ip` (host or host:port) and ADS `port` of the controller.

    `reconnect_s` is how long to try to connect, and to connect again after a cut.
    """

    net_id: str
    ip: str
    port: Annotated[int, Within(1, 65535)] = 851
    reconnect_s: Annotated[int, Within(0, 60, "s")] = 5

    def __post_init__(self):
        parts = self.net_id.split(".")
        if len(parts) != 6 or not all(part.isdigit() for part in parts):
            raise Fault(f'must be six numbers such as "5.12.82.20.1.1", not {self.net_id!r}', "net_id")


# A request on the ADS port of this computer that it is given. It returns the answer's bytes.
Request = Callable[[int], bytes]


class AdsRig(RingRig):
    """A controller behind one ADS connection, with two ports of this computer on it. `reconnects` counts mended cuts.

    Requests on a port go one at a time, since AdsLib allows no second one there. STOP has a port of its own, so that it
    overtakes a call whose answer does not come. Where that port fails, STOP takes its turn on the other one.

    Both ports share one TCP connection, since a router keeps one for each computer. Where that is cut or being opened
    STOP waits, and so does the heartbeat: the controller then releases the finger by itself, `heartbeat_s` after the
    last beat that came. No stop is later than that.
    """

    def __init__(self, description: RigDescription):
        super().__init__(description)
        try:
            import pyads
        except ImportError as error:
            raise UserError("the backend 'ads' needs pyads; install it with: pip install 'jaxfinger[rig]'") from error
        self._pyads = pyads
        self._failures = (pyads.ADSError, RuntimeError)  # RuntimeError: AdsLib opens no port, or an answer is short
        self._connection = None
        where = description.address
        self._address = pyads.AmsAddr(str(where["net_id"]), int(where["port"]))
        self._lock = threading.Lock()
        self._port = self._stop_port = 0  # 0: closed, which AdsLib answers with an error
        # On the port of STOP. Opening and closing needs it too: AdsLib frees a route that a request is still using.
        self._stop_lock = threading.Lock()
        self._places: dict[str, tuple[int, int, int]] = {}  # symbol: group, offset, size in bytes
        self.reconnects = 0
        self._calls = 0  # calls that have had the connection, and attempts to connect again
        self._hanging = -1  # the newest of them that was found to hang
        self._given_up = False  # a call could not connect again, so later calls do not try
        self._closed = False
        self._claim: socket.socket | None = None  # keeps other programs of this computer away

    def _open(self) -> None:
        where, self._given_up, self._closed = self.description.address, False, False
        if self._claim is None:
            self._claim = _claim(str(where["ip"]))
        deadline = time.monotonic() + float(where["reconnect_s"])
        while True:  # A router may still hang up on the connection of a program that was killed a moment ago.
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
                time.sleep(RETRY_S)

    def _attach(self) -> None:
        where = self.description.address
        connection = self._pyads.Connection(str(where["net_id"]), int(where["port"]), str(where["ip"]))
        with self._stop_lock:
            connection.open()
            assert connection._port is not None
            self._connection, self._port = connection, connection._port
            self._stop_port = self._pyads.pyads_ex.adsPortOpenEx()
        for port in (self._port, self._stop_port):
            self._pyads.pyads_ex.adsSyncSetTimeoutEx(port, TIMEOUT_MS)  # Every close loses it.
        places = {}
        for symbol in contract.SYMBOLS:
            try:
                info = self._pyads.pyads_ex.adsGetSymbolInfo(self._port, self._address, contract.PREFIX + symbol)
            except self._pyads.ADSError as error:
                if error.err_code != 1808:  # 1808: symbol not found
                    raise
                if symbol == "stBench":
                    continue
                raise UserError(
                    f"the controller has no symbol {contract.PREFIX}{symbol}; load the program of docs/plc-contract.md."
                ) from error
            places[symbol] = (info.iGroup, info.iOffs, info.size)
        self._places = places  # Replaced as a whole: where the controller is lost halfway, the earlier set stays.

    def close(self) -> None:
        self._closed = self._given_up = True  # A thread that was left behind must not connect again.
        with contextlib.suppress(ConnectionLost):  # A thread that hangs closes the connection when it comes back.
            self._acquire(patient=True)
            try:
                self._detach()
            finally:
                self._lock.release()
        if self._claim is not None:
            self._claim.close()
            self._claim = None

    def _detach(self) -> None:
        with self._stop_lock:
            if self._stop_port:
                with contextlib.suppress(*self._failures):
                    self._pyads.pyads_ex.adsPortCloseEx(self._stop_port)
            if self._connection is not None:
                with contextlib.suppress(*self._failures):
                    self._connection.close()
            self._connection, self._port, self._stop_port = None, 0, 0

    def arm(self) -> int:
        """Switch the drives on, once the port of STOP has proven to work."""
        try:
            self._call_at_once(self._reading("stStatus", 0, contract.STATUS.itemsize))
        except ConnectionLost as error:
            raise ConnectionLost(f"nothing was armed: STOP would not reach the controller at once ({error})") from error
        return super().arm()

    def _call_at_once(self, request: Request) -> bytes:
        """Do a request on the port of STOP, whatever the other port waits for.

        Raises:
            ConnectionLost: the request failed, or the connection is being opened or closed.
        """
        if not self._stop_lock.acquire(timeout=LOCK_POLL_S):
            raise ConnectionLost("the port of STOP is in use.")
        try:
            return request(self._stop_port)
        except self._failures as error:
            raise ConnectionLost(f"the port of STOP has failed ({error}).") from error
        finally:
            self._stop_lock.release()

    def _call(self, request: Request, mend: bool = True, urgent: bool = False) -> bytes:
        """Do a request. With `mend`, connect again and repeat it after a cut, for `reconnect_s` at most.

        An `urgent` one goes by the port of STOP first.

        Raises:
            ConnectionLost: the request failed, or another thread's call hangs.
        """
        if urgent:
            with contextlib.suppress(ConnectionLost):
                return self._call_at_once(request)
        patience = float(self.description.address["reconnect_s"])
        self._acquire(mend)
        try:
            return request(self._port)
        except self._failures as first:
            deadline = time.monotonic() + patience
            while mend and not self._given_up and time.monotonic() < deadline:
                self.report_alive()
                self._calls += 1
                self._detach()
                try:
                    self._attach()
                    answer = request(self._port)
                    self.reconnects += 1
                    return answer
                except self._failures:
                    time.sleep(RETRY_S)
            self._given_up |= mend
            raise ConnectionLost(f"the connection to the controller is lost ({first}).") from first
        finally:
            if self._closed:
                self._detach()
            self._lock.release()

    def _acquire(self, patient: bool) -> None:
        """Take the connection, which another thread may be using.

        A patient call waits MAX_CALL_S for any one call or attempt to connect of others, and not at all for one that
        was found to hang before. A heartbeat is not patient: it waits MAX_BEAT_WAIT_S in all. The waits are counted,
        not measured by the clock: a machine that held up this thread also held up the other's call.

        Raises:
            ConnectionLost: the other call hangs.
        """
        call, waits = self._calls, 0
        while not self._lock.acquire(timeout=LOCK_POLL_S):
            self.report_alive()
            if patient and self._calls != call:
                call, waits = self._calls, 0
            waits += 1
            if patient and waits * LOCK_POLL_S > MAX_CALL_S:
                self._hanging = call
            if self._hanging == call or waits * LOCK_POLL_S > (MAX_CALL_S if patient else MAX_BEAT_WAIT_S):
                raise ConnectionLost("a call to the controller hangs.")
        self._calls += 1

    def _reading(self, symbol: str, offset: int, size: int) -> Request:
        """Request that reads `size` bytes of a symbol from `offset` on."""

        def request(port: int) -> bytes:
            group, start, _ = self._places[symbol]
            # As ctypes, since pyads would turn every byte into a Python object: 0.06 ms instead of 1.6 ms for 25 KiB.
            read, array = self._pyads.pyads_ex.adsSyncReadReqEx2, ctypes.c_ubyte * size
            return bytes(read(port, self._address, group, start + offset, array, return_ctypes=True))

        return request

    def _read(self, symbol: str, offset: int, size: int, urgent: bool = False) -> bytes:
        return self._call(self._reading(symbol, offset, size), urgent=urgent)

    def _write(self, symbol: str, data: bytes, mend: bool = True, urgent: bool = False) -> None:
        def request(port: int) -> bytes:
            group, start, _ = self._places[symbol]
            array = ctypes.c_ubyte * len(data)
            self._pyads.pyads_ex.adsSyncWriteReqEx(port, self._address, group, start, list(data), array)
            return b""

        self._call(request, mend, urgent)

    def _sizes(self) -> dict[str, int]:
        return {symbol: size for symbol, (_, _, size) in self._places.items()}

    def _has_bench(self) -> bool:
        return "stBench" in self._places


def _claim(ip: str) -> socket.socket:
    """Claim the controller at `ip` (host or host:port) for this program, until it ends or closes the socket.

    A router keeps one connection for each computer, so a second program here would cut off the first one. The claim is
    a UDP port on a loopback address of its own, which one program can bind at a time; nothing is sent. Both follow from
    the controller's address alone, so programs of any user, in any folder, agree on them.

    Raises:
        UserError: another program of this computer has claimed it.
    """
    host, _, port = ip.partition(":")
    with contextlib.suppress(OSError):  # A name that nobody knows is the connection's to report.
        host = socket.gethostbyname(host)
    key = hashlib.sha256(f"jaxfinger {host}:{port or ADS_PORT}".encode()).digest()
    place = f"127.{key[0]}.{key[1]}.{key[2]}", CLAIM_PORTS[int.from_bytes(key[3:5]) % len(CLAIM_PORTS)]
    claim, deadline = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), time.monotonic() + CLAIM_S
    while True:
        try:
            claim.bind(place)
            return claim
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:  # macOS has one loopback address.
                place = "127.0.0.1", place[1]
            elif time.monotonic() > deadline:
                claim.close()
                said = f"another program on this computer has the controller at {ip} (or holds UDP port {place[1]})"
                raise UserError(f"{said}; end it first.") from error
            else:
                time.sleep(LOCK_POLL_S)


def make(description: RigDescription) -> AdsRig:
    """Return the rig of a rig file."""
    return AdsRig(description)
