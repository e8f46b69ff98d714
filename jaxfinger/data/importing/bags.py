"""rosbag2 and MCAP recordings: variables `/topic.field`, with `/topic.time` in s from the recording's start."""

from __future__ import annotations

import json
import struct
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.opening import plain_reason
from jaxfinger.errors import UserError

_NS = 1e-9  # s. Stamps stay whole numbers of ns until their start is subtracted, so that no digit is lost.
_CLOCKS = ("time", "stamp")


@dataclass
class _Topic:
    """Messages of one topic, field by field: the indices of the messages that hold the field, and its values."""

    log: list[int] = field(default_factory=list)  # ns, time at which each message was logged
    stamps: list[int | None] = field(default_factory=list)  # ns, time at which it was made, by its header
    names: list[tuple[str, ...] | None] = field(default_factory=list)  # names of its columns, as in JointState
    values: dict[str, tuple[list[int], list[np.ndarray]]] = field(default_factory=lambda: defaultdict(lambda: ([], [])))


def load_bag(path: Path) -> Recording:
    """Load every numeric field of every topic: (N,), or (N, k) for lists of k numbers.

    `/topic.time` is the time of logging. Messages with a header also have `/topic.stamp`, the time at which they were
    made. Where messages carry a list of names (JointState), these name the columns of their other lists. A field that a
    message lacks is NaN there. Topics that cannot be decoded are left out, with the reason.

    Raises:
        UserError: a package for reading bags is not installed.
    """
    topics: dict[str, _Topic] = defaultdict(_Topic)
    unusable: dict[str, str] = {}
    try:
        for topic, stamp, message in _messages(path):
            if isinstance(message, Exception | str):
                unusable.setdefault(topic, message if isinstance(message, str) else _undecoded(message))
                continue
            _add(topics[topic], stamp, message)
    except ImportError as error:
        raise UserError(f"{path}: needs the package {error.name}; install jaxfinger[bags]") from None
    start = _start(topics.values())
    variables: dict[str, Variable] = {}
    for name, topic in topics.items():
        _collect(name, topic, start, variables, unusable)
    broken = [name for name in unusable if name in topics]
    remarks = tuple(f"some messages of {name} are left out: the topic {unusable.pop(name)}" for name in broken)
    return Recording(path, variables, unusable, remarks)


def _undecoded(error: Exception) -> str:
    said = plain_reason(error)
    return f"cannot be decoded ({type(error).__name__}: {said}); its message definition is not in the recording"


def _start(topics: Iterable[_Topic]) -> int:
    """Start of the recording, ns: the time of logging of the first message of the busiest topic.

    The earliest message of all will not do, since a latched message may be logged at any time.
    """
    busiest = max(topics, key=lambda topic: len(topic.log), default=None)
    return min(busiest.log) if busiest is not None else 0


def _add(topic: _Topic, stamp: int, message: Any) -> None:
    index = len(topic.log)
    topic.log.append(stamp)
    topic.stamps.append(None)
    topic.names.append(None)
    for name, value in _fields(message):
        if name == "stamp" and isinstance(value, int):
            topic.stamps[index] = value
        elif name == "name" and isinstance(value, tuple):
            topic.names[index] = value
        else:
            indices, values = topic.values[name]
            indices.append(index)
            values.append(value)


