"""Lenient parsing of an open HDF5 file into a `Session`: parts that cannot be read are reported and left out.

HDF5 raises exceptions of many kinds on a damaged file, so the functions here catch all of them.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import h5py
import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.opening import plain_reason, why_unreadable
from jaxfinger.data.schema import (
    CHANNELS,
    FINGERTIP,
    FORMAT,
    JOINTS,
    LINKS,
    MAJOR,
    TEMPERATURE,
    TENDONS,
    TIME,
    VERSION,
    Entry,
    entry_units,
)
from jaxfinger.data.session import EXPERIMENT_NAMES, FingerDescription, Session, Trial
from jaxfinger.errors import listed

# gzip shrinks a constant by at most about 1:1030, so a dataset that claims more than this cannot be in the file.
_MAX_COMPRESSION = 1100
# Allowed whole numbers, by kind: lowest, highest, and both in words.
RANGES = {
    "bool": (0, 1, "false or true"),
    "int8": (-1, 1, "-1, 0 or 1"),
    "int32": (-1, 2**31 - 1, "-1 or an index of a hold"),
}


def parse_file(file: h5py.File, path: str, report: Report, names: Collection[str] | None = None) -> Session | None:
    """Session of an open file; None where its header or finger cannot be read. `names` limits the trials."""
    if not parse_version(file, report):
        return None
    if text_attribute(file, "content", "/", Report()) == "predictions":
        report.error("/", "this file holds predictions, not recordings; give the session that they were made from")
        return None
    specimen, source, created = (text_attribute(file, key, "/", report) for key in ("specimen", "source", "created"))
    for key, value in (("specimen", specimen), ("source", source), ("created", created)):
        if value is None:
            report.warning("/", f"has no attribute `{key}`; write it beside `format`")
    finger = parse_finger(file, report)
    if finger is None:
        return None
    trials = parse_trials(file, finger, report, names)
    return Session(specimen or "", finger, sorted_trials(trials), source or "", created or "", path)


def parse_version(file: h5py.File, report: Report) -> bool:
    """Whether the file states our format, in a version that this reader knows."""
    format_name = text_attribute(file, "format", "/", report)
    if format_name != FORMAT:
        said = "has no attribute `format`" if format_name is None else f"has format {format_name!r}"
        report.error("/", f"{said}, so this is not a dataset file; it must be {FORMAT!r}, or import the recording")
        return False
    version = text_attribute(file, "format_version", "/", report)
    if version is None or version.split(".")[0].strip() != MAJOR:
        report.error(
            "/", f"has format_version {version!r}, and this reader knows {VERSION}; update it, or write {VERSION}"
        )
        return False
    return True


def parse_finger(file: h5py.File, report: Report) -> FingerDescription | None:
    """Read `/finger`; None where an indispensable table is missing or misshapen."""
    group = child(file, "finger", "/finger", report, h5py.Group)
    if group is None:
        return None
    before = len(report)
    gravity = number_attribute(group, "gravity", "/finger", report, (3,))
    joints = _table(group, "joints", JOINTS, {}, (), report)
    m = len(joints["name"]) if "name" in joints else None
    if m == 0:
        report.error("/finger/joints/name", "names no joint; a finger has at least one")
    sizes = {"m": m}
    prismatic = _joint_types(joints, report)
    links = _table(group, "links", LINKS, sizes, prismatic, report)
    fingertip = dataset(group, FINGERTIP, "/finger", {}, prismatic, report)
    if "tendons" in group:
        tendons = _table(group, "tendons", TENDONS, sizes, prismatic, report)
    else:
        report.warning(
            "/finger/tendons", "is absent, so the finger is read as one without tendons; list them if it has any"
        )
        tendons = {"name": (), "active": np.zeros(0, bool), "crosses": np.zeros((0, m or 0), bool)}
    if gravity is None or any(f.severity == "error" for f in report[before:]):
        return None
    return FingerDescription(
        gravity=gravity,
        joint_names=joints["name"],
        axis=joints["axis"],
        origin=joints["origin"],
        limits=joints["limits"],
        mass=links["mass"],
        com=links["com"],
        inertia=links["inertia"],
        fingertip=fingertip,
        tendon_names=tendons["name"],
        active=tendons["active"],
        crosses=tendons["crosses"],
        prismatic=prismatic,
        mass_std=links.get("mass_std"),
        com_std=links.get("com_std"),
        rotor_inertia=joints.get("rotor_inertia"),
        rotor_inertia_std=joints.get("rotor_inertia_std"),
        excursion=tendons.get("excursion"),
        excursion_std=tendons.get("excursion_std"),
    )


def _table(group, name: str, entries: Sequence[Entry], sizes: dict, prismatic, report: Report) -> dict[str, Any]:
    """Read the datasets of one table. The first one, the names, sets the table's length."""
    place = f"/finger/{name}"
    table = child(group, name, place, report, h5py.Group)
    if table is None:
        return {}
    found: dict[str, Any] = {}
    sizes = dict(sizes)
    if entries is JOINTS:  # The units of the other datasets depend on the types.
        type_entry = next(entry for entry in JOINTS if entry.name == "type")
        kinds = dataset(table, type_entry, place, {}, (), Report()) if "type" in table else None
        prismatic = tuple(kind == "prismatic" for kind in kinds) if kinds is not None else ()
    for entry in entries:
        value = dataset(table, entry, place, sizes, prismatic, report)
        if value is None:
            continue
        found[entry.name] = value
        if entry.name == "name":
            sizes[str(entry.shape[0])] = len(value)
    return found


