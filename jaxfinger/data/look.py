"""What a recording holds (names, sizes, rates, gaps, units guessed from ranges), and a mapping that reads it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxfinger.data.recording import Recording, Variable
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.units import TO_SI, known

_GAP = 5.0  # times the median interval: a sample or more was lost
# What a name says that a variable is: (channel, pattern), the first that fits. Words of robots' logs in several habits.
_MEANINGS = (
    ("time", r"^t$|time|stamp|clock|zeit|^sec"),
    ("temperature", r"temp"),
    ("joint_torque", r"(^|_)tau|torque|effort|moment"),
    ("tendon_excursion", r"excursion|^l\d*$|length|pull|spool|linear"),
    ("tendon_force", r"tension|tendon.*force|^f_?t|cable|loadcell|^force"),
    ("fingertip_force", r"f?tip|contact|^f[xyz]$|wrench"),
    ("q", r"^q[_\d]*|angle|pos|enc|theta|winkel|deg$"),
)
_NOT = r"vel|speed|dot|^v$|^dq|cmd|command|ref|desired|set|goal"
# Largest sizes that a channel has in its units: the first unit in which the numbers are no larger is the guess.
_SIZES = {
    "q": (("rad", 7.0), ("deg", 400.0)),
    "joint_torque": (("N m", 5.0), ("", 100.0), ("N mm", 5e3)),  # a finger's in N mm, or an arm's in N m: nothing tells
    "tendon_force": (("N", 500.0), ("mN", 1e6)),
    "tendon_excursion": (("m", 0.2), ("mm", 200.0)),
    "fingertip_force": (("N", 100.0), ("mN", 1e5)),
    "temperature": (("K", 1e3),),
}
_TICKS = (("s", 1e-5, 0.5), ("ms", 0.01, 500.0), ("us", 10.0, 5e5), ("ns", 1e4, 5e8))  # of usual intervals


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
            meaning = _meaning(name, column, x)
            units, stated = known(variable.units), bool(known(variable.units))
            if not stated:
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
    time = np.ravel(variable.values) * TO_SI[units][1]
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


def _meaning(name: str, column: str | int | None, x: np.ndarray) -> str:
    """What the last word of a name says, where it can be so."""
    bare = re.sub(r"[\[(].*", "", name).strip("/ ")  # units stand in brackets
    word = re.split(r"[./]", bare)[-1].lower()
    if re.search(_NOT, word):
        return ""
    for meaning, pattern in _MEANINGS:
        if re.search(pattern, word):
            runs = len(x) > 2 and len(np.unique(x)) > 0.5 * len(x)
            return meaning if meaning != "time" or (column is None and runs) else ""
    return ""


def _tick(x: np.ndarray) -> str:
    steps = _steps(x)
    step = float(np.median(steps)) if len(steps) else np.nan
    return next((unit for unit, low, high in _TICKS if low <= step < high), "s")


def _guess(meaning: str, x: np.ndarray) -> str:
    size = float(np.nanpercentile(np.abs(x), 99.0)) if np.isfinite(x).any() else np.nan
    return next((unit for unit, most in _SIZES.get(meaning, ()) if size <= most), "")


def proposal(recordings: Sequence[Recording], finger: FingerDescription | None = None) -> str:
    """A mapping (TOML) that reads these recordings: one trial of each, to be corrected by who knows the rig.

    Joints and tendons are those of the finger, in order, or are named by the recordings' columns.
    """
    lines = ['specimen = "my finger"', 'finger = "finger.toml"']
    for number, recording in enumerate(recordings, 1):
        lines += ["", *_trial(number, recording, finger)]
    return "\n".join(lines) + "\n"


def _trial(number: int, recording: Recording, finger: FingerDescription | None) -> list[str]:
    seen = columns_of(recording)
    stem = re.sub(r"[^A-Za-z0-9_-]+", "-", recording.path.stem).strip("-") or "log"
    lines = [f"[trials.{_quoted(f'{number:02}-{stem}')}]", f"file = {_quoted(recording.path.name, True)}"]
    lines.append('experiment = "ID.3-dynamic"   # or ID.2, ID.3-static, ID.4, VD.1, VD.2, VD.3')
    clock = next((s for s in seen if s.meaning == "time" and s.name.endswith(".stamp")), None)
    clock = clock or next((s for s in seen if s.meaning == "time"), None)
    channels: dict[str, list[Seen]] = {}
    for s in seen:
        if s.meaning not in ("", "time") and s.samples > 2:
            channels.setdefault(s.meaning, []).append(s)
    names = {channel: _names(channel, columns, finger) for channel, columns in channels.items()}
    joint = names.get("q", ["J"])[0] if names.get("q") else "J"
    lines.append(f"joint = {_quoted(joint, True)}   # the joint that is moved, or leave it out")
    if clock is None:
        lines.append("rate_hz = 1000   # no time was found: write samples per second")
    elif clock.units in ("s", ""):
        lines.append(f"time = {_quoted(clock.name, True)}")
    else:
        lines.append(f'time = {{ from = {_quoted(clock.name, True)}, units = "{clock.units}" }}')
    if clock is not None and (np.diff(np.ravel(recording.variables[clock.name].values)) <= 0.0).any():
        lines.append("sort = true   # its stamps are out of order, or repeated")
    for channel, columns in channels.items():
        for name, s in zip(names[channel], columns, strict=False):
            lines.append(f"channels.{channel}.{_quoted(name)} = {_column(s)}")
    return lines


def _names(channel: str, columns: Sequence[Seen], finger: FingerDescription | None) -> list[str]:
    if channel == "temperature":
        return [s.name for s in columns]
    if channel == "fingertip_force":
        return ["x", "y", "z"]
    letter = "J" if channel in ("q", "joint_torque") else "T"
    if finger is not None:
        return list(finger.joint_names if letter == "J" else finger.tendon_names)
    return [s.column if isinstance(s.column, str) else f"{letter}{k}" for k, s in enumerate(columns, 1)]


def _column(seen: Seen) -> str:
    parts = [f"from = {_quoted(seen.name, True)}"]
    if seen.column is not None:
        parts.append(f"column = {_quoted(seen.column, True) if isinstance(seen.column, str) else seen.column}")
    fits = {"q": "rad", "joint_torque": "N m", "tendon_force": "N", "fingertip_force": "N", "tendon_excursion": "m"}
    if seen.units and TO_SI[seen.units][0] == fits.get(seen.meaning):
        parts.append(f'units = "{seen.units}"')
    return "{ " + ", ".join(parts) + " }"


def _quoted(name: str, always: bool = False) -> str:
    """A key or a string of TOML."""
    if not always and re.fullmatch(r"[A-Za-z0-9_-]+", name):
        return name
    escaped = name.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
