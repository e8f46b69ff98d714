"""Recordings of other tools as sessions, by a mapping file (TOML), as docs/your-own-data.md has it.

A column is (variable · scale + offset) in `units`; a list of such tables is their sum. Variables on their own clock
are interpolated to the trial's. Columns that are not named are NaN: not measured.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.data.check import check_session, examine
from jaxfinger.data.columns import Columns, Source, find, trial_clock
from jaxfinger.data.findings import Finding, Report
from jaxfinger.data.finger_file import finger_from
from jaxfinger.data.hdf5 import write_session
from jaxfinger.data.mapping import Channels, MappedTrial, MappingFile, read_mapping, terms
from jaxfinger.data.parse import RANGES, in_order, listed
from jaxfinger.data.recording import Recording
from jaxfinger.data.schema import CHANNELS, DRIVES, TEMPERATURE, Channel, Entry, units_of
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.sources import load_recording, refuse_path
from jaxfinger.data.toml import Place


def import_file(
    sources: Sequence[str | os.PathLike],
    mapping_path: str | os.PathLike,
    out: str | os.PathLike,
    overwrite: bool = False,
    report: Report | None = None,
) -> Session:
    """Turn recordings into one dataset file by a mapping file; the session is returned too.

    `report` takes what is worth saying of recordings, mapping and session: all that `check_file` would say.

    Raises:
        UserError: a mistake in the mapping, a variable that is not there, or a session that the checker refuses.
    """
    session = import_session(sources, mapping_path, report)
    write_session(session, out, overwrite)
    return session


def import_session(
    sources: Sequence[str | os.PathLike], mapping_path: str | os.PathLike, report: Report | None = None
) -> Session:
    """The session that a mapping makes of recordings, in memory; refused where the checker finds an error."""
    report = Report() if report is None else report
    mapping, where = read_mapping(Path(mapping_path))
    finger = finger_from(mapping.finger, where / "finger")
    recordings = _Recordings(sources, mapping, where, report)
    trials = {
        name: _trial(name, trial, mapping.channels, recordings, finger, where / "trials" / name, report)
        for name, trial in mapping.trials.items()
    }
    recordings.unread()
    session = Session(
        specimen=mapping.specimen,
        finger=finger,
        trials=in_order(trials),
        source=mapping.source or f"imported from {', '.join(sorted({p.name for p in recordings.paths}))}",
        created=mapping.created_text or datetime.now(UTC).isoformat(timespec="seconds"),
    )
    check_session(session, report)
    examine(session, report)
    if report.fatal is not None:
        _where_of(report.fatal, where).fail(report.fatal.message)
    return session


class _Recordings:
    """The given files, each read once and when it is first needed."""

    def __init__(self, sources: Sequence[str | os.PathLike], mapping: MappingFile, where: Place, report: Report):
        self.paths = list({Path(source).resolve(): Path(source) for source in sources}.values())
        if not self.paths:
            where.fail("no recording was given; name at least one")
        for path in self.paths:
            refuse_path(path)
        self._constants, self._derived = mapping.constants, mapping.derived
        self._report = report
        self._loaded: dict[Path, Recording] = {}
        self._sources: dict[tuple[Path, str], Source] = {}

    def source(self, name: str | None, derived: Mapping[str, str], where: Place) -> Source:
        """The recording called `name`, or the only one, with what the mapping and the trial derive of it."""
        if name is None and len(self.paths) > 1:
            where.fail(f"has no `file`; name one of {listed([str(path) for path in self.paths])}")
        path = self.paths[0] if name is None else find(name, dict.fromkeys(self.paths), where)
        if path not in self._loaded:
            self._loaded[path] = load_recording(path)
            for remark in self._loaded[path].remarks:
                self._report.warning(str(path), remark)
        return self._sources.setdefault(
            (path, where.key if derived else ""),
            Source(self._loaded[path], self._constants, {**self._derived, **derived}),
        )

    def unread(self) -> None:
        """Name the recordings that no trial reads."""
        for path in self.paths:
            if path not in self._loaded:
                self._report.warning(str(path), "is read by no trial; name it as `file` of one, or leave it out")


def _where_of(fault: Finding, where: Place) -> Place:
    """The key of a mapping that a place in the session comes from."""
    _, room, *names = fault.place.split("/")
    for key in (
        ("trials", names[0], *(("channels", *names[1:]) if len(names) > 1 else ())) if room == "trials" else (room,)
    ):
        where = where / key
    return where


def _trial(
    name: str,
    trial: MappedTrial,
    shared: Channels,
    recordings: _Recordings,
    finger: FingerDescription,
    where: Place,
    report: Report,
) -> Trial:
    channels = trial.channels.over(shared).said()
    source = recordings.source(trial.file, trial.derived, where)
    if "q" not in channels:
        where.fail("maps no channel `q`; name the joint positions")
    clock = trial_clock(trial, terms(next(iter(channels["q"].values())))[0], source, where, report)
    columns = Columns(clock, lambda file, place: recordings.source(file, trial.derived, place), report)
    own = trial.channels.said()
    places = {c: (where if c in own else Place(where.file, where.lines)) / "channels" / c for c in channels}
    values = {channel: _channel(channel, said, columns, finger, places[channel]) for channel, said in channels.items()}
    keep = columns.covered
    if keep.sum() == 0:
        where.fail("holds no sample at which all of its clocks run; name clocks that count from the same start")
    time = clock.time[keep]
    whole = {channel for channel in values if _entry(channel).kind != "float"}
    arrays: dict[str, Any] = {
        channel: _labels(channel, x[keep], places[channel]) if channel in whole else x[keep]
        for channel, x in values.items()
    }
    if not finger.n and "tendon_force" in DRIVES.get(trial.experiment, ()):
        arrays.setdefault("tendon_force", np.zeros((len(time), 0)))  # of a machine without tendons
    return Trial(
        name=name,
        experiment=trial.experiment,
        time=time - time[0],
        joint=trial.joint,
        tendon=trial.tendon,
        complete=trial.complete,
        motion=trial.motion,
        session_start=trial.session_start,
        temperature_names=tuple(channels.get("temperature", ())),
        **arrays,
    )


def _entry(channel: str) -> Entry:
    return TEMPERATURE if channel == "temperature" else CHANNELS[channel]


def _channel(channel: str, spec: Any, columns: Columns, finger: FingerDescription, where: Place) -> np.ndarray:
    """One channel (N, columns): those that are named, the others NaN (directions 0)."""
    entry = _entry(channel)
    units = units_of(entry, finger.prismatic) or "1"
    if channel == "hold":
        return columns.column(spec, units, True, where)
    whole = entry.kind != "float"
    names = entry.columns(finger) if isinstance(entry, Channel) else tuple(spec)
    values = np.full((len(columns.clock.time), len(names)), 0.0 if whole else np.nan)
    for name, column in spec.items():
        if name not in names:
            where.fail(f"has a column {name!r}; it must be one of {listed(names)}")
        k = names.index(name)
        here = {"rad": "m", "N m": "N"}.get(units, units) if entry.shape[1] == "m" and finger.prismatic[k] else units
        values[:, k] = columns.column(column, here, whole, where / name)
    return values


def _labels(channel: str, values: np.ndarray, where: Place) -> np.ndarray:
    """Directions and holds as the whole numbers that they must be: never wrapped or cut to fit."""
    kind = CHANNELS[channel].kind
    lowest, highest, allowed = RANGES[kind]
    bad = ~((values >= lowest) & (values <= highest) & (values == np.round(values)))
    if bad.any():
        samples = int(bad.reshape(len(bad), -1).any(axis=1).sum())
        where.fail(f"holds {values[bad][0]:g}, and {samples} such samples; each must be {allowed}")
    return values.astype(kind)
