"""Survey of a recording (names, ranges, rates, gaps, guessed units), and a proposal of a mapping that reads it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxfinger.data.importing.columns import coarse_rate, restarts
from jaxfinger.data.importing.recording import Recording, Variable
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.toml import as_key, quoted
from jaxfinger.data.units import TO_SI, is_foreign, unit_name
from jaxfinger.errors import listed

MIN_GAP = 5.0  # usual intervals of a clock that ticks evenly: in a longer one samples were lost.
# Patterns of names for each channel, of which the first that fits counts: common words in logs of robots.
_MEANINGS = (
    ("time", r"^t$|time|stamp|clock|zeit|^sec"),
    ("temperature", r"temp"),
    ("joint_torque", r"(^|_)tau|torque|effort|moment"),
    ("tendon_excursion", r"excursion|^l\d*$|length|pull|spool|linear|travel"),
    ("tendon_force", r"tension|tendon.*force|^f_?t|^f(\d|_(?!([xyz]|tip)$))|cable|loadcell|(^|_)cell(_|\d|$)|^force"),
    ("fingertip_force", r"f?tip|contact|^f[xyz]$|wrench"),
    ("q", r"^q[_\d]*|angle|pos|enc|theta|winkel|deg$"),
)
# Names of velocities, which belong to no channel, and of set-points, which are not measured.
_VELOCITY = r"(?<![a-z])vel|speed|dot|^v$|^dq"
_SET_POINT = (
    r"cmd|command|ref(?!l)|desired|set_?p(oin)?t|goal|target|demand|soll|feed_?forward"
    r"|(?<![a-z])(q|tau|pos)?(des|set(?!\d+\.)|sp|ff|tgt|nominal|planned)(?![a-z])"
)
# Names of what is in front of a joint's gear or spring.
_MOTOR = r"(?<![a-z])(motor|mot|drive|actuator|rotor|spool|winch)(?![a-z])"
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
_MIN_TRAVEL = {"rad": 0.1, "m": 1e-3}  # Less is the yield of a fixture.
# Ranges of the usual interval, 10 µs to 0.5 s, in each unit. Where they overlap the first one counts.
_INTERVALS = (("s", 1e-5, 0.5), ("ms", 0.01, 500.0), ("us", 10.0, 5e5), ("ns", 1e4, 5e8))
_PARTS = 400  # of a recording: a step of a protocol lasts several of them, and each averages noise.
_MAX_STILL_CHANGE = 0.1  # of the quickest change between parts: with less a joint stands still.
_MIN_STILL_SHARE = 0.4  # of the parts: a stepped joint stands still in more of them, a swinging one in a sixteenth.
_MIN_TENSION_CHANGE = 0.5  # of the highest tension: larger where tendons drive the finger (VD.3), smaller in VD.1.
_MAX_LEFT_OUT = 12  # variables that are named, so that the line of a large bag stays readable.
_HEAD = 'specimen = "my finger"\nfinger = "finger.toml"'


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

    A unit is guessed from the largest values that the column has in any recording `among` these: a joint that is held
    at 5 degrees could be one at 5 rad, until another recording shows it at 80.
    """
    found = []
    for name, variable in recording.variables.items():
        table = variable.values.reshape(len(variable.values), -1)
        for k, x in enumerate(table.T):
            column = None if table.shape[1] == 1 else (variable.columns[k] if variable.columns else k)
            units, stated = unit_name(variable.units), bool(unit_name(variable.units))
            spelt = units or _spelt(name)
            foreign = variable.units if is_foreign(variable.units) and not spelt else ""
            meaning = _meaning(name, column, x, spelt)
            if spelt:
                units = spelt
            elif not stated and not foreign:
                units = _time_unit(x) if meaning == "time" else _unit(meaning, _sizes(name, k, recording, among))
            finite = x[np.isfinite(x)]
            low, high = (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)
            missing = len(x) - len(finite)
            found.append(ColumnSurvey(name, column, len(x), low, high, missing, units, stated, meaning, foreign))
    return found


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
    word = re.split(r"[./]", bare)[-1].lower()
    if re.search(_VELOCITY, word) or is_set_point(name):
        return ""
    for meaning, pattern in _MEANINGS:
        if re.search(pattern, word) and (not units or TO_SI[units].si in _SI_UNITS[meaning]):
            runs = len(x) > 2 and (len(np.unique(x)) > 0.5 * len(x) or coarse_rate(x) is not None)
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


