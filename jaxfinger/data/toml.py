"""Reader of TOML files: a file becomes a frozen dataclass, or an error that names file, line and key in one sentence.

A dataclass declares a table: its fields are the keys, with their types. Unknown keys, values of another type and
missing required keys are refused. Values are not converted, except whole numbers to floats. A field whose key is a
word of Python ends in an underscore (`from_` reads `from`).

tomllib reads the values, tree-sitter finds their lines, and cattrs selects the function that reads a type.
"""

from __future__ import annotations

import functools
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from datetime import date, datetime
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

import cattrs
import tree_sitter
import tree_sitter_toml

from jaxfinger.errors import UserError, did_you_mean

T = TypeVar("T")
Keys = tuple[str | int, ...]


class Fault(ValueError):
    """Fault of a value. The message is the end of a sentence whose subject is the key, at the path `keys` from here."""

    def __init__(self, message: str, *keys: str | int):
        super().__init__(message)
        self.message, self.keys = message, keys


@dataclass(frozen=True)
class Within:
    """Annotation of a number with bounds: `Annotated[float, Within(0.1, 100.0, "N")]`. `above` excludes the lower."""

    low: float = -math.inf
    high: float = math.inf
    unit: str = ""
    above: bool = False

    def check(self, value: float) -> None:
        """Raise Fault where the value lies outside."""
        if self.low <= value <= self.high and not (self.above and value == self.low):
            return
        unit = f" {self.unit}" if self.unit else ""
        if self.high == math.inf:
            raise Fault(f"is {value:g}{unit}; it must be {'above' if self.above else 'at least'} {self.low:g}{unit}")
        raise Fault(f"is {value:g}{unit}, which is outside {self.low:g} to {self.high:g}{unit}")


@dataclass(frozen=True)
class OneOf:
    """Annotation of a name, or a list of names, with the known ones: `Annotated[str, OneOf(EXPERIMENT_NAMES)]`."""

    known: tuple[str, ...]

    def check(self, value: str) -> None:
        """Raise Fault where the name is none of them."""
        one_of(value, self.known)


@dataclass(frozen=True)
class NotEmpty:
    """Annotation of a list that may not be empty."""


Positive = Annotated[float, Within(0.0, above=True)]
Share = Annotated[float, Within(0.0, 1.0)]


@dataclass(frozen=True)
class Place:
    """Place of a key in a file, for messages about it. `lines` is None for content that was never text."""

    file: str
    lines: Mapping[Keys, int] | None = field(default=None, repr=False)
    keys: Keys = ()

    def __truediv__(self, key: str | int) -> Place:
        return Place(self.file, self.lines, (*self.keys, key))

    @property
    def key(self) -> str:
        """Key as text, such as `finger.joints[0].mass`."""
        return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in self.keys).removeprefix(".")

    @property
    def line(self) -> int | None:
        """Line of the key, from 1; for a missing key the line of its table."""
        if self.lines is None:
            return None
        ends = range(len(self.keys), 0, -1)
        return next((self.lines[self.keys[:end]] for end in ends if self.keys[:end] in self.lines), 1)

    def fail(self, message: str) -> NoReturn:
        """Raise UserError with a message about this key."""
        where = self.file if self.line is None else f"{self.file}, line {self.line}"
        raise UserError(f"{where}: {self.key + ': ' if self.keys else ''}{message}") from None


@dataclass(frozen=True)
class Document:
    """Parsed TOML file: its text, its content as dictionaries, and the place of its keys."""

    path: Path
    text: str
    content: Mapping[str, Any]
    place: Place

    def read(self, kind: type[T]) -> T:
        """Content of the file as a dataclass.

        Raises:
            UserError: a key is unknown or missing, or a value has a wrong type or is out of range.
        """
        return structure(self.content, kind, self.place)


