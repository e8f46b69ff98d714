"""Recordings of other tools as sessions, by a small mapping file (TOML), as `mapping` has it.

A column is (variable · scale + offset) in `units`; a list of such tables is their sum; `scale` may name a variable;
`time` beside `from` names the variable's own clock, from which it is interpolated to the trial's.
Columns that are not named are NaN: not measured.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.data.check import check_session
from jaxfinger.data.findings import Finding, Report
from jaxfinger.data.finger_file import finger_from
from jaxfinger.data.hdf5 import write_session
from jaxfinger.data.mapping import COLUMN_KEYS, TRIAL_KEYS, MappingFile, Where
from jaxfinger.data.parse import in_order, listed
from jaxfinger.data.schema import CHANNELS, units_of
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.sources import Variables, load_variables
from jaxfinger.data.toml import read_toml
from jaxfinger.errors import UserError

# What one unit is in SI: (SI unit, factor).
TO_SI = {
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "turn": ("rad", 2.0 * math.pi),
    "m": ("m", 1.0),
    "cm": ("m", 1e-2),
    "mm": ("m", 1e-3),
    "um": ("m", 1e-6),
    "N": ("N", 1.0),
    "mN": ("N", 1e-3),
    "kN": ("N", 1e3),
    "N m": ("N m", 1.0),
    "N cm": ("N m", 1e-2),
    "N mm": ("N m", 1e-3),
    "mN m": ("N m", 1e-3),
    "s": ("s", 1.0),
    "ms": ("s", 1e-3),
    "us": ("s", 1e-6),
    "ns": ("s", 1e-9),
    "1": ("1", 1.0),
}


def import_file(
    sources: Sequence[str | os.PathLike],
    mapping_path: str | os.PathLike,
    out: str | os.PathLike,
    overwrite: bool = False,
) -> Session:
    """Turn recordings into one dataset file by a mapping file; the session is returned too.

    Raises:
        UserError: a mistake in the mapping, a variable that is not there, or a session that the checker refuses.
    """
    session = import_session(sources, mapping_path)
    write_session(session, out, overwrite)
    return session


def import_session(sources: Sequence[str | os.PathLike], mapping_path: str | os.PathLike) -> Session:
    """The session that a mapping makes of recordings, in memory; refused where the checker finds an error."""
    path = Path(mapping_path)
    document = read_toml(path, "name a mapping file")
    said, mapping = document.read(MappingFile), document.content
    where = Where(str(path), document.place.lines)
    finger = finger_from(said.finger, where / "finger")
    files = {Path(source).name: Path(source) for source in sources}
    if not files:
        raise UserError(f"{path}: no recording was given; name at least one")
    loaded: dict[Path, Variables] = {}
    trials = {}
    for name, table in where.table(mapping, "trials").items():
        place = where / f"trials.{name}"
        place.known(table, TRIAL_KEYS)
        file = _file_of(table, files, place)
        if file not in loaded:
            loaded[file] = load_variables(file)
        shared = mapping.get("channels", {})
        trials[name] = _trial(name, table, shared, loaded[file], finger, place)
    session = Session(
        specimen=where.text(mapping, "specimen"),
        finger=finger,
        trials=in_order(trials),
        source=mapping.get("source", f"imported from {', '.join(sorted(files))}"),
        created=said.created_text or (datetime.now(UTC).isoformat(timespec="seconds")),
    )
    report = Report()
    check_session(session, report)
    if report.fatal is not None:
        _where_of(report.fatal, where).fail(report.fatal.message)
    return session


def _where_of(fault: Finding, where: Where) -> Where:
    """The key of a mapping that a place in the session comes from."""
    _, room, *names = fault.place.split("/")
    for key in (
        ("trials", names[0], *(("channels", *names[1:]) if len(names) > 1 else ())) if room == "trials" else (room,)
    ):
        where = where / key
    return where


def _file_of(table: Mapping[str, Any], files: Mapping[str, Path], where: Where) -> Path:
    name = table.get("file")
    if name is None and len(files) == 1:
        return next(iter(files.values()))
    if name not in files:
        where.fail(f"reads the file {name!r}, which was not given; there are {listed(list(files))}")
    return files[str(name)]


def _trial(
    name: str,
    table: Mapping[str, Any],
    shared: Mapping[str, Any],
    variables: Variables,
    finger: FingerDescription,
    where: Where,
) -> Trial:
    channels = {**shared, **table.get("channels", {})}
    time = _time(table, channels, variables, where)
    keep = slice(None)
    if "span" in table:
        begin, end = where.numbers(table, "span", (2,))
        keep = slice(*np.searchsorted(time, (begin, end)))
    values: dict[str, Any] = {}
    for channel, columns in channels.items():
        place = where / f"channels.{channel}"
        if channel not in CHANNELS:
            place.fail(f"is no channel; it must be one of {', '.join(CHANNELS)}")
        values[channel] = _channel(channel, columns, time, variables, finger, place)[keep]
    if "q" not in values:
        where.fail("maps no channel `q`; name the joint positions")
    time = time[keep]
    if len(time) == 0:
        where.fail("holds no sample; widen its `span`")
    attributes: dict[str, Any] = {key: table.get(key) for key in ("joint", "tendon", "motion", "session_start")}
    return Trial(
        name=name,
        experiment=where.text(table, "experiment"),
        time=time - time[0],
        complete=bool(table.get("complete", True)),
        **attributes,
        **values,
    )


def _time(table: Mapping[str, Any], channels: Mapping[str, Any], variables: Variables, where: Where) -> np.ndarray:
    if "time" in table:
        time = _term(table["time"], None, "s", variables, where / "time")
        if np.any(np.diff(time) <= 0.0):
            at = int(np.argmax(np.diff(time) <= 0.0))
            (where / "time").fail(f"does not increase after sample {at}; cut the recording there, or use `rate_hz`")
        return time
    if "rate_hz" not in table:
        where.fail("has neither `time` nor `rate_hz`; name the variable that holds the time, or the sampling rate")
    (rate,) = where.numbers({"rate_hz": [table["rate_hz"]]}, "rate_hz", (1,))
    if rate <= 0.0:
        where.fail("has a `rate_hz` that is not positive; write samples per second")
    first = next(iter(next(iter(channels.values()), {}).values()), None) if channels else None
    if first is None:
        where.fail("maps no channel; name at least the joint positions")
    spec = first[0] if isinstance(first, list) else first
    return np.arange(len(_variable(spec, variables, where))) / rate


def _channel(
    channel: str, columns: Any, time: np.ndarray, variables: Variables, finger: FingerDescription, where: Where
) -> np.ndarray:
    """One channel (N, columns): those that are named, the others NaN (directions 0)."""
    entry = CHANNELS[channel]
    units = units_of(entry, finger.prismatic) or "1"
    if channel == "hold":
        return _column(columns, time, units, variables, where).astype(np.int32)
    axis = entry.shape[1]
    names = {"m": finger.joint_names, "n": finger.tendon_names}.get(str(axis), ("x", "y", "z"))
    if not isinstance(columns, Mapping):
        where.fail(f"must be a table with a column for each of {listed(names)}")
    values = np.full((len(time), len(names)), np.nan if entry.kind == "float" else 0.0)
    for name, spec in columns.items():
        if name not in names:
            where.fail(f"has a column {name!r}; it must be one of {listed(names)}")
        k = names.index(name)
        here = units
        if axis == "m" and finger.prismatic[k]:
            here = {"rad": "m", "N m": "N"}.get(units, units)
        values[:, k] = _column(spec, time, here, variables, where / name)
    return values if entry.kind == "float" else values.astype(np.int8)


def _column(spec: Any, time: np.ndarray, units: str, variables: Variables, where: Where) -> np.ndarray:
    """One column: a term, or the sum of a list of them."""
    terms = spec if isinstance(spec, list) else [spec]
    return np.sum([_term(term, time, units, variables, where) for term in terms], axis=0)


def _term(spec: Any, time: np.ndarray | None, units: str, variables: Variables, where: Where) -> np.ndarray:
    """variable · scale + offset, in SI, on the trial's clock."""
    spec = {"from": spec} if isinstance(spec, str) else spec
    if not isinstance(spec, Mapping):
        where.fail("must name a variable, as 'enc' or { from = 'enc', units = 'deg' }")
    where.known(spec, COLUMN_KEYS)
    values = _variable(spec, variables, where)
    scale = spec.get("scale", 1.0)
    if isinstance(scale, str):
        factor = _variable({"from": scale}, variables, where / "scale")
        if factor.size != 1:
            where.fail(f"is scaled by {scale!r}, which holds {factor.size} values; name a single number")
        scale = float(factor.reshape(-1)[0])
    said = spec.get("units", units)
    if said not in TO_SI or TO_SI[said][0] != units:
        fitting = [name for name, (si, _) in TO_SI.items() if si == units]
        where.fail(f"has units {said!r}; it must be one of {listed(fitting)}, after `scale` and `offset`")
    values = (values * scale + spec.get("offset", 0.0)) * TO_SI[said][1]
    if "time" in spec:
        clock = _variable({"from": spec["time"]}, variables, where / "time")
        if len(clock) != len(values):
            where.fail(
                f"has {len(values)} samples, and its clock {spec['time']!r} has {len(clock)}; name its own clock"
            )
        if time is not None:
            values = np.interp(time, clock, values)
    if time is not None and len(values) != len(time):
        where.fail(f"has {len(values)} samples where the trial's time has {len(time)}; give it its own `time`")
    return values


def _variable(spec: Any, variables: Variables, where: Where) -> np.ndarray:
    spec = {"from": spec} if isinstance(spec, str) else spec
    name = where.text(spec, "from")
    if name not in variables:
        where.fail(f"reads the variable {name!r}, which the recording has not; it has {listed(sorted(variables), 30)}")
    values = variables[name]
    if values.ndim == 2:
        column = spec.get("column", 0 if values.shape[1] == 1 else None)
        if not isinstance(column, int) or not 0 <= column < values.shape[1]:
            where.fail(f"reads {name!r}, which has {values.shape[1]} columns; choose one by `column`, from 0")
        values = values[:, column]
    return np.atleast_1d(values)
