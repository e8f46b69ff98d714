"""JSON, NumPy's files and HDF5 of other programs as recordings."""

import json

import h5py
import numpy as np
import pytest

from jaxfinger.data.importing.recording import side_by_side
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.errors import UserError

NAN = float("nan")
SAMPLES = [
    {"t": 0.0, "q": [0.1, 0.2], "on": True, "mode": "up", "cell": {"raw": 3}},
    {"t": 0.1, "q": [0.3, 0.4], "on": False, "mode": "up", "cell": {"raw": None}},
    {"t": 0.2, "on": True, "mode": "down", "cell": {"raw": 5}},
]
EXPECTED = {
    "t": [0.0, 0.1, 0.2],
    "q": [[0.1, 0.2], [0.3, 0.4], [NAN, NAN]],
    "on": [1.0, 0.0, 1.0],
    "cell.raw": [3.0, NAN, 5.0],
}


def written(path, content):
    path.write_text(content)
    return load_recording(path)


def same(found, expected):
    assert set(found.variables) == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found.variables[name].values, values)


def test_json_with_an_object_a_sample(tmp_path):
    for name, content in (
        ("log.json", json.dumps(SAMPLES)),
        ("log.jsonl", "\n".join(map(json.dumps, SAMPLES)) + "\n"),
    ):
        found = written(tmp_path / name, content)
        same(found, EXPECTED)
        assert list(found.words["mode"]) == ["up", "up", "down"]


def test_json_with_samples_inside_an_object_or_lists_by_name(tmp_path):
    found = written(tmp_path / "log.json", json.dumps({"mass": 1.5, "motor": "x", "entries": SAMPLES}))
    same(found, {"mass": [1.5], **{f"entries.{name}": values for name, values in EXPECTED.items()}})
    same(written(tmp_path / "log.json", json.dumps({"t": [0, 1], "q": [0.5, None]})), {"t": [0, 1], "q": [0.5, NAN]})


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("log.json", '{"t": [0, 1}', "is no JSON"),
        ("log.json", '{"t": 0}\n{"t": 1,}\n{"t": 2}\n', "line 2, column"),
        ("log.jsonl", '{"t": 0}\n\n{"t": \n{"t": 1}\n', "line 3, column"),
        ("log.json", '{"a.b": [1], "a": {"b": [2]}}', "two variables 'a.b'"),
    ],
)
def test_json_that_cannot_be_read_is_named_with_the_mend(tmp_path, name, content, said):
    with pytest.raises(UserError, match=f"{name}: .*{said}"):
        written(tmp_path / name, content)


def test_json_values_that_are_no_variables_have_reasons(tmp_path):
    content = {"ragged": [[1, 2], [3]], "wide": [[1, 2, 3], [4, 5, 6]], "mixed": [1, "x"], "none": [], "t": [0, 1]}
    found = written(tmp_path / "log.json", json.dumps(content))
    assert set(found.variables) == {"t"}
    said = {"ragged": "different lengths", "wide": "2 rows and 3 columns", "mixed": "mixes", "none": "is empty"}
    assert set(found.unusable) == set(said)
    assert all(said[name] in reason for name, reason in found.unusable.items())


def test_numpy(tmp_path):
    q = np.arange(6.0).reshape(3, 2)
    when = np.array(["2026-01-31T12:00:00.000", "2026-01-31T12:00:00.005", "NaT"], "datetime64[ns]")
    table = np.array([(0, 1.5), (1, 2.5)], [("n", int), ("tau", float)])
    np.savez(tmp_path / "log.npz", q=q, when=when, table=table, bad=np.array([{}, {}, {}], object), z=q + 1j)
    found = load_recording(tmp_path / "log.npz")
    assert set(found.variables) == {"q", "when", "table.n", "table.tau"}
    np.testing.assert_allclose(np.diff(found.variables["when"].values), [0.005, NAN], atol=1e-6)
    assert "Python objects" in found.unusable["bad"]
    assert "complex" in found.unusable["z"]
    np.save(tmp_path / "q.npy", q)
    np.testing.assert_array_equal(load_recording(tmp_path / "q.npy").variables["q"].values, q)
    np.save(tmp_path / "q.npy", table)
    assert set(load_recording(tmp_path / "q.npy").variables) == {"q.n", "q.tau"}


