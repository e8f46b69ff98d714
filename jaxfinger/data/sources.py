"""Recordings of other tools as named arrays: MATLAB .mat (v5 and v7.3), CSV, rosbag2 and MCAP."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import scipy.io

from jaxfinger.errors import UserError

Variables = dict[str, np.ndarray]


def load_variables(path: Path) -> Variables:
    """Every numeric variable of a recording, samples first; members of structures as `outer.inner`.

    Raises:
        UserError: the file is missing, of an unknown kind, or damaged.
    """
    if not path.exists():
        raise UserError(f"{path}: does not exist; name a recording")
    try:
        if path.suffix == ".mat":
            return _flat(_load_mat(path))
        if path.suffix in (".csv", ".txt", ".tsv"):
            return _load_csv(path)
        if path.is_dir() or path.suffix in (".mcap", ".db3", ".bag"):
            from jaxfinger.data.bags import load_bag

            return load_bag(path)
    except UserError:
        raise
    except Exception as error:  # readers of foreign formats raise nearly anything
        raise UserError(f"{path}: cannot be read ({error}); export the recording again") from error
    raise UserError(f"{path}: is of an unknown kind; give .mat, .csv, .mcap or a rosbag2 folder")


def _load_mat(path: Path) -> Mapping[str, Any]:
    """v5 to v7.2 through scipy; v7.3 is an HDF5 file, whose arrays MATLAB stores transposed."""
    if not h5py.is_hdf5(path):
        return scipy.io.loadmat(path, simplify_cells=True)
    with h5py.File(path, "r") as file:
        return {name: _from_hdf5(item) for name, item in file.items() if not name.startswith("#")}


def _from_hdf5(item: h5py.Group | h5py.Dataset) -> Any:
    if isinstance(item, h5py.Group):
        return {name: _from_hdf5(child) for name, child in item.items()}
    return np.zeros(0) if item.dtype.kind not in "biuf" or item.attrs.get("MATLAB_empty", 0) else item[()].T


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Variables:
    found: Variables = {}
    for name, value in tree.items():
        if name.startswith("__"):
            continue
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{name}.")
            continue
        array = np.asarray(value)
        if array.size and array.dtype.kind in "biuf":
            found[prefix + name] = _samples_first(array.astype(np.float64))
    return found


def _samples_first(array: np.ndarray) -> np.ndarray:
    """Row vectors and Simulink's 1×1×N signals as plain vectors."""
    array = np.squeeze(array)
    return np.moveaxis(array, -1, 0).reshape(array.shape[-1], -1) if array.ndim > 2 else array


def _load_csv(path: Path) -> Variables:
    """Columns by the names in the first line that is not a comment (#); separated by comma, semicolon or tab."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        lines = [line for line in file if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise UserError(f"{path}: holds no samples; it needs a line of names, then one line a sample")
    delimiter = max(",;\t", key=lines[0].count)
    names = [name.strip() for name in next(csv.reader(lines[:1], delimiter=delimiter))]
    try:
        table = np.loadtxt(lines[1:], delimiter=delimiter, ndmin=2, converters=_number, encoding="utf-8")
    except ValueError as error:
        raise UserError(
            f"{path}: holds a line that is not {len(names)} numbers ({error}); correct or drop it"
        ) from None
    if table.shape[1] != len(names):
        raise UserError(f"{path}: names {len(names)} columns and holds {table.shape[1]}; give each column one name")
    return dict(zip(names, table.T, strict=True))


def _number(text: str) -> float:
    return float(text) if text.strip() else np.nan
