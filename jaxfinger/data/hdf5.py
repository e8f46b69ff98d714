"""Session files: read, check, write, hash (dataset format, version 1.1)."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields
from datetime import UTC, datetime

import h5py
import numpy as np

from jaxfinger.data.atomic import atomic_path
from jaxfinger.data.checks.session import check_samples, check_session
from jaxfinger.data.findings import Finding, Report
from jaxfinger.data.opening import plain_reason, why_closed
from jaxfinger.data.parse import parse_file
from jaxfinger.data.schema import (
    CHANNELS,
    FINGERTIP,
    FORMAT,
    JOINTS,
    LINKS,
    TEMPERATURE,
    TENDONS,
    TIME,
    VERSION,
    Entry,
    entry_units,
)
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.errors import UserError, require

# The newest version of HDF5 files that MATLAB before R2021b and other old tools open.
LIBVER = ("earliest", "v108")
_TEXT = h5py.string_dtype("utf-8")


def read_session(
    path: str | os.PathLike, trials: str | Collection[str] | None = None, report: Report | None = None
) -> Session:
    """Read the session in a file, or only its named trials, one or more. Findings of the checker go to `report`.

    Numbers are float64, in SI units.

    >>> import jaxfinger as jf
    >>> jf.read("session.h5")
    Session('EMPS': 1 joint, 0 tendons; 1 ID.3-dynamic)

    Raises:
        UserError: the first error that `check_file` finds, in one sentence with file, place and mend.
    """
    session, findings = read_and_check(path, (trials,) if isinstance(trials, str) else trials)
    if report is not None:
        report.extend(findings)
    fault = findings.fatal
    if fault is not None:
        raise UserError(f"{path}: {fault.sentence}")
    assert session is not None
    return session


def check_file(path: str | os.PathLike) -> list[Finding]:
    """Check a session file: its faults, none for a sound file. Faults of the file are never raised.

    >>> import jaxfinger as jf
    >>> jf.check("session.h5")
    []
    >>> [finding.severity for finding in jf.check("fit.json")]
    ['error']
    """
    return list(read_and_check_all(path)[1])


def read_and_check_all(path: str | os.PathLike) -> tuple[Session | None, Report]:
    """Read a file and make all checks: the session, None where it is unusable, and the findings about it."""
    session, report = read_and_check(path)
    if session is not None:
        check_samples(session, report)
    return session, report


def read_and_check(path: str | os.PathLike, trials: Collection[str] | None = None) -> tuple[Session | None, Report]:
    """Read a file, or only the named trials: the session, None where it is unusable, and the findings about it.

    The slow checks, for spikes and contradictions, are left to `check_samples`.
    """
    report = Report()
    file = open_file(path, report)
    if file is None:
        return None, report
    try:
        with file:
            session = parse_file(file, os.fspath(path), report, trials)
    except Exception as error:  # h5py raises exceptions of many kinds on a damaged file.
        said = plain_reason(error)
        report.error("/", f"cannot be read to the end ({said}): the file is damaged; record or import it again")
        return None, report
    if session is not None:
        check_session(session, report)
    return session, report


def open_file(path: str | os.PathLike, report: Report) -> h5py.File | None:
    """Open the file; None with the reason reported where it does not open."""
    reason = why_closed(path)
    if reason is not None:
        report.error("/", reason)
        return None
    return h5py.File(path, "r")


def write_session(session: Session, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a session; the file appears whole or not at all.

    >>> import jaxfinger as jf
    >>> session = jf.read("session.h5")
    >>> jf.write(session.select("ID.3-dynamic"), "sweeps.h5")
    >>> jf.read("sweeps.h5")
    Session('EMPS': 1 joint, 0 tendons; 1 ID.3-dynamic)

    Raises:
        UserError: the file exists and `overwrite` is false, a channel has the wrong shape, or it cannot be written.
    """
    require(Session, session=session)
    for trial in session:
        _refuse_misshapen(trial, session.finger, path)
    with new_file(path, overwrite) as file:
        write_into(file, session)


@contextmanager
def new_file(path: str | os.PathLike, overwrite: bool = False) -> Iterator[h5py.File]:
    """A new HDF5 file in memory, which is written whole to `path` on success (`atomic_path`).

    All HDF5 files are written in this way: where a disk fills up while the HDF5 library closes a file, the library
    crashes the interpreter, so it must not write to the disk itself.

    Raises:
        UserError: the file exists and `overwrite` is false, or it cannot be written.
    """
    with atomic_path(path, overwrite) as part:
        with h5py.File(part.name, "w", driver="core", backing_store=False, libver=LIBVER) as file:
            yield file
            file.flush()
            image = file.id.get_file_image()
        part.write_bytes(image)


def write_into(file: h5py.File, session: Session) -> None:
    """Write a session into an open file, which may also hold other groups."""
    write_header(file, session)
    trials = file.create_group("trials")
    for name, trial in session.trials.items():
        _write_trial(trials.create_group(name), trial, session.finger)