def _joint_types(joints: Mapping[str, Any], report: Report) -> tuple[bool, ...]:
    types = joints.get("type", ("revolute",) * len(joints.get("name", ())))
    for name, kind in zip(joints.get("name", ()), types, strict=False):
        if kind not in ("revolute", "prismatic"):
            report.error("/finger/joints/type", f"joint {name} is {kind!r}; it must be 'revolute' or 'prismatic'")
    return tuple(kind == "prismatic" for kind in types)


def parse_trials(
    file: h5py.File, finger: FingerDescription, report: Report, names: Collection[str] | None
) -> dict[str, Trial]:
    """Read all trials, or the named ones, that can be read."""
    group = child(file, "trials", "/trials", report, h5py.Group)
    if group is None:
        return {}
    present = list(group)
    for name in names or ():
        if name not in present:
            report.error("/trials", f"has no trial {name!r}; there are {listed(present)}")
    chosen = [name for name in present if names is None or name in names]
    if not present:
        report.warning("/trials", "holds no trial; record or import at least one")
    trials = (parse_trial(group, name, finger, report) for name in chosen)
    return {trial.name: trial for trial in trials if trial is not None}


def parse_trial(trials: h5py.Group, name: str, finger: FingerDescription, report: Report) -> Trial | None:
    """Read one recording; None where its experiment, time or joint positions cannot be read."""
    place = f"/trials/{name}"
    group = child(trials, name, place, report, h5py.Group)
    if group is None:
        return None
    experiment = text_attribute(group, "experiment", place, report)
    if experiment not in EXPERIMENT_NAMES:
        said = "has no attribute `experiment`" if experiment is None else f"has the unknown experiment {experiment!r}"
        report.error(place, f"{said}; it must be one of {', '.join(EXPERIMENT_NAMES)}")
    complete = _complete(group, place, report)
    time = dataset(group, TIME, place, {}, finger.prismatic, report)
    if time is None:
        return None
    if len(time) == 0:
        if complete:
            report.error(f"{place}/time", "holds no sample; delete the trial or record it again")
        else:
            report.warning(f"{place}/time", "holds no sample: the recording was cut short at once, and is left out")
        return None
    sizes = {"N": len(time), "m": finger.m, "n": finger.n}
    channels = {}
    for key, entry in CHANNELS.items():
        value = dataset(group, entry, place, sizes, finger.prismatic, report)
        if value is not None:
            channels[key] = value
    if "q" not in channels or experiment not in EXPERIMENT_NAMES:
        return None
    return Trial(
        name=name,
        experiment=experiment,
        time=time,
        joint=text_attribute(group, "joint", place, report),
        tendon=text_attribute(group, "tendon", place, report),
        complete=complete,
        motion=text_attribute(group, "motion", place, report),
        session_start=_session_start(group, place, report),
        **channels,
        **_temperature(group, place, sizes, report),
    )


