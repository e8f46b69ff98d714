"""Survey of a recording: its columns and clocks, with ranges, rates and gaps, and what they may be by name and size."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from jaxfinger.data.example import is_example
from jaxfinger.data.importing.names import (
    Owners,
    as_word,
    is_before_a_gear,
    is_electric,
    is_joint,
    is_nameless,
    is_of_tendon,
    is_position,
    meaning_of,
    words,
)
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.importing.stamps import coarse_rate, restarts
from jaxfinger.data.mounting import reach_of, weight_of
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.units import TO_SI, is_foreign, is_ratio, is_unknown, spelt, without_units

# Usual intervals of a clock that ticks evenly. A late sample makes one up to twice as long; in a longer one than this,
# samples were lost. It decides what counts as the rate, not what is a fault (`signals.clock`).
MIN_GAP = 5.0
# Share of a clock's steps that its usual one is not twice or half of.
_MIN_EVEN = 0.9
# Largest plausible values of a channel by unit, with room for arms. The first unit whose largest value is not exceeded
# is the guess; sizes that are usual in several units leave it open. Torques from 0.2 to 500 may be an arm's in N m or a
# finger's in N mm, and a link of 1 g weighs 0.2 N mm at 2 cm. The finger's own weight tells more of torques. Tensions
# up to 15 may be in kgf, or volts of a load cell, and those above 100 in gf; so may smaller forces at the fingertip.
# Travel from 0.01 to 8 may be in cm or of a spool. Moment arms tell more of all these (`leverage`).
_MAX_VALUES = {
    "q": (("rad", 7.0), ("deg", 400.0)),
    "joint_torque": (("N m", 0.2), ("", 500.0), ("N mm", 5e3)),
    "tendon_force": (("", 15.0), ("N", 100.0), ("", 1e6)),
    "tendon_excursion": (("m", 0.01), ("", 8.0), ("mm", 200.0)),
    "fingertip_force": (("", 0.5), ("N", 20.0), ("", 1e5)),
    "temperature": (("degC", 200.0), ("K", 1e3)),
}
# Angles that are never larger may be turns, in which some motor drives count: no joint of a finger turns by more than
# 110°. In rad they would be 17° at most, which is little for a recording.
_MAX_TURNS = 0.3
GEARED = "it may be in rad, in degrees or, as drives count, in turns; of a motor before a gear write `scale` too"
# Of the torque with which the whole finger weighs on an arm as long as its reach: torques up to the first are in N m,
# since in N cm or N mm they would be a few hundredths of it, less than any load moves them. Larger ones than the second
# are in N mm: in N cm they would be twenty times it. Between them the unit stays open.
_WEIGHTS = 3.0, 2000.0
_MIN_DATE = 1e4  # days: spreadsheets count them from 1900, and MATLAB from the year 0.
# Of a force's larger side of zero, the smaller one from which it pushes as well as pulls: a tension only reads below
# zero by its noise and by a tare that is off, a few percent of its range.
_MIN_PUSH = 0.2
# Of a column's scatter, that of its steps: that of white noise about zero, as of a slack tendon's force, is 1.4.
_MAX_ROUGH = 0.5
PUSHES = "it pushes and pulls, as no tendon does: of a load cell on a lever write `scale`, the arm in m, and units N m"
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
    whole: bool = False  # whether its values are whole numbers, as counts are
    doubt: str = ""  # why its unit is open, or may be another, if there is more to say than that its size does not tell


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


def weight_on_reach(finger: FingerDescription | None) -> float:
    """Torque, N m, with which the whole finger weighs on an arm as long as its reach.

    It is 0 where it is not known: without a finger, with an example's masses, and with sliding joints.
    """
    known = finger is not None and not is_example(finger) and not any(finger.prismatic)
    return weight_of(finger) * reach_of(finger) if finger is not None and known else 0.0


def columns_of(
    recording: Recording,
    among: Sequence[Recording] = (),
    joints: Sequence[str] = (),
    tendons: Sequence[str] = (),
    weight: float = 0.0,
) -> list[ColumnSurvey]:
    """Survey every column of every variable of a recording.

    A unit is guessed from the largest values that the column has in any recording `among` these, and its like in this
    one: a joint that is held at 5 degrees could be one at 5 rad, until it or the others are seen at 80. `joints` and
    `tendons` are the finger's, and `weight` is its own (`weight_on_reach`). Where no column is an angle by its name,
    those with a joint's name alone are.
    """
    owners = Owners(joints, tendons)
    said = _said(recording, owners)
    beside = _beside(recording, said)
    found, guessed = [], {}
    for name, variable in recording.variables.items():
        table = variable.values.reshape(len(variable.values), -1)
        for k, x in enumerate(table.T):
            column = _column(variable, k)
            meaning, units = said[name, k]
            angles = recording.angles if meaning == "q" and not (units or is_foreign(variable.units)) else ""
            units = units or angles
            stated = bool(units and (variable.units or angles))
            text = variable.units or spelt(name)
            foreign = text if not units and _is_no_unit(text, owners) else ""
            finite = x[np.isfinite(x)]
            whole = len(finite) > 0 and bool(np.all(finite == np.round(finite)) and np.ptp(finite) > 0.0)
            counts = whole and meaning in _MAX_VALUES and meaning != "temperature"
            doubt = ""
            if meaning == "tendon_force" and not counts and _pushes(name, k, recording, among, owners):
                meaning, units, doubt = "joint_torque", "", PUSHES
            elif not (units or foreign or counts):
                sizes = _sizes(name, k, recording, among)
                units = _time_unit(x) if meaning == "time" else _unit(meaning, sizes, weight)
                if meaning == "q" and finite.any():
                    units, doubt = _angle(name, variable, units, owners, beside)
                if meaning in _MAX_VALUES and np.isfinite(sizes).any():
                    guessed[len(found)] = np.nanmax(sizes)
            low, high = (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)
            missing = len(x) - len(finite)
            found.append(
                ColumnSurvey(name, column, len(x), low, high, missing, units, stated, meaning, foreign, whole, doubt)
            )
    found = _without_turns(agreed(found, guessed, owners, weight), guessed)
    if not any(s.meaning == "time" for s in found):
        for k, s in enumerate(found):
            x = np.ravel(recording.variables[s.name].values)
            if _is_clock(s, x):
                found[k] = replace(s, meaning="time", units=s.units or _time_unit(x))
                break
    return found


def _pushes(name: str, k: int, recording: Recording, among: Sequence[Recording], owners: Owners) -> bool:
    """Whether a force that no name calls a tendon's goes well beyond zero both ways in some recording, and smoothly."""
    if is_of_tendon(name) or owners.of(words(name))[0]:
        return False
    for variable in _alike(name, recording, among):
        x = variable.values.reshape(len(variable.values), -1)[:, k] if k < len(variable.sizes) else np.zeros(0)
        x = x[np.isfinite(x)]
        if len(x) < 3 or np.std(np.diff(x)) > _MAX_ROUGH * np.std(x):
            continue
        sides = sorted((max(-x.min(), 0.0), max(x.max(), 0.0)))
        if sides[0] > _MIN_PUSH * sides[1]:
            return True
    return False


