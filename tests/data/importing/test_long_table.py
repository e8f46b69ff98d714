"""Long tables, with one row a sample and signal, are read at the rate of each signal."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from jaxfinger.data.importing.by_mapping import import_session
from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from tests.data.conftest import ONE_JOINT

TIME = np.arange(600) / 100
ANGLE, TORQUE = 0.5 + 0.4 * np.sin(TIME), 0.02 * np.cos(TIME)
SLOW = TIME[3::10] + 0.004
FORCE = 2.0 + 0.1 * np.sin(SLOW)


def rows(scale: float = 1.0) -> list[tuple[float, str, float]]:
    """Time, signal and value of three signals, a force at a tenth of the rate among them, in order of time."""
    of_force = [(scale * t, "force_T1", x) for t, x in zip(SLOW, FORCE, strict=True)]
    pairs = ("angle_MCP", ANGLE, 0.0), ("torque_MCP", TORQUE, 0.003)
    others = [(scale * (t + late), name, v) for name, x, late in pairs for t, v in zip(TIME, x, strict=True)]
    return sorted(of_force + others)


def csv(path: Path, header: str, table: list[tuple]) -> Path:
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in table), ""]))
    return path


def session_of(path: Path):
    """The session that the proposed mapping imports, with its open units filled in."""
    said = proposal([load_recording(path)]).replace('finger = "finger.toml"\n', "")
    said = said.replace("q.J1", "q.MCP").replace("torque.J1", "torque.MCP").replace('joint = "J1"', 'joint = "MCP"')
    said = re.sub(r'(tendon_force.*units = )"\?"', r'\1"N"', said)
    mapping = path.parent / "m.toml"
    mapping.write_text(ONE_JOINT[ONE_JOINT.index("[finger]") :] + "\n")
    mapping.write_text(said.split("[trials")[0] + mapping.read_text() + "[trials" + said.split("[trials")[1])
    return import_session([path], mapping)


@pytest.mark.parametrize(
    ("header", "scale"),
    [
        ("time,signal,value", 1.0),
        ("stamp,topic,data", 1.0),
        ("t [ms],name,Wert", 1e3),
        ("t,channel,value", 1e3),
    ],
)
def test_a_row_a_sample_and_signal(tmp_path, header, scale):
    """The angle gives the times; the others are interpolated to them."""
    trial = session_of(csv(tmp_path / "log.csv", header, rows(scale)))["01-log"]
    within = (SLOW[0] <= TIME) & (SLOW[-1] >= TIME)
    assert len(trial.time) == within.sum()
    assert trial.joint_torque is not None
    assert trial.tendon_force is not None
    np.testing.assert_allclose(np.diff(trial.time), 0.01, atol=1e-9)
    np.testing.assert_allclose(trial.q[:, 0], ANGLE[within])
    np.testing.assert_allclose(trial.joint_torque[:, 0], np.interp(TIME[within], TIME + 0.003, TORQUE), atol=1e-12)
    np.testing.assert_allclose(trial.tendon_force[:, 0], np.interp(TIME[within], SLOW, FORCE), atol=1e-12)


def test_an_object_a_sample_and_signal(tmp_path):
    path = tmp_path / "log.jsonl"
    path.write_text("".join(json.dumps({"stamp": t, "topic": name, "data": x}) + "\n" for t, name, x in rows()))
    found = load_recording(path).variables
    np.testing.assert_array_equal(found["force_T1"].values, FORCE)
    np.testing.assert_array_equal(found[found["force_T1"].clock].values, SLOW)


def test_signals_one_after_another_that_share_their_times_share_a_clock(tmp_path):
    """As `DataFrame.melt` writes them."""
    table = [(name, t, v) for name, x in (("q", ANGLE), ("tau", TORQUE)) for t, v in zip(TIME, x, strict=True)]
    found = load_recording(csv(tmp_path / "log.csv", "variable,time,value", table)).variables
    assert set(found) == {"time", "q", "tau"}
    np.testing.assert_array_equal(found["time"].values, TIME)
    np.testing.assert_array_equal(found["tau"].values, TORQUE)


@pytest.mark.parametrize("often", [1, 8])
@pytest.mark.parametrize("name", ["dev", "source", "board", "msg_type", "whence"])
def test_lines_of_two_devices_are_told_apart_by_their_tag(tmp_path, name, often):
    """Also where one has several lines for each of the other, and whatever the column is called if it is regular."""
    table = []
    for k, (t, a) in enumerate(zip(TIME, ANGLE, strict=True)):
        table += [("A", t, a), *([("B", t + 0.002, 9.0)] if k % often == 0 else [])]
    found = load_recording(csv(tmp_path / "log.csv", f"{name},t,angle", table)).variables
    np.testing.assert_array_equal(found["A.angle"].values, ANGLE)
    np.testing.assert_allclose(found[found["B.angle"].clock].values, TIME[::often] + 0.002)


def test_numbers_of_devices_of_which_one_is_slower_are_told_apart(tmp_path):
    table = [(k % 6 == 0, t, a) for k, (t, a) in enumerate(zip(TIME, ANGLE, strict=True))]
    found = load_recording(csv(tmp_path / "log.csv", "node,t,angle", [(int(n), t, a) for n, t, a in table])).variables
    np.testing.assert_array_equal(found["node 1.angle"].values, ANGLE[::6])


def test_words_that_tell_phases_or_states_apart_are_no_devices(tmp_path):
    rng = np.random.default_rng(0)
    states = np.where(rng.random(len(TIME)) < 0.2, "late", "ok")
    phases = np.repeat(["up", "hold", "down", "hold"], len(TIME) // 4)
    for words in (states, phases):
        path = csv(tmp_path / "log.csv", "t,state,angle", list(zip(TIME, words, ANGLE, strict=True)))
        assert len(load_recording(path).variables["angle"].values) == len(TIME)


@pytest.mark.parametrize(("key", "labels"), [("joint", ("MCP", "PIP")), ("motor_id", (11, 12))])
def test_a_row_a_sample_and_joint(tmp_path, key, labels):
    """No rate is invented from stamps that the joints share."""
    table = [
        (t, label, a + k, b) for t, a, b in zip(TIME, ANGLE, TORQUE, strict=True) for k, label in enumerate(labels)
    ]
    recording = load_recording(csv(tmp_path / "log.csv", f"time,{key},position,effort", table))
    first, second = (label if isinstance(label, str) else f"{key} {label}" for label in labels)
    np.testing.assert_array_equal(recording.variables[f"{first}.position"].values, ANGLE)
    np.testing.assert_array_equal(recording.variables[f"{second}.position"].values, ANGLE + 1)
    said = proposal([recording])
    assert 'time = "time"' in said
    assert "rate_hz" not in said
    units = "?" if key == "motor_id" else "rad"
    assert f'channels.q.J2 = {{ from = "{second}.position", units = "{units}" }}' in said


def test_units_in_a_column_of_their_own(tmp_path):
    """Units that change within a signal are refused."""
    units = {"angle_MCP": "deg", "torque_MCP": "N mm", "force_T1": "N"}
    table = [(t, name, x, units[name]) for t, name, x in rows()]
    table[-1] = (*table[-1][:3], "V")
    recording = load_recording(csv(tmp_path / "log.csv", "time,signal,value,unit", table))
    last = table[-1][1]
    assert {name: v.units for name, v in recording.variables.items() if name in units} == {
        name: unit for name, unit in units.items() if name != last
    }
    assert "has values in different units" in recording.unusable[last]


@pytest.mark.parametrize(
    ("header", "label"),
    [
        ("time,phase,angle", lambda k: "up" if k < 300 else "down"),
        ("time,tendon,angle", lambda k: 1 + k // 300),
        ("time,joint,angle", lambda k: 10 + k % 7 * (k // 50)),
    ],
    ids=["phases", "tendons pulled one after another", "whole degrees"],
)
def test_a_wide_table_stays_as_it_is(tmp_path, header, label):
    table = [(t, label(k), a) for k, (t, a) in enumerate(zip(TIME, ANGLE, strict=True))]
    recording = load_recording(csv(tmp_path / "log.csv", header, table))
    np.testing.assert_array_equal(recording.variables["angle"].values, ANGLE)
