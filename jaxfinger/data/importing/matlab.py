"""MATLAB's .mat files: v4 to v7.2 through SciPy, v7.3, which is HDF5, through h5py."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io
import scipy.sparse
from scipy.io.matlab import MatlabOpaque, varmats_from_mat

from jaxfinger.data.importing.recording import Recording, Variable, samples_first
from jaxfinger.data.opening import why_closed, why_unreadable
from jaxfinger.data.probe import restart_timer, survives
from jaxfinger.errors import UserError

_NUMBERS = ("double", "single", "logical", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")
_MIN_SPEED = 1e6  # bytes/s: a hundredth of the speed at which SciPy reads a compressed file
_OBJECT = "is a MATLAB object ({kind}), which only MATLAB can open; there, if it is x, {mend}"
_MENDS = {
    "timetable": "write it as CSV by writetimetable(x, 'x.csv')",
    "table": "write it as CSV by writetable(x, 'x.csv')",
    "datetime": "save seconds(x - x(1))",
    "duration": "save seconds(x)",
    "categorical": "save double(x)",
}
_MEND = "save its members as arrays, as x.Data and x.Time of a timeseries"
_NAMELESS = "None"  # as SciPy names each object, whose own name is in its member `s0`
_ONE = "choose one and save it alone"


class _Unusable(str):
    """Reason why a variable gives no numbers, in place of its value."""


def load_mat(path: Path) -> Recording:
    """Load every numeric variable, samples first. Members of structures are named `outer.inner`, and those of a
    list of structures `outer(1).inner`, as MATLAB counts.

    The clock of a signal in a Simulink structure with time (`S.time` beside `S.signals`) is `S.time`.

    Raises:
        UserError: the file is damaged, or holds two variables of one name.
    """
    tree = _hdf5(path) if h5py.is_hdf5(path) else _scipy(path)
    variables: dict[str, Variable] = {}
    unusable: dict[str, str] = {}
    for name, value in _leaves(tree):
        if isinstance(value, _Unusable):
            unusable[name] = str(value)
            continue
        signals = re.search(r"\.signals(\(\d+\))?\.", name)
        clock = f"{name[: signals.start()]}.time" if signals else ""
        variables[name] = Variable(_samples_first(value), clock=clock)
    on_clocks = {name: _on_clock(v, variables) for name, v in variables.items()}
    return Recording(path, samples_first(on_clocks), unusable)


def _on_clock(variable: Variable, variables: Mapping[str, Variable]) -> Variable:
    """Variable with its clock, if there is one, and samples first as on the clock.

    Simulink stacks the samples of a k×1 signal along the third axis, and SciPy makes k×N of it.
    """
    if variable.clock not in variables:
        return Variable(variable.values)
    count, values = len(variables[variable.clock].values), variable.values
    turned = values.ndim == 2 and len(values) != count and values.shape[1] == count
    return Variable(values.T if turned else values, clock=variable.clock)


def _visit(path: Path) -> None:
    restart_timer(path.stat().st_size / _MIN_SPEED)
    with warnings.catch_warnings(), suppress(Exception):  # The reader meets the same exception and reports it.
        warnings.simplefilter("ignore")
        scipy.io.loadmat(path)


def _scipy(path: Path) -> Mapping[str, Any]:
    damaged = UserError(f"{path}: is damaged in its structure; save it in MATLAB again")
    if not survives(path, _visit):
        raise damaged
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", f'Duplicate variable name (?!"{_NAMELESS}")')
        try:
            loaded = scipy.io.loadmat(path, simplify_cells=True)
        except scipy.io.matlab.MatReadWarning as error:
            raise UserError(f"{path}: {error}; give each variable its own name") from None
        # SciPy raises these on damaged lengths and types.
        except (ArithmeticError, LookupError, MemoryError, TypeError, ValueError):
            raise damaged from None
    variables = {name: value for name, value in loaded.items() if not name.startswith("__")}
    if isinstance(variables.get(_NAMELESS), MatlabOpaque):
        del variables[_NAMELESS]
        variables |= _objects(path)
    return variables


def _objects(path: Path) -> dict[str, _Unusable]:
    """Objects of a file by their own names."""
    with path.open("rb") as file:
        parts = [scipy.io.loadmat(part) for name, part in varmats_from_mat(file) if name == _NAMELESS]
    return {bytes(part[_NAMELESS][0]["s0"]).decode(): _plain(part[_NAMELESS]) for part in parts}


def _hdf5(path: Path) -> Mapping[str, Any]:
    reason = why_closed(path)
    if reason is not None:
        raise UserError(f"{path}: {reason}")
    with h5py.File(path, "r") as file:
        return {name: _from_hdf5(item) for name, item in file.items() if not name.startswith("#")}


def _from_hdf5(item: Any) -> Any:
    kind = item.attrs.get("MATLAB_class", b"double")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    if "MATLAB_object_decode" in item.attrs and kind not in _NUMBERS:
        return _object(kind)
    if "MATLAB_sparse" in item.attrs:
        return _Unusable("is a sparse matrix; save full(…) of it")
    if isinstance(item, h5py.Group):
        if len(sizes := {_listed(child) for child in item.values()}) == 1 and (count := sizes.pop()):
            return [
                {name: _from_hdf5(item.file[child[()].T.flat[k]]) for name, child in item.items()} for k in range(count)
            ]
        return {name: _from_hdf5(child) for name, child in item.items()}
    if item.dtype.kind == "O":  # References are a cell array.
        return _Unusable(f"is a list of {item.size} cells; {_ONE}")
    if kind == "char":
        return _Unusable("is text; name a variable of numbers")
    if item.attrs.get("MATLAB_empty", 0):
        return _Unusable("is empty")
    reason = why_unreadable(item)
    return _Unusable(reason) if reason is not None else _plain(item[()].T)


def _listed(item: h5py.Group | h5py.Dataset) -> int:
    """Number of structures of a list, of which this is a member: references without a class; 0 of another item."""
    if isinstance(item, h5py.Group) or "MATLAB_class" in item.attrs:
        return 0
    return int(item.size or 0) if h5py.check_ref_dtype(item.dtype) is h5py.Reference else 0


def _leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        name, items = prefix + key, _structures(value)
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{name}.")
        elif items:
            first = next(iter(items[0]), "…")
            yield name, _Unusable(f"is a list of {len(items)} structures; name a member of one, as {name}(1).{first}")
            for k, item in enumerate(items, 1):
                yield from _leaves(item, f"{name}({k}).")
        else:
            yield name, _plain(value)


def _structures(value: Any) -> list[Mapping[str, Any]]:
    """Structures of a list that holds nothing else; empty for any other value."""
    if not isinstance(value, list) and not (isinstance(value, np.ndarray) and value.dtype == object):
        return []
    items = np.ravel(np.array(value, object)).tolist()
    return items if all(isinstance(item, Mapping) for item in items) else []


def _plain(value: Any) -> Any:
    """Value as an array of float64, or `_Unusable` with the reason why it is none."""
    if isinstance(value, _Unusable):
        return value
    if isinstance(value, str):
        return _Unusable("is text; name a variable of numbers")
    if scipy.sparse.issparse(value):
        return _Unusable("is a sparse matrix; save full(…) of it")
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        kind = "structures" if any(isinstance(item, Mapping) for item in np.ravel(np.array(value, object))) else "cells"
        return _Unusable(f"is a list of {len(value) if np.ndim(value) else 1} {kind}; {_ONE}")
    array = np.asarray(value)
    if array.dtype.names is not None and set(array.dtype.names) >= {"real", "imag"}:
        return _Unusable("is complex; save its real part")
    if array.dtype.names is not None or type(value).__name__ in ("MatlabOpaque", "MatlabFunction", "MatlabObject"):
        kind = bytes(np.ravel(array)[0]["s2"]).decode() if array.dtype.names and "s2" in array.dtype.names else "class"
        return _object(kind)
    if array.dtype.kind == "c":
        return _Unusable("is complex; save its real part")
    if array.dtype.kind not in "biuf":
        return _Unusable("is text; name a variable of numbers")
    return array.astype(np.float64) if array.size else _Unusable("is empty")


def _object(kind: str) -> _Unusable:
    return _Unusable(_OBJECT.format(kind=kind, mend=_MENDS.get(kind, _MEND)))


def _samples_first(array: np.ndarray) -> np.ndarray:
    """Array with samples first: single rows are transposed, and so are Simulink's k×1×N signals."""
    if array.ndim > 2:
        array = np.moveaxis(array, -1, 0).reshape(array.shape[-1], -1)
    return np.atleast_1d(np.squeeze(array)) if 1 in array.shape or not array.ndim else array
