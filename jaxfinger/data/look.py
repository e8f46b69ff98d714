"""What a recording holds (names, sizes, rates, gaps, units guessed from ranges), and a mapping that reads it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jaxfinger.data.recording import Recording, Variable
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.toml import as_key, quoted
from jaxfinger.data.units import TO_SI, unit_name

_GAP = 5.0  # times the median interval: a sample or more was lost
# What a name says that a variable is: (channel, pattern), the first that fits. Words of robots' logs in several habits.
_MEANINGS = (
    ("time", r"^t$|time|stamp|clock|zeit|^sec"),
    ("temperature", r"temp"),
    ("joint_torque", r"(^|_)tau|torque|effort|moment"),
    ("tendon_excursion", r"excursion|^l\d*$|length|pull|spool|linear|travel"),
    ("tendon_force", r"tension|tendon.*force|^f_?t|^f(\d|_(?!([xyz]|tip)$))|cable|loadcell|^force"),
    ("fingertip_force", r"f?tip|contact|^f[xyz]$|wrench"),
    ("q", r"^q[_\d]*|angle|pos|enc|theta|winkel|deg$"),
)
_NOT = r"(?<![a-z])vel|speed|dot|^v$|^dq|cmd|command|ref|desired|set|goal"
# Largest sizes that a channel has in its units: the first unit in which the numbers are no larger is the guess.
_SIZES = {
    "q": (("rad", 7.0), ("deg", 400.0)),
    "joint_torque": (("N m", 5.0), ("", 100.0), ("N mm", 5e3)),  # a finger's in N mm, or an arm's in N m: nothing tells
    "tendon_force": (("N", 500.0), ("mN", 1e6)),
    "tendon_excursion": (("m", 0.2), ("mm", 200.0)),
    "fingertip_force": (("N", 100.0), ("mN", 1e5)),
    "temperature": (("degC", 200.0), ("K", 1e3)),
}
_UNITS_OF = {
    "time": ("s",),
    "temperature": ("K",),
    "joint_torque": ("N m", "N"),
    "tendon_excursion": ("m",),
    "tendon_force": ("N",),
    "fingertip_force": ("N",),
    "q": ("rad", "m"),
}
_OF_UNITS = {"rad": "q", "N m": "joint_torque", "N": "tendon_force", "m": "tendon_excursion"}
_MOVES = {"rad": 0.1, "m": 1e-3}  # spans of an angle, or a slide, that moves; less is what a fixture yields
_TICKS = (("s", 1e-5, 0.5), ("ms", 0.01, 500.0), ("us", 10.0, 5e5), ("ns", 1e4, 5e8))  # of usual intervals
_PARTS = 400  # of a recording: a step of a protocol lasts several, and noise is averaged in each
_STANDS = 0.1  # of the quickest change from part to part, below which a joint stands still
_MOSTLY = 0.4  # share of the parts in which a stepped joint stands still; one that swings does so in a sixteenth
_FREE = 0.5  # of the highest tension, by which tension changes where it drives the finger (VD.3), and not along a path
_HEAD = 'specimen = "my finger"\nfinger = "finger.toml"'


@dataclass(frozen=True)
class Seen:
    """One column of a recording."""

    name: str
    column: str | int | None
    samples: int
    low: float
    high: float
    missing: int  # NaN
    units: str  # stated by the recording, else guessed; empty where nothing tells
    stated: bool
    meaning: str  # a channel, `time`, or empty


@dataclass(frozen=True)
class Ticks:
    """One clock of a recording: a variable that increases as times do."""

    name: str
    units: str
    duration: float  # s
    rate: float  # Hz
    gaps: int
    longest: float  # s
    disordered: int  # stamps that do not increase


def columns_of(recording: Recording) -> list[Seen]:
    """Every column of every variable."""
    found = []
    for name, variable in recording.variables.items():
        table = variable.values.reshape(len(variable.values), -1)
        for k, x in enumerate(table.T):
            column = None if table.shape[1] == 1 else (variable.columns[k] if variable.columns else k)
            units, stated = unit_name(variable.units), bool(unit_name(variable.units))
            spelt = units or _spelt(name)
            meaning = _meaning(name, column, x, spelt)
            if spelt:
                units = spelt
            elif not stated:
                units = _tick(x) if meaning == "time" else _guess(meaning, x)
            finite = x[np.isfinite(x)]
            low, high = (float(finite.min()), float(finite.max())) if len(finite) else (np.nan, np.nan)
            found.append(Seen(name, column, len(x), low, high, len(x) - len(finite), units, stated, meaning))
    return found


def clocks_of(recording: Recording, seen: Sequence[Seen]) -> list[Ticks]:
    """Rate, duration and gaps of every clock."""
    return [
        ticks(s.name, recording.variables[s.name], s.units or "s")
        for s in seen
        if s.meaning == "time" and s.samples > 2
    ]


def ticks(name: str, variable: Variable, units: str) -> Ticks:
    """How a clock runs, once its stamps are in order."""
    time = np.ravel(variable.values) * TO_SI[units].factor
    steps = _steps(time)
    usual = float(np.median(steps)) if len(steps) else np.nan
    gaps = steps > _GAP * usual
    return Ticks(
        name,
        units,
        float(steps.sum()),
        1.0 / usual,
        int(gaps.sum()),
        float(steps[gaps].max()) if gaps.any() else 0.0,
        int((np.diff(time) <= 0.0).sum()),
    )


def _steps(time: np.ndarray) -> np.ndarray:
    """From stamp to stamp, in the order of time: what the order of the file says of them would be no rate."""
    return np.diff(np.unique(time[np.isfinite(time)]))


def _meaning(name: str, column: str | int | None, x: np.ndarray, units: str) -> str:
    """What the last word of a name says, where it can be so; else what has these units."""
    bare = re.sub(r"[\[(].*", "", name).strip("/ ")  # units stand in brackets
    word = re.split(r"[./]", bare)[-1].lower()
    if re.search(_NOT, word):
        return ""
    for meaning, pattern in _MEANINGS:
        if re.search(pattern, word) and (not units or TO_SI[units].si in _UNITS_OF[meaning]):
            runs = len(x) > 2 and len(np.unique(x)) > 0.5 * len(x)
            return meaning if meaning != "time" or (column is None and runs) else ""
    return _OF_UNITS.get(TO_SI[units].si, "") if units else ""


def _spelt(name: str) -> str:
    """The unit that a name ends in, `stamp_ms`; of one letter it may be anything."""
    last = re.split(r"[\s_./]", name.strip())[-1]
    return unit_name(last) if len(last) > 1 else ""


def _tick(x: np.ndarray) -> str:
    steps = _steps(x)
    step = float(np.median(steps)) if len(steps) else np.nan
    return next((unit for unit, low, high in _TICKS if low <= step < high), "s")


def _guess(meaning: str, x: np.ndarray) -> str:
    size = float(np.nanpercentile(np.abs(x), 99.0)) if np.isfinite(x).any() else np.nan
    return next((unit for unit, most in _SIZES.get(meaning, ()) if size <= most), "")


def proposal(recordings: Sequence[Recording], finger: FingerDescription | None = None, head: str = _HEAD) -> str:
    """A mapping (TOML) that reads these recordings: one trial of each, to be corrected by who knows the rig.

    Joints and tendons are those of the finger whose names the columns hold, else in order; without a finger they are
    named by the recordings. What all recordings have alike is shared. `head`: the lines of specimen and finger.
    """
    looked = [_looked(recording, finger) for recording in recordings]
    channels = {channel: None for trial in looked for channel in trial.channels}
    shared = {}
    for channel in channels if len(looked) > 1 else ():
        first = looked[0].channels.get(channel)
        if first is not None and all(trial.channels.get(channel) == first for trial in looked):
            shared[channel] = first
    lines = [head]
    if shared:
        lines += ["", "[channels]   # of all trials"]
        lines += [f"{channel}.{as_key(name)} = {said}" for channel, rows in shared.items() for name, said in rows]
    for number, (recording, trial) in enumerate(zip(recordings, looked, strict=True), 1):
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", recording.path.stem).strip("-") or "log"
        stem = stem if re.match(r"\d", stem) else f"{number:02}-{stem}"
        lines += ["", f"[trials.{as_key(stem)}]", f"file = {quoted(recording.path.name)}", *trial.lines]
        for channel, rows in trial.channels.items():
            if channel not in shared:
                lines += [f"channels.{channel}.{as_key(name)} = {said}" for name, said in rows]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class _Looked:
    """What a recording may be as a trial: the lines that say so, and of each channel its columns by name."""

    lines: list[str]
    channels: dict[str, list[tuple[str, str]]]


def _looked(recording: Recording, finger: FingerDescription | None) -> _Looked:
    seen = columns_of(recording)
    clock = next((s for s in seen if s.meaning == "time" and s.name.endswith(".stamp")), None)
    clock = clock or next((s for s in seen if s.meaning == "time"), None)
    channels: dict[str, list[Seen]] = {}
    for s in seen:
        if s.meaning not in ("", "time") and s.samples > 2:
            channels.setdefault(s.meaning, []).append(s)
    names = {channel: _names(channel, columns, finger) for channel, columns in channels.items()}
    experiment, joint, tendon = _experiment(recording, channels, names)
    if joint and len(channels.get("joint_torque", ())) == 1:
        names["joint_torque"] = [joint]  # the one that the motor moves
    lines = [f'experiment = "{experiment}"   # guessed: ID.2, ID.3-static, ID.3-dynamic, ID.4, VD.1, VD.2 or VD.3']
    lines += [f"joint = {quoted(joint)}   # that is moved, or held by the torque sensor"] if joint else []
    lines += [f"tendon = {quoted(tendon)}   # that is pulled"] if tendon else []
    if clock is None:
        lines.append("rate_hz = 1000   # no time was found: write samples per second")
    elif clock.units in ("s", ""):
        lines.append(f"time = {quoted(clock.name)}")
    else:
        lines.append(f'time = {{ from = {quoted(clock.name)}, units = "{clock.units}" }}')
    if clock is not None and (np.diff(np.ravel(recording.variables[clock.name].values)) <= 0.0).any():
        lines.append("sort = true   # its stamps are out of order, or repeated")
    rows = {
        channel: [(name, _column(s)) for name, s in zip(names[channel], columns, strict=False)]
        for channel, columns in channels.items()
    }
    return _Looked(lines, rows)


def _experiment(
    recording: Recording, channels: Mapping[str, Sequence[Seen]], names: Mapping[str, Sequence[str]]
) -> tuple[str, str, str]:
    """What moves tells which experiment it may be, of which joint and tendon; empty where none is.

    Which joint a torque sensor holds no motion tells: `?`, which import refuses, unless it is the only one, or named by
    the file.
    """
    q, force, excursion, torque = (
        channels.get(c, ()) for c in ("q", "tendon_force", "tendon_excursion", "joint_torque")
    )
    units = [s.units or "rad" for s in q]
    spans = [
        (s.high - s.low) * TO_SI[u].factor / _MOVES.get(TO_SI[u].si, np.inf) for s, u in zip(q, units, strict=True)
    ]
    moved = [k for k, span in enumerate(spans) if span > 1.0]
    most = int(np.nanargmax(spans)) if moved else 0
    joint = names["q"][most] if q and most < len(names["q"]) else ""
    pulls = [s.high - s.low for s in force]
    pulled = int(np.nanargmax(pulls)) if force and np.isfinite(pulls).any() else 0
    tendon = names["tendon_force"][pulled] if force and pulled < len(names["tendon_force"]) else ""
    if q and not moved:
        if not torque and channels.get("fingertip_force"):
            return "VD.2", "", tendon
        stem = recording.path.stem.lower()
        named = [name for name in names["q"] if name.lower() in stem] if len(names["q"]) > 1 else names["q"]
        return "ID.4", named[0] if len(named) == 1 else "?", tendon
    if torque or not moved or not (force or excursion):
        return ("ID.3-static" if moved and _stepped(recording, q[most]) else "ID.3-dynamic"), joint, ""
    if len(moved) == 1:
        return "ID.2", joint, ""
    high = max((s.high for s in force), default=0.0)
    return ("VD.3" if max(pulls, default=0.0) > _FREE * high else "VD.1"), "", ""


def _stepped(recording: Recording, seen: Seen) -> bool:
    """Whether a joint stands still for much of the time between its moves."""
    values = recording.variables[seen.name].values
    table = values.reshape(len(values), -1)
    columns = recording.variables[seen.name].columns
    x = table[:, 0 if seen.column is None else columns.index(seen.column) if columns else int(seen.column)]
    x = x[np.isfinite(x)]
    steps = np.abs(np.diff([part.mean() for part in np.array_split(x, min(len(x), _PARTS))]))
    return float(np.mean(steps < _STANDS * np.percentile(steps, 95.0))) > _MOSTLY


def _names(channel: str, columns: Sequence[Seen], finger: FingerDescription | None) -> list[str]:
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
    return own if len(own) == len(columns) == len(set(own)) else known


def _column(seen: Seen) -> str:
    parts = [f"from = {quoted(seen.name)}"]
    if seen.column is not None:
        parts.append(f"column = {quoted(seen.column) if isinstance(seen.column, str) else seen.column}")
    fits = {"q": "rad", "joint_torque": "N m", "tendon_force": "N", "fingertip_force": "N", "tendon_excursion": "m"}
    if seen.units and TO_SI[seen.units].si == fits.get(seen.meaning):
        parts.append(f'units = "{seen.units}"')
    return "{ " + ", ".join(parts) + " }"
