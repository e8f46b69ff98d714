"""MCAP and rosbag2 recordings are read exactly, and up to the cut where they are cut short."""

import json

import numpy as np
import pytest

from jaxfinger.data import check_file, read_session
from jaxfinger.data.importing.by_mapping import import_file
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.errors import UserError
from tests.data.conftest import ONE_JOINT

COUNT = 200


def write_mcap(path):
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1000)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        channel = writer.register_channel("/state", "json", schema)
        for i in range(COUNT):
            body = {"position": [0.1 * i, -0.2 * i], "temperature": 20.0 + i, "note": "x"}
            stamp = 5_000_000_000 + i * 1_000_000
            writer.add_message(channel, log_time=stamp, publish_time=stamp, data=json.dumps(body).encode())
        writer.finish()


def test_mcap_in_json(tmp_path):
    write_mcap(tmp_path / "log.mcap")
    found = load_recording(tmp_path / "log.mcap").variables
    np.testing.assert_allclose(found["/state.time"].values, np.arange(COUNT) * 1e-3, atol=1e-9)
    np.testing.assert_array_equal(found["/state.position"].values, np.arange(COUNT)[:, None] * [0.1, -0.2])
    np.testing.assert_array_equal(found["/state.temperature"].values, 20.0 + np.arange(COUNT))
    assert "/state.note" not in found


def test_mcap_cut_short_is_read_to_the_cut(tmp_path):
    path = tmp_path / "log.mcap"
    write_mcap(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    position = load_recording(path).variables["/state.position"].values
    assert 10 < len(position) < COUNT
    np.testing.assert_array_equal(position, np.arange(len(position))[:, None] * [0.1, -0.2])


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ([1.0, 2.0], [1.0, 2.0, 3.0], "changes its length from 2 to 3 at message 1"),
        (1.0, [1.0], "changes its shape from () to (1,) at message 1"),
        ([[1.0, 2.0]], [[1.0]], "changes its shape from (1, 2) to (1, 1) at message 1"),
    ],
)
def test_a_field_that_changes_its_shape_is_unusable_and_the_others_are_read(tmp_path, first, second, words):
    from mcap.writer import Writer

    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("state", "jsonschema", b"{}")
        channel = writer.register_channel("/state", "json", schema)
        for i, value in enumerate((first, second)):
            body = json.dumps({"x": value, "y": i}).encode()
            writer.add_message(channel, log_time=i, publish_time=i, data=body)
        writer.finish()
    found = load_recording(tmp_path / "log.mcap")
    assert words in found.unusable["/state.x"]
    np.testing.assert_array_equal(found.variables["/state.y"].values, [0, 1])


def write_rosbag2(path):
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, clock = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer(path, version=9) as writer:
        connection = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for i in range(COUNT):
            message = state(
                header=header(stamp=clock(sec=100 + i, nanosec=500), frame_id=""),
                name=["MCP", "PIP"],
                position=np.array([0.1 * i, -0.2 * i]),
                velocity=np.zeros(2),
                effort=np.array([20.0 + i]),
            )
            writer.write(connection, 2_000_000 * i, store.serialize_cdr(message, state.__msgtype__))


def test_rosbag2_with_joint_states(tmp_path):
    write_rosbag2(tmp_path / "bag")
    found = load_recording(tmp_path / "bag").variables
    np.testing.assert_array_equal(found["/joint_states.position"].values, np.arange(COUNT)[:, None] * [0.1, -0.2])
    np.testing.assert_allclose(found["/joint_states.time"].values, 2e-3 * np.arange(COUNT), atol=1e-9)
    np.testing.assert_allclose(np.diff(found["/joint_states.stamp"].values), 1.0, atol=1e-6)


MAPPING = (
    ONE_JOINT
    + """[trials.01-ID2]
experiment = "ID.2"
joint = "MCP"
time = "TOPIC.time"
[trials.01-ID2.channels]
q.MCP = { from = "TOPIC.position", column = 0, units = "deg" }
tendon_force.T1 = { from = "TOPIC.FORCE", scale = 0.1, units = "N" }
tendon_excursion.T1 = { from = "TOPIC.position", column = 1, units = "mm" }
"""
)


@pytest.mark.parametrize(
    ("write", "name", "topic", "force", "period"),
    [(write_mcap, "log.mcap", "/state", "temperature", 1e-3), (write_rosbag2, "bag", "/joint_states", "effort", 2e-3)],
)
def test_a_bag_becomes_a_session_by_a_mapping_file(tmp_path, write, name, topic, force, period):
    write(tmp_path / name)
    (tmp_path / "map.toml").write_text(MAPPING.replace("TOPIC", topic).replace("FORCE", force))
    import_file([tmp_path / name], tmp_path / "map.toml", tmp_path / "out.h5")
    assert [f for f in check_file(tmp_path / "out.h5") if f.severity == "error"] == []
    trial, i = read_session(tmp_path / "out.h5")["01-ID2"], np.arange(COUNT)
    np.testing.assert_allclose(trial.time, period * i, atol=1e-9)
    np.testing.assert_allclose(trial.q[:, 0], np.deg2rad(0.1 * i), atol=1e-12)
    np.testing.assert_allclose(trial.tendon_force[:, 0], 2.0 + 0.1 * i, atol=1e-12)
    np.testing.assert_allclose(trial.tendon_excursion[:, 0], -2e-4 * i, atol=1e-12)


def test_a_damaged_bag_is_refused(tmp_path):
    (tmp_path / "log.mcap").write_bytes(b"not a recording")
    with pytest.raises(UserError, match="cannot be read"):
        load_recording(tmp_path / "log.mcap")