def data_hash(path: str | os.PathLike) -> str:
    """SHA-256 of a file's bytes, in hexadecimal.

    Raises:
        UserError: the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check the name") from None


def trial_hash(trial: Trial) -> str:
    """SHA-256 of a trial's samples and attributes, in hexadecimal; its name does not count."""
    digest = hashlib.sha256()
    for key, value in sorted(vars(trial).items()):
        if key != "name":
            content = np.ascontiguousarray(value).tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
            digest.update(f"{key} {np.shape(value)} ".encode() + content)
    return digest.hexdigest()


def write_header(file: h5py.File, session: Session) -> None:
    """Write the root attributes and `/finger`."""
    file.attrs["format"] = FORMAT
    file.attrs["format_version"] = VERSION
    file.attrs["specimen"] = session.specimen
    file.attrs["source"] = session.source
    file.attrs["created"] = session.created or datetime.now(UTC).isoformat(timespec="seconds")
    finger = session.finger
    group = file.create_group("finger")
    group.attrs["gravity"] = np.asarray(finger.gravity, np.float64)
    types = tuple("prismatic" if slides else "revolute" for slides in finger.prismatic)
    joints = {
        "name": finger.joint_names,
        "axis": finger.axis,
        "type": types if any(finger.prismatic) else None,
        "origin": finger.origin,
        "limits": finger.limits,
        "rotor_inertia": finger.rotor_inertia,
        "rotor_inertia_std": finger.rotor_inertia_std,
    }
    links = {entry.name: getattr(finger, entry.name) for entry in LINKS}
    tendons = {
        "name": finger.tendon_names,
        "active": finger.active,
        "crosses": finger.crosses,
        "excursion": finger.excursion,
        "excursion_std": finger.excursion_std,
    }
    for name, entries, values in (("joints", JOINTS, joints), ("links", LINKS, links), ("tendons", TENDONS, tendons)):
        table = group.create_group(name)
        for entry in entries:
            if values[entry.name] is not None:
                write_dataset(table, entry, values[entry.name], finger.prismatic)
    write_dataset(group, FINGERTIP, finger.fingertip, finger.prismatic)


def _write_trial(group: h5py.Group, trial: Trial, finger: FingerDescription) -> None:
    for key in ("experiment", "joint", "tendon", "complete", "motion", "session_start"):
        value = getattr(trial, key)
        if value is not None:
            group.attrs[key] = value
    write_dataset(group, TIME, trial.time, finger.prismatic)
    for name, entry in CHANNELS.items():
        value = getattr(trial, name)
        if value is not None:
            write_dataset(group, entry, value, finger.prismatic)
    if trial.temperature is not None:
        write_dataset(group, TEMPERATURE, trial.temperature, finger.prismatic)
        names = np.array(trial.temperature_names, _TEXT)
        group[TEMPERATURE.name].attrs.create("names", names, dtype=_TEXT)


def write_dataset(group: h5py.Group, entry: Entry, value, prismatic: Sequence[bool]) -> None:
    """Write one dataset with its `units`, compressed where it is long."""
    if entry.kind == "text":
        group.create_dataset(entry.name, data=list(value), dtype=_TEXT)
        return
    value = np.asarray(value, np.float64 if entry.kind == "float" else entry.kind)
    if entry.kind == "float" and entry is not TIME:
        value = _lossless_single(value)
    long = value.size > 1024
    item = group.create_dataset(
        entry.name, data=value, compression="gzip" if long else None, compression_opts=1 if long else None, shuffle=long
    )
    if entry.units is not None:
        item.attrs["units"] = entry_units(entry, prismatic)


def _lossless_single(value: np.ndarray) -> np.ndarray:
    """Value as float32 where no digit is lost, which halves the space of sensors with 16 bits or fewer."""
    with np.errstate(over="ignore"):
        single = value.astype(np.float32)
    return single if np.array_equal(single, value, equal_nan=True) else value


def _refuse_misshapen(trial: Trial, finger: FingerDescription, path) -> None:
    sizes = {"N": len(trial.time), "m": finger.m, "n": finger.n}
    channels = {field.name for field in fields(Trial)} & CHANNELS.keys()
    for name in sorted(channels):
        value = getattr(trial, name)
        wanted = tuple(sizes[axis] if isinstance(axis, str) else axis for axis in CHANNELS[name].shape)
        if value is not None and np.shape(value) != wanted:
            raise UserError(f"{path}: {trial.place(name)}: has shape {np.shape(value)}; it must be {wanted}")
    if trial.temperature is not None:
        wanted = (sizes["N"], len(trial.temperature_names))
        if np.shape(trial.temperature) != wanted:
            shape = np.shape(trial.temperature)
            raise UserError(f"{path}: {trial.place(TEMPERATURE.name)}: has shape {shape}; it must be {wanted}")