def proposal(recordings: Sequence[Recording], finger: FingerDescription | None = None, head: str = _HEAD) -> str:
    """Propose a mapping (TOML) with one trial for each recording, to be corrected by someone who knows the rig.

    Columns are assigned to the finger's joints and tendons by name, or in order where names do not match. Without a
    finger, joints and tendons are named as in the recordings. Channels that all recordings map alike are shared. `head`
    holds the lines of specimen and finger.
    """
    proposed = [_trial_proposal(recording, recordings, finger) for recording in recordings]
    channels = {channel: None for trial in proposed for channel in trial.channels}
    shared = {}
    for channel in channels if len(proposed) > 1 else ():
        first = proposed[0].channels.get(channel)
        if first is not None and all(trial.channels.get(channel) == first for trial in proposed):
            shared[channel] = first
    lines = [head]
    if shared:
        lines += ["", "[channels]   # of all trials"]
        lines += [f"{channel}.{as_key(name)} = {said}" for channel, rows in shared.items() for name, said in rows]
    for number, (recording, trial) in enumerate(zip(recordings, proposed, strict=True), 1):
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", recording.path.stem).strip("-") or "log"
        stem = stem if re.match(r"\d", stem) else f"{number:02}-{stem}"
        lines += ["", f"[trials.{as_key(stem)}]", f"file = {quoted(recording.path.name)}", *trial.lines]
        for channel, rows in trial.channels.items():
            if channel not in shared:
                lines += [f"channels.{channel}.{as_key(name)} = {said}" for name, said in rows]
        for what, said in ((False, "in no channel yet"), (True, "set-points by their names, which are not measured")):
            named = [quoted(name) for name in trial.left_out if is_set_point(name) == what]
            lines += [f"# {said}: {listed(named, _MAX_LEFT_OUT)}"] if named else []
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class _Proposal:
    """Proposal for one recording as a trial."""

    lines: list[str]  # of TOML: experiment, joint, tendon and time
    channels: dict[str, list[tuple[str, str]]]  # name and reading of each column
    left_out: list[str]  # names of variables that no channel reads


def _trial_proposal(
    recording: Recording, recordings: Sequence[Recording], finger: FingerDescription | None
) -> _Proposal:
    """Propose a trial for a recording, one of several of one rig."""
    seen = columns_of(recording, recordings)
    clock = next((s for s in seen if s.meaning == "time" and s.name.endswith(".stamp")), None)
    clock = clock or next((s for s in seen if s.meaning == "time"), None)
    channels: dict[str, list[ColumnSurvey]] = {}
    for s in seen:
        if s.meaning not in ("", "time") and s.samples > 2:
            channels.setdefault(s.meaning, []).append(s)
    for channel in ("q", "joint_torque"):
        if own := [s for s in channels.get(channel, ()) if not _is_motor(s)]:
            channels[channel] = own
    names = {channel: _names(channel, columns, finger) for channel, columns in channels.items()}
    experiment, joint, tendon = _experiment(recording, channels, names)
    if joint and len(channels.get("joint_torque", ())) == 1:
        names["joint_torque"] = [joint]  # A single torque sensor belongs to the joint that the motor moves.
    lines = [f'experiment = "{experiment}"   # guessed: ID.2, ID.3-static, ID.3-dynamic, ID.4, VD.1, VD.2 or VD.3']
    lines += [f"joint = {quoted(joint)}   # that is moved, or held by the torque sensor"] if joint else []
    lines += [f"tendon = {quoted(tendon)}   # that is pulled"] if tendon else []
    time = np.ravel(recording.variables[clock.name].values) * TO_SI[clock.units or "s"].factor if clock else np.zeros(0)
    coarse = coarse_rate(time)
    if clock is None:
        lines.append("rate_hz = 1000   # no time was found: write samples per second")
    elif coarse is not None:
        lines.append(f"rate_hz = {coarse[1]:.4g}   # several samples share each stamp of {quoted(clock.name)}")
    elif clock.units in ("s", ""):
        lines.append(f"time = {quoted(clock.name)}")
    else:
        lines.append(f'time = {{ from = {quoted(clock.name)}, units = "{clock.units}" }}')
    if len(begins := restarts(time)):
        lines.append(f"# the time begins again after sample {begins[0]}: a trial for each part, chosen by `where`")
    elif coarse is None and (np.diff(time) <= 0.0).any():
        lines.append("sort = true   # its stamps are out of order, or repeated")
    rows = {
        channel: [(name, _column(s)) for name, s in zip(names[channel], columns, strict=False)]
        for channel, columns in channels.items()
    }
    read = {s.name for channel, columns in channels.items() for s in columns[: len(rows[channel])]}
    left_out = dict.fromkeys(s.name for s in seen if s.name not in read and s.meaning != "time")
    return _Proposal(lines, rows, list(left_out))