def _angle(name: str, variable: Variable, units: str, owners: Owners, beside: Mapping[str, str]) -> tuple[str, str]:
    """Unit of an angle that states none, given one by its size, and why it may be another.

    It is open for what is a motor's by its name, or a position and no joint's, and beside a column of a `motor` that
    has no other angle: these may be before a gear, or in turns. Beside that of a `drive` it is only said. Positions of
    a joint, as those of a JointState, are in rad.
    """
    of_joint = variable.columns or owners.of(words(name))[0] or "joint" in name.lower()
    if is_before_a_gear(name) or (units == "rad" and is_position(name) and not of_joint):
        return "", GEARED
    if units != "rad" or of_joint or not beside:
        return units, ""
    if motor := beside.get("motor"):
        return "", f"{motor} is of a motor, and so may this be: {GEARED}"
    return units, f"if the joint's; if of the drive with {beside['drive']}, it may be in turns before a gear"


def _beside(recording: Recording, said: Mapping[tuple[str, int], tuple[str, str]]) -> dict[str, str]:
    """Names of a column that is of a `motor`, and of one of a `drive`; none where the motor's angle is there too."""
    named = {"motor": is_before_a_gear, "drive": is_electric}
    found = {what: next((name for name in recording.variables if of(name)), "") for what, of in named.items()}
    has_angle = any(is_before_a_gear(name) and meaning == "q" for (name, _), (meaning, _) in said.items())
    return {} if has_angle else {what: name for what, name in found.items() if name}