def test_hdf5_of_another_program(tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["obs/q"] = np.arange(6.0).reshape(3, 2)
        file["obs/mode"] = ["up", "down", "up"]
        file["t"] = [0.0, 0.1, 0.2]
    found = load_recording(tmp_path / "log.h5")
    same(found, {"obs.q": [[0, 1], [2, 3], [4, 5]], "t": [0.0, 0.1, 0.2]})
    assert list(found.words["obs.mode"]) == ["up", "down", "up"]


def test_a_session_is_no_recording(tmp_path):
    with h5py.File(tmp_path / "session.h5", "w") as file:
        file.attrs["format"] = "jaxfinger-dataset"
    with pytest.raises(UserError, match="is a session already; look at it with: jaxfinger check"):
        load_recording(tmp_path / "session.h5")


def test_a_table_that_is_not_read_is_answered_with_the_line_that_writes_it_as_csv(tmp_path):
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    with pytest.raises(UserError, match=r"pandas.read_parquet\('log.parquet'\).to_csv\('log.csv', index=False\)"):
        load_recording(tmp_path / "log.parquet")


def test_arrays_in_files_of_their_own_lie_side_by_side_by_their_names(tmp_path):
    np.save(tmp_path / "times.npy", np.arange(3.0))
    np.savez(tmp_path / "log.npz", q=np.arange(6.0).reshape(3, 2))
    found = side_by_side([load_recording(tmp_path / name) for name in ("times.npy", "log.npz")])
    assert set(found.variables) == {"times", "log.q"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("log.json", '{"t": {"0": 0.0, "1": 0.1, "2": 0.2}, "q": {"0": 1.0, "1": null, "2": 3.0}}'),
        ("log.json", '{"columns": ["t", "q"], "index": [0, 1, 2], "data": [[0.0, 1.0], [0.1, null], [0.2, 3.0]]}'),
        ("log.json", '{"t": 0.0, "q": 1.0}\n{"t": 0.1, "q": null}\n{"t": 0.2, "q": 3.0}\n'),
        ("log.log", '{"t": 0.0, "q": 1.0}\n{"t": 0.1, "q": null}\n{"t": 0.2, "q": 3.0}\n'),
        ("log.jsonl", '{"t": 0.0, "q": 1.0}\n{"t": 0.1, "q": null}\n{"t": 0.2, "q": 3.0}\n{"t": 0.3, "q'),
    ],
    ids=["columns", "split", "lines", "log", "cut"],
)
def test_json_as_pandas_and_loggers_write_it(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    found = load_recording(path)
    np.testing.assert_array_equal(found.variables["t"].values, [0.0, 0.1, 0.2])
    np.testing.assert_array_equal(found.variables["q"].values, [1.0, np.nan, 3.0])
    assert found.remarks == (("its last line is cut short and is left out",) if text.endswith("q") else ())


def test_units_are_read_where_hdf5_and_json_state_them(tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["adc/angle"], file["adc/t_us"] = np.arange(5.0), np.arange(5.0)
        file["adc/angle"].attrs["units"] = "mrad"
    found = load_recording(tmp_path / "log.h5").variables
    assert {name: variable.units for name, variable in found.items()} == {"adc.angle": "mrad", "adc.t_us": ""}
    content = {
        "angle": {"values": [1, 2, 3], "unit": "deg"},
        "run": {"tau": [1, 2, 3], "t": [1, 2, 3], "units": {"tau": "N mm"}},
        "force [mN]": [1, 2, 3],
    }
    found = written(tmp_path / "log.json", json.dumps(content)).variables
    units = {name: variable.units for name, variable in found.items()}
    assert units == {"angle.values": "deg", "run.tau": "N mm", "run.t": "", "force [mN]": "mN"}


def test_arrays_with_joints_first_are_read_beside_their_clock(tmp_path):
    q, path = np.arange(12.0).reshape(2, 6), tmp_path / "log.npz"
    np.savez(path, t=np.arange(6.0), q=q, other=np.ones((2, 7)))
    found = load_recording(path)
    np.testing.assert_array_equal(found.variables["q"].values, q.T)
    assert found.unusable["other"] == "has 2 rows and 7 columns; save it with one row a sample"
