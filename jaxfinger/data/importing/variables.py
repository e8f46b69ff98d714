"""Variables of a recording as a mapping names them: recorded ones and derived ones, their columns, and scales."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxfinger.data.importing.expressions import ExpressionError, evaluate, units_of
from jaxfinger.data.importing.mapping import Reading
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.toml import Place
from jaxfinger.data.units import TO_SI, unit_name
from jaxfinger.errors import listed

UNKNOWN = "?"  # what a proposal writes in place of a name that it cannot guess


@dataclass(frozen=True)
class Source:
    """A recording, with the variables that a mapping derives from it."""

    recording: Recording
    constants: Mapping[str, Any] = field(default_factory=dict)
    derived: Mapping[str, str] = field(default_factory=dict)

    def variable(self, name: str, where: Place, within: tuple[str, ...] = ()) -> Variable:
        """Variable of this name: the derived one, else the recording's.

        `within` are the names of the derived variables that are being computed; `where` is the place to blame.

        Raises:
            UserError: there is no such variable, or it gives no numbers, or it is derived from itself.
        """
        if name in self.derived and name not in within:
            return self._derive(name, where, within)
        if name in self.recording.variables:
            return self.recording.variables[name]
        said = f"reads the variable {name!r} of {self.recording.path.name}"
        for candidate in (name, *(name[:i] for i in range(len(name) - 1, 0, -1) if name[i] == ".")):
            if candidate in self.recording.unusable:
                where.fail(f"{said}, but {candidate} {self.recording.unusable[candidate]}")
        if name in within:
            where.fail(f"derives {name!r} from itself, and the recording has no variable of this name; name another")
        there = sorted([*self.recording.variables, *self.derived])
        if name == UNKNOWN:
            rate = ", or write `rate_hz` in place of `time`" if where.keys[-1:] == ("time",) else ""
            where.fail(
                f"is still to be filled in; name a variable of {self.recording.path.name}{rate}: {listed(there, 30)}"
            )
        elsewhere = "; move what only some recordings hold to their trials" if where.keys[:1] == ("channels",) else ""
        return where.fail(f"{said}, which the recording has not; it has {listed(there, 30)}{elsewhere}")

    @property
    def words(self) -> dict[str, np.ndarray]:
        """Recorded variables of words that no derived variable replaces."""
        return {name: words for name, words in self.recording.words.items() if name not in self.derived}

    def _derive(self, name: str, where: Place, within: tuple[str, ...]) -> Variable:
        where = where / "derived" / name
        text = self.derived[name]
        clocks: dict[str, str] = {}
        units: dict[str, str] = {}

        def lookup(inner: str, column: Any) -> np.ndarray:
            if inner == name and inner in self.recording.variables:
                variable = self.recording.variables[inner]
            else:
                variable = self.variable(inner, where, (*within, name))
            clocks[inner], unit = variable.clock, unit_name(variable.units)
            # A number that is added to a temperature may convert it.
            units[inner] = unit if unit and TO_SI[unit].si not in ("K", "1") else ""
            if variable.present is not None:
                where.fail(f"uses {inner!r}, whose names change from message to message; map its columns by name")
            return variable.values if column is None else column_of(variable, inner, column, where)[0]

        try:
            values = np.asarray(evaluate(text, lookup, self.constants, self.words), np.float64)
            unit = units_of(text, lambda inner: units.get(inner, ""), self.constants)
        except ExpressionError as error:
            where.fail(f"{text!r} {error}")
        if len(set(clocks.values())) > 1:
            of = ", ".join(f"{inner} on {clock or 'none'}" for inner, clock in clocks.items())
            where.fail(f"joins variables that have different clocks ({of}); derive one variable for each clock")
        if values.ndim not in (1, 2):
            where.fail("gives a single number and no samples; put it into [constants]")
        return Variable(values, clock=next(iter(clocks.values()), ""), units=unit)


def column_of(variable: Variable, name: str, column: Any, where: Place) -> tuple[np.ndarray, int]:
    """Column of a variable by its number or name, and its number."""
    values, names = variable.values, variable.columns
    if values.ndim == 1:
        if column not in (None, 0):
            where.fail(f"reads column {column!r} of {name!r}, which has one column; leave `column` out")
        return np.atleast_1d(values), 0
    if isinstance(column, str):
        if column not in names:
            there = listed(names) if names else "no names of columns"
            where.fail(f"reads column {column!r} of {name!r}, which has {there}; choose one of them")
        column = names.index(column)
    elif variable.present is not None:
        groups = np.unique(variable.present, axis=0)[::-1]
        kinds = "; ".join(", ".join(np.array(names)[row]) for row in groups if row.any())
        where.fail(
            f"reads {name!r}, whose names change from message to message ({kinds}); choose by name, as column = "
            f"{names[0]!r}"
        )
    elif column is None and values.shape[1] == 1:
        column = 0
    if isinstance(column, bool) or not isinstance(column, int) or not 0 <= column < values.shape[1]:
        called = f" ({listed(names)})" if names else ""
        where.fail(f"reads {name!r}, which has {values.shape[1]} columns{called}; choose one by `column`, from 0")
    return values[:, column], column


def scale_of(reading: Reading, source: Source, where: Place) -> float:
    """Scale of a reading: a number, or the single one of the constant or variable that it names."""
    name, where = reading.scale, where / "scale"
    if not isinstance(name, str):
        return name
    values = np.asarray(source.constants.get(name) if name in source.constants else source.variable(name, where).values)
    if values.size != 1:
        where.fail(f"is scaled by {name!r}, which holds {values.size} values; name a single number")
    return float(values.reshape(-1)[0])
