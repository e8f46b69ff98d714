"""A small AMS/TCP server that serves a controller's memory as ADS symbols, only on the loopback address.

AMS/TCP header: 2 bytes zero, length (u32). AMS header: target NetId and port, source NetId and port, command (u16),
state flags (u16), length (u32), error (u32), invoke id (u32). All little endian (Beckhoff Information System, «ADS/AMS
specification»). Like a TwinCAT router it keeps one connection per client address: a new one closes the old one.
"""

from __future__ import annotations

import socket
import socketserver
import struct
import threading
import time
from collections.abc import Callable, Mapping

_TCP = struct.Struct("<HI")
_AMS = struct.Struct("<6sH6sHHHIII")
RESPONSE = 0x0005  # state flags of an answer
# Commands.
READ_DEVICE_INFO, READ, WRITE, READ_STATE, WRITE_CONTROL, READ_WRITE = 1, 2, 3, 4, 5, 9
# Index groups. MEMORY addresses the controller's memory by offset.
HANDLE_BY_NAME, VALUE_BY_NAME, VALUE_BY_HANDLE, RELEASE_HANDLE = 0xF003, 0xF004, 0xF005, 0xF006
INFO_BY_NAME = 0xF009
MEMORY = 0x4040
# Error codes.
OK, UNKNOWN_SERVICE, INVALID_GROUP, INVALID_OFFSET, INVALID_SIZE, NO_SYMBOL = 0, 0x701, 0x702, 0x703, 0x705, 0x710


