"""Atomic writing: a file appears whole or not at all, and none is overwritten unless asked."""

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
except ImportError:  # Windows has no such locks, so the files that a killed process leaves stay there.
    fcntl = None

# Age, s, from which an empty unlocked part is an orphan. The process of a younger one may not have locked it yet.
MIN_ORPHAN_AGE = 60.0


@contextmanager
def atomic_path(path: str | os.PathLike, overwrite: bool = False) -> Iterator[Path]:
    """Context of a temporary path beside `path` to write to. On success it is synced to disk and replaces `path`.

    Half-written files that killed processes left for the same `path` are removed first. They are recognised by their
    missing lock.

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
        part.chmod(0o666 & ~_umask())  # mkstemp makes files that only their owner can read.
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
    """Lock an open file until it is closed or the process dies. False where another process holds it or none can."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # Another process holds the lock, or the file system has no locks.
        return False
    return True


def _remove_orphans(folder: Path, prefix: str, suffix: str) -> None:
    """Remove parts of this name that no process has locked."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if not (entry.name.startswith(prefix) and entry.name.endswith(suffix)):
                continue
            with suppress(OSError):
                young = not entry.stat().st_size and time.time() - entry.stat().st_mtime < MIN_ORPHAN_AGE
                handle = os.open(entry.path, os.O_RDONLY)
                try:
                    if not young and _lock(handle):
                        os.unlink(entry.path)
                finally:
                    os.close(handle)


@contextmanager
def folder_to_fill(path: str | os.PathLike) -> Iterator[Path]:
    """Context of the path of a folder, which is made where there is none.

    At the end, or where an error or Ctrl-C ends the work, the folders that it made and that are still empty are
    removed.

    Raises:
        UserError: the path is a file, or the folder cannot be made.
    """
    path = Path(path)
    made = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            said = "is a file" if os.path.isfile(path) else f"cannot be made ({error.strerror})"
            raise UserError(f"{path}: {said}; choose another folder") from None
        yield path
    finally:
        for folder in made:
            with suppress(OSError):  # It is filled.
                folder.rmdir()


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Refuse an output path that cannot be written, before any work is done.

    Raises:
        UserError: the path is a file and `overwrite` is false, or a folder, device or pipe.
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
