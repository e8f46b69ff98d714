"""JSON recordings: lists of numbers by name, or one object a sample, as a list or as JSON Lines."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxfinger.data.importing.arrays import named_arrays
from jaxfinger.data.importing.recording import Recording
from jaxfinger.errors import UserError

_UNITS = "unit", "units"  # names of members that state units
_VALUES = "value", "values", "data", "samples", "y"  # and of those beside them that are in these


def load_json(path: Path) -> Recording:
    """Load every list of numbers, samples first.

    Members of objects are named `outer.inner`, and so are those of the objects in a list, one object a sample. What a
    sample lacks is NaN, true and false are 1 and 0.

    Raises:
        UserError: the file is no JSON, or holds two variables of one name.
    """
    text = path.read_text(encoding="utf-8-sig")
    if path.suffix.lower() == ".json" and not _is_object_in_each_line(text):
        leaves = list(_leaves(_parsed(path, text, 1), ""))
        return named_arrays(path, leaves, _stated_units(leaves))
    lines = [(number, line) for number, line in enumerate(text.splitlines(), start=1) if line.strip()]
    remarks = ()
    if len(lines) > 1 and not lines[-1][1].rstrip().endswith(("}", "]")):
        lines, remarks = lines[:-1], ("its last line is cut short and is left out",)
    tree = [_parsed(path, line, number) for number, line in lines]
    return replace(named_arrays(path, _leaves(tree, "")), remarks=remarks)


def _is_object_in_each_line(text: str) -> bool:
    """Whether the first two lines are objects each, as in JSON Lines."""
    lines = [line.strip() for line in text.lstrip().split("\n", 2)[:2]]
    return len(lines) == 2 and all(line.startswith("{") and line.endswith("}") for line in lines)


def _parsed(path: Path, text: str, first: int) -> Any:
    """Parse text whose first line has the number `first` in the file."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        where = f"line {first + error.lineno - 1}, column {error.colno}"
        raise UserError(f"{path}: is no JSON ({error.msg}, {where}); export the recording again") from None


def _stated_units(leaves: Sequence[tuple[str, Any]]) -> dict[str, str]:
    """Units by variable, as in `{"angle": {"values": […], "unit": "deg"}}` or `{"q": […], "units": {"q": "deg"}}`."""
    units = {}
    for name, value in leaves:
        *outer, last = name.split(".")
        if isinstance(value, str) and last in _UNITS:
            units |= {".".join([*outer, values]): value for values in _VALUES}
        elif isinstance(value, str) and outer[-1:] and outer[-1] in _UNITS:
            units[".".join([*outer[:-1], last])] = value
    return units


def _leaves(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Names and values of the lists and numbers in the tree.

    Objects whose members are numbered are lists, and those of names, `columns`, and rows, `data`, tables: pandas writes
    both.
    """
    if isinstance(tree, Mapping) and len(tree) > 1 and all(str(key) == str(k) for k, key in enumerate(tree)):
        tree = list(tree.values())
    if isinstance(tree, Mapping) and isinstance(tree.get("columns"), list) and isinstance(tree.get("data"), list):
        columns = zip(*tree["data"], strict=True)
        tree = dict(zip(map(str, tree["columns"]), map(list, columns), strict=True))
    if isinstance(tree, list) and any(isinstance(item, Mapping) for item in tree):
        objects = [item if isinstance(item, Mapping) else {} for item in tree]
        members = dict.fromkeys(key for item in objects for key in item)
        tree = {key: [item.get(key) for item in objects] for key in members}
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _leaves(value, f"{name}.{key}" if name else str(key))
    else:
        yield name or "values", tree