def _is_motor(seen: ColumnSurvey) -> bool:
    """Whether a column's name says that it belongs to a motor: where the joint has columns of its own, these count."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", f"{seen.name} {seen.column or ''}").lower()
    return re.search(_MOTOR, words) is not None


def _experiment(
    recording: Recording, channels: Mapping[str, Sequence[ColumnSurvey]], names: Mapping[str, Sequence[str]]
) -> tuple[str, str, str]:
    """Guess experiment, joint and tendon (empty where there is none) from what moves.

    No motion shows which joint a torque sensor holds. It is the only joint, or the one in the file's name, or else `?`,
    which import refuses.
    """
    q, force, excursion, torque = (
        channels.get(c, ()) for c in ("q", "tendon_force", "tendon_excursion", "joint_torque")
    )
    units = [s.units or "rad" for s in q]
    spans = [
        (s.high - s.low) * TO_SI[u].factor / _MIN_TRAVEL.get(TO_SI[u].si, np.inf) for s, u in zip(q, units, strict=True)
    ]
    moved = [k for k, span in enumerate(spans) if span > 1.0]
    most = int(np.nanargmax(spans)) if moved else 0
    joint = names["q"][most] if q and most < len(names["q"]) else ""
    pulls = [s.high - s.low for s in force]
    pulled = int(np.nanargmax(pulls)) if force and np.isfinite(pulls).any() else 0
    tendon = names["tendon_force"][pulled] if force and pulled < len(names["tendon_force"]) else ""
    if q and not moved:  # The joints are held, and a tendon is pulled.
        if not torque and channels.get("fingertip_force"):
            return "VD.2", "", tendon
        stem = recording.path.stem.lower()
        named = [name for name in names["q"] if name.lower() in stem] if len(names["q"]) > 1 else names["q"]
        return "ID.4", named[0] if len(named) == 1 else "?", tendon
    if torque or not moved or not (force or excursion):  # A motor moves a joint.
        return ("ID.3-static" if moved and _stepped(recording, q[most]) else "ID.3-dynamic"), joint, ""
    if len(moved) == 1:
        return "ID.2", joint, ""
    # Several joints are moved, by hand or by the tendons.
    high = max((s.high for s in force), default=0.0)
    return ("VD.3" if max(pulls, default=0.0) > _MIN_TENSION_CHANGE * high else "VD.1"), "", ""


def _stepped(recording: Recording, seen: ColumnSurvey) -> bool:
    """Whether a joint stands still for much of the time between its moves."""
    values = recording.variables[seen.name].values
    table = values.reshape(len(values), -1)
    columns = recording.variables[seen.name].columns
    x = table[:, 0 if seen.column is None else columns.index(seen.column) if columns else int(seen.column)]
    x = x[np.isfinite(x)]
    steps = np.abs(np.diff([part.mean() for part in np.array_split(x, min(len(x), _PARTS))]))
    return float(np.mean(steps < _MAX_STILL_CHANGE * np.percentile(steps, 95.0))) > _MIN_STILL_SHARE


def _names(channel: str, columns: Sequence[ColumnSurvey], finger: FingerDescription | None) -> list[str]:
    """Names of joints, tendons, axes or sensors for the columns of a channel."""
    if channel == "temperature":
        return [s.name for s in columns]
    if channel == "fingertip_force":
        return ["x", "y", "z"]
    letter = "J" if channel in ("q", "joint_torque") else "T"
    if finger is None:
        return [s.column if isinstance(s.column, str) else f"{letter}{k}" for k, s in enumerate(columns, 1)]
    known = list(finger.joint_names if letter == "J" else finger.tendon_names)
    held = [[n for n in known if n.lower() in f"{s.name} {s.column or ''}".lower()] for s in columns]
    own = [max(names, key=len) for names in held if names]
    return own if len(own) == len(columns) == len(set(own)) else _by_number(columns, known)


def _by_number(columns: Sequence[ColumnSurvey], known: Sequence[str]) -> list[str]:
    """Names for columns that differ in a number alone, such as q2 and q1, by that number; else in their order."""
    parts = [re.split(r"(\d+)", s.name if s.column is None else f"{s.name} {s.column}") for s in columns]
    places = [k for k in range(len(parts[0])) if len({tuple(part[k : k + 1]) for part in parts}) > 1]
    if len({len(part) for part in parts}) > 1 or len(places) != 1 or places[0] % 2 == 0:
        return list(known)
    numbers = [int(part[places[0]]) for part in parts]
    if min(numbers) > 0 and max(numbers) <= len(known):
        return [known[number - 1] for number in numbers]
    return [known[sorted(numbers).index(number)] for number in numbers] if len(numbers) <= len(known) else list(known)


def _column(seen: ColumnSurvey) -> str:
    """Inline table (TOML) that reads a column."""
    parts = [f"from = {quoted(seen.name)}"]
    if seen.column is not None:
        parts.append(f"column = {quoted(seen.column) if isinstance(seen.column, str) else seen.column}")
    fits = {"q": "rad", "joint_torque": "N m", "tendon_force": "N", "fingertip_force": "N", "tendon_excursion": "m"}
    if seen.units and TO_SI[seen.units].si == fits.get(seen.meaning):
        parts.append(f'units = "{seen.units}"')
    said = f"it states {seen.foreign}: write `scale`" if seen.foreign else "SI as it stands"
    unclear = "" if seen.units else f"   # units? {said}"
    return "{ " + ", ".join(parts) + " }" + unclear
