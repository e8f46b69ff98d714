"""JSON recordings: lists of numbers by name, or one object a sample, as a list or as JSON Lines."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from jaxfinger.data.importing.arrays import named_arrays
from jaxfinger.data.importing.recording import Recording
from jaxfinger.errors import UserError

_LINES = (".jsonl", ".ndjson")


def load_json(path: Path) -> Recording:
    """Load every list of numbers, samples first.

    Members of objects are named `outer.inner`, and so are those of the objects in a list, one object a sample. What a
    sample lacks is NaN, true and false are 1 and 0.

    Raises:
        UserError: the file is no JSON, or holds two variables of one name.
    """
    text = path.read_text(encoding="utf-8-sig")
    if path.suffix.lower() in _LINES:
        lines = enumerate(text.splitlines(), start=1)
        tree = [_parsed(path, line, number, "export the recording again") for number, line in lines if line.strip()]
    else:
        tree = _parsed(path, text, 1, "export the recording again, with the ending .jsonl if each line is an object")
    return named_arrays(path, _leaves(tree, ""))


def _parsed(path: Path, text: str, first: int, mend: str) -> Any:
    """Parse text whose first line has the number `first` in the file."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        where = f"line {first + error.lineno - 1}, column {error.colno}"
        raise UserError(f"{path}: is no JSON ({error.msg}, {where}); {mend}") from None


def _leaves(tree: Any, name: str) -> Iterator[tuple[str, Any]]:
    """Names and values of the lists and numbers in the tree."""
    if isinstance(tree, list) and any(isinstance(item, Mapping) for item in tree):
        objects = [item if isinstance(item, Mapping) else {} for item in tree]
        members = dict.fromkeys(key for item in objects for key in item)
        tree = {key: [item.get(key) for item in objects] for key in members}
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from _leaves(value, f"{name}.{key}" if name else str(key))
    else:
        yield name or "values", tree