def read_toml(path: str | Path, mend: str = "give the path of a TOML file") -> Document:
    """Parse a file. `mend` is the advice in the message if it cannot be read.

    Raises:
        UserError: the file cannot be read, or is not TOML.
    """
    path = Path(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); {mend}") from None
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw[: error.start].count(b"\n") + 1
        raise UserError(f"{path}, line {line}: is not text in UTF-8; save the file as UTF-8") from None
    return parse_toml(text, path)


# What is often wrong in a line that is no TOML, and its mend.
_MENDS = (
    (r"[“”„‟‘’‚«»]", "write straight quotes"),
    (r'"[^"]*\\[^"]*"', "write this path in single quotes, or with / in place of \\"),
    (r"=\s*[+-]?\d+,\d+\s*[,}]", "write decimals with a point"),
)


def parse_toml(text: str, path: str | Path) -> Document:
    """Parse the text of the file `path`.

    Raises:
        UserError: the text is not TOML.
    """
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise UserError(f"{path}, line 1: is nested too deeply; no file of jaxfinger is") from None
    except ValueError as error:  # This includes integers of thousands of digits.
        found = re.search(r" \(at (?:line (\d+), column \d+|end of document)\)", str(error))
        line = int(found[1]) if found and found[1] else len(text.splitlines()) or 1
        said = str(error)[: found.start()] if found else str(error)
        wrong = text.splitlines()[line - 1 : line]
        mend = next((m for pattern, m in _MENDS if any(re.search(pattern, x) for x in wrong)), "mend this line")
        raise UserError(f"{path}, line {line}: is not valid TOML ({said}); {mend}") from None
    return Document(Path(path), text, content, Place(str(path), _lines(text)))


def structure(content: Any, kind: type[T], place: Place) -> T:
    """Convert nested dictionaries, such as parsed TOML, to a dataclass.

    Raises:
        UserError: a key is unknown or missing, or a value has a wrong type or is out of range.
    """
    try:
        return _CONVERTER.structure(content, kind)
    except Fault as fault:
        for key in fault.keys:
            place = place / key
        place.fail(fault.message)


