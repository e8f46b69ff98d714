"""Lines of a proposed mapping (TOML): how a column is read, and what its comments say of rates and units."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxfinger.data.importing.logs import Log
from jaxfinger.data.importing.names import is_speed, words
from jaxfinger.data.importing.speeds import speeds
from jaxfinger.data.importing.survey import GEARED, ColumnSurvey, values_of
from jaxfinger.data.signals.pace import speed
from jaxfinger.data.toml import quoted
from jaxfinger.data.units import EITHER, MAX_OVERTRAVEL, TO_SI, near_limits, spelt_unit
from jaxfinger.errors import listed

_MAX_SPEEDS = 4  # that are named
# SI units of a sliding joint's position and force, and their largest plausible values, with room for gantries.
_MAX_SLIDING = {"q": ("m", 2.0), "joint_torque": ("N", 500.0)}
_MOST_OF_A_TURN = 6.0  # rad
_USUAL_RATES = 100, 1000  # Hz


def column_line(seen: ColumnSurvey, log: Log | None, slides: bool, turns: bool) -> str:
    """Inline table (TOML) that reads a column, of another log than the trial's where one is given.

    A joint that slides is in m; where one turns several times, the sizes of angles do not tell rad from degrees.
    """
    parts, doubts = [f"from = {quoted(seen.name)}"], []
    if seen.column is not None:
        parts.append(f"column = {quoted(seen.column) if isinstance(seen.column, str) else seen.column}")
    if log is not None:
        parts.append(f"file = {quoted(log.file)}")
        if log.clock is not None:
            units = _units_of_clock(log.clock)
            parts.append(f"time = {{ from = {quoted(log.clock.name)}{units} }}")
            doubts += [_doubt(log.clock)] if log.clock.foreign else []
    fits = {"q": "rad", "joint_torque": "N m", "tendon_force": "N", "fingertip_force": "N", "tendon_excursion": "m"}
    fits["temperature"] = "K"
    if slides and seen.meaning in _MAX_SLIDING:
        fits[seen.meaning], largest = _MAX_SLIDING[seen.meaning]
        if not (seen.stated or seen.foreign):
            seen = replace(seen, units=fits[seen.meaning] if max(-seen.low, seen.high) <= largest else "")
    guessed = seen.meaning == "q" and turns and not seen.stated
    if seen.units and TO_SI[seen.units].si == fits.get(seen.meaning) and not guessed:
        parts.append(f'units = "{seen.units}"')
        doubts += [seen.doubt] if seen.doubt else []
    else:
        parts.append('units = "?"')
        doubts.append(_doubt(seen))
    if seen.meaning == "tendon_excursion" and _has_length(seen):
        doubts.append("a length that falls as the tendon is pulled in needs scale = -1")
    return "{ " + ", ".join(parts) + " }" + (f"   # {'; '.join(doubts)}" if doubts else "")


def _has_length(seen: ColumnSurvey) -> bool:
    """Whether a column's name calls it a length, as of the tendon or its muscle."""
    return re.search(r"length|(?<![a-z])len(?![a-z])", words(f"{seen.name} {seen.column or ''}")) is not None


def time_line(clock: ColumnSurvey, period: int = 0) -> str:
    """Line that reads the times of a trial, of a clock that wraps after `period` counts if that is not 0."""
    units = _units_of_clock(clock) + (f", unwrap = {period}" if period else "")
    name = quoted(clock.name)
    said = f"   # {_doubt(clock)}" if clock.foreign else ""
    return f"time = {{ from = {name}{units} }}{said}" if units else f"time = {name}"


def _units_of_clock(clock: ColumnSurvey) -> str:
    """Units of times, as an inline table has them: none for s, and open where the recording states unknown ones."""
    units = "?" if clock.foreign else clock.units
    return f', units = "{units}"' if units not in ("s", "") else ""


def _doubt(seen: ColumnSurvey) -> str:
    """Why the unit of a column is open."""
    if seen.foreign:
        return f"it states {seen.foreign}: {EITHER.get(seen.foreign.lower(), 'write `scale` too, or another unit')}"
    if seen.whole:
        return "whole numbers, as counts are: then write `scale` too"
    return seen.doubt or "its size does not tell"


def torque_line(columns: Sequence[ColumnSurvey], weight: float) -> list[str]:
    """A comment on the unit of torques that their recording does not state, by the finger's own `weight`, N m."""
    sizes = [max(-s.low, s.high) for s in columns if _is_guessed(s) and not s.foreign]
    if not sizes or not weight:
        return []
    times = max(sizes) / weight
    return [
        f"# joint_torque reaches {times:.2g} times the torque with which the whole finger weighs on an arm as long "
        f"as its reach, if in N m, and {1e-3 * times:.2g} times, if in N mm"
    ]


