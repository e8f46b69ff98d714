"""Proposal of a mapping that reads some recordings, by a survey of their columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxfinger.data.importing.assignment import assigned, held_names, known_names, named_columns
from jaxfinger.data.importing.experiment import guessed_experiment
from jaxfinger.data.importing.leverage import surveyed
from jaxfinger.data.importing.lines import (
    called,
    column_line,
    elsewhere_lines,
    pace_line,
    rate_by_speeds,
    time_line,
    torque_line,
    transposed_lines,
    turns_line,
    within,
)
from jaxfinger.data.importing.logs import Log, trials_of
from jaxfinger.data.importing.names import MOTOR, is_nameless, is_set_point, words
from jaxfinger.data.importing.parts import apart
from jaxfinger.data.importing.recording import Recording, told_apart
from jaxfinger.data.importing.stamps import coarse_rate, restarts
from jaxfinger.data.importing.survey import ColumnSurvey, weight_on_reach
from jaxfinger.data.importing.time_steps import steps_of
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.toml import as_key, quoted
from jaxfinger.data.units import TO_SI, beyond_a_turn
from jaxfinger.errors import counted, listed

# Where a log has both, q is a joint's angle, and theta that of the motor in front of its elastic gear.
_LINK, _MOTOR_BESIDE_LINK = r"(?<![a-z])q(?![a-z])", r"(?<![a-z])theta(?![a-z])"
_MAX_LEFT_OUT = 12  # variables that are named, so that the line of a large bag stays readable.
_MAX_TABLE = 10  # samples: files that are no longer may be tables of parameters, and of one length by chance.
_ANGLES = np.array([[-1.6, 1.6]])  # rad: of a joint whose limits are not known
_HEAD = 'specimen = "my finger"\nfinger = "finger.toml"'


def proposal(recordings: Sequence[Recording], finger: FingerDescription | None = None, head: str = _HEAD) -> str:
    """Propose a mapping (TOML) with one trial for each recording, to be corrected by someone who knows the rig.

    A recording in which words tell several trials apart makes one of each. One without angles, such as the log of a
    torque sensor alone, belongs to the trial of the recording with angles that was made at the same time. Columns are
    assigned to the finger's joints and tendons by name, or in order where names do not match. Without a finger, joints
    and tendons are named as in the recordings. Channels that all recordings map alike are shared. `head` holds the
    lines of specimen and finger.
    """
    weight = weight_on_reach(finger)
    files = told_apart([recording.path for recording in recordings])
    whole = [Log(*of) for of in zip(recordings, surveyed(recordings, finger), files, strict=True)]
    trials = trials_of(apart(whole, finger))
    proposed = [_trial_proposal(logs, finger, weight) for logs in trials]
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
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", logs[0].title).strip("-") or "log"
        stem = stem if re.match(r"\d", stem) else f"{number:02}-{stem}"
        lines += ["", f"[trials.{as_key(stem)}]", f"file = {quoted(logs[0].file)}"]
        lines += [f"where = {quoted(logs[0].where)}"] if logs[0].where else []
        lines += trial.lines
        for channel, rows in trial.channels.items():
            if channel not in shared:
                lines += [f"channels.{channel}.{as_key(name)} = {said}" for name, said in rows]
        for log in logs:
            lines += transposed_lines(log)
            unread = [f"# {quoted(name)} {reason}" for name, reason in log.recording.unusable.items()]
            lines += unread[:_MAX_LEFT_OUT]
        lines += elsewhere_lines(logs[0]) if "q" not in trial.channels and len(trials) > 1 else []
        for what, said in ((False, "in no channel yet"), (True, "set-points by their names, which are not measured")):
            named = [quoted(name) for name in trial.left_out if is_set_point(name) == what]
            lines += [f"# {said}: {listed(named, _MAX_LEFT_OUT)}"] if named else []
    return "\n".join(lines) + "\n"


def _side_by_side(logs: Sequence[Log]) -> list[str]:
    """A comment for logs with as many samples as one without a clock: each may hold an array of one recording."""
    lines = []
    for count in dict.fromkeys(log.count for log in logs if log.clock is None):
        names = [quoted(log.file) for log in logs if log.count == count]
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


def _trial_proposal(logs: Sequence[Log], finger: FingerDescription | None, weight: float) -> _Proposal:
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
    experiment, joint, tendon = guessed_experiment(logs[0], channels, names)
    torques = channels.get("joint_torque", ())
    if joint and len(torques) == 1 and not any(held_names(torques, known_names("joint_torque", finger))):
        names["joint_torque"] = [joint]  # A single torque sensor belongs to the joint that the motor moves.
    lines = [f'experiment = "{experiment}"   # guessed: ID.2, ID.3-static, ID.3-dynamic, ID.4, VD.1, VD.2 or VD.3']
    lines += [f"joint = {quoted(joint)}   # that is moved, or held by the torque sensor"] if joint else []
    lines += [f"tendon = {quoted(tendon)}   # that is pulled"] if tendon else []
    coarse = None if logs[0].repeats else coarse_rate(time)
    guessed = ""
    if clock is not None and is_nameless(clock.name) and not clock.stated:
        guessed = "   # guessed: its values rise evenly"
    if clock is not None and logs[0].counts(clock):
        guessed = "   # it counts by one: if it counts samples, write `rate_hz`, samples per second, in its place"
    if clock is not None and (steps := steps_of(recording, clock.name)):
        guessed = f"   # the sum of the steps of time in {quoted(steps)}"
    if clock is None:
        lines.append('time = "?"   # no time was found: name its variable, or write `rate_hz`, samples per second')
        lines += pace_line(logs[0], channels.get("q", ()))
    elif coarse is not None:
        lines.append(f"rate_hz = {coarse[1]:.4g}   # several samples share each stamp of {quoted(clock.name)}")
    else:
        lines.append(f"{time_line(clock, period := logs[0].period)}{guessed}")
        time = np.unwrap(time, period=period * TO_SI[clock.units or "s"].factor) if period else time
    if clock is None or is_nameless(clock.name):
        lines += rate_by_speeds(logs[0])
    for channel, families in rivals.items():
        named = [f"{called(family[0])} to {called(family[-1])}" for family in families]
        lines.append(f"# {channel} could also be {' or '.join(named)}: take what was measured")
    limits = finger.limits[~np.array(finger.prismatic, bool)] if finger is not None else _ANGLES
    lines += [*surplus, *turns_line(channels.get("q", ()), limits if limits.size else _ANGLES)]
    lines += torque_line(channels.get("joint_torque", ()), weight)
    if len(begins := restarts(time)):
        lines.append(f"# the time begins again after sample {begins[0]}: a trial for each part, chosen by `where`")
    elif coarse is None and (np.diff(time) <= 0.0).any():
        lines.append("sort = true   # its stamps are out of order, or repeated")
    slides = dict(zip(finger.joint_names, finger.prismatic, strict=True)) if finger is not None else {}
    limits_of = dict(zip(finger.joint_names, finger.limits, strict=True)) if finger is not None else {}
    turns = finger is not None and any(map(beyond_a_turn, finger.limits))
    rows = {
        channel: [
            (name, column_line(within(s, limits_of.get(name)), elsewhere.get(s), slides.get(name, False), turns))
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
        if columns:
            channels[channel] = columns
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
        elif len(known) > 1 and not any(held_names(columns, known)) and (channel == "q" or len(columns) > 1):
            pairs = zip(names[channel], channels[channel], strict=True)
            order = listed([f"{called(s)} of {name}" for name, s in pairs])
            comments.append(f"# {channel} by numbers or in their order, {order}: correct this if it is another")
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


def _is_motor(seen: ColumnSurvey) -> bool:
    """Whether a column's name says that it belongs to a motor: where the joint has columns of its own, these count."""
    return _has(MOTOR, seen)


def _has(pattern: str, seen: ColumnSurvey) -> bool:
    """Whether a pattern of words fits a column's name."""
    return re.search(pattern, words(f"{seen.name} {seen.column or ''}")) is not None
