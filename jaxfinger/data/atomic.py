"""A file appears whole or not at all, and none is overwritten unless asked."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from jaxfinger.errors import UserError

try:
    import fcntl
except ImportError:  # no such locks on Windows: what a killed process leaves stays there
    fcntl = None

YOUNG_S = 60.0  # an empty part may be a moment old and not locked yet


@contextmanager
def atomic_path(path: str | os.PathLike, overwrite: bool = False) -> Iterator[Path]:
    """A temporary path beside `path` to write to; on success it is synced to disk and takes the place of `path`.

    What a killed process left half-written for the same `path` is removed: a part that is being written is locked.

    Raises:
        UserError: the file exists and `overwrite` is false, or its folder cannot be written.
    """
    path = Path(path)
    refuse_existing(path, overwrite)
    prefix, suffix = f".{path.name}.", ".part"
    _remove_orphans(path.parent, prefix, suffix)
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=prefix, suffix=suffix)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror}); choose a folder that exists and is yours"
        ) from None
    part = Path(name)
    try:
        _lock(handle)
        yield part
        _sync(part)
        part.chmod(0o666 & ~_umask())  # mkstemp makes it private
        refuse_existing(path, overwrite)
        os.replace(part, path)
        _sync(path.parent)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another place"
        ) from None
    finally:
        os.close(handle)
        part.unlink(missing_ok=True)


def _lock(handle: int) -> bool:
    """Mark an open file as being written, until it is closed or its process dies; False where another does so."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # locked by another, or a file system without locks
        return False
    return True


def _remove_orphans(folder: Path, prefix: str, suffix: str) -> None:
    with suppress(OSError):
        for entry in os.scandir(folder):
            if not (entry.name.startswith(prefix) and entry.name.endswith(suffix)):
                continue
            with suppress(OSError):
                young = not entry.stat().st_size and time.time() - entry.stat().st_mtime < YOUNG_S
                handle = os.open(entry.path, os.O_RDONLY)
                try:
                    if not young and _lock(handle):
                        os.unlink(entry.path)
                finally:
                    os.close(handle)


def make_folder(path: str | os.PathLike) -> Path:
    """The folder, made where there is none.

    Raises:
        UserError: it is a file, or cannot be made.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        said = "is a file" if path.is_file() else f"cannot be made ({error.strerror})"
        raise UserError(f"{path}: {said}; choose another folder") from None
    return path


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Before any work: an output file that exists is only replaced when asked.

    Raises:
        UserError: there is a file and `overwrite` is false, or there is what is no file.
    """
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file in it")
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: is a device or a pipe, which no file may replace; choose another name")
    if path.exists() and not overwrite:
        raise UserError(f"{path}: exists already and is not overwritten; choose another name, or add --overwrite")


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
