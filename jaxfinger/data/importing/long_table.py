"""Long tables, with one row a sample and signal, as variables that have clocks of their own.

    time, signal, value          time, joint, position, torque
    0.000, angle_MCP, 0.51       0.000, MCP, 0.51, 0.02
    0.000, force_T1, 2.03        0.000, PIP, 0.33, 0.01
    0.001, angle_MCP, 0.52       0.001, MCP, 0.52, 0.02

The first gives the variables `angle_MCP` and `force_T1`, the second `MCP.position`, `MCP.torque`, `PIP.position` and
`PIP.torque`. Signals that do not share their times have clocks such as `angle_MCP.time`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
from jaxtyping import Bool

from jaxfinger.data.importing.names import is_clock
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.units import TO_SI, unit_name, without_units
from jaxfinger.errors import UserError, listed

# Names of the column that says which signal a row is of, beside a column that is called a value; and of one that says
# whose the row is.
_SIGNAL = r"signal|topic|channel|kanal|variable|sensor|name|metric|field|measurement|quantity|parameter|key|tag|path"
_OWNER = r"joint|motor|servo|actuator|drive|axis|dof|tendon|finger|sensor|channel|device|dev|node|can|board|module"
_OWNER += r"|source|src|sender|port|bus|message|msg|type|kind|tag"
_WHOSE = rf"(?=.)({_OWNER})?[_ ]?(name|id|index|number|no|nr|type)?"
_VALUE = r"(value|val|data|reading|wert|messwert|valeur)s?"
_UNIT = r"units?|einheit"
_MAX_LABELS = 100  # different signals; more are no names
# Of the rows: rows of several joints alternate, also where one has ten for each of another, and phases of an experiment
# do not.
_MIN_CHANGES = 0.1
_FIRST = "column 0"  # name of the first column of a table without names
_MIN_PERIODIC = 0.8  # of the rows: numbers of joints return in turn, other whole numbers do not.


def widened(recording: Recording) -> Recording:
    """Recording with a variable for each signal of a long table; other recordings as they are.

    Raises:
        UserError: its rows begin with the tags of several devices, and its columns have no names.
    """
    table = _rows_of(recording, slice(None))
    value = next((name for name in table.variables if re.fullmatch(_VALUE, _plain(name))), "")
    keys = _keys(table, bool(value))
    if not keys:
        return recording
    labels = np.array([".".join(row) for row in zip(*keys.values(), strict=True)])
    parts = {
        str(label): _with_stated_unit(_rows_of(recording, labels == label, without=list(keys)), value)
        for label in dict.fromkeys(labels.tolist())
    }
    first = next(iter(parts.values()))
    clock = next((name for name, v in first.variables.items() if is_clock(name, v.values, v.units)), "")
    shared = not clock or all(
        np.array_equal(part.variables[clock].values, first.variables[clock].values) for part in parts.values()
    )
    variables: dict[str, Variable] = {}
    unusable: dict[str, str] = {}
    words: dict[str, np.ndarray] = {}
    for label, part in parts.items():
        called = {name: label if name == value else f"{label}.{name}" for name in (*part.variables, *part.unusable)}
        called[clock] = clock if shared else f"{label}.{clock}"
        for name, variable in part.variables.items():
            timed = "" if shared or name == clock else called[clock]
            variables[called[name]] = replace(_in_seconds(variable) if name == clock else variable, clock=timed)
        unusable |= {called[name]: reason for name, reason in part.unusable.items()}
        words |= {called[name]: cells for name, cells in part.words.items()}
    return replace(recording, variables=variables, unusable=unusable, words=words)


def _rows_of(recording: Recording, rows: slice | Bool[np.ndarray, " N"], without: Collection[str] = ()) -> Recording:
    """Some rows of the longest columns of a recording, without columns that have no value in them."""
    count = max((len(v.values) for v in recording.variables.values()), default=0)
    variables = {
        name: replace(v, values=v.values[rows])
        for name, v in recording.variables.items()
        if len(v.values) == count and name not in without and np.isfinite(v.values[rows]).any()
    }
    words = {k: x[rows] for k, x in recording.words.items() if len(x) == count and k not in without}
    unusable = {name: reason for name, reason in recording.unusable.items() if name not in without}
    return replace(recording, variables=variables, unusable=unusable, words=words)


def _with_stated_unit(part: Recording, value: str) -> Recording:
    """Rows of one signal, whose `value` has the unit that a column of theirs states."""
    column = next((name for name in part.words if re.fullmatch(_UNIT, _plain(name))), "")
    if not column or value not in part.variables:
        return part
    units = np.unique(part.words[column]).tolist()
    variables, unusable = dict(part.variables), {k: v for k, v in part.unusable.items() if k != column}
    stated = variables.pop(value)
    if len(units) == 1:
        variables[value] = replace(stated, units=units[0])
    else:
        unusable[value] = f"has values in different units ({listed(units)}); write one unit throughout"
    words = {name: cells for name, cells in part.words.items() if name != column}
    return replace(part, variables=variables, unusable=unusable, words=words)


def _keys(table: Recording, valued: bool) -> dict[str, list[str]]:
    """Columns that tell which signal each row is of, as words. `valued` says whether a column is called a value."""
    found = {}
    for name, cells in table.words.items():
        several = 1 < len(np.unique(cells)) <= _MAX_LABELS
        alternates = np.mean(cells[1:] != cells[:-1]) > _MIN_CHANGES
        if several and alternates and name == _FIRST:
            _refuse_tags(table.path, list(dict.fromkeys(cells.tolist())))
        whose = re.fullmatch(_WHOSE, _plain(name)) if alternates else None
        in_turn = several and _takes_turns(np.unique(cells, return_inverse=True)[1])
        if several and (whose or in_turn or (valued and re.fullmatch(_SIGNAL, _plain(name)))):
            found[name] = cells.tolist()
    for name, variable in table.variables.items():
        if name == _FIRST and len(table.variables) > 1 and _takes_turns(variable.values):
            _refuse_tags(table.path, [f"{x:g}" for x in dict.fromkeys(variable.values.tolist())])
        if re.fullmatch(_WHOSE, _plain(name)) and _takes_turns(variable.values):
            found[name] = [f"{name} {x:g}" for x in variable.values]
    return found


def _refuse_tags(path: Path, tags: Sequence[str]) -> NoReturn:
    """Refuse a table without names whose lines begin with the tags of several devices."""
    raise UserError(
        f"{path}: has lines that begin with {listed(tags, 4)} in turn, as of several devices, and no names; write a "
        "line of names above them, as device,time,value, or give the lines of each device a file of its own"
    )


def _takes_turns(x: np.ndarray) -> bool:
    """Whether a column holds a few whole numbers that return in turn, as those of joints do."""
    if x.ndim > 1 or not np.all(x == np.round(x)):
        return False
    labels, counts = np.unique(x, return_counts=True)
    if not 1 < len(labels) <= _MAX_LABELS < len(x):
        return False
    comes = np.flatnonzero(np.diff((x == labels[np.argmin(counts)]).astype(int)) > 0)  # of the one that is there least
    period = int(np.median(np.diff(comes))) if len(comes) > 1 else 0
    changes = np.mean(x[1:] != x[:-1]) > _MIN_CHANGES
    return bool(len(labels) <= period < len(x) and changes and np.mean(x[period:] == x[:-period]) > _MIN_PERIODIC)


def _in_seconds(clock: Variable) -> Variable:
    """Clock in s where its unit is stated."""
    unit = unit_name(clock.units)
    known = unit and TO_SI[unit].si == "s"
    return replace(clock, values=clock.values * TO_SI[unit].factor, units="s") if known else clock


def _plain(name: str) -> str:
    """A column's name without units, structures that hold it, and marks at its ends, in small letters."""
    return without_units(name).split(".")[-1].strip(" _").lower()
