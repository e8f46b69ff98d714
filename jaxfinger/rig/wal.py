"""A write-ahead log: frames with a checksum, appended and never changed, so that every prefix of the file is readable.

    file  = "JXFWAL01" frame*
    frame = tag (4 bytes), length (u32), crc32 of tag + length + payload (u32), payload

All numbers are little endian. HDF5 cannot be the log: killed between two flushes, an HDF5 file loses everything or
cannot be opened (measured). A prefix of this file loses only the frame that was being written. Damage within the file
costs the frames that it touches: reading goes on at the next tag whose frame has the right checksum.
"""

from __future__ import annotations

import errno
import fcntl
import io
import json
import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.errors import UserError
from jaxfinger.rig.backend import Block

MAGIC = b"JXFWAL01"
_HEAD = struct.Struct("<4sII")  # tag, length, crc32
_DATA = struct.Struct("<IIQ")  # samples, channels, samples lost before
# A longer length is damage. A block of MAX_RECORDS samples (ring.py) with 60 channels has 50 KB.
MAX_FRAME_BYTES = 64 * 2**20

# Tags. HEADER is the first frame. TRIAL and END enclose a trial, DATA holds a block of it, MARK a hold or directions.
# An EVENT may stand anywhere. An END that names a trial, after that trial's own, replaces what it says.
HEADER, TRIAL, DATA, MARK, EVENT, END = TAGS = b"HEAD", b"TRIA", b"DATA", b"MARK", b"EVNT", b"ENDT"
_TAG = re.compile(b"|".join(TAGS))
_SEARCH_BYTES = 2**20  # bytes of a damaged file that are searched for a tag at a time


@dataclass(frozen=True)
class Frame:
    """One frame: its tag, its payload, and the byte of the file at which it ends.

    `damaged` counts the bytes between it and the sound frame before it that are no sound frame.
    """

    tag: bytes
    payload: bytes
    end: int
    damaged: int = 0

    @property
    def start(self) -> int:
        """Byte of the file at which it begins."""
        return self.end - _HEAD.size - len(self.payload)

    @property
    def json(self) -> dict[str, Any]:
        """Payload of every frame but DATA, as a dictionary."""
        return json.loads(self.payload)

    @property
    def block(self) -> Block:
        """Payload of a DATA frame, as a block."""
        count, channels, lost = _DATA.unpack_from(self.payload)
        at = _DATA.size
        parts = []
        for dtype, size in (("<u8", count), ("<u8", count), ("<u4", count), ("<u4", count), ("<f8", count * channels)):
            parts.append(np.frombuffer(self.payload, dtype, size, at))
            at += parts[-1].nbytes
        seq, t_ns, state, flags, x = parts
        return Block(seq, t_ns, x.reshape(count, channels), state, flags, lost)


def pack_block(block: Block) -> bytes:
    """Payload of a DATA frame."""
    arrays = (
        block.seq.astype("<u8"), block.t_ns.astype("<u8"), block.state.astype("<u4"), block.flags.astype("<u4"),
        np.ascontiguousarray(block.x, "<f8"),
    )  # fmt: skip
    return _DATA.pack(len(block), block.x.shape[1], block.lost_before) + b"".join(a.tobytes() for a in arrays)


def sample_bytes(channels: int) -> int:
    """Bytes of one sample in the payload of a DATA frame."""
    return 24 + 8 * channels  # number, time, state, flags, values


def pack_json(value: dict[str, Any]) -> bytes:
    """Payload of every frame but DATA."""
    return json.dumps(value, separators=(",", ":")).encode()


def pack_frame(tag: bytes, payload: bytes) -> bytes:
    """Bytes of one frame."""
    crc = zlib.crc32(payload, zlib.crc32(tag + struct.pack("<I", len(payload))))
    return _HEAD.pack(tag, len(payload), crc) + payload