def _is_no_unit(stated: str, owners: Owners) -> bool:
    """Whether a recording states what no mapping converts: another unit, or a word that is no joint's or tendon's."""
    return is_foreign(stated) or (is_unknown(stated) and not owners.of(words(stated))[0])


def _said(recording: Recording, owners: Owners) -> dict[tuple[str, int], tuple[str, str]]:
    """What the name and units of each column say: its channel and its units, by variable and place."""
    said = {}
    for name, variable in recording.variables.items():
        for k, x in enumerate(variable.values.reshape(len(variable.values), -1).T):
            text = variable.units or spelt(name)
            said[name, k] = ("", "") if is_ratio(text) else meaning_of(name, _column(variable, k), x, text, owners)
    if not any(channel == "q" for channel, _ in said.values()):
        for (name, k), (channel, units) in said.items():
            variable = recording.variables[name]
            if not channel and not units and is_joint(name, owners) and not is_ratio(variable.units):
                said[name, k] = ("q" if variable.values.ndim == 1 and len(variable.values) > 1 else "", "")
    return said


def _column(variable: Variable, k: int) -> str | int | None:
    """Name or number of a variable's column k; None where it has one column."""
    if np.ndim(variable.values) == 1 or variable.values.shape[1] == 1:
        return None
    return variable.columns[k] if variable.columns else k


def values_of(recording: Recording, seen: ColumnSurvey) -> np.ndarray:
    """Values of a column, (N,)."""
    variable = recording.variables[seen.name]
    table = variable.values.reshape(len(variable.values), -1)
    named = variable.columns
    return table[:, 0 if seen.column is None else named.index(seen.column) if named else int(seen.column)]


def _is_clock(seen: ColumnSurvey, x: np.ndarray) -> bool:
    """Whether a column that no name calls a clock is one: it rises, evenly or in units of time."""
    if seen.units and TO_SI[seen.units].si == "s":
        return len(x) > 2 and bool(np.all(np.diff(x) > 0.0))
    return is_nameless(seen.name) and _rises_evenly(x)


def _rises_evenly(x: np.ndarray) -> bool:
    """Whether values rise by similar steps throughout, as times do. A count of samples does not show their times."""
    steps = np.diff(x)
    if len(x) < 3 or not np.all(steps > 0.0) or np.all(steps == 1.0):
        return False
    ratio = steps / np.median(steps)
    return bool(np.mean((ratio > 0.5) & (ratio < 2.0)) > _MIN_EVEN)


def agreed(
    found: Sequence[ColumnSurvey], guessed: Mapping[int, float], owners: Owners, weight: float
) -> list[ColumnSurvey]:
    """Columns of one quantity, with one guess of their unit: that of the largest value.

    Where too few of them need that unit they may have several, as joints that slide or turn on, and all are left open.
    `guessed` has the sizes of the columns whose unit is guessed, by their places.
    """
    alike = list(found)
    for group, least in _of_one_quantity(found, list(guessed), owners):
        largest = _unit(found[group[0]].meaning, [guessed[i] for i in group], weight)
        many = sum(found[i].units == largest for i in group) >= least
        for i in group:
            alike[i] = replace(found[i], units=largest if many else "")
    return alike


