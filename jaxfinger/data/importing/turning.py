"""Units of angles that their speeds tell: of a log with both and a clock, speed · unit = change of the angle · unit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxfinger.data.importing.names import is_before_a_gear, is_speed
from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.importing.speeds import speeds
from jaxfinger.data.importing.survey import GEARED, ColumnSurvey, values_of
from jaxfinger.data.units import TO_SI, spelt, unit_name

_ANGLES = {name: TO_SI[name].factor for name in ("rad", "deg", "turn")}
_SPEEDS = {f"{name}/s": factor for name, factor in _ANGLES.items()} | {"rpm": 2.0 * math.pi / 60.0}
_MAX_ERROR = 0.03  # of a ratio, by which a filter and a clock change it; the ratios of units differ by half at least


def by_speeds(recording: Recording, seen: Sequence[ColumnSurvey]) -> list[ColumnSurvey]:
    """Survey of a log's columns, with the units of angles, where these state none, that their speeds tell.

    Turns stay open, since a drive that counts them is often in front of a gear, and so do angles that fit no unit of
    their stated speed, or whose speed is a motor's. Of a speed that is the change of its angle in that one's own units
    nothing is learnt.
    """
    rate = _rate(recording, seen)
    open_ = {i for i, s in enumerate(seen) if s.meaning == "q" and not (s.stated or s.foreign or s.whole)}
    alike = [i for i, s in enumerate(seen) if i in open_ or (not s.meaning and is_speed(s.name))]
    alike = [i for i in alike if seen[i].samples == max(s.samples for s in seen)]
    told = list(seen)
    if not rate or not open_:
        return told
    for of, speed, there in speeds([values_of(recording, seen[i]) for i in alike]):
        at, by = alike[of], seen[alike[speed]]
        if at not in open_ or not is_speed(by.name):
            continue
        unit = _unit_of_speed(recording, by)
        among = {unit: _SPEEDS[unit]} if unit else _SPEEDS
        ratios = {name: [there / rate * factor / x for factor in among.values()] for name, x in _ANGLES.items()}
        fitting = [name for name, of_units in ratios.items() if any(abs(r - 1.0) < _MAX_ERROR for r in of_units)]
        if len(fitting) == 1 or unit:
            tells = len(fitting) == 1 and fitting != ["turn"] and not is_before_a_gear(by.name)
            doubt = "" if tells else f"{by.name} tells turns or a gear: {GEARED}"
            told[at] = replace(seen[at], units=fitting[0] if tells else "", doubt=doubt)
    return told


def _rate(recording: Recording, seen: Sequence[ColumnSurvey]) -> float:
    """Sampling rate of a log by its clock, Hz; 0 where it has none that runs evenly."""
    clock = next((s for s in seen if s.meaning == "time" and s.units), None)
    if clock is None or clock.samples < 3:
        return 0.0
    steps = np.diff(np.ravel(recording.variables[clock.name].values)) * TO_SI[clock.units].factor
    usual = float(np.median(steps))
    even = usual > 0.0 and bool(abs(float(np.mean(steps)) / usual - 1.0) < _MAX_ERROR)
    return 1.0 / usual if even else 0.0


def _unit_of_speed(recording: Recording, seen: ColumnSurvey) -> str:
    """Unit of a speed as its recording or its name states it; empty where neither does."""
    text = recording.variables[seen.name].units or spelt(seen.name)
    angle, _, time = text.partition("/")
    unit = f"{unit_name(angle)}/{unit_name(time)}" if time else text.strip().lower()
    return unit if unit in _SPEEDS else ""
