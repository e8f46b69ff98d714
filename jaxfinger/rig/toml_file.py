"""TOML read strictly: every complaint names file, line and the mend; a key that nobody asked for is a complaint too."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from jaxfinger.errors import UserError

_HEADER = re.compile(r"^\s*(\[\[?)\s*([\w.\-]+)\s*\]\]?")


@dataclass
class Table:
    """One table of the file, by its `name` and, in an array of tables, its index."""

    path: Path
    text: str
    values: dict[str, Any]
    name: str = ""
    index: int = 0
    seen: set[str] = field(default_factory=set)

    def line(self, key: str | None = None) -> int:
        """Line of the key, else of the table's header (1 is the first)."""
        count, inside, header = -1, self.name == "", 1
        for number, line in enumerate(self.text.splitlines(), 1):
            if found := _HEADER.match(line):
                count += found.group(2) == self.name
                inside = found.group(2) == self.name and count == self.index
                header = number if inside else header
            elif inside and key is not None and re.match(rf'^\s*"?{re.escape(key)}"?\s*=', line):
                return number
        return header

    def fail(self, key: str | None, message: str) -> NoReturn:
        """Raise UserError at the line of `key`."""
        raise UserError(f"{self.path.name}, line {self.line(key)}: {message}")

    def get(self, key: str, default: Any = ...) -> Any:
        """The value of `key`; without a default it must be there."""
        self.seen.add(key)
        if key not in self.values and default is ...:
            self.fail(None, f"'{key}' is missing in [{self.name or 'the file'}]; add a line '{key} = …'.")
        return self.values.get(key, default)

    def text_of(self, key: str, default: Any = ..., choices: Sequence[str] | None = None) -> str:
        """A string, one of `choices` where they are given."""
        value = self.get(key, default)
        if value is default:
            return value
        if not isinstance(value, str):
            self.fail(key, f"'{key}' must be a string in quotes, not {value!r}.")
        if choices is not None and value not in choices:
            self.fail(key, f"'{key}' is {value!r}; choose one of {', '.join(choices)}.")
        return value

    def number(
        self, key: str, default: Any = ..., low: float = -math.inf, high: float = math.inf, unit: str = ""
    ) -> float:
        """A finite number within [low, high]."""
        value = self.get(key, default)
        if value is default and default is None:
            return value
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            self.fail(key, f"'{key}' must be a number{f' in {unit}' if unit else ''}, not {value!r}.")
        if not low <= value <= high:
            self.fail(key, f"'{key}' = {value:g} {unit} is outside {low:g} to {high:g}.")
        return float(value)

    def integer(self, key: str, default: Any = ..., low: int = 0, high: int = 2**31) -> int:
        """An integer within [low, high]."""
        value = self.number(key, default, low, high)
        if value != int(value):
            self.fail(key, f"'{key}' must be a whole number, not {value!r}.")
        return int(value)

    def flag(self, key: str, default: Any = ...) -> bool:
        """true or false."""
        value = self.get(key, default)
        if not isinstance(value, bool):
            self.fail(key, f"'{key}' must be true or false, not {value!r}.")
        return value

    def vector(self, key: str, default: Any = ..., length: int | None = None) -> list[float]:
        """A list of finite numbers."""
        value = self.get(key, default)
        good = isinstance(value, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in value
        )
        if not good or (length is not None and len(value) != length):
            self.fail(
                key, f"'{key}' must be a list of {length if length is not None else 'some'} numbers, not {value!r}."
            )
        return [float(v) for v in value]

    def names(self, key: str, default: Any = ...) -> list[str]:
        """A list of strings."""
        value = self.get(key, default)
        if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
            self.fail(key, f"'{key}' must be a list of names in quotes, not {value!r}.")
        return list(value)

    def table(self, key: str, required: bool = True) -> Table | None:
        """The table [key]."""
        value = self.get(key, ... if required else None)
        if value is None:
            return None
        if not isinstance(value, dict):
            self.fail(key, f"'{key}' must be a table, written [{self._child(key)}].")
        return Table(self.path, self.text, value, self._child(key))

    def tables(self, key: str, required: bool = True) -> list[Table]:
        """The array of tables [[key]]."""
        value = self.get(key, ... if required else [])
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value) or (required and not value):
            self.fail(key, f"'{key}' must be an array of tables, each headed [[{self._child(key)}]].")
        return [Table(self.path, self.text, v, self._child(key), i) for i, v in enumerate(value)]

    def _child(self, key: str) -> str:
        return f"{self.name}.{key}" if self.name else key

    def finish(self) -> None:
        """Complain about keys that were never asked for: a misspelt limit must not pass as an absent one."""
        for key in self.values:
            if key not in self.seen:
                known = ", ".join(sorted(self.seen))
                self.fail(key, f"'{key}' is unknown in [{self.name or 'the file'}]; known are {known}.")


def read_toml(path: str | Path) -> Table:
    """Parse a TOML file; raises UserError with the line."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read ({error}); give the path of a TOML file.") from error
    return parse_toml(text, path)


def parse_toml(text: str, path: Path) -> Table:
    """Parse TOML text that came from `path`."""
    try:
        return Table(path, text, tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path.name}: not valid TOML: {error}.") from error