def _temperature(group: h5py.Group, place: str, sizes: Mapping[str, int], report: Report) -> dict[str, Any]:
    """Temperatures and their names. Misfits are left out: a file of version 1.0 may use the name for its own data."""
    if TEMPERATURE.name not in group:
        return {}
    found = Report()
    values = dataset(group, TEMPERATURE, place, sizes, (), found)
    names: tuple[str, ...] = ()
    if values is not None:
        try:
            said: Any = group[TEMPERATURE.name].attrs["names"]
            names = tuple(_decode(name) for name in np.atleast_1d(said))
        except Exception:  # The attribute is absent, or does not hold strings.
            names = ()
        if len(names) != values.shape[1]:
            message = f"has {values.shape[1]} columns and {len(names)} names; name each in its attribute `names`"
            found.error(f"{place}/{TEMPERATURE.name}", message)
    if found.fatal is None:
        report.extend(found)
        return {"temperature": values, "temperature_names": names}
    report.warning(found.fatal.place, f"{found.fatal.message}; it is left out")
    return {}


def _complete(group: h5py.Group, place: str, report: Report) -> bool:
    if "complete" not in group.attrs:
        report.warning(place, "has no attribute `complete`, so it is taken to have run to its end; write true or false")
        return True
    value = number_attribute(group, "complete", place, report, ())
    if value is not None and value not in (0, 1):
        report.error(place, f"has `complete` = {value}; it must be true or false")
    return bool(value)


def _session_start(group: h5py.Group, place: str, report: Report) -> float | None:
    if "session_start" not in group.attrs:
        return None
    value = number_attribute(group, "session_start", place, report, ())
    return None if value is None else float(value)


def sorted_trials(trials: Mapping[str, Trial]) -> dict[str, Trial]:
    """Sort trials by `session_start` where every trial has one, else by name."""
    if all(trial.session_start is not None for trial in trials.values()):
        return dict(sorted(trials.items(), key=lambda item: (item[1].session_start, item[0])))
    return dict(sorted(trials.items()))


def child(parent: h5py.Group, name: str, place: str, report: Report, kind: type) -> Any:
    """Member of a group, of this kind (h5py.Group or h5py.Dataset); None with the reason reported."""
    what = "group" if kind is h5py.Group else "dataset"
    try:
        if isinstance(parent.get(name, getlink=True), h5py.ExternalLink):
            report.error(place, f"lies in another file, to which this one only links; copy the {what} into this one")
            return None
        item = parent.get(name)
    except Exception:  # h5py raises exceptions of many kinds on a damaged file.
        report.error(
            place, "cannot be opened: the file is damaged or its link leads nowhere; record or import it again"
        )
        return None
    if item is None:
        report.error(place, f"is missing; write this {what}")
    elif not isinstance(item, kind):
        report.error(place, f"must be a {what}; write it as one")
        item = None
    return item


def dataset(group, entry: Entry, place: str, sizes: Mapping[str, int | None], prismatic, report: Report) -> Any:
    """Value of one dataset in its declared shape (names as a tuple of str); None with the reason reported.

    `sizes` holds the lengths of the axes N, m and n that are known so far.
    """
    place = f"{place}/{entry.name}"
    if entry.optional and entry.name not in group:
        return None
    item = child(group, entry.name, place, report, h5py.Dataset)
    if item is None:
        return None
    try:
        reason = why_unreadable(item)
        if reason is None and not _plausible_size(item):
            reason = f"claims the shape {item.shape}, more than the file can hold; the file is damaged"
        if reason is not None:
            report.error(place, reason)
            return None
        value = _names(item) if entry.kind == "text" else item[()]
    except Exception as error:  # h5py raises exceptions of many kinds on a damaged file.
        said = plain_reason(error)
        report.error(place, f"cannot be read ({said}): the file is truncated or damaged; record or import it again")
        return None
    if not _right_shape(value, entry, place, sizes, report):
        return None
    if entry.kind == "text":
        return value
    _check_units(item, entry, place, prismatic, report)
    return _as_kind(np.asarray(value), entry, place, report)


def _plausible_size(item: h5py.Dataset) -> bool:
    stored = 2**20 + item.file.id.get_filesize()
    return item.size * item.dtype.itemsize <= _MAX_COMPRESSION * stored


def _right_shape(value: Any, entry: Entry, place: str, sizes: Mapping[str, int | None], report: Report) -> bool:
    shape = (len(value),) if entry.kind == "text" else np.shape(value)
    wanted = tuple(sizes.get(axis) if isinstance(axis, str) else axis for axis in entry.shape)
    if len(shape) == len(wanted) and all(want in (None, size) for want, size in zip(wanted, shape, strict=True)):
        return True
    meaning = {"N": "samples", "m": "joints", "n": "tendons"}
    said = ", ".join(
        f"{want if want is not None else axis} {meaning.get(str(axis), '')}".strip()
        for axis, want in zip(entry.shape, wanted, strict=True)
    )
    report.error(place, f"has shape {shape}; it must be ({said})")
    return False


