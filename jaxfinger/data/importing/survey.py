"""Survey of a recording: its columns and clocks, with ranges, rates and gaps, and what they may be by name and size."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxfinger.data.importing.columns import coarse_rate, restarts
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.units import TO_SI, is_foreign, is_ratio, unit_name

# Usual intervals of a clock that ticks evenly. A late sample makes one up to twice as long; in a longer one than this,
# samples were lost. It decides what counts as the rate, not what is a fault (`signals.clock`).
MIN_GAP = 5.0
# Patterns of names for each channel, of which the first that fits counts: common words in logs of robots.
_MEANINGS = (
    ("time", r"^t(_?(s|sec|ms|us|ns))?$|time|stamp|clock|zeit|^sec|^duration$"),
    ("temperature", r"temp"),
    ("joint_torque", r"(^|_)tau|torque|effort|moment|joint[_ ]?\d*[_ ]?force"),
    ("tendon_excursion", r"excursion|^l\d*$|length|pull|spool|linear|travel"),
    (
        "tendon_force",
        r"tension|tendon.*force|^f_?t|^f(\d|_(?!([xyz](_|\d|$)|tip$)))|cable|load[ _-]?cell|(^|_)cell(_|\d|$)|^force",
    ),
    ("fingertip_force", r"f?tip|contact|^f[xyz]$|wrench"),
    ("q", r"^q[_\d]*|_q(_|\d|$)|angle|pos|enc|theta|winkel|deg$"),
)
# Of a clock's values or steps: more values differ, also out of order, or more steps go on, also of a recording that was
# pasted twice.
_MIN_RUNNING = 0.5
_NO_WORDS = "value", "data"  # at the end of a name, which say nothing of what they are: the word before them does
# Name of a column of a table without names, and share of a clock's steps that its usual one is not twice or half of.
_NAMELESS = r"column \d+"
_MIN_EVEN = 0.9
# Names of velocities, which belong to no channel, of set-points, which are not measured, and of switches and states.
_VELOCITY = r"(?<![a-z])vel|speed|dot|^v$|^dq|(^|_)(d+(q|theta)|(q|theta)d+)(_|\d|$)"
_STATE = r"enable|flag|status|valid|(^|_)(on|off|ok|mode|err|error|fault|alarm)(_|\d|$)|collision|joint_contact"
_SET_POINT = (
    r"cmd|command|cmptd|computed|ref(?!l)|desired|set_?p(oin)?t|goal|target|demand|soll|feed_?forward"
    r"|(?<![a-z])d*(q|theta|tau|tau_j)_d(?![a-z])"
    r"|(?<![a-z])(q|tau|pos)?(des|set(?!\d+\.)|sp|ff|tgt|nominal|planned)(?![a-z])"
)
# Largest plausible values of a channel by unit, with room for arms. The first unit whose largest value is not exceeded
# is the guess. Torques from 5 to 100 may be an arm's in N m or a finger's in N mm, and large tensions may be in mN or
# gf, so their unit stays open.
_MAX_VALUES = {
    "q": (("rad", 7.0), ("deg", 400.0)),
    "joint_torque": (("N m", 5.0), ("", 100.0), ("N mm", 5e3)),
    "tendon_force": (("N", 500.0), ("", 1e6)),
    "tendon_excursion": (("m", 0.2), ("mm", 200.0)),
    "fingertip_force": (("N", 100.0), ("mN", 1e5)),
    "temperature": (("degC", 200.0), ("K", 1e3)),
}
_SI_UNITS = {
    "time": ("s",),
    "temperature": ("K",),
    "joint_torque": ("N m", "N"),
    "tendon_excursion": ("m",),
    "tendon_force": ("N",),
    "fingertip_force": ("N",),
    "q": ("rad", "m"),
}
_CHANNEL_OF_UNITS = {"rad": "q", "N m": "joint_torque", "N": "tendon_force", "m": "tendon_excursion"}
# Ranges of the usual interval, 10 µs to 0.5 s, in each unit. Where they overlap the first one counts.
_INTERVALS = (("s", 1e-5, 0.5), ("ms", 0.01, 500.0), ("us", 10.0, 5e5), ("ns", 1e4, 5e8))


@dataclass(frozen=True)
class ColumnSurvey:
    """Survey of one column of a recording."""

    name: str
    column: str | int | None  # name or number, None for a variable with one column
    samples: int
    low: float  # smallest value
    high: float  # largest value
    missing: int  # number of values that are NaN or infinite
    units: str  # as the recording states them, else a guess; empty where they are unclear
    stated: bool  # whether the recording states the units
    meaning: str  # channel, `time`, or empty
    foreign: str = ""  # unit that the recording states and no mapping converts, such as counts


@dataclass(frozen=True)
class ClockSurvey:
    """Survey of one clock of a recording: a variable that increases as times do."""

    name: str
    units: str
    duration: float  # s
    rate: float  # Hz
    gaps: int  # number of gaps
    longest: float  # s, longest gap
    disordered: int  # number of stamps that do not increase
    restarts: int  # number of places at which it begins again or wraps


def columns_of(recording: Recording, among: Sequence[Recording] = ()) -> list[ColumnSurvey]:
    """Survey every column of every variable of a recording.

    A unit is guessed from the largest values that the column has in any recording `among` these, and its like in this
    one: a joint that is held at 5 degrees could be one at 5 rad, until it or the others are seen at 80.
    """
    found, guessed = [], {}
    for name, variable in recording.variables.items():
        table = variable.values.reshape(len(variable.values), -1)
        for k, x in enumerate(table.T):
            column = None if table.shape[1] == 1 else (variable.columns[k] if variable.columns else k)
            units = unit_name(variable.units)
            spelt = units or _spelt(name)
            foreign = variable.units if is_foreign(variable.units) and not spelt else ""
            meaning = "" if is_ratio(variable.units) else _meaning(name, column, x, spelt)
            if meaning == "q" and not (spelt or foreign):
                units = spelt = recording.angles
            stated = bool(units)
            if spelt:
                units = spelt
            elif not stated and not foreign:
                sizes = _sizes(name, k, recording, among)
                units = _time_unit(x) if meaning == "time" else _unit(meaning, sizes)
                guessed |= {len(found): np.nanmax(sizes)} if meaning in _MAX_VALUES and np.isfinite(sizes).any() else {}
            finite = x[np.isfinite(x)]
            low, high = (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)
            missing = len(x) - len(finite)
            found.append(ColumnSurvey(name, column, len(x), low, high, missing, units, stated, meaning, foreign))
    found = _agreed(found, guessed)
    if not any(s.meaning == "time" for s in found):
        for k, s in enumerate(found):
            x = np.ravel(recording.variables[s.name].values)
            if is_nameless(s.name) and _rises_evenly(x):
                found[k] = replace(s, meaning="time", units=_time_unit(x))
                break
    return found


def is_nameless(name: str) -> bool:
    """Whether a column has no name in its recording, so that its values alone say what it may be."""
    return re.fullmatch(_NAMELESS, name) is not None


def is_speed(name: str) -> bool:
    """Whether a column may hold speeds by its name; one without a name may hold anything."""
    return is_nameless(name) or re.search(_VELOCITY, name.lower()) is not None


def _rises_evenly(x: np.ndarray) -> bool:
    """Whether values rise by similar steps throughout, as times do. A count of samples does not show their times."""
    steps = np.diff(x)
    if len(x) < 3 or not np.all(steps > 0.0) or np.all(steps == 1.0):
        return False
    ratio = steps / np.median(steps)
    return bool(np.mean((ratio > 0.5) & (ratio < 2.0)) > _MIN_EVEN)


def _agreed(found: Sequence[ColumnSurvey], guessed: Mapping[int, float]) -> list[ColumnSurvey]:
    """Columns whose names differ in numbers alone, with one guess of their unit: that of the largest value.

    Where less than half of them need that unit they may have several, as joints that slide or turn on, and all are left
    open. `guessed` has the sizes of the columns whose unit is guessed, by their places.
    """
    agreed = list(found)
    groups: dict[tuple[str, str], list[int]] = {}
    for i in guessed:
        groups.setdefault((found[i].meaning, re.sub(r"\d+", "#", found[i].name)), []).append(i)
    for (meaning, _), group in groups.items():
        largest = _unit(meaning, [guessed[i] for i in group])
        many = sum(found[i].units == largest for i in group) >= len(group) / 2
        for i in group:
            agreed[i] = replace(found[i], units=largest if many else "")
    return agreed


def _sizes(name: str, k: int, recording: Recording, among: Sequence[Recording]) -> list[float]:
    """Sizes of column `k` of a variable, in its recording and in those of `among` with the same columns and units."""
    variable = recording.variables[name]
    alike = [variable, *(v for other in among if (v := other.variables.get(name)) is not None)]
    same = [v for v in alike if (v.columns, v.units) == (variable.columns, variable.units)]
    return [v.sizes[k] for v in same if k < len(v.sizes)]


def clocks_of(recording: Recording, seen: Sequence[ColumnSurvey]) -> list[ClockSurvey]:
    """Survey every clock among the columns of a recording."""
    return [
        _clock_survey(s.name, recording.variables[s.name], s.units or "s")
        for s in seen
        if s.meaning == "time" and s.samples > 2
    ]


def _clock_survey(name: str, variable: Variable, units: str) -> ClockSurvey:
    """Survey one clock, with its stamps put into order."""
    time = np.ravel(variable.values) * TO_SI[units].factor
    begins = restarts(time)
    steps = np.concatenate([_steps(part) for part in np.split(time, begins + 1)])
    usual = float(np.median(steps)) if len(steps) else np.nan
    gaps = steps > MIN_GAP * usual
    return ClockSurvey(
        name,
        units,
        float(steps.sum()),
        1.0 / usual,
        int(gaps.sum()),
        float(steps[gaps].max()) if gaps.any() else 0.0,
        int((np.diff(time) <= 0.0).sum()),
        len(begins),
    )


def _steps(time: np.ndarray) -> np.ndarray:
    """Intervals between the distinct stamps in order of time, since stamps in the file may be out of order."""
    return np.diff(np.unique(time[np.isfinite(time)]))


def _meaning(name: str, column: str | int | None, x: np.ndarray, units: str) -> str:
    """Channel or `time` by the last word of a name where the units allow it, else by the units; empty where unclear."""
    bare = re.sub(r"[\[(].*", "", name).strip("/ ")  # Units stand in brackets.
    *before, word = re.split(r"[./]", bare.lower())
    word = before[-1] if before and word in _NO_WORDS else word
    if len(x) == 1 or re.search(_VELOCITY, word) or re.search(_STATE, word) or is_set_point(name):
        return ""
    for meaning, pattern in _MEANINGS:
        if re.search(pattern, word) and (not units or TO_SI[units].si in _SI_UNITS[meaning]):
            shares = (len(np.unique(x)) / len(x), np.mean(np.diff(x) > 0.0)) if len(x) > 2 else (0.0,)
            runs = max(shares) > _MIN_RUNNING or coarse_rate(x) is not None
            return meaning if meaning != "time" or (column is None and runs) else ""
    return _CHANNEL_OF_UNITS.get(TO_SI[units].si, "") if units else ""


def is_set_point(name: str) -> bool:
    """Whether a variable's name, or that of a structure which holds it, says that it is a set-point."""
    members = re.sub(r"[\[(].*", "", name).strip("/ ").split("/")[-1]
    return re.search(_SET_POINT, re.sub(r"(?<=[a-z])(?=[A-Z])", "_", members).lower()) is not None


def _spelt(name: str) -> str:
    """Unit at the end of a name such as `stamp_ms`. A single letter is not taken for one."""
    last = re.split(r"[\s_./]", name.strip())[-1]
    return unit_name(last) if len(last) > 1 else ""


def _time_unit(x: np.ndarray) -> str:
    """Guess the unit of a clock from its usual interval between samples."""
    steps, coarse = _steps(x), coarse_rate(x)
    step = 1.0 / coarse[1] if coarse else float(np.median(steps)) if len(steps) else np.nan
    return next((unit for unit, low, high in _INTERVALS if low <= step < high), "s")


def _unit(meaning: str, sizes: Sequence[float]) -> str:
    """Guess the unit of a channel from the sizes of its values in several recordings."""
    size = max((size for size in sizes if not np.isnan(size)), default=np.nan)
    return next((unit for unit, largest in _MAX_VALUES.get(meaning, ()) if size <= largest), "")