def quoted(text: str) -> str:
    """Quote and escape a string for TOML."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in escaped) + '"'


def as_key(text: str) -> str:
    """Key for TOML, quoted only where it must be."""
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else quoted(text)


# --- Lines ------------------------------------------------------------------------------------------------------------


def _lines(text: str) -> dict[Keys, int]:
    """Line of every key and of every element of a list, from 1."""
    root = tree_sitter.Parser(_language()).parse(text.encode()).root_node
    lines: dict[Keys, int] = {}
    counts: dict[Keys, int] = {}

    def resolved(names: Sequence[str]) -> Keys:
        """Path of a header. After the name of an array of tables comes the index of its last element."""
        path: Keys = ()
        for name in names:
            path = (*path, name)
            if path in counts:
                path = (*path, counts[path] - 1)
        return path

    def note(path: Keys, line: int) -> None:
        for end in range(1, len(path) + 1):
            lines.setdefault(path[:end], line)

    def value(node: tree_sitter.Node, path: Keys) -> None:
        if node.type == "inline_table":
            pairs(node, path)
        elif node.type == "array":
            for i, item in enumerate(child for child in node.named_children if child.type != "comment"):
                note((*path, i), item.start_point.row + 1)
                value(item, (*path, i))

    def pairs(node: tree_sitter.Node, path: Keys) -> None:
        for child in node.named_children:
            if child.type == "pair" and len(child.named_children) >= 2:
                whole = (*path, *_names(child.named_children[0]))
                note(whole, child.start_point.row + 1)
                value(child.named_children[1], whole)

    pairs(root, ())
    for table in root.named_children:
        if table.type not in ("table", "table_array_element"):
            continue
        *outer, last = _names(table.named_children[0])
        path = (*resolved(outer), last)
        if table.type == "table_array_element":
            counts[path] = counts.get(path, 0) + 1
            path = (*path, counts[path] - 1)
        note(path, table.start_point.row + 1)
        pairs(table, path)
    return lines


@functools.cache
def _language() -> tree_sitter.Language:
    return tree_sitter.Language(tree_sitter_toml.language())


def _names(key: tree_sitter.Node) -> list[str]:
    """Parts of a key, which may be bare, quoted or dotted."""
    names: list[str] = []
    table = tomllib.loads(f"{(key.text or b'').decode()} = 0")
    while isinstance(table, dict):
        ((name, table),) = table.items()
        names.append(name)
    return names


# --- Types ------------------------------------------------------------------------------------------------------------


def _at(key: str | int, hook: Callable[[Any, Any], Any], value: Any, kind: Any) -> Any:
    """Result of a hook; a fault is raised with the key put before its path."""
    try:
        return hook(value, kind)
    except Fault as fault:
        raise Fault(fault.message, key, *fault.keys) from None


def shown(value: Any) -> str:
    """Value as TOML writes it, shortened to fit into a message."""
    if isinstance(value, Mapping):
        return "a table"
    text = str(value).lower() if isinstance(value, bool) else str(value) if hasattr(value, "isoformat") else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _number(value: Any, _: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise Fault(f"must be a number, not {shown(value)}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise Fault(f"must be a finite number, not {shown(value)}")
    return number


def _whole(value: Any, _: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or abs(value) >= 2**63:
        raise Fault(f"must be a whole number, not {shown(value)}")
    return value


def _flag(value: Any, _: Any) -> bool:
    if not isinstance(value, bool):
        raise Fault(f"must be true or false, not {shown(value)}")
    return value


def _text(value: Any, _: Any) -> str:
    if not isinstance(value, str):
        raise Fault(f"must be a string in quotes, not {shown(value)}")
    return value


def one_of(value: Any, known: Sequence[str]) -> str:
    """Return the value if it is one of the known names.

    Raises:
        Fault: it is not.
    """
    if not isinstance(value, str) or value not in known:
        raise Fault(f"is {shown(value)}{did_you_mean(value, known)}; choose one of {', '.join(known)}")
    return value


def _annotated(kind: Any) -> Callable[[Any, Any], Any]:
    base, *notes = get_args(kind)
    hook = _CONVERTER.get_structure_hook(base)
    checks = [note for note in notes if hasattr(note, "check")]

    def read(value: Any, _: Any) -> Any:
        result = hook(value, base)
        if not result and any(isinstance(note, NotEmpty) for note in notes):
            raise Fault("is empty; give at least one")
        for note in checks:
            if not isinstance(result, tuple):
                note.check(result)
                continue
            for i, item in enumerate(result):
                _at(i, lambda x, _, note=note: note.check(x), item, None)
        return result

    return read


def _tuple(kind: Any) -> Callable[[Any, Any], Any]:
    args = get_args(kind)
    any_length = len(args) == 2 and args[1] is Ellipsis
    hooks = [(_CONVERTER.get_structure_hook(arg), arg) for arg in (args[:1] if any_length else args)]
    tables = is_dataclass(args[0]) or get_origin(args[0]) in (dict, Mapping)
    what = "tables" if tables else {float: "numbers", int: "whole numbers", str: "strings"}.get(args[0], "lists")

    def read(value: Any, _: Any) -> Any:
        if not isinstance(value, list | tuple) or not (any_length or len(value) == len(hooks)):
            count = "" if any_length else f"{len(hooks)} "
            said = f"{len(value)}" if isinstance(value, list | tuple) else shown(value)
            raise Fault(f"must be a list of {count}{what}, not {said}")
        each = hooks * len(value) if any_length else hooks
        return tuple(_at(i, hook, item, arg) for i, (item, (hook, arg)) in enumerate(zip(value, each, strict=True)))

    return read


def _mapping(kind: Any) -> Callable[[Any, Any], Any]:
    _, inner = get_args(kind)
    hook = _CONVERTER.get_structure_hook(inner)

    def read(value: Any, _: Any) -> Any:
        if not isinstance(value, Mapping):
            raise Fault(f"must be a table, not {shown(value)}")
        return {key: _at(key, hook, item, inner) for key, item in value.items()}

    return read


def _union(kind: Any) -> Callable[[Any, Any], Any]:
    """Reader of a union: it takes the first member that fits the value's TOML type."""
    members = [arg for arg in get_args(kind) if arg is not NoneType]
    hooks = [(_CONVERTER.get_structure_hook(member), member) for member in members]

    def fits(value: Any, member: Any) -> bool:
        base = get_args(member)[0] if get_origin(member) is Annotated else member
        if is_dataclass(base) or get_origin(base) in (dict, Mapping):
            return isinstance(value, Mapping)
        if get_origin(base) is tuple:
            return isinstance(value, list | tuple)
        if base is float:
            return isinstance(value, int | float) and not isinstance(value, bool)
        return isinstance(value, base) and not (base is int and isinstance(value, bool))

    def name(member: Any) -> str:
        base = get_args(member)[0] if get_origin(member) is Annotated else member
        plain = {str: "a string", float: "a number", int: "a whole number", bool: "true or false", datetime: "a date"}
        return plain.get(base, "a list" if get_origin(base) is tuple else "a table")

    def read(value: Any, _: Any) -> Any:
        if value is None and NoneType in get_args(kind):  # TOML has no null; Python's defaults may be None.
            return None
        if len(hooks) == 1:
            return hooks[0][0](value, members[0])
        for hook, member in hooks:
            if fits(value, member):
                return hook(value, member)
        raise Fault(f"must be {' or '.join(dict.fromkeys(map(name, members)))}, not {shown(value)}")

    return read


