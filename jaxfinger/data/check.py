"""Check a file: every fault that it has, each in one sentence with its mend."""

from __future__ import annotations

import os
from collections.abc import Collection
from pathlib import Path

import h5py

from jaxfinger.data.findings import Finding, Report
from jaxfinger.data.parse import parse_file
from jaxfinger.data.session import Session


def check_file(path: str | os.PathLike) -> list[Finding]:
    """All that is wrong with a file, in the order of the file; empty where it is as the format wants it."""
    return list(inspect(path)[1])


def inspect(path: str | os.PathLike, trials: Collection[str] | None = None) -> tuple[Session | None, Report]:
    """What could be read of a file, and what is wrong with it. Never raises for what is in the file."""
    report = Report()
    file = open_file(path, report)
    if file is None:
        return None, report
    try:
        with file:
            session = parse_file(file, os.fspath(path), report, trials)
    except Exception:  # h5py raises nearly anything on a damaged file
        report.error("/", "cannot be read to the end: the file is damaged; record or import it again")
        return None, report
    return session, report


def open_file(path: str | os.PathLike, report: Report) -> h5py.File | None:
    if not Path(path).is_file():
        what = "is a folder" if Path(path).is_dir() else "does not exist"
        report.error("/", f"{what}; name a dataset file")
        return None
    try:
        return h5py.File(path, "r")
    except OSError as error:
        report.error("/", _reason(Path(path), str(error)))
        return None


def _reason(path: Path, error: str) -> str:
    try:
        if path.stat().st_size == 0:
            return "is empty; record or import it again"
        if not h5py.is_hdf5(path):
            return "is not an HDF5 file; give a dataset file, or import the recording first"
    except OSError:
        pass
    if "truncated" in error:
        return "is truncated: its end is missing; copy it again, or recover it from the recorder's log"
    if "Permission" in error or "permission" in error:
        return "may not be read; change its permissions"
    return "cannot be opened as HDF5: it is damaged; copy it again, or recover it from the recorder's log"
