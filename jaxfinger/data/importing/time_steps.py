"""Clocks of logs that write the time since the sample before in place of the time: the sum of these steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxfinger.data.importing.names import is_clock, is_time_step
from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.units import spelt
from jaxfinger.errors import counted

_SUM = ".time"  # end of the name of the clock, behind that of the steps


def with_summed_steps(recording: Recording) -> Recording:
    """Recording whose column `dt` of steps, if nothing else is a clock by its name, has their sum as `dt.time`.

    The first step, from a sample that was not recorded, may be missing.
    """
    variables = recording.variables
    count = max((len(v.values) for v in variables.values()), default=0)
    name = next((n for n, v in variables.items() if len(v.values) == count and is_time_step(n, v.values)), "")
    if not name or any(is_clock(n, v.values, v.units) for n, v in variables.items()):
        return recording
    steps = variables[name].values
    if lost := int(np.count_nonzero(~np.isfinite(steps[1:]))):
        said = f"has no sum, since {counted(lost, 'step')} of time cannot be read; fill in what is missing"
        return replace(recording, unusable={**recording.unusable, name + _SUM: said})
    clock = replace(variables[name], values=np.cumsum(np.nan_to_num(steps)), units=variables[name].units or spelt(name))
    return replace(recording, variables={**variables, name + _SUM: clock})


def steps_of(recording: Recording, clock: str) -> str:
    """Name of the steps of which a recording's clock is the sum; empty where it is recorded itself."""
    name = clock.removesuffix(_SUM)
    steps = recording.variables.get(name)
    return name if name != clock and steps is not None and is_time_step(name, steps.values) else ""