def turns_line(columns: Sequence[ColumnSurvey], limits: np.ndarray) -> list[str]:
    """A comment on angles that may be in rad, where they lie within the joints' `limits` (m, 2), rad, in turns too.

    Some motor drives count turns.
    """
    guessed = [s for s in columns if _is_guessed(s) and not s.foreign and s.units in ("rad", "")]
    if not guessed:
        return []
    low, high = min(s.low for s in guessed), max(s.high for s in guessed)
    turn = TO_SI["turn"].factor
    if not near_limits(turn * low, turn * high, limits.ravel()):
        return []
    said = [f"{np.degrees(low * f):.0f} to {np.degrees(high * f):.0f} degrees" for f in (1.0, turn)]
    return [f"# q runs from {said[0]} if in rad, and from {said[1]} if in turns, as some motor drives count"]


def within(seen: ColumnSurvey, limits: np.ndarray | None) -> ColumnSurvey:
    """Survey of a column whose angles are no longer taken for rad where they go farther than the joint's `limits`, rad.

    They may be turns of a motor before its gear. An encoder that wraps goes through a whole turn.
    """
    if seen.meaning != "q" or seen.units != "rad" or limits is None or not _is_guessed(seen):
        return seen
    farther = float(np.ptp(limits)) + 2.0 * MAX_OVERTRAVEL < seen.high - seen.low < _MOST_OF_A_TURN
    return replace(seen, units="", doubt=f"it goes farther than the limits: {GEARED}") if farther else seen


def _is_guessed(seen: ColumnSurvey) -> bool:
    """Whether neither the recording nor the column's name states the unit of its values."""
    return not (seen.stated or spelt_unit(seen.name)) and seen.missing < seen.samples


def rate_by_speeds(log: Log) -> list[str]:
    """A comment on the sampling rate at which some columns of a log without a named clock are the speeds of others."""
    seen = [s for s in log.seen if s.samples == log.count and s.meaning in ("", "q")]
    found = [x for x in speeds([values_of(log.recording, s) for s in seen]) if is_speed(seen[x.speed].name)]
    if not found:
        return []
    named = [f"{called(seen[x.speed])} of {called(seen[x.of])} at {float(f'{x.rate:.3g}'):g}" for x in found]
    return [
        f"# speeds, if in the units of their angles by s, tell the samples per second: {listed(named, _MAX_SPEEDS)}"
    ]


def pace_line(log: Log, angles: Sequence[ColumnSurvey]) -> list[str]:
    """A comment on how long a log without a clock lasts, and how fast its joints move, at two usual sampling rates."""
    if not angles:
        return []
    count = np.arange(float(log.count))
    moves = [(speed(count, values_of(log.recording, s)), called(s), s.units) for s in angles if s.samples == log.count]
    fastest, name, units = max(moves, default=(0.0, "", ""))
    said = [
        f"at {rate} Hz they last {len(count) / rate:.3g} s"
        + (f" and {name} moves by up to {fastest * rate:.3g} {units or 'of its units'} in 1 s" if fastest else "")
        for rate in _USUAL_RATES
    ]
    return [f"# {len(count)} samples: {'; '.join(said)}"]


def transposed_lines(log: Log) -> list[str]:
    """Comments on arrays with as many columns as the log has samples."""
    samples = log.clock.samples if log.clock is not None else 0
    arrays = [(name, v.values) for name, v in log.recording.variables.items()]
    return [
        f"# {quoted(name)} is {len(x)} by {samples}, joints first: transpose it, and save it again"
        for name, x in arrays
        if x.ndim == 2 and len(x) < samples == x.shape[1]
    ]


def elsewhere_lines(log: Log) -> list[str]:
    """Comments on a log without angles at the times of none that has them: its clock may have begun elsewhere."""
    if log.clock is None:
        return []
    return [
        "# it holds no angles, and no log that does shares its times. If it belongs to another trial, and its clock",
        f"# began elsewhere, write its columns there, each with file = {quoted(log.file)} and time =",
        f"# {{ from = {quoted(log.clock.name)}, offset = … }}, what is to be added to its times for those of the trial",
    ]


def called(seen: ColumnSurvey) -> str:
    return quoted(seen.name if seen.column is None else f"{seen.name}[{seen.column}]")
