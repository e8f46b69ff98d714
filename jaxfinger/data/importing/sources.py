"""Loading of recordings of other tools by the kind of file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from jaxfinger.data.importing.dates import packed, texts
from jaxfinger.data.importing.long_table import widened
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.importing.time_steps import with_summed_steps
from jaxfinger.data.opening import plain_reason
from jaxfinger.errors import UserError, listed

# Functions of pandas for tables that are not read here.
_FRAMES = {
    ".parquet": "read_parquet",
    ".feather": "read_feather",
    ".pkl": "read_pickle",
    ".pickle": "read_pickle",
    ".xls": "read_excel",
    ".xlsx": "read_excel",
    ".ods": "read_excel",
}
_PACKED = (".gz", ".zip", ".bz2", ".xz", ".7z", ".zst", ".tgz")
# Names of seconds and of the rest of a stamp, behind the name of the stamp, and the rest's unit in s.
_WHOLE = re.compile(r"(.*?)(?:secs?|seconds)", re.IGNORECASE)
_REST = (("(?i:n(ano)?sec(ond)?s?)", 1e-9), ("(?i:(u|micro)sec(ond)?s?)", 1e-6))
_TEXTS = (".csv", ".txt", ".tsv", ".dat", ".asc", ".sto", ".mot", ".log")
_OTHERS = (".mat", ".npy", ".npz", ".h5", ".hdf5", ".mcap", ".db3", ".bag", ".tdms", *_FRAMES, *_PACKED)
_BEGIN = 4096  # bytes, which show whether a file is text


def load_recording(path: Path) -> Recording:
    """Load every numeric variable of a recording, and the reasons why others cannot be used. Dates are seconds.

    Raises:
        UserError: the file is missing, empty, of an unknown kind, damaged, or without numbers.
    """
    recording = with_summed_steps(widened(_with_dates(_load(path))))
    if not recording.variables and recording.unusable:
        said = listed([f"{name} {reason}" for name, reason in recording.unusable.items()], 1)
        raise UserError(f"{path}: holds no variable of numbers: {said}")
    return recording


def _with_dates(recording: Recording) -> Recording:
    """Recording with dates and times of day, as texts or packed into numbers, as variables in s."""
    read = {name: texts(column.tolist()) for name, column in recording.words.items()}
    read |= {name: packed(v.values) for name, v in recording.variables.items() if v.values.ndim == 1}
    stamps = {name: seconds for name, seconds in read.items() if seconds is not None}
    variables = {**recording.variables, **_joined(recording.variables)}
    for name, seconds in stamps.items():
        variables[name] = replace(variables.get(name, Variable(seconds)), values=seconds, units="s")
    unusable, words = ({k: v for k, v in of.items() if k not in stamps} for of in (recording.unusable, recording.words))
    return replace(recording, variables=variables, unusable=unusable, words=words)


def _joined(variables: Mapping[str, Variable]) -> dict[str, Variable]:
    """Stamps, s, that a recording splits into whole seconds and the rest, as ROS prints them."""
    joined = {}
    for name, whole in variables.items():
        if (at := _WHOLE.fullmatch(name)) is None or whole.values.ndim > 1:
            continue
        stamp = at[1].rstrip("._/ ") or "stamp"
        for ending, factor in _REST:
            rest = next((v for k, v in variables.items() if re.fullmatch(re.escape(at[1]) + ending, k)), None)
            if rest is not None and stamp not in variables and _splits(whole, rest, factor):
                joined[stamp] = replace(whole, values=whole.values + factor * rest.values, units="s")
    return joined


def _splits(whole: Variable, rest: Variable, factor: float) -> bool:
    """Whether two variables are whole seconds and what is beyond them."""
    x, beyond = whole.values, factor * rest.values
    return x.shape == beyond.shape and bool(np.all((np.floor(x) == x) & (beyond >= 0.0) & (beyond < 1.0)))


def _load(path: Path) -> Recording:
    refuse_path(path)
    kind = path.suffix.lower()
    try:
        text = kind in _TEXTS or (kind not in _OTHERS and _is_text(path))
        if path.is_file() and path.stat().st_size == 0:
            raise UserError(f"{path}: is empty; export the recording again")
        if kind == ".mat":
            from jaxfinger.data.importing.matlab import load_mat

            return load_mat(path)
        if kind in (".json", ".jsonl", ".ndjson") or (text and _begin(path).startswith(b"{")):
            from jaxfinger.data.importing.json_file import load_json

            return load_json(path)
        if kind in (".npy", ".npz"):
            from jaxfinger.data.importing.arrays import load_numpy

            return load_numpy(path)
        if kind in (".h5", ".hdf5"):
            from jaxfinger.data.importing.arrays import load_hdf5

            return load_hdf5(path)
        if path.is_dir() or kind in (".mcap", ".db3", ".bag"):
            from jaxfinger.data.importing.bags import load_bag

            return load_bag(path)
        if text:
            from jaxfinger.data.importing.csv_file import load_csv

            return load_csv(path)
    except UserError:
        raise
    except PermissionError:
        raise UserError(f"{path}: may not be read; change its permissions") from None
    except Exception as error:  # Readers of foreign formats raise exceptions of many kinds.
        said = f"{type(error).__name__}: {plain_reason(error)}"
        raise UserError(f"{path}: cannot be read ({said}); export the recording again") from error
    if kind in _PACKED:
        raise UserError(f"{path}: is compressed; unpack it, and give the file in it")
    if kind == ".tdms":
        call = f"nptdms.TdmsFile.read({path.name!r}).as_dataframe(time_index=True).to_csv({path.stem + '.csv'!r})"
        raise UserError(f"{path}: is a binary file of LabVIEW, which is not read; write it as CSV, in Python: {call}")
    if kind in _FRAMES:
        call = f"pandas.{_FRAMES[kind]}({path.name!r}).to_csv({path.stem + '.csv'!r}, index=False)"
        raise UserError(f"{path}: is a table of a kind that is not read; write it as CSV, in Python: {call}")
    raise UserError(f"{path}: is of an unknown kind; give .csv, .mat, .json, .npz, .h5, .mcap or a rosbag2 folder")


def _begin(path: Path) -> bytes:
    """The first bytes of a file."""
    with path.open("rb") as file:
        return file.read(_BEGIN)


def _is_text(path: Path) -> bool:
    """Whether a file of an unknown ending is text, as `.lvm`: it begins without bytes of control."""
    if not path.is_file():
        return False
    begin = _begin(path)
    return begin.startswith((b"\xff\xfe", b"\xfe\xff")) or not re.search(rb"[\x00-\x08\x0e-\x1f]", begin)


def refuse_path(path: Path) -> None:
    """Refuse a path without a recording.

    Raises:
        UserError: the path does not exist, or is a folder without a rosbag2.
    """
    if not path.exists():
        raise UserError(f"{path}: does not exist; name a recording")
    if path.is_dir() and not any(any(path.glob(kind)) for kind in ("*.yaml", "*.db3", "*.mcap")):
        raise UserError(f"{path}: is a folder, and no rosbag2; name the recordings in it, as {path / '*.csv'}")
