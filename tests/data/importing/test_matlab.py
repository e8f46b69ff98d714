"""Objects in MATLAB's files, which only MATLAB can open, are named with what to write in their place."""

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
