"""Reasons why an HDF5 file, or a part of one, cannot be read: the end of a sentence, with its mend."""

from __future__ import annotations

import os
import re
from pathlib import Path

import h5py

from jaxfinger.data.probe import survives

_DAMAGED = "copy it again, or recover it from the recorder's log"


def why_closed(path: str | os.PathLike) -> str | None:
    """Reason why the file does not open as HDF5, or None where it does."""
    path = Path(path)
    if not path.is_file():
        return f"{'is a folder' if path.is_dir() else 'does not exist'}; name a file"
    if not os.access(path, os.R_OK):
        return "may not be read; change its permissions"
    if path.stat().st_size == 0:
        return "is empty; record or import it again"
    if not survives(path):
        return f"is damaged in its structure; {_DAMAGED}"
    try:
        h5py.File(path, "r").close()
    except (OSError, RuntimeError, ValueError, UnicodeError) as error:
        return _reason(path, str(error))
    return None


def _reason(path: Path, error: str) -> str:
    if "already open" in error:
        return "was not closed by the program that wrote it; close it there, or mend a copy with `h5clear -s`"
    if "unable to lock" in error:
        return "is open in another program; close it there and try again"
    if not h5py.is_hdf5(path):
        return "is not an HDF5 file; give a dataset file, or import the recording first"
    if "truncated" in error:
        return f"is truncated: its end is missing; {_DAMAGED}"
    return f"cannot be opened as HDF5 ({plain_reason(error)}); {_DAMAGED}"


def why_unreadable(item: h5py.Dataset) -> str | None:
    """Reason why the values of a dataset cannot be read or trusted, or None where they can."""
    if item.is_virtual or item.external:
        kind = "virtual" if item.is_virtual else "external"
        return (
            f"is {kind}: its numbers lie in another file, and read as zeros where that is missing; copy them into this "
            "one"
        )
    if item.shape is None:
        return "is empty (it has no shape); write its samples or leave it out"
    filters = item.id.get_create_plist()
    for k in range(filters.get_nfilters()):
        number, _, _, name = filters.get_filter(k)
        if not h5py.h5z.filter_avail(number):
            called = name.decode(errors="replace").strip("\0") or "unnamed"
            return (
                f"is compressed with a filter that is not installed here ({called}, {number}); install hdf5plugin, or "
                "write the file with gzip"
            )
    return None


def plain_reason(error: object) -> str:
    """Message of a library's exception on one line, without its details about where in its code it happened."""
    text = re.sub(r"\s+", " ", str(error)).strip()
    inner = re.search(r"\(([^()]+)\)\s*$", text)
    return (inner.group(1) if inner else text)[:200] or type(error).__name__
