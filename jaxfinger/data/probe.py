"""Touch every corner of an HDF5 file in a child process first.

libhdf5 trusts what it reads: a few damaged bytes in the structure of a file can crash it or send it round in circles,
where no exception handler helps. A child that dies or does not come back says so without harm.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import warnings
from pathlib import Path

import h5py
import h5py.h5o as h5o

_PATIENCE = 5  # s
_SMALL = 10_000  # elements


def survives(path: str | os.PathLike) -> bool:
    """Whether a child process gets through the structure of the file; True where the system cannot fork."""
    if not hasattr(os, "fork"):
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a fork beside JAX's threads: the child touches HDF5 alone, and leaves at once
        child = os.fork()
    if child == 0:
        faulthandler.disable()
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(_PATIENCE)
        try:
            _walk(Path(path))
        finally:
            os._exit(0)  # an exception is no harm: the reader will meet it and say what it means
    return os.waitpid(child, 0)[1] == 0


def _walk(path: Path) -> None:
    with h5py.File(path, "r") as file:
        seen: set[int] = set()
        waiting: list[h5py.Group] = [file]
        while waiting:
            group = waiting.pop()
            _attempt(lambda item=group: dict(item.attrs))
            for name in group:
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
    try:
        return action()
    except Exception:  # the reader's business
        return None