def _table(kind: Any) -> Callable[[Any, Any], Any]:
    """Reader of a dataclass. It reports unknown keys first, since misspelt ones explain those that are missing."""
    hints = get_type_hints(kind, include_extras=True)
    keys = {f.name: f.name.rstrip("_") for f in fields(kind)}
    required = [keys[f.name] for f in fields(kind) if f.default is MISSING and f.default_factory is MISSING]
    hooks = {key: (name, _CONVERTER.get_structure_hook(hints[name]), hints[name]) for name, key in keys.items()}

    def read(value: Any, _: Any) -> Any:
        if not isinstance(value, Mapping):
            raise Fault(f"must be a table, not {shown(value)}")
        for key in value:
            if key not in hooks:
                raise Fault(f"is unknown{did_you_mean(key, hooks)}; it may be one of {', '.join(hooks)}", key)
        for key in required:
            if key not in value:
                raise Fault(f"is missing; add a line '{key} = …'", key)
        values = {}
        for key, item in value.items():
            name, hook, hint = hooks[key]
            values[name] = _at(key, hook, item, hint)
        return kind(**values)

    return read


def _converter() -> cattrs.Converter:
    converter = cattrs.Converter()
    for kind, hook in ((float, _number), (int, _whole), (bool, _flag), (str, _text)):
        converter.register_structure_hook(kind, hook)
    for kind in (Any, datetime, date):
        converter.register_structure_hook(kind, lambda value, _: value)
    for predicate, factory in (
        (lambda kind: isinstance(kind, type) and is_dataclass(kind), _table),
        (lambda kind: get_origin(kind) is tuple, _tuple),
        (lambda kind: get_origin(kind) in (dict, Mapping), _mapping),
        (lambda kind: get_origin(kind) in (Union, UnionType), _union),
        (lambda kind: get_origin(kind) is Annotated, _annotated),
        (
            lambda kind: get_origin(kind) is Literal,
            lambda kind: lambda value, _: one_of(value, get_args(kind)),
        ),
    ):
        converter.register_structure_hook_factory(predicate, factory)
    return converter


_CONVERTER = _converter()
