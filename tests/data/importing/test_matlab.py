"""Objects in MATLAB's files, which only MATLAB can open, are named with what to write in their place."""

import re
import struct
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io

from jaxfinger.data.importing.sources import load_recording
from jaxfinger.errors import UserError

# Kinds of elements of a version 5 file, and of arrays in it.
INT8, INT32, UINT32, MATRIX = 1, 5, 6, 14
UINT32_ARRAY, OBJECT = 13, 17
MENDS = [
    ("timetable", "writetimetable(x, 'x.csv')"),
    ("table", "writetable(x, 'x.csv')"),
    ("timeseries", "as x.Data and x.Time of a timeseries"),
    ("datetime", "seconds(x - x(1))"),
]


def element(kind: int, data: bytes) -> bytes:
    return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)


def saved_object(name: str, kind: str) -> bytes:
    """An object as MATLAB saves it in version 5: its name, MCOS, its class, and a reference."""
    flags = element(UINT32, struct.pack("<II", UINT32_ARRAY, 0)) + element(INT32, struct.pack("<ii", 1, 1))
    reference = element(MATRIX, flags + element(INT8, b"") + element(UINT32, struct.pack("<I", 0xDD000000)))
    words = b"".join(element(INT8, word.encode()) for word in (name, "MCOS", kind))
    return element(MATRIX, element(UINT32, struct.pack("<II", OBJECT, 0)) + words + reference)


def version_5(path: Path, objects: dict[str, str], **arrays: np.ndarray) -> Path:
    scipy.io.savemat(path, arrays)
    path.write_bytes(path.read_bytes() + b"".join(saved_object(*item) for item in objects.items()))
    return path


@pytest.mark.parametrize(("kind", "mend"), MENDS)
def test_an_object_is_said_with_its_name_and_the_arrays_beside_it_are_read(tmp_path, kind, mend):
    found = load_recording(version_5(tmp_path / "log.mat", {"run": kind, "other": "table"}, q=np.arange(5.0)))
    np.testing.assert_array_equal(found.variables["q"].values, np.arange(5.0))
    assert set(found.unusable) == {"run", "other"}
    assert f"MATLAB object ({kind})" in found.unusable["run"]
    assert mend in found.unusable["run"]


@pytest.mark.parametrize(("kind", "mend"), MENDS)
def test_an_object_in_hdf5_is_said_too(tmp_path, kind, mend):
    with h5py.File(tmp_path / "log.mat", "w") as file:
        file["q"] = np.arange(5.0)[None]
        file["run"] = np.zeros((1, 6), np.uint32)
        file["run"].attrs["MATLAB_class"] = np.bytes_(kind)
        file["run"].attrs["MATLAB_object_decode"] = 3
    found = load_recording(tmp_path / "log.mat")
    assert set(found.variables) == {"q"}
    assert mend in found.unusable["run"]


def test_a_file_of_objects_alone_is_refused_with_the_mend(tmp_path):
    with pytest.raises(UserError, match=r"log.mat: holds no variable of numbers: run is .*writetimetable"):
        load_recording(version_5(tmp_path / "log.mat", {"run": "timetable"}))


def trials(count: int) -> list[dict]:
    """Trials as labs save them: structures of times, angles with joints first, and torques, each of another length."""
    lengths = [20 + k for k in range(count)]
    return [{"t": np.arange(n) / 9, "q": np.arange(2.0 * n).reshape(2, n), "tau": np.arange(n) + 0.5} for n in lengths]


def as_version_7_3(path: Path, name: str, items: list[dict]) -> None:
    """MATLAB writes a list of structures as a group with a dataset of references for each member."""
    with h5py.File(path, "w") as file:
        for member in items[0]:
            kept = [file.create_dataset(f"#refs#/{member}{k}", data=item[member].T) for k, item in enumerate(items)]
            file.create_dataset(f"{name}/{member}", (len(items), 1), h5py.ref_dtype)
            file[f"{name}/{member}"][:, 0] = [data.ref for data in kept]


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_structures_of_a_list_are_named_as_matlab_counts_them(tmp_path, version):
    path, items = tmp_path / "log.mat", trials(3)
    if version == "5":
        kept = np.array([tuple(item.values()) for item in items], [(k, object) for k in items[0]])
        scipy.io.savemat(path, {"run": kept[None]})
    else:
        as_version_7_3(path, "run", items)
    found = load_recording(path)
    assert set(found.variables) == {f"run({k}).{member}" for k in (1, 2, 3) for member in ("t", "q", "tau")}
    for k, item in enumerate(items, 1):
        np.testing.assert_array_equal(found.variables[f"run({k}).tau"].values, item["tau"])
        np.testing.assert_array_equal(found.variables[f"run({k}).q"].values, item["q"].T)  # samples first
    assert re.search(r"a list of 3 structures; name a member of one, as run\(1\)\.(t|q|tau)", found.unusable["run"])


def test_an_array_is_turned_only_where_a_vector_beside_it_has_as_many_samples(tmp_path):
    wide = np.arange(60.0).reshape(3, 20)
    saved = {"t": np.arange(20.0), "inner": {"q": wide}, "tall": wide.T, "gain": np.eye(3)[:, :2].T}
    scipy.io.savemat(tmp_path / "log.mat", saved | {"other": {"t": np.arange(30.0)}, "f": np.ones((2, 30))})
    shapes = {name: v.values.shape for name, v in load_recording(tmp_path / "log.mat").variables.items()}
    assert shapes["inner.q"] == (20, 3)
    assert shapes["tall"] == (20, 3)
    assert shapes["gain"] == (2, 3)
    assert shapes["f"] == (2, 30)
