"""Files of named arrays: NumPy's .npy and .npz, and HDF5 of any program. What each array is as a variable."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

from jaxfinger.data.importing.recording import Recording, Variable, samples_first
from jaxfinger.data.opening import why_closed, why_unreadable
from jaxfinger.data.schema import FORMAT
from jaxfinger.data.units import stated_units
from jaxfinger.errors import UserError, listed

_NANOSECONDS = {"M": "datetime64[ns]", "m": "timedelta64[ns]"}


class Unusable(str):
    """Reason why a variable gives no numbers, in place of its value."""


_MIXED = Unusable("mixes numbers with text or lists; give each sample as many numbers")


def load_numpy(path: Path) -> Recording:
    """Load every array of numbers of a .npz file, or the one of a .npy file by the name of the file, samples first.

    The fields of a structured array are named `array.field`. Dates and durations are seconds.

    Raises:
        UserError: the file holds two variables of one name.
    """
    if path.suffix.lower() == ".npy":
        return named_arrays(path, _fields(path.stem, _one(lambda: np.load(path, allow_pickle=False))))
    with np.load(path, allow_pickle=False) as file:
        read = [(name, _one(lambda name=name: file[name])) for name in file.files]
    return named_arrays(path, (leaf for name, value in read for leaf in _fields(name, value)))


def _one(read: Any) -> Any:
    """The array that `read` returns, or why it gives none: arrays of Python objects may run any code when read."""
    try:
        return read()
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        return Unusable("holds Python objects; save arrays of numbers, as np.array(…, float)")


def _fields(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, np.ndarray) and value.dtype.names is not None:
        for field in value.dtype.names:
            yield f"{name}.{field}", value[field]
    else:
        yield name, value


def load_hdf5(path: Path) -> Recording:
    """Load every dataset of numbers of an HDF5 file, samples first. Those in groups are named `group.dataset`.

    Raises:
        UserError: the file is damaged, or a session, or holds two variables of one name.
    """
    reason = why_closed(path)
    if reason is not None:
        raise UserError(f"{path}: {reason}")
    with h5py.File(path, "r") as file:
        if file.attrs.get("format") == FORMAT:
            raise UserError(f"{path}: is a session already; look at it with: jaxfinger check {path}")
        units: dict[str, str] = {}
        file.visititems(lambda name, item: units.update({name.replace("/", "."): _attribute(item)}))
        return named_arrays(path, list(_datasets(file, "")), units)


def _attribute(item: h5py.Group | h5py.Dataset) -> str:
    """Unit that an attribute of a dataset states; empty where none does."""
    stated = next((value for name, value in item.attrs.items() if name.lower() in ("unit", "units")), "")
    return stated.decode(errors="replace") if isinstance(stated, bytes) else str(stated)


def _datasets(group: h5py.Group, prefix: str) -> Iterator[tuple[str, Any]]:
    for key, item in group.items():
        name = f"{prefix}{key}"
        if isinstance(item, h5py.Group):
            yield from _datasets(item, f"{name}.")
        elif isinstance(item, h5py.Dataset):
            reason = why_unreadable(item)
            if reason is not None:
                yield name, Unusable(reason)
            elif h5py.check_string_dtype(item.dtype) is not None:
                yield name, np.array(item.asstr(errors="replace")[()], str)
            else:
                yield from _fields(name, item[()])


def named_arrays(
    path: Path, leaves: Iterable[tuple[str, Any]], units: Mapping[str, str] = MappingProxyType({})
) -> Recording:
    """Recording of values by name: arrays, or lists of numbers or texts, samples first.

    `units` are those that the file states beside the names; others may end the names, as in `q [deg]`.

    Raises:
        UserError: a name occurs twice.
    """
    variables: dict[str, Variable] = {}
    unusable: dict[str, str] = {}
    words: dict[str, np.ndarray] = {}
    for name, value in leaves:
        if name in variables or name in unusable:
            raise UserError(f"{path}: holds two variables {name!r}; give each its own name")
        array = _array(value)
        if isinstance(array, Unusable):
            unusable[name] = str(array)
        elif array.dtype.kind in "UT":
            said = listed([repr(str(word)) for word in dict.fromkeys(np.ravel(array).tolist())], 4)
            unusable[name] = f"holds the words {said}; a trial's `where` can test it"
            if array.ndim == 1:
                words[name] = array.astype(np.dtypes.StringDType())
        else:
            variables[name] = Variable(array, units=units.get(name) or stated_units(name))
    variables = samples_first(variables)
    for name, v in tuple(variables.items()):
        if v.values.ndim == 2 and v.values.shape[1] > len(v.values):
            rows, columns = v.values.shape
            unusable[name] = f"has {rows} rows and {columns} columns; save it with one row a sample"
            del variables[name]
    return Recording(path, variables, unusable, words=words)


def _array(value: Any) -> np.ndarray | Unusable:
    """Value as an array (N,) or (N, k) of float64 or of text, or the reason why it is none."""
    if isinstance(value, Unusable):
        return value
    if isinstance(value, list):
        if any(isinstance(item, str) for item in value):
            texts = all(isinstance(item, str | None) for item in value)
            return np.array([item or "" for item in value]) if texts else _MIXED
        value = _filled(value)
    try:
        array = np.asarray(value)
    except ValueError:  # NumPy refuses lists of different lengths.
        return Unusable("has rows of different lengths; give each sample as many numbers")
    if array.dtype.kind in _NANOSECONDS:
        missing = np.isnat(array)
        array = np.where(missing, np.nan, array.astype(_NANOSECONDS[array.dtype.kind]).astype(np.int64) * 1e-9)
    if array.dtype.kind == "c":
        return Unusable("is complex; save its real part")
    if array.dtype.kind in "UT":
        return np.atleast_1d(array)
    if array.dtype.kind == "O":
        array = _numbers(array)
        if isinstance(array, Unusable):
            return array
    if array.dtype.kind not in "biuf":
        return Unusable("is no array of numbers; save it as one")
    if not array.size:
        return Unusable("is empty")
    array = np.atleast_1d(np.squeeze(array)) if 1 in array.shape else np.atleast_1d(array)
    if array.ndim > 2:
        return Unusable(f"is an array of {' × '.join(map(str, array.shape))}; save it with one row a sample")
    return array.astype(np.float64)


def _filled(value: list) -> list:
    """List whose missing items, None, are rows of NaN where the others are lists."""
    widths = {len(item) for item in value if isinstance(item, list)}
    if len(widths) != 1 or any(not isinstance(item, list | None) for item in value):
        return value
    return [[None] * next(iter(widths)) if item is None else item for item in value]


def _numbers(array: np.ndarray) -> np.ndarray | Unusable:
    """Array of Python objects as numbers, None as NaN."""
    try:
        return np.array([np.nan if x is None else float(x) for x in array.ravel()]).reshape(array.shape)
    except (TypeError, ValueError):
        return _MIXED
