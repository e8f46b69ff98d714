"""Trials of one recording that its words tell apart, as in the log of a whole day."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from jaxfinger.data.importing.leverage import surveyed
from jaxfinger.data.importing.logs import Log
from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.session import FingerDescription

_MAX_STEP = 10.0  # usual steps of a clock: a longer one, or one back, lies between trials
_MIN_SAMPLES = 20  # of a trial


def apart(logs: Sequence[Log], finger: FingerDescription | None) -> list[Log]:
    """Logs, of which each that holds several trials is replaced by one for each of them, surveyed anew."""
    split = [(log, _parts(log)) for log in logs]
    recordings = [part for _, parts in split for part in parts.values()]
    seen = iter(surveyed(recordings, finger) if recordings else ())
    return [
        new
        for log, parts in split
        for new in ([Log(part, next(seen), log.file, *said) for said, part in parts.items()] or [log])
    ]


def _parts(log: Log) -> dict[tuple[str, str], Recording]:
    """Recordings of the trials in a log, by the word of each and the condition that chooses it; empty if it is one.

    A word names a trial if all of its samples follow each other, after a jump of the clock or after samples without a
    word. Phases of a trial follow each other at the usual step, and states come again.
    """
    recording, time = log.recording, log.time
    if any(len(v.values) != len(time) for v in recording.variables.values()):
        return {}
    usual = float(np.median(np.abs(np.diff(time)))) if len(time) > 1 else 0.0
    for name, words in recording.words.items():
        if len(words) != len(time):
            continue
        ends = [0, *(np.flatnonzero(words[1:] != words[:-1]) + 1).tolist(), len(words)]
        runs = [(str(words[a]), a, b) for a, b in pairwise(ends) if words[a]]
        begins = [a for _, a, _ in runs if a > 0 and words[a - 1]]
        jumps = all(not 0.0 <= time[a] - time[a - 1] <= _MAX_STEP * usual for a in begins)
        long = all(b - a >= _MIN_SAMPLES for _, a, b in runs)
        if jumps and long and 1 < len(runs) == len({word for word, _, _ in runs}):
            called = name if name.isidentifier() else repr(name)
            return {(word, f"{called} == {word!r}"): _rows(recording, name, slice(a, b)) for word, a, b in runs}
    return {}


def _rows(recording: Recording, label: str, rows: slice) -> Recording:
    """Some rows of a recording, without the column that chooses them."""
    variables = {
        name: replace(v, values=v.values[rows], present=None if v.present is None else v.present[rows])
        for name, v in recording.variables.items()
    }
    unusable = {name: reason for name, reason in recording.unusable.items() if name not in recording.words}
    words = {name: values[rows] for name, values in recording.words.items() if name != label}
    return replace(recording, variables=variables, unusable=unusable, words=words)
