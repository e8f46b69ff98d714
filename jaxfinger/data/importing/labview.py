"""Header of a LabVIEW measurement file (.lvm): units, and the times of samples that are not written beside them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from jaxfinger.data.importing.recording import Recording, Variable

# Lines of the header, with a cell for each column: units of values, what the first column holds, its first value, step.
UNITS, _DIMENSION, _FIRST, _STEP = "Y_Unit_Label", "X_Dimension", "X0", "Delta_X"
TIMES = "X_Value"  # names the column of times, one for all channels or one before each


def columns(names: Sequence[str], header: Mapping[str, Sequence[str]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the columns. Where each channel has its own times, these are called `name.time`."""
    several = names.count(TIMES) > 1
    beside = [*names[1:], ""]
    called = [f"{after}.time" if several and n == TIMES else n for n, after in zip(names, beside, strict=True)]
    seconds = "s" if "Time" in header.get(_DIMENSION, ()) else ""
    stated = [seconds if n == TIMES else unit for n, unit in zip(names, header[UNITS], strict=True)]
    return tuple(called), tuple(stated)


def timed(
    recording: Recording, header: Mapping[str, Sequence[str]], number: Callable[[str], float | None]
) -> Recording:
    """Recording whose channels have their own times as clocks, or the times of the header where none are written."""
    variables = dict(recording.variables)
    for name, variable in variables.items():
        if f"{name}.time" in variables:
            variables[name] = replace(variable, clock=f"{name}.time")
    steps = {number(cell) for cell in header.get(_STEP, ())[1:] if cell}
    first = {number(cell) for cell in header.get(_FIRST, ())[1:] if cell}
    blank = TIMES in variables and bool(np.isnan(variables[TIMES].values).all())
    if blank and len(steps) == len(first) == 1 and "Time" in header.get(_DIMENSION, ()):
        (step,), (start,) = steps, first
        if step and start is not None:
            count = np.arange(len(variables[TIMES].values))
            variables[TIMES] = Variable(start + step * count, units="s")
    return replace(recording, variables=variables)