def _check_units(item: h5py.Dataset, entry: Entry, place: str, prismatic: Sequence[bool], report: Report) -> None:
    if entry.units is None:
        return
    wanted = entry_units(entry, prismatic)
    units = text_attribute(item, "units", place, report)
    if units is None:
        if entry.kind == "float":
            report.error(place, f"carries no `units`; write {wanted!r} if that is what the numbers are")
        else:
            report.note(place, f"carries no `units`; write {wanted!r}")
        return
    if _plain(units) == _plain(wanted or ""):
        return
    if _plain(units) == _plain(entry.units):
        report.note(place, f"has units {units!r} though every joint is prismatic; write {wanted!r}")
    else:
        report.error(place, f"has units {units!r}; it must be {wanted!r}: convert the numbers, then the attribute")


def _plain(units: str) -> str:
    """Units in one spelling: `N·m`, `N*m` and `N m` become the same, and an empty string becomes `1`."""
    return units.translate(str.maketrans("", "", " ·*^")).replace("⋅", "").replace("²", "2").replace("⁻", "-") or "1"


def _as_kind(value: np.ndarray, entry: Entry, place: str, report: Report) -> np.ndarray | None:
    """Array in the type of its entry; None with the reason reported where a value does not fit.

    Its columns are contiguous, since most sums, maxima and medians are taken along time.
    """
    if entry.kind == "float":
        if value.dtype.kind not in "fiu":
            report.error(place, f"holds {value.dtype}, not numbers; write it as float64")
            return None
        with np.errstate(invalid="ignore", over="ignore"):  # The checks report extreme values.
            return np.asfortranarray(value, np.float64)
    whole = value.dtype.kind in "biu" or (value.dtype.kind == "f" and bool(np.all(np.round(value) == value)))
    if not whole or not np.all(np.isfinite(value)):
        report.error(place, f"holds values that are not whole numbers; write it as {entry.kind}")
        return None
    lowest, highest, allowed = RANGES[entry.kind]
    if value.size and (value.min() < lowest or value.max() > highest):
        report.error(place, f"holds values from {value.min()} to {value.max()}; each must be {allowed}")
        return None
    return np.asfortranarray(value, entry.kind)


def _names(item: h5py.Dataset) -> tuple[str, ...]:
    return tuple(_decode(name) for name in np.atleast_1d(item[()]))


def _decode(value: Any) -> str:
    """Decode a string, however h5py, MATLAB or C wrote it.

    Raises:
        TypeError: the value is no string.
        UnicodeError: its bytes are not UTF-8.
    """
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8")
    if isinstance(value, str):
        value.encode("utf-8")  # Raises for broken bytes, which h5py passes on as surrogates.
        return str(value)
    raise TypeError(f"{type(value).__name__} is not a string")


def text_attribute(item: Any, key: str, place: str, report: Report) -> str | None:
    """String attribute; None where it is absent, and with a report where it is no string."""
    try:
        return _decode(item.attrs[key]) if key in item.attrs else None
    except Exception:  # The value is no string, or cannot be read: h5py then raises exceptions of many kinds.
        report.error(place, f"has an attribute `{key}` that is not a UTF-8 string; write it as one")
        return None


def number_attribute(item: Any, key: str, place: str, report: Report, shape: tuple[int, ...]) -> np.ndarray | None:
    """Numeric attribute as float64 of this shape; None with the reason reported."""
    try:
        if key not in item.attrs:
            report.error(place, f"has no attribute `{key}`; write it")
            return None
        value = np.asarray(item.attrs[key])
        if value.dtype.kind not in "biuf":
            raise TypeError(value.dtype)
        value = value.astype(np.float64).reshape(shape)
    except Exception:  # The value is of another kind or shape, or cannot be read: h5py then raises many kinds.
        report.error(place, f"has an attribute `{key}` that is not {shape or 'one'} of numbers; write it as such")
        return None
    if not np.all(np.isfinite(value)):
        report.error(place, f"has an attribute `{key}` that is not finite; write a number")
        return None
    return value
