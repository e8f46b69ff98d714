"""Proposal of a mapping that reads some recordings, by a survey of their columns."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxfinger.data.importing.assignment import assigned, held_names, known_names, named_columns
from jaxfinger.data.importing.columns import coarse_rate, restarts
from jaxfinger.data.importing.names import is_nameless, is_set_point, is_speed, spelt_unit, words
from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.importing.speeds import speeds
from jaxfinger.data.importing.survey import ColumnSurvey, columns_of
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.signals.pace import speed
from jaxfinger.data.toml import as_key, quoted
from jaxfinger.data.units import TO_SI, beyond_a_turn
from jaxfinger.errors import counted, listed

# Names of what is in front of a joint's gear or spring.
_MOTOR = r"(?<![a-z])(motor|mot|drive|actuator|rotor|spool|winch)(?![a-z])"
# Where a log has both, q is a joint's angle, and theta that of the motor in front of its elastic gear.
_LINK, _MOTOR_BESIDE_LINK = r"(?<![a-z])q(?![a-z])", r"(?<![a-z])theta(?![a-z])"
_MIN_TRAVEL = {"rad": 0.1, "m": 1e-3}  # Less is the yield of a fixture.
_PARTS = 400  # of a recording: a step of a protocol lasts several of them, and each averages noise.
_MAX_STILL_CHANGE = 0.1  # of the quickest change between parts: with less a joint stands still.
_MIN_STILL_SHARE = 0.4  # of the parts: a stepped joint stands still in more of them, a swinging one in a sixteenth.
_MIN_TENSION_CHANGE = 0.5  # of the highest tension: larger where tendons drive the finger (VD.3), smaller in VD.1.
_MAX_LEFT_OUT = 12  # variables that are named, so that the line of a large bag stays readable.
# Of the time of two logs: with more in common they show one trial. Loggers that are started by hand begin and end a
# little apart.
_TOGETHER = 0.9
_MAX_SPEEDS = 4  # that are named
_MAX_TABLE = 10  # samples: files that are no longer may be tables of parameters, and of one length by chance.
_USUAL_RATES = 100, 1000  # Hz
_HEAD = 'specimen = "my finger"\nfinger = "finger.toml"'


def proposal(recordings: Sequence[Recording], finger: FingerDescription | None = None, head: str = _HEAD) -> str:
    """Propose a mapping (TOML) with one trial for each recording, to be corrected by someone who knows the rig.

    A recording without angles, such as the log of a torque sensor alone, belongs to the trial of the recording with
    angles that was made at the same time. Columns are assigned to the finger's joints and tendons by name, or in order
    where names do not match. Without a finger, joints and tendons are named as in the recordings. Channels that all
    recordings map alike are shared. `head` holds the lines of specimen and finger.
    """
    names = (finger.joint_names, finger.tendon_names) if finger is not None else ()
    seen = [columns_of(recording, recordings, *names) for recording in recordings]
    trials = _trials([_Log(*pair) for pair in zip(recordings, seen, strict=True)])
    proposed = [_trial_proposal(logs, finger) for logs in trials]
    channels = {channel: None for trial in proposed for channel in trial.channels}
    shared = {}
    for channel in channels if len(proposed) > 1 else ():
        first = proposed[0].channels.get(channel)
        if first is not None and all(trial.channels.get(channel) == first for trial in proposed):
            shared[channel] = first
    lines = [head, *_side_by_side([log for logs in trials for log in logs])]
    if shared:
        lines += ["", "[channels]   # of all trials"]
        lines += [f"{channel}.{as_key(name)} = {said}" for channel, rows in shared.items() for name, said in rows]
    for number, (logs, trial) in enumerate(zip(trials, proposed, strict=True), 1):
        recording = logs[0].recording
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", recording.path.stem).strip("-") or "log"
        stem = stem if re.match(r"\d", stem) else f"{number:02}-{stem}"
        lines += ["", f"[trials.{as_key(stem)}]", f"file = {quoted(recording.path.name)}", *trial.lines]
        for channel, rows in trial.channels.items():
            if channel not in shared:
                lines += [f"channels.{channel}.{as_key(name)} = {said}" for name, said in rows]
        for log in logs:
            unread = [f"# {quoted(name)} {reason}" for name, reason in log.recording.unusable.items()]
            lines += unread[:_MAX_LEFT_OUT]
        for what, said in ((False, "in no channel yet"), (True, "set-points by their names, which are not measured")):
            named = [quoted(name) for name in trial.left_out if is_set_point(name) == what]
            lines += [f"# {said}: {listed(named, _MAX_LEFT_OUT)}"] if named else []
    return "\n".join(lines) + "\n"


def _side_by_side(logs: Sequence[_Log]) -> list[str]:
    """A comment for logs with as many samples as one without a clock: each may hold an array of one recording."""
    lines = []
    for count in dict.fromkeys(log.count for log in logs if log.clock is None):
        names = [quoted(log.recording.path.name) for log in logs if log.count == count]
        if len(names) > 1 and count > _MAX_TABLE:
            lines += [
                "",
                f"# {listed(names)} hold {count} samples each. If these are the same samples, write one trial",
                f"# of them: file = [{', '.join(names)}]",
            ]
    return lines


@dataclass(frozen=True)
class _Proposal:
    """Proposal for one recording as a trial."""

    lines: list[str]  # of TOML: experiment, joint, tendon and time
    channels: dict[str, list[tuple[str, str]]]  # name and reading of each column
    left_out: list[str]  # names of variables that no channel reads


@dataclass(frozen=True)
class _Log:
    """A recording and the survey of its columns."""

    recording: Recording
    seen: list[ColumnSurvey]

    @property
    def clock(self) -> ColumnSurvey | None:
        """Column with the times of its samples: stamps of headers before other clocks, and these before counts."""
        clocks = [s for s in self.seen if s.meaning == "time"]
        return min(clocks, key=lambda s: (not s.name.endswith(".stamp"), self.counts(s)), default=None)

    def counts(self, clock: ColumnSurvey) -> bool:
        """Whether a clock without units goes on by one from sample to sample, as an index does and ms may."""
        steps = np.diff(np.ravel(self.recording.variables[clock.name].values))
        return not (clock.stated or spelt_unit(clock.name)) and bool(np.all(steps == 1.0))

    @property
    def count(self) -> int:
        """Number of samples of its longest column."""
        return max((s.samples for s in self.seen), default=0)

    @cached_property
    def time(self) -> np.ndarray:
        """Times of its samples, s; empty where it has no clock."""
        if (clock := self.clock) is None:
            return np.zeros(0)
        return np.ravel(self.recording.variables[clock.name].values) * TO_SI[clock.units or "s"].factor

    @cached_property
    def span(self) -> tuple[float, float] | None:
        """First and last time, s; None where it has none."""
        return (float(np.nanmin(self.time)), float(np.nanmax(self.time))) if np.isfinite(self.time).any() else None

    @property
    def columns(self) -> list[ColumnSurvey]:
        """Columns that may belong to a channel: those that the log's clock, or one of their own, gives times.

        Families of columns without any value are left out.
        """
        samples = self.clock.samples if self.clock is not None else self.count
        filled = {_family(s) for s in self.seen if s.missing < s.samples}
        timed = [s for s in self.seen if s.samples == samples or self.recording.variables[s.name].clock]
        return [s for s in timed if s.meaning not in ("", "time") and s.samples > 2 and _family(s) in filled]

    @property
    def channels(self) -> set[str]:
        """Channels that its columns may belong to."""
        return {s.meaning for s in self.columns}


def _trials(logs: Sequence[_Log]) -> list[list[_Log]]:
    """Logs of each trial: one without angles joins the only one with angles that shares its time and no channel."""
    trials = {i: [log] for i, log in enumerate(logs)}
    for i, log in enumerate(logs):
        if "q" in log.channels:
            continue
        beside = [
            k
            for k, other in enumerate(logs)
            if "q" in other.channels
            and not log.channels & other.channels
            and _overlap(log.span, other.span) > _TOGETHER
        ]
        if len(beside) == 1:
            trials[beside[0]].append(log)
            del trials[i]
    return list(trials.values())


def _overlap(a: tuple[float, float] | None, b: tuple[float, float] | None) -> float:
    """Share of the time of two spans that both cover."""
    if a is None or b is None or (whole := max(a[1], b[1]) - min(a[0], b[0])) <= 0.0:
        return 0.0
    return (min(a[1], b[1]) - max(a[0], b[0])) / whole


def _trial_proposal(logs: Sequence[_Log], finger: FingerDescription | None) -> _Proposal:
    """Propose a trial for the logs that were made at one time; the first one gives its times."""
    recording, clock, time = logs[0].recording, logs[0].clock, logs[0].time
    elsewhere = {s: log for log in logs[1:] for s in log.seen}
    channels: dict[str, list[ColumnSurvey]] = {}
    for s in (s for log in logs for s in log.columns):
        channels.setdefault(s.meaning, []).append(s)
    for channel in ("q", "joint_torque"):
        if own := [s for s in channels.get(channel, ()) if not _is_motor(s)]:
            channels[channel] = own
    if any(_has(_LINK, s) for s in channels.get("q", ())):
        channels["q"] = [s for s in channels["q"] if not _has(_MOTOR_BESIDE_LINK, s)]
    rivals = _choose_families(channels, finger)
    names, surplus = _assign(channels, finger)
    experiment, joint, tendon = _experiment(recording, channels, names)
    torques = channels.get("joint_torque", ())
    if joint and len(torques) == 1 and not any(held_names(torques, known_names("joint_torque", finger))):
        names["joint_torque"] = [joint]  # A single torque sensor belongs to the joint that the motor moves.
    lines = [f'experiment = "{experiment}"   # guessed: ID.2, ID.3-static, ID.3-dynamic, ID.4, VD.1, VD.2 or VD.3']
    lines += [f"joint = {quoted(joint)}   # that is moved, or held by the torque sensor"] if joint else []
    lines += [f"tendon = {quoted(tendon)}   # that is pulled"] if tendon else []
    coarse = coarse_rate(time)
    guessed = "   # guessed: its values rise evenly" if clock is not None and is_nameless(clock.name) else ""
    if clock is not None and logs[0].counts(clock):
        guessed = "   # it counts by one: if it counts samples, write `rate_hz`, samples per second, in its place"
    if clock is None:
        lines.append('time = "?"   # no time was found: name its variable, or write `rate_hz`, samples per second')
        lines += _pace(logs[0], channels.get("q", ()))
    elif coarse is not None:
        lines.append(f"rate_hz = {coarse[1]:.4g}   # several samples share each stamp of {quoted(clock.name)}")
    elif clock.units in ("s", ""):
        lines.append(f"time = {quoted(clock.name)}{guessed}")
    else:
        lines.append(f'time = {{ from = {quoted(clock.name)}, units = "{clock.units}" }}{guessed}')
    if clock is None or is_nameless(clock.name):
        lines += _rate_by_speeds(logs[0])
    for channel, families in rivals.items():
        named = [f"{_called(family[0])} to {_called(family[-1])}" for family in families]
        lines.append(f"# {channel} could also be {' or '.join(named)}: take what was measured")
    lines += surplus
    if len(begins := restarts(time)):
        lines.append(f"# the time begins again after sample {begins[0]}: a trial for each part, chosen by `where`")
    elif coarse is None and (np.diff(time) <= 0.0).any():
        lines.append("sort = true   # its stamps are out of order, or repeated")
    slides = dict(zip(finger.joint_names, finger.prismatic, strict=True)) if finger is not None else {}
    turns = finger is not None and any(map(beyond_a_turn, finger.limits))
    rows = {
        channel: [
            (name, _column(s, elsewhere.get(s), slides.get(name, False), turns))
            for name, s in zip(names[channel], columns, strict=True)
        ]
        for channel, columns in channels.items()
    }
    read = {s for columns in channels.values() for s in columns}
    read |= {s for families in rivals.values() for family in families for s in family}
    unread = [s for log in logs for s in log.seen if s not in read and s.meaning != "time"]
    left_out = dict.fromkeys(s.name for s in sorted(unread, key=lambda s: not s.meaning))  # what could be read first
    return _Proposal(lines, rows, list(left_out))


def _choose_families(
    channels: dict[str, list[ColumnSurvey]], finger: FingerDescription | None
) -> dict[str, list[list[ColumnSurvey]]]:
    """Keep one set of columns of angles and of torques in `channels`, and return the other sets by channel."""
    rivals = {}
    for channel in ("q", "joint_torque"):
        known = known_names(channel, finger)
        columns = named_columns(channels.get(channel, ()), known)
        # Without a finger, the angles tell how many joints have a torque.
        if families := _families(columns, len(known) or len(channels.get("q", ())), known):
            columns, *rivals[channel] = families
        channels |= {channel: columns} if columns else {}
    return rivals


def _assign(
    channels: dict[str, list[ColumnSurvey]], finger: FingerDescription | None
) -> tuple[dict[str, list[str]], list[str]]:
    """Names of the columns of each channel, of which `channels` keeps those with one; and comments on the others."""
    names, comments = {}, []
    for channel, columns in channels.items():
        known = known_names(channel, finger)
        names[channel], channels[channel] = assigned(channel, columns, finger)
        if known and len(columns) > len(known) and not any(held_names(columns, known)):
            said = f"{counted(len(columns), 'column')} for {listed(known)}, in their order"
            comments.append(f"# {channel}: {said}: correct this, or give the finger the names of the recording")
    counts = [len(channels.get(channel, ())) for channel in ("q", "joint_torque")]
    if finger is None and min(counts) > 1 and counts[0] != counts[1]:
        said = " and ".join(
            f"{count} of {channel}" for count, channel in zip(counts, ("q", "joint_torque"), strict=True)
        )
        comments.append(f"# {said}, named in their order: give those of one joint the same name")
    return names, comments


def _families(columns: Sequence[ColumnSurvey], count: int, known: Sequence[str]) -> list[list[ColumnSurvey]]:
    """Sets of `count` columns each whose names differ in `known` names or numbers alone, if these are all.

    Those that change come first.

    None where there is one set only, or where some column is in no set: then they may be of different joints.
    """
    sets: dict[str, list[ColumnSurvey]] = {}
    for s, name in zip(columns, held_names(columns, known), strict=True):
        text = f"{s.name} {s.column}"
        text = re.sub(re.escape(name), "#", text, flags=re.IGNORECASE) if name else text
        sets.setdefault(re.sub(r"\d+", "#", text), []).append(s)
    if len(sets) < 2 or any(len(family) != count for family in sets.values()):
        return []
    return sorted(sets.values(), key=lambda family: all(s.low == s.high for s in family))


def _rate_by_speeds(log: _Log) -> list[str]:
    """A comment on the sampling rate at which some columns of a log without a named clock are the speeds of others."""
    seen = [s for s in log.seen if s.samples == log.count and s.meaning in ("", "q")]
    found = [x for x in speeds([_values(log.recording, s) for s in seen]) if is_speed(seen[x.speed].name)]
    if not found:
        return []
    named = [f"{_called(seen[x.speed])} of {_called(seen[x.of])} at {float(f'{x.rate:.3g}'):g}" for x in found]
    return [
        f"# speeds, if in the units of their angles by s, tell the samples per second: {listed(named, _MAX_SPEEDS)}"
    ]


def _pace(log: _Log, angles: Sequence[ColumnSurvey]) -> list[str]:
    """A comment on how long a log without a clock lasts, and how fast its joints move, at two usual sampling rates."""
    if not angles:
        return []
    count = np.arange(float(log.count))
    moves = [(speed(count, _values(log.recording, s)), _called(s), s.units) for s in angles if s.samples == log.count]
    fastest, name, units = max(moves, default=(0.0, "", ""))
    said = [
        f"at {rate} Hz they last {len(count) / rate:.3g} s"
        + (f" and {name} moves by up to {fastest * rate:.3g} {units or 'of its units'} in 1 s" if fastest else "")
        for rate in _USUAL_RATES
    ]
    return [f"# {len(count)} samples: {'; '.join(said)}"]


def _family(seen: ColumnSurvey) -> str:
    """What the names of columns that differ in numbers alone have in common."""
    return re.sub(r"\d+", "#", seen.name)


def _called(seen: ColumnSurvey) -> str:
    return quoted(seen.name if seen.column is None else f"{seen.name}[{seen.column}]")


def _values(recording: Recording, seen: ColumnSurvey) -> np.ndarray:
    """Values of a column, (N,)."""
    variable = recording.variables[seen.name]
    table = variable.values.reshape(len(variable.values), -1)
    named = variable.columns
    return table[:, 0 if seen.column is None else named.index(seen.column) if named else int(seen.column)]


def _is_motor(seen: ColumnSurvey) -> bool:
    """Whether a column's name says that it belongs to a motor: where the joint has columns of its own, these count."""
    return _has(_MOTOR, seen)


