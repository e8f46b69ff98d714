"""Touch every corner of a file in a child process first.

libhdf5 and SciPy's reader of MATLAB's files trust what they read: a few damaged bytes can crash them or send them round
in circles, where no exception handler helps. A child that dies, raises, or spends its processor time says so without
harm.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import warnings
from collections.abc import Callable
from pathlib import Path

import h5py
import h5py.h5o as h5o

# s of processor time for one object: a thousand times what a sound one takes. The clock on the wall would call a file
# damaged because the machine is busy.
_PATIENCE = 5.0
_LEAST_OBJECT = 16  # bytes: no object of a file takes less, so a walk over more objects than fit goes in circles
_SMALL = 10_000  # elements


def survives(path: str | os.PathLike, visit: Callable[[Path], None] | None = None) -> bool:
    """Whether a child process gets through a visit of the file, by default a walk through the structure of an HDF5
    file; True where the system cannot fork.

    A file that does not open survives: the reader will meet the reason, and say it.
    """
    if not hasattr(os, "fork"):
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a fork beside JAX's threads: the child reads the file, and leaves at once
        child = os.fork()
    if child == 0:
        status = 1
        try:
            faulthandler.disable()
            signal.signal(signal.SIGPROF, signal.SIG_DFL)
            rest()
            (visit or _walk_through)(Path(path))
            status = 0
        finally:
            os._exit(status)
    return os.waitpid(child, 0)[1] == 0


def rest(more: float = 0.0) -> None:
    """Start the measure of the processor time anew, of a visit that may take `more` seconds than an object does."""
    signal.setitimer(signal.ITIMER_PROF, _PATIENCE + more)


def _walk_through(path: Path) -> None:
    try:
        file = h5py.File(path, "r")
    except Exception:  # whatever it is, the reader meets it too
        return
    _walk(file, path.stat().st_size // _LEAST_OBJECT)


def _walk(file: h5py.File, most: int) -> None:
    seen: set[int] = set()
    waiting: list[h5py.Group] = [file]
    while waiting:
        group = waiting.pop()
        _attempt(lambda item=group: dict(item.attrs))
        for name in group:
            rest()
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
    except Exception:  # h5py raises whatever libhdf5 met
        return None