def _fields(message: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of a message's fields: numbers as arrays, the header's stamp in ns, and the names of columns."""
    items = message.items() if isinstance(message, dict) else vars(message).items()
    for name, value in items:
        inner = prefix + name
        if name == "stamp" and (hasattr(value, "sec") or isinstance(value, dict)):
            stamp = value if isinstance(value, dict) else vars(value)
            if not prefix or prefix == "header.":
                yield "stamp", int(stamp.get("sec", 0)) * 10**9 + int(stamp.get("nanosec", stamp.get("nsec", 0)))
        elif isinstance(value, dict) or hasattr(value, "__msgtype__"):
            yield from _fields(value, "header." if name == "header" and not prefix else f"{inner}.")
        elif name == "name" and not prefix and isinstance(value, list) and value and isinstance(value[0], str):
            yield "name", tuple(map(str, value))
        elif isinstance(value, bool | int | float | np.ndarray | list):
            try:
                array = np.asarray(value)
            except ValueError:  # Nested lists have different lengths.
                continue
            if array.size and array.dtype.kind in "biuf":
                yield inner, array.astype(np.float64)


def _collect(name: str, topic: _Topic, start: int, variables: dict[str, Variable], unusable: dict[str, str]) -> None:
    """Add the variables of a topic to `variables`, or the reason against one to `unusable`."""
    count = len(topic.log)
    clock = f"{name}.time"
    variables[clock] = Variable((np.array(topic.log, object) - start).astype(np.float64) * _NS, units="s")
    if all(stamp is not None for stamp in topic.stamps):
        variables[f"{name}.stamp"] = Variable(
            (np.array(topic.stamps, object) - start).astype(np.float64) * _NS, units="s", clock=clock
        )
    elif any(stamp is not None for stamp in topic.stamps):
        unusable[f"{name}.stamp"] = "is missing in some of its messages; take `time`, when they were logged"
    for key, (indices, values) in topic.values.items():
        # The clocks have the names `time` and `stamp`, so fields with these names get a longer one.
        called = f"{name}.message.{key}" if key in _CLOCKS else f"{name}.{key}"
        widths = sorted({value.shape for value in values})
        names = {topic.names[i] for i in indices} - {None}
        if (
            names
            and widths[0]
            and all(len(topic.names[i] or ()) == len(v) for i, v in zip(indices, values, strict=True))
        ):
            fault = _by_name(called, topic, indices, values, clock, variables)
            if fault:
                unusable[called] = fault
        elif len(widths) > 1:
            turn = next(i for i, value in enumerate(values) if value.shape != values[0].shape)
            before, after = values[0], values[turn]
            if max(before.ndim, after.ndim) == 1 and before.size != after.size:
                change = f"length from {before.size} to {after.size}"
            else:
                change = f"shape from {before.shape} to {after.shape}"
            unusable[called] = (
                f"changes its {change} at message {indices[turn]}; cut the bag there, or log the parts on topics of "
                "their own"
            )
        else:
            array = np.full((count, *widths[0]), np.nan)
            array[indices] = values
            variables[called] = Variable(array.reshape(count, -1) if array.ndim > 2 else array, clock=clock)


def _by_name(
    called: str,
    topic: _Topic,
    indices: Sequence[int],
    values: Sequence[np.ndarray],
    clock: str,
    variables: dict[str, Variable],
) -> str | None:
    """Add a list with named entries to `variables`, a column for each name that occurs; a reason where it cannot be."""
    order: list[str] = []
    for names in dict.fromkeys(topic.names):
        if names is not None and len(set(names)) < len(names):
            double = next(name for name in names if names.count(name) > 1)
            return f"lists {double!r} twice in one message; give each joint its own name"
        order += [name for name in names or () if name not in order]
    place = {name: k for k, name in enumerate(order)}
    array = np.full((len(topic.log), len(order)), np.nan)
    present = np.zeros(array.shape, bool)
    for names in dict.fromkeys(topic.names):
        columns = [place[name] for name in names or ()]
        of_these = [i for i, found in enumerate(topic.names) if found == names]
        present[np.ix_(of_these, columns)] = True
    for index, value in zip(indices, values, strict=True):
        array[index, [place[name] for name in topic.names[index] or ()]] = value
    changing = len({names for names in topic.names if names is not None}) > 1
    variables[called] = Variable(array, tuple(order), clock, present=present if changing else None)
    return None


def _messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Topic, time in ns and content of every message; the reason takes the place of content that cannot be decoded."""
    return _mcap_messages(path) if path.suffix.lower() == ".mcap" else _rosbag_messages(path)


def _rosbag_messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, stamp, raw in reader.messages():
            try:
                message = reader.deserialize(raw, connection.msgtype)
            except KeyError:
                message = f"is of the type {connection.msgtype}, whose definition the recording does not carry"
            except Exception as error:  # It concerns one topic; the others are still read.
                message = error
            yield connection.topic, stamp, message


def _mcap_messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Messages of an MCAP file in JSON, or in CDR by the file's own definitions. A cut file is read up to the cut."""
    from mcap.exceptions import EndOfFile
    from mcap.reader import NonSeekingReader

    decoders: dict[int, Any] = {}
    with path.open("rb") as file:
        try:
            for schema, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
                yield channel.topic, message.log_time, _decoded(schema, channel, message, decoders)
        except (EndOfFile, struct.error):  # The file is cut between two records, or inside one.
            return


def _decoded(schema: Any, channel: Any, message: Any, decoders: dict[int, Any]) -> Any:
    encoding = channel.message_encoding
    try:
        if encoding == "json":
            content = json.loads(message.data)
            return content if isinstance(content, dict) else {"value": content}
        if encoding == "cdr" and schema is not None:
            if channel.id not in decoders:
                decoders[channel.id] = _ros_decoder(schema)
            return decoders[channel.id](message.data)
    except Exception as error:  # It concerns one topic; the others are still read.
        return error
    return f"is in {encoding or 'an unnamed encoding'}, which is not read (JSON and CDR are); convert it"


def _ros_decoder(schema: Any) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    known = get_types_from_msg(schema.data.decode(), schema.name)
    store.register({name: fields for name, fields in known.items() if name not in store.types})
    return lambda data: store.deserialize_cdr(data, schema.name)