class LogWriter:
    """Appends frames. Each is handed to the operating system at once, so the death of this process loses none.

    `end` is the byte at which the file's last sound frame ends.
    """

    def __init__(self, file: io.RawIOBase | io.BufferedIOBase, end: int = 0):
        self._file, self._end = file, end

    @classmethod
    def create(cls, path: Path) -> LogWriter:
        """Create a log. Raises UserError where one exists or the file cannot be written."""
        writer = cls(_opened(path, "x"))
        writer._write(MAGIC)
        return writer

    @classmethod
    def append(cls, path: Path) -> LogWriter:
        """Open a log to append to it, after cutting off a torn last frame. Raises UserError as `create` does."""
        file = _opened(path, "r+")
        end = sound_length(path)
        file.truncate(end)
        file.seek(end)
        return cls(file, end)

    def write(self, tag: bytes, payload: bytes) -> None:
        """Append one frame. Raises OSError on a full disk; the frames before stay intact."""
        self._write(pack_frame(tag, payload))

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                view = view[self._file.write(view) or 0 :]
        except OSError:
            self._file.seek(self._end)  # Half a frame would hide every frame written after it.
            self._file.truncate()
            raise
        self._end += len(data)

    def sync(self) -> None:
        """Wait until the disk has what was written. Raises OSError where somebody has deleted the file."""
        os.fdatasync(self._file.fileno())
        if not os.fstat(self._file.fileno()).st_nlink:
            raise OSError(errno.ENOENT, "somebody has deleted it")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _opened(path: Path, mode: str) -> io.FileIO:
    """Open a log to write, and keep other recorders from it for as long as it is open."""
    try:
        file = io.FileIO(path, mode)
    except FileExistsError as error:
        raise UserError(
            f"{path}: a recording was interrupted here; go on with --resume, or rescue it with jaxfinger recover."
        ) from error
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror}); choose another place, or mend it.") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise UserError(f"{path}: another recorder writes to it; end that one first.") from error
    except OSError:
        pass  # A file system without locks: the controller itself refuses a second recorder.
    return file


def refuse_live(path: str | Path) -> None:
    """Raise UserError where a recorder still writes to a log: its run goes on, maybe with the finger armed."""
    with suppress(OSError), open(path, "rb") as file:  # What cannot be opened is the reader's to report.
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            said = "a recorder still writes to it, and the finger may be armed"
            raise UserError(f"{path}: {said}; end that run first, by its stop key or kill.") from error


def frames(file: io.BufferedIOBase, name: str = "log") -> Iterator[Frame]:
    """Yield the sound frames. Damage between two of them is counted in the second; damage at the end ends them.

    Raises:
        UserError: the file is not a log.
    """
    if file.read(len(MAGIC)) != MAGIC:
        raise UserError(f"{name}: not a recording log of jaxfinger; give the file that ends in .wal.")
    end = len(MAGIC)
    while (frame := _frame(file, end) or _next_frame(file, end + 1)) is not None:
        yield replace(frame, damaged=frame.start - end)
        end = frame.end


def _frame(file: io.BufferedIOBase, at: int) -> Frame | None:
    """The sound frame that begins at byte `at`, or None."""
    file.seek(at)
    if len(head := file.read(_HEAD.size)) < _HEAD.size:
        return None
    tag, length, crc = _HEAD.unpack(head)
    if length > MAX_FRAME_BYTES or len(payload := file.read(length)) < length:
        return None
    if zlib.crc32(payload, zlib.crc32(head[:8])) != crc:
        return None
    return Frame(tag, payload, at + _HEAD.size + length)


def _next_frame(file: io.BufferedIOBase, at: int) -> Frame | None:
    """The first sound frame with one of TAGS that begins at byte `at` or later, or None."""
    while True:
        file.seek(at)
        part = file.read(_SEARCH_BYTES)
        for found in _TAG.finditer(part):
            if (frame := _frame(file, at + found.start())) is not None:
                return frame
        if len(part) < _SEARCH_BYTES:
            return None
        at += len(part) - len(HEADER) + 1  # A tag may lie across the two parts.


def read_log(path: str | Path) -> Iterator[Frame]:
    """Yield the sound frames of a log file. Raises UserError where it is not a log or cannot be read."""
    try:
        file = open(path, "rb")  # noqa: SIM115 - closed below
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); give the path of a .wal file.") from error
    with file:
        yield from frames(file, str(path))


def sound_length(path: str | Path) -> int:
    """Byte of a log at which its last sound frame ends: what follows is torn."""
    end = len(MAGIC)
    for frame in read_log(path):
        end = frame.end
    return end
