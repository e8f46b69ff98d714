"""Import of other tools' recordings as sessions by a mapping file (TOML; docs/your-own-data.md).

A column is (variable · scale + offset) in `units`, or the sum of a list of such terms. Variables with a clock of their
own are interpolated to the trial's. Columns without a mapping are NaN, which means not measured.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.data.checks.session import check_samples, check_session
from jaxfinger.data.findings import Finding, Report
from jaxfinger.data.finger_file import finger_from
from jaxfinger.data.hdf5 import write_session
from jaxfinger.data.importing.columns import ColumnReader, find, trial_clock
from jaxfinger.data.importing.mapping import Channels, Files, MappedTrial, MappingFile, read_mapping, terms
from jaxfinger.data.importing.rates import compare_rate
from jaxfinger.data.importing.recording import Recording, side_by_side
from jaxfinger.data.importing.sources import load_recording, refuse_path
from jaxfinger.data.importing.variables import Source
from jaxfinger.data.parse import RANGES, sorted_trials
from jaxfinger.data.schema import CHANNELS, DRIVES, TEMPERATURE, Channel, Entry, entry_units
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.toml import Place
from jaxfinger.errors import listed


def import_file(
    sources: Sequence[str | os.PathLike],
    mapping_path: str | os.PathLike,
    out: str | os.PathLike,
    overwrite: bool = False,
    report: Report | None = None,
) -> Session:
    """Import recordings by a mapping file, write the session to `out`, and return it.

    Findings about recordings, mapping and session, including all of `check_file`, go to `report`.

    Raises:
        UserError: the mapping has a mistake, a variable is missing, the checker refuses the session, or `out` cannot be
            written.
    """
    session = import_session(sources, mapping_path, report)
    write_session(session, out, overwrite)
    return session


def import_session(
    sources: Sequence[str | os.PathLike], mapping_path: str | os.PathLike, report: Report | None = None
) -> Session:
    """Import recordings by a mapping file as a session in memory.

    Raises:
        UserError: the mapping has a mistake, a variable is missing, or the checker refuses the session.
    """
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
        trials=sorted_trials(trials),
        source=mapping.source or f"imported from {', '.join(sorted({p.name for p in recordings.paths}))}",
        created=mapping.created_text or datetime.now(UTC).isoformat(timespec="seconds"),
    )
    check_session(session, report)
    check_samples(session, report)
    if report.fatal is not None:
        _where_of(report.fatal, where).fail(report.fatal.message)
    return session


class _Recordings:
    """The given recordings. Each is read when it is first needed, and only once."""

    def __init__(self, sources: Sequence[str | os.PathLike], mapping: MappingFile, where: Place, report: Report):
        self.paths = list({Path(source).resolve(): Path(source) for source in sources}.values())
        if not self.paths:
            where.fail("no recording was given; name at least one")
        for path in self.paths:
            refuse_path(path)
        self._constants, self._derived = mapping.constants, mapping.derived
        self._report = report
        self._loaded: dict[Path, Recording] = {}
        self._joined: dict[tuple[Path, ...], Recording] = {}
        self._sources: dict[tuple[tuple[Path, ...], str], Source] = {}

    def source(self, name: Files | None, derived: Mapping[str, str], where: Place) -> Source:
        """Recording of this name, or of these names side by side, or the only one; with what is derived from it."""
        if name is None and len(self.paths) > 1:
            where.fail(f"has no `file`; name one of {listed([str(path) for path in self.paths])}")
        names = (name,) if isinstance(name, str) else name or ()
        paths = tuple(find(n, dict.fromkeys(self.paths), where) for n in names) or (self.paths[0],)
        return self._sources.setdefault(
            (paths, where.key if derived else ""),
            Source(self._recording(paths, where), self._constants, {**self._derived, **derived}),
        )

    def _recording(self, paths: tuple[Path, ...], where: Place) -> Recording:
        """The recording of one path, or those of several side by side."""
        for path in paths:
            if path not in self._loaded:
                self._loaded[path] = load_recording(path)
                for remark in self._loaded[path].remarks:
                    self._report.warning(str(path), remark)
        if len(paths) == 1:
            return self._loaded[paths[0]]
        if paths not in self._joined:
            try:
                self._joined[paths] = side_by_side([self._loaded[path] for path in paths])
            except ValueError as error:
                (where / "file").fail(str(error))
        return self._joined[paths]

    def unread(self) -> None:
        """Warn of recordings that no trial reads."""
        for path in self.paths:
            if path not in self._loaded:
                self._report.warning(str(path), "is read by no trial; name it as `file` of one, or leave it out")


def _where_of(fault: Finding, where: Place) -> Place:
    """Key of the mapping from which the place of a finding comes."""
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
    """Read one trial from its recordings."""
    channels = trial.channels.over(shared).mapped()
    source = recordings.source(trial.file, trial.derived, where)
    if "q" not in channels:
        where.fail("maps no channel `q`; name the joint positions")
    clock = trial_clock(trial, terms(next(iter(channels["q"].values())))[0], source, where, report)
    if trial.rate_hz is not None:
        compare_rate(trial.rate_hz, clock, source.recording, where, report)
    columns = ColumnReader(clock, lambda file, place: recordings.source(file, trial.derived, place), report)
    own = trial.channels.mapped()
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
        arrays.setdefault("tendon_force", np.zeros((len(time), 0)))  # The format requires it without tendons, too.
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


def _channel(channel: str, spec: Any, columns: ColumnReader, finger: FingerDescription, where: Place) -> np.ndarray:
    """One channel (N, columns). Columns without a mapping are NaN, or 0 in directions."""
    entry = _entry(channel)
    units = entry_units(entry, finger.prismatic) or "1"
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
        if channel == "q":
            values[:, k] = columns.position(column, here, finger.limits[k], where / name)
        else:
            values[:, k] = columns.column(column, here, whole, where / name)
    return values


def _labels(channel: str, values: np.ndarray, where: Place) -> np.ndarray:
    """Directions or holds as whole numbers.

    Raises:
        UserError: a value is not whole or out of its range; converting it would wrap or cut it.
    """
    kind = CHANNELS[channel].kind
    lowest, highest, allowed = RANGES[kind]
    bad = ~((values >= lowest) & (values <= highest) & (values == np.round(values)))
    if bad.any():
        samples = int(bad.reshape(len(bad), -1).any(axis=1).sum())
        where.fail(f"holds {values[bad][0]:g}, and {samples} such samples; each must be {allowed}")
    return values.astype(kind)
