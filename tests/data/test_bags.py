"""MCAP and rosbag2 recordings: exact, and readable to the cut when cut short."""

import json

import numpy as np
import pytest

from jaxfinger.data.sources import load_variables
from jaxfinger.errors import UserError

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
    found = load_variables(tmp_path / "log.mcap")
    np.testing.assert_allclose(found["/state.time"], np.arange(COUNT) * 1e-3, atol=1e-9)
    np.testing.assert_array_equal(found["/state.position"], np.arange(COUNT)[:, None] * [0.1, -0.2])
    np.testing.assert_array_equal(found["/state.temperature"], 20.0 + np.arange(COUNT))
    assert "/state.note" not in found


def test_mcap_cut_short_is_read_to_the_cut(tmp_path):
    path = tmp_path / "log.mcap"
    write_mcap(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    position = load_variables(path)["/state.position"]
    assert 10 < len(position) < COUNT
    np.testing.assert_array_equal(position, np.arange(len(position))[:, None] * [0.1, -0.2])


def test_rosbag2_with_joint_states(tmp_path):
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    state, header, clock = (
        store.types[name]
        for name in ("sensor_msgs/msg/JointState", "std_msgs/msg/Header", "builtin_interfaces/msg/Time")
    )
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        for i in range(COUNT):
            message = state(
                header=header(stamp=clock(sec=100 + i, nanosec=500), frame_id=""),
                name=["MCP", "PIP"],
                position=np.array([0.1 * i, 0.2 * i]),
                velocity=np.zeros(2),
                effort=np.zeros(0),
            )
            writer.write(connection, 2_000_000 * i, store.serialize_cdr(message, state.__msgtype__))
    found = load_variables(tmp_path / "bag")
    np.testing.assert_array_equal(found["/joint_states.position"], np.arange(COUNT)[:, None] * [0.1, 0.2])
    np.testing.assert_allclose(found["/joint_states.time"], 2e-3 * np.arange(COUNT), atol=1e-9)
    np.testing.assert_allclose(np.diff(found["/joint_states.stamp"]), 1.0, atol=1e-6)


def test_a_damaged_bag_is_refused(tmp_path):
    (tmp_path / "log.mcap").write_bytes(b"not a recording")
    with pytest.raises(UserError, match="cannot be read"):
        load_variables(tmp_path / "log.mcap")
