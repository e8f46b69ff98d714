"""Read a file in a child process first, to see whether it is safe to read.

libhdf5 and SciPy's reader of MATLAB files do not verify what they read. A few damaged bytes can crash them or let them
loop for ever, and no exception handler helps. A child process that crashes, raises, or uses up its processor time shows
this without harm.
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

# Processor time, s, for one object: a thousand times what a sound one takes. Wall time would call a file damaged on a
# busy machine.
_MAX_CPU_TIME = 5.0
_MIN_OBJECT_SIZE = 16  # bytes: no object of a file is smaller, so a walk over more objects than fit runs in a loop.
_SMALL = 10_000  # elements: datasets below it, such as names and tables, are read whole. Channels would take too long.


def survives(path: str | os.PathLike, visit: Callable[[Path], None] | None = None) -> bool:
    """Whether a child process survives reading the file with `visit`, by default a walk through an HDF5 file.

    True where the system cannot fork, and for a file that does not open, since the reader then reports the reason.
    """
    if not hasattr(os, "fork"):
        return True
    with warnings.catch_warnings():
        # Python warns of forks beside threads such as JAX's. This child only reads the file and exits.
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        status = 1
        try:
            faulthandler.disable()
            signal.signal(signal.SIGPROF, signal.SIG_DFL)
            restart_timer()
            (visit or _walk_through)(Path(path))
            status = 0
        finally:
            os._exit(status)
    return os.waitpid(child, 0)[1] == 0


def restart_timer(extra: float = 0.0) -> None:
    """Restart the limit of the child's processor time. `extra` seconds are added for visits that take longer."""
    signal.setitimer(signal.ITIMER_PROF, _MAX_CPU_TIME + extra)


def _walk_through(path: Path) -> None:
    try:
        file = h5py.File(path, "r")
    except Exception:  # The reader meets the same exception and reports it.
        return
    _walk(file, path.stat().st_size // _MIN_OBJECT_SIZE)


def _walk(file: h5py.File, max_objects: int) -> None:
    """Read every object of the file once; RecursionError where there are more than `max_objects`."""
    seen: set[int] = set()
    waiting: list[h5py.Group] = [file]
    while waiting:
        group = waiting.pop()
        _attempt(lambda item=group: dict(item.attrs))
        for name in group:
            restart_timer()
            max_objects -= 1
            if max_objects < 0:
                raise RecursionError("more objects than the file can hold")
            item = _attempt(lambda name=name, group=group: group.get(name))
            if isinstance(item, h5py.Group) and h5o.get_info(item.id).addr not in seen:
                seen.add(h5o.get_info(item.id).addr)
                waiting.append(item)
            elif isinstance(item, h5py.Dataset):
                _attempt(lambda item=item: dict(item.attrs))
                _attempt(lambda item=item: _touch(item))


def _touch(item: h5py.Dataset) -> None:
    """Read small datasets whole, and of chunked ones the index of chunks: damage within a chunk crashes no reader."""
    if item.chunks is not None:
        item.id.get_num_chunks()
    elif item.size is not None and item.size < _SMALL:
        item[()]


def _attempt(action):
    """Result of an action; None where it raises, since the reader reports that object and goes on with the others."""
    try:
        return action()
    except Exception:  # h5py raises exceptions of many kinds on a damaged file.
        return None
