"""Header of a LabVIEW measurement file (.lvm): units, and the times of samples that are not written beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from jaxfinger.data.importing.recording import Recording, Variable

Heads = Sequence[list[str]]  # lines above the numbers with a cell for each column, the nearest first

# First cells of these lines: units of values, what the first column holds, its first value, and its step.
_UNITS, _DIMENSION, _FIRST, _STEP = "Y_Unit_Label", "X_Dimension", "X0", "Delta_X"
_TIMES = "X_Value"  # begins the line of names, as that of the column of times; each channel may have one before it


def wrote(heads: Heads) -> bool:
    """Whether LabVIEW wrote these lines: a line of names, and one of its header at least."""
    labels = set(_by_label(heads))
    return _TIMES in labels and not labels.isdisjoint((_UNITS, _DIMENSION, _FIRST, _STEP))


def columns(heads: Heads) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns. Where each channel has its own times, these are called `name.time`."""
    head = _by_label(heads)
    names = head[_TIMES]
    several = names.count(_TIMES) > 1
    beside = [*names[1:], ""]
    called = [f"{after}.time" if several and n == _TIMES else n for n, after in zip(names, beside, strict=True)]
    seconds = "s" if "Time" in head.get(_DIMENSION, ()) else ""
    units = head.get(_UNITS, [""] * len(names))
    return tuple(called), tuple(seconds if n == _TIMES else unit for n, unit in zip(names, units, strict=True))


def timed(recording: Recording, heads: Heads, number: Callable[[str], float | None]) -> Recording:
    """Recording whose channels have their own times as clocks, or the times of the header where none are written."""
    head, variables = _by_label(heads), dict(recording.variables)
    for name, variable in variables.items():
        if f"{name}.time" in variables:
            variables[name] = replace(variable, clock=f"{name}.time")
    steps, first = ({number(cell) for cell in head.get(label, ())[1:] if cell} for label in (_STEP, _FIRST))
    blank = _TIMES in variables and bool(np.isnan(variables[_TIMES].values).all())
    if blank and len(steps) == len(first) == 1 and "Time" in head.get(_DIMENSION, ()):
        (step,), (start,) = steps, first
        if step and start is not None:
            count = np.arange(len(variables[_TIMES].values))
            variables[_TIMES] = Variable(start + step * count, units="s")
    return replace(recording, variables=variables)


def _by_label(heads: Heads) -> dict[str, list[str]]:
    """Lines by their first cells, the nearest of each."""
    return {row[0]: row for row in reversed(heads)}
