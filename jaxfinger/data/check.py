"""Check a file: every fault that it has, each in one sentence with its mend."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Collection
from datetime import datetime
from pathlib import Path

import h5py
import numpy as np

from jaxfinger.data.check_finger import check_finger
from jaxfinger.data.check_trial import check_trial
from jaxfinger.data.filtering import longest_spike, outlier_mask
from jaxfinger.data.findings import Finding, Report
from jaxfinger.data.parse import listed, parse_file
from jaxfinger.data.probe import survives
from jaxfinger.data.schema import MEASURED
from jaxfinger.data.session import EXPERIMENTS, Session, Trial

_MANY_SPIKES = 0.05
_START = 100  # samples by which most pairs of trials are told apart


def check_file(path: str | os.PathLike) -> list[Finding]:
    """All that is wrong with a file; empty where it is as the format wants it. Never raises for what is in the file."""
    session, report = inspect(path)
    for trial in session or ():
        _check_spikes(trial, report)
    return list(report)


def inspect(path: str | os.PathLike, trials: Collection[str] | None = None) -> tuple[Session | None, Report]:
    """What could be read of a file (or of the named trials), and what is wrong with it."""
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
    if session is not None:
        check_session(session, report)
    return session, report


def check_session(session: Session, report: Report) -> None:
    """Report every fault of a session in memory: what the writer cannot see from shapes alone."""
    # Wild numbers overflow here and there; what is wrong with them is said by the checks.
    with np.errstate(all="ignore"):
        check_finger(session.finger, report)
        for trial in session:
            if trial.experiment not in EXPERIMENTS:
                message = f"has the unknown experiment {trial.experiment!r}; it must be one of {', '.join(EXPERIMENTS)}"
                report.error(f"/trials/{trial.name}", message)
                continue
            check_trial(trial, session.finger, report)
    _check_order(session, report)
    _check_motions(session, report)
    _check_copies(session, report)
    if session.created:
        _check_created(session.created, report)


def open_file(path: str | os.PathLike, report: Report) -> h5py.File | None:
    """The open file, or None with the reason reported."""
    if not Path(path).is_file():
        what = "is a folder" if Path(path).is_dir() else "does not exist"
        report.error("/", f"{what}; name a dataset file")
        return None
    if not survives(path):
        report.error("/", "is damaged in its structure; copy it again, or recover it from the recorder's log")
        return None
    try:
        return h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError, UnicodeError) as error:
        report.error("/", _reason(Path(path), str(error)))
        return None


def _reason(path: Path, error: str) -> str:
    if not os.access(path, os.R_OK):
        return "may not be read; change its permissions"
    if path.stat().st_size == 0:
        return "is empty; record or import it again"
    if not h5py.is_hdf5(path):
        return "is not an HDF5 file; give a dataset file, or import the recording first"
    if "truncated" in error:
        return "is truncated: its end is missing; copy it again, or recover it from the recorder's log"
    return "cannot be opened as HDF5: it is damaged; copy it again, or recover it from the recorder's log"


def _check_order(session: Session, report: Report) -> None:
    without = [trial.name for trial in session if trial.session_start is None]
    if without and len(without) < len(session):
        report.warning(
            "/trials", f"{listed(without)} lack `session_start`, so trials are ordered by name; give it to all or none"
        )


def _check_motions(session: Session, report: Report) -> None:
    """Trials of one `motion` must be repeats of one thing."""
    kinds: dict[str, set] = defaultdict(set)
    for trial in session:
        if trial.motion is not None:
            kinds[trial.motion].add((trial.experiment, trial.joint, trial.tendon))
    for motion, found in kinds.items():
        if len(found) > 1:
            report.warning(
                "/trials",
                f"the motion {motion!r} is shared by trials that differ in experiment, joint or tendon; "
                "their differences are no pure noise: name the motions apart",
            )


def _check_copies(session: Session, report: Report) -> None:
    """A recording counts once: a copy would pass for a repeat without noise."""
    alike: dict[tuple, list[Trial]] = defaultdict(list)
    for trial in session:
        measured = {name: values for name in MEASURED if (values := getattr(trial, name)) is not None}
        start = tuple((name, np.ascontiguousarray(values[:_START]).tobytes()) for name, values in measured.items())
        earlier = alike[(trial.experiment, len(trial.time), start)]
        for other in earlier if len(trial.time) > 1 else ():
            if all(np.array_equal(values, getattr(other, name), equal_nan=True) for name, values in measured.items()):
                message = f"is the same recording as trial {other.name}, sample for sample; remove one of them"
                report.error(f"/trials/{trial.name}", message)
                break
        earlier.append(trial)


def _check_created(created: str, report: Report) -> None:
    try:
        zoned = datetime.fromisoformat(created).tzinfo is not None
    except ValueError:
        zoned = False
    if not zoned:
        report.warning("/", f"has `created` {created!r}; write ISO 8601 with time zone, as 2026-01-31T12:00:00+00:00")


def _check_spikes(trial: Trial, report: Report) -> None:
    longest = longest_spike(float(np.median(np.diff(trial.time))) if len(trial.time) > 1 else 0.0)
    for name in MEASURED:
        values = getattr(trial, name)
        if values is None:
            continue
        share = float(outlier_mask(values, longest=longest).mean(axis=0).max(initial=0.0))
        if share > 0.0:
            say = report.warning if share > _MANY_SPIKES else report.note
            say(
                f"/trials/{trial.name}/{name}",
                f"up to {share:.2%} of a column's samples are spikes; robust fits discount them",
            )