class AmsServer:
    """Serves `memory`, in which `places` gives offset and size of each symbol.

    It holds `lock` while it reads or writes the memory. Every answer comes `delay()` s late, and to reads of the symbol
    that `unanswered()` names none comes. `port` is the TCP port (0: any free one).
    """

    def __init__(
        self,
        memory: bytearray,
        places: Mapping[str, tuple[int, int]],
        lock: threading.Lock,
        port: int = 0,
        delay: Callable[[], float] = lambda: 0.0,
        unanswered: Callable[[], str] = lambda: "",
    ):
        self.memory, self.places, self.lock = memory, dict(places), lock
        self.delay, self.unanswered = delay, unanswered
        self.requests = 0
        self._clients: dict[str, socket.socket] = {}
        self._clients_lock = threading.Lock()
        outer = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                outer._serve(self.request)

        class Server(socketserver.ThreadingTCPServer):
            daemon_threads = True
            allow_reuse_address = True

        self._server = Server(("127.0.0.1", port), Handler)
        self.port: int = self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True).start()

    def cut(self) -> None:
        """Close every connection, as a pulled cable would."""
        with self._clients_lock:
            clients, self._clients = list(self._clients.values()), {}
        for client in clients:
            _hang_up(client)

    def close(self) -> None:
        """Stop listening and close every connection."""
        self._server.shutdown()
        self._server.server_close()
        self.cut()

    def _serve(self, client: socket.socket) -> None:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        host = client.getpeername()[0]
        with self._clients_lock:
            old, self._clients[host] = self._clients.get(host), client
        if old is not None:
            _hang_up(old)
        try:
            while True:
                _, length = _TCP.unpack(_exactly(client, _TCP.size))
                frame = _exactly(client, length)
                answer = self._answer(frame)
                if self._reads(frame, self.unanswered()):
                    continue
                if late := self.delay():
                    time.sleep(late)
                client.sendall(answer)
        except (ConnectionError, OSError, struct.error):
            return

    def _reads(self, frame: bytes, symbol: str) -> bool:
        """Whether a request reads the memory of a symbol ("": of none)."""
        start, size = self.places.get(symbol, (0, 0))
        if _AMS.unpack_from(frame)[4] != READ:
            return False
        group, offset = struct.unpack_from("<II", frame, _AMS.size)
        return group == MEMORY and start <= offset < start + size

    def _answer(self, frame: bytes) -> bytes:
        target, target_port, source, source_port, command, _, length, _, invoke = _AMS.unpack_from(frame)
        body = self._dispatch(command, frame[_AMS.size : _AMS.size + length])
        self.requests += 1
        head = _AMS.pack(source, source_port, target, target_port, command, RESPONSE, len(body), 0, invoke)
        return _TCP.pack(0, len(head) + len(body)) + head + body

    def _dispatch(self, command: int, data: bytes) -> bytes:
        if command == READ_DEVICE_INFO:
            return struct.pack("<IBBH16s", OK, 3, 1, 4024, b"jaxfinger")
        if command == READ_STATE:
            return struct.pack("<IHH", OK, 5, 0)  # ADS state RUN
        if command == READ:
            group, offset, size = struct.unpack_from("<III", data)
            error, answer = self._read(group, offset, size)
            return struct.pack("<II", error, len(answer)) + answer
        if command == WRITE:
            group, offset, size = struct.unpack_from("<III", data)
            return struct.pack("<I", self._write(group, offset, data[12 : 12 + size]))
        if command == READ_WRITE:
            group, offset, size, sent = struct.unpack_from("<IIII", data)
            error, answer = self._read_write(group, offset, size, data[16 : 16 + sent])
            return struct.pack("<II", error, len(answer)) + answer
        return struct.pack("<I", UNKNOWN_SERVICE)

    def _read(self, group: int, offset: int, size: int) -> tuple[int, bytes]:
        if group == VALUE_BY_HANDLE:
            return self._by_handle(offset, size)
        if group != MEMORY:
            return INVALID_GROUP, b""
        if offset + size > len(self.memory):
            return INVALID_OFFSET, b""
        with self.lock:
            return OK, bytes(self.memory[offset : offset + size])

    def _by_handle(self, handle: int, size: int) -> tuple[int, bytes]:
        place = list(self.places.values())[handle - 1] if 1 <= handle <= len(self.places) else None
        if place is None:
            return NO_SYMBOL, b""
        return self._read(MEMORY, place[0], size) if size <= place[1] else (INVALID_SIZE, b"")

    def _write(self, group: int, offset: int, data: bytes) -> int:
        if group == RELEASE_HANDLE:
            return OK
        if group == VALUE_BY_HANDLE and 1 <= offset <= len(self.places):
            offset, group = list(self.places.values())[offset - 1][0], MEMORY
        if group != MEMORY:
            return INVALID_GROUP
        if offset + len(data) > len(self.memory):
            return INVALID_OFFSET
        with self.lock:
            self.memory[offset : offset + len(data)] = data
        return OK

    def _read_write(self, group: int, offset: int, size: int, data: bytes) -> tuple[int, bytes]:
        name = data.rstrip(b"\0").decode(errors="replace")
        if name not in self.places:
            return NO_SYMBOL, b""
        start, length = self.places[name]
        if group == HANDLE_BY_NAME:
            return OK, struct.pack("<I", 1 + list(self.places).index(name))
        if group == VALUE_BY_NAME:
            return self._read(MEMORY, start, min(size, length))
        if group == INFO_BY_NAME:
            label, kind = name.encode(), b"BYTE"
            entry = struct.pack("<IIIIIHHH", MEMORY, start, length, 65, 0, len(label), len(kind), 0)
            entry += label + b"\0" + kind + b"\0" + b"\0"
            return OK, (struct.pack("<I", 4 + len(entry)) + entry)
        return INVALID_GROUP, b""


def _exactly(client: socket.socket, size: int) -> bytes:
    """Receive exactly `size` bytes."""
    data = bytearray()
    while len(data) < size:
        part = client.recv(size - len(data))
        if not part:
            raise ConnectionResetError
        data += part
    return bytes(data)


def _hang_up(client: socket.socket) -> None:
    try:
        client.shutdown(socket.SHUT_RDWR)
    except OSError:
        return