def _without_turns(found: Sequence[ColumnSurvey], guessed: Mapping[int, float]) -> list[ColumnSurvey]:
    """Columns, with the unit of angles open where all are so small that they may be turns. 0 is 0 in any unit."""
    sizes = {i: size for i, size in guessed.items() if found[i].units == "rad"}
    small = 0.0 < max(sizes.values(), default=0.0) <= _MAX_TURNS
    return [replace(s, units="") if small and i in sizes else s for i, s in enumerate(found)]


def _of_one_quantity(
    found: Sequence[ColumnSurvey], places: Sequence[int], owners: Owners
) -> list[tuple[list[int], float]]:
    """Groups of columns at these places whose names differ in numbers or in known joints and tendons alone, else in one
    word; and how many of each must need a unit. Words also tell raw and other values apart, so most must need it."""
    texts = {i: words(without_units(found[i].name)) for i in places}
    numbered: dict[tuple, list[int]] = {}
    for i, text in texts.items():
        owner, _ = owners.of(text)
        masked = as_word(owner).sub("#", text, count=1) if owner else text
        numbered.setdefault((found[i].meaning, re.sub(r"\d+", "#", masked)), []).append(i)
    groups = [(group, len(group) / 2.0) for group in numbered.values() if len(group) > 1]
    worded: dict[tuple, list[int]] = {}
    for (i,) in (group for group in numbered.values() if len(group) == 1):
        parts = re.findall(r"[^\W_]+", texts[i])
        for k in range(len(parts) if len(parts) > 1 else 0):
            worded.setdefault((found[i].meaning, k, *parts[:k], *parts[k + 1 :]), []).append(i)
    taken: set[int] = set()
    for group in sorted(worded.values(), key=len, reverse=True):
        if len(group) > 1 and not taken & set(group):
            taken |= set(group)
            groups.append((group, (len(group) + 1.0) / 2.0))
    return groups


def _sizes(name: str, k: int, recording: Recording, among: Sequence[Recording]) -> list[float]:
    """Sizes of column `k` of a variable, in its recording and in those of `among` with the same columns and units."""
    return [v.sizes[k] for v in _alike(name, recording, among) if k < len(v.sizes)]


def _alike(name: str, recording: Recording, among: Sequence[Recording]) -> list[Variable]:
    """A variable in its recording and in those of `among` where it has the same columns and units."""
    variable = recording.variables[name]
    alike = [variable, *(v for other in among if (v := other.variables.get(name)) is not None)]
    return [v for v in alike if (v.columns, v.units) == (variable.columns, variable.units)]


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


def _time_unit(x: np.ndarray) -> str:
    """Guess the unit of a clock from its usual interval between samples."""
    steps, coarse = _steps(x), coarse_rate(x)
    step = 1.0 / coarse[1] if coarse else float(np.median(steps)) if len(steps) else np.nan
    if step < _INTERVALS[0][1] and np.nanmin(x) > _MIN_DATE:
        return "day"
    return next((unit for unit, low, high in _INTERVALS if low <= step < high), "s")


def _unit(meaning: str, sizes: Sequence[float], weight: float) -> str:
    """Guess the unit of a channel from the sizes of its values in several recordings, a torque's by the weight."""
    size = max((size for size in sizes if not np.isnan(size)), default=np.nan)
    if meaning == "joint_torque" and weight and size:
        least, most = (share * weight for share in _WEIGHTS)
        return "N m" if size < least else "N mm" if size > most else ""
    return next((unit for unit, largest in _MAX_VALUES.get(meaning, ()) if size <= largest), "")