def _has(pattern: str, seen: ColumnSurvey) -> bool:
    """Whether a pattern of words fits a column's name."""
    return re.search(pattern, words(f"{seen.name} {seen.column or ''}")) is not None


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
    if torque or not moved or not (force or excursion):  # A motor moves a joint, or several do, each with its torque.
        joint = joint if len(moved) <= 1 or len(torque) == 1 else ""
        return ("ID.3-static" if moved and _stepped(recording, q[most]) else "ID.3-dynamic"), joint, ""
    if len(moved) == 1:
        return "ID.2", joint, ""
    # Several joints are moved, by hand or by the tendons.
    high = max((s.high for s in force), default=0.0)
    return ("VD.3" if max(pulls, default=0.0) > _MIN_TENSION_CHANGE * high else "VD.1"), "", ""


def _stepped(recording: Recording, seen: ColumnSurvey) -> bool:
    """Whether a joint stands still for much of the time between its moves."""
    x = _values(recording, seen)
    x = x[np.isfinite(x)]
    steps = np.abs(np.diff([part.mean() for part in np.array_split(x, min(len(x), _PARTS))]))
    return float(np.mean(steps < _MAX_STILL_CHANGE * np.percentile(steps, 95.0))) > _MIN_STILL_SHARE


def _column(seen: ColumnSurvey, log: _Log | None, slides: bool, turns: bool) -> str:
    """Inline table (TOML) that reads a column, of another log than the trial's where one is given.

    A joint that slides is in m; where one turns several times, the sizes of angles do not tell rad from degrees.
    """
    parts = [f"from = {quoted(seen.name)}"]
    if seen.column is not None:
        parts.append(f"column = {quoted(seen.column) if isinstance(seen.column, str) else seen.column}")
    if log is not None:
        parts.append(f"file = {quoted(log.recording.path.name)}")
        if log.clock is not None:
            units = f', units = "{log.clock.units}"' if log.clock.units not in ("s", "") else ""
            parts.append(f"time = {{ from = {quoted(log.clock.name)}{units} }}")
    fits = {"q": "rad", "joint_torque": "N m", "tendon_force": "N", "fingertip_force": "N", "tendon_excursion": "m"}
    fits |= {"temperature": "K"} | ({"q": "m", "joint_torque": "N"} if slides else {})
    doubts = []
    guessed = seen.meaning == "q" and turns and not seen.stated
    if seen.units and TO_SI[seen.units].si == fits.get(seen.meaning) and not guessed:
        parts.append(f'units = "{seen.units}"')
    else:
        doubts.append(f"units? it states {seen.foreign}: write `scale`" if seen.foreign else "units? SI as it stands")
    if seen.meaning == "tendon_excursion" and "length" in f"{seen.name} {seen.column or ''}".lower():
        doubts.append("a length that falls as the tendon is pulled in needs scale = -1")
    return "{ " + ", ".join(parts) + " }" + (f"   # {'; '.join(doubts)}" if doubts else "")
