"""rosbag2 and MCAP recordings as named arrays: `/topic.field`, with `/topic.time` in s from the recording's start."""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.errors import UserError

_SECOND = 1e-9  # stamps are in ns


def load_bag(path: Path) -> dict[str, np.ndarray]:
    """Every numeric field of every topic: (N,) or, where the field is a list of k numbers, (N, k).

    `/topic.time` is when the message was logged; messages with a header also have `/topic.stamp`, when it was made.
    """
    messages = _mcap_messages(path) if path.suffix == ".mcap" else _rosbag_messages(path)
    series: dict[str, list] = defaultdict(list)
    try:
        for topic, stamp, message in messages:
            series[f"{topic}.time"].append(stamp * _SECOND)
            for name, value in _fields(message):
                series[f"{topic}.{name}"].append(value)
    except ImportError as error:
        raise UserError(f"{path}: needs the package {error.name}; install jaxfinger[bags]") from None
    arrays = {name: _array(values) for name, values in series.items()}
    starts = [array[0] for name, array in arrays.items() if array is not None and name.endswith((".time", ".stamp"))]
    first = min(starts, default=0.0)
    return {
        name: array - first if name.endswith((".time", ".stamp")) else array
        for name, array in arrays.items()
        if array is not None
    }


def _array(values: list) -> np.ndarray | None:
    """Messages whose lists change length make no array, and are left out."""
    lengths = {np.shape(value) for value in values}
    return np.asarray(values, np.float64) if len(lengths) == 1 else None


def _fields(message: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    items = message.items() if isinstance(message, dict) else vars(message).items()
    for name, value in items:
        if name == "stamp" and (hasattr(value, "sec") or isinstance(value, dict)):
            stamp = value if isinstance(value, dict) else vars(value)
            yield "stamp", stamp.get("sec", 0) + stamp.get("nanosec", stamp.get("nsec", 0)) * _SECOND
        elif isinstance(value, dict) or hasattr(value, "__msgtype__"):
            yield from _fields(value, "" if name == "header" else f"{prefix}{name}.")
        elif isinstance(value, bool | int | float | np.ndarray | list):
            array = np.asarray(value)
            if array.size and array.dtype.kind in "biuf":
                yield prefix + name, array.astype(np.float64)


def _rosbag_messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, stamp, raw in reader.messages():
            yield connection.topic, stamp, reader.deserialize(raw, connection.msgtype)


def _mcap_messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Messages in JSON, or in CDR by the definition that the file carries. A file cut short is read to the cut."""
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader

    decoders: dict[int, Any] = {}
    with path.open("rb") as file:
        try:
            for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                if channel.message_encoding == "json":
                    yield channel.topic, message.log_time, json.loads(message.data)
                elif channel.message_encoding == "cdr" and schema is not None:
                    decode = decoders.setdefault(schema.id, None) or _ros_decoder(schema)
                    decoders[schema.id] = decode
                    yield channel.topic, message.log_time, decode(message.data)
        except (EndOfFile, struct.error):  # cut between records, or inside one
            return


def _ros_decoder(schema: Any) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    known = get_types_from_msg(schema.data.decode(), schema.name)
    store.register({name: fields for name, fields in known.items() if name not in store.types})
    return lambda data: store.deserialize_cdr(data, schema.name)
