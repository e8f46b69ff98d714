"""Touch every corner of an HDF5 file in a child process first.

libhdf5 trusts what it reads: a few damaged bytes in the structure of a file can crash it or send it round in circles,
where no exception handler helps. A child that dies, raises, or spends its processor time says so without harm.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import warnings
from pathlib import Path

import h5py
import h5py.h5o as h5o

# s of processor time for one object: a thousand times what a sound one takes. The clock on the wall would call a file
# damaged because the machine is busy.
_PATIENCE = 5.0
_LEAST_OBJECT = 16  # bytes: no object of a file takes less, so a walk over more objects than fit goes in circles
_SMALL = 10_000  # elements


def survives(path: str | os.PathLike) -> bool:
    """Whether a child process gets through the structure of the file; True where the system cannot fork.

    A file that does not open survives: the reader will meet the reason, and say it.
    """
    if not hasattr(os, "fork"):
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a fork beside JAX's threads: the child touches HDF5 alone, and leaves at once
        child = os.fork()
    if child == 0:
        status = 1
        try:
            faulthandler.disable()
            signal.signal(signal.SIGPROF, signal.SIG_DFL)
            _rest()
            status = _visit(Path(path))
        finally:
            os._exit(status)
    return os.waitpid(child, 0)[1] == 0


def _rest() -> None:
    """Start the measure of the processor time anew."""
    signal.setitimer(signal.ITIMER_PROF, _PATIENCE)


def _visit(path: Path) -> int:
    try:
        file = h5py.File(path, "r")
    except Exception:
        return 0
    _walk(file, path.stat().st_size // _LEAST_OBJECT)
    return 0


def _walk(file: h5py.File, most: int) -> None:
    seen: set[int] = set()
    waiting: list[h5py.Group] = [file]
    while waiting:
        group = waiting.pop()
        _attempt(lambda item=group: dict(item.attrs))
        for name in group:
            _rest()
            most -= 1
            if most < 0:
                raise RecursionError("more objects than the file can hold")
            item = _attempt(lambda name=name, group=group: group.get(name))
            if isinstance(item, h5py.Group) and h5o.get_info(item.id).addr not in seen:
                seen.add(h5o.get_info(item.id).addr)
                waiting.append(item)
            elif isinstance(item, h5py.Dataset):
                _attempt(lambda item=item: dict(item.attrs))
                _attempt(lambda item=item: _touch(item))


def _touch(item: h5py.Dataset) -> None:
    """Names and small tables as a whole; of a channel the index of its chunks (damage inside a chunk is harmless)."""
    if item.chunks is not None:
        item.id.get_num_chunks()
    elif item.size is not None and item.size < _SMALL:
        item[()]


def _attempt(action):
    """One object that cannot be read does no harm to the others: the reader names it."""
    try:
        return action()
    except Exception:
        return None
