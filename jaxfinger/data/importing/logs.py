"""Logs: recordings with what their columns may be, and which of them are of one trial."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.importing.survey import ColumnSurvey
from jaxfinger.data.units import TO_SI, spelt_unit

# Of the time of two logs: with more in common they show one trial. Loggers that are started by hand begin and end a
# little apart.
_TOGETHER = 0.9
_PERIODS = 2**32, 2**16  # counts of a clock that wraps
_MAX_LOST = 100.0  # samples that may be lost where a clock wraps
_MIN_REPEATED = 0.9  # of the samples with the stamp of the one before: with its values too they are no other samples.


@dataclass(frozen=True)
class Log:
    """A recording, the survey of its columns, and the name by which a mapping reads its file.

    Of a file that holds several trials it is one of them: `part` names it, and `where` is the condition that chooses
    it. Both are empty where it is the whole file.
    """

    recording: Recording
    seen: list[ColumnSurvey]
    file: str
    part: str = ""
    where: str = ""

    @property
    def title(self) -> str:
        """Words that tell it apart from others: its file without the ending, and its part."""
        return str(Path(self.file).with_suffix("")) + (f"-{self.part}" if self.part else "")

    @property
    def clock(self) -> ColumnSurvey | None:
        """Column with the times of its samples: stamps of headers before other clocks, these before counts, those that
        never run back before others, and those of angles before others."""
        clocks = [s for s in self.seen if s.meaning == "time"]
        of_angles = {self.recording.variables[s.name].clock for s in self.seen if s.meaning == "q"}
        return min(
            clocks,
            key=lambda s: (
                not s.name.endswith(".stamp"),
                self.counts(s),
                self._runs_back(s),
                s.name not in of_angles,
            ),
            default=None,
        )

    def counts(self, clock: ColumnSurvey) -> bool:
        """Whether a clock without units goes on by one from sample to sample, as an index does and ms may."""
        steps = np.diff(np.ravel(self.recording.variables[clock.name].values))
        return not (clock.stated or spelt_unit(clock.name)) and bool(np.all(steps == 1.0))

    @cached_property
    def repeats(self) -> bool:
        """Whether samples are repeated with their stamps, rather than stamps being coarser than samples."""
        same = np.flatnonzero(np.diff(self.time) == 0.0)
        tables = [v.values for v in self.recording.variables.values() if len(v.values) == len(self.time)]
        alike = [np.all(x[same] == x[same + 1], axis=tuple(range(1, x.ndim))) for x in tables]
        return bool(len(same)) and bool(np.mean(np.all(alike, axis=0)) > _MIN_REPEATED)

    def _runs_back(self, clock: ColumnSurvey) -> bool:
        return bool(np.any(np.diff(np.ravel(self.recording.variables[clock.name].values)) < 0.0))

    @cached_property
    def period(self) -> int:
        """Counts after which its clock wraps, as those of 32 and 16 bits do; 0 where it does not."""
        if self.clock is None:
            return 0
        ticks = np.ravel(self.recording.variables[self.clock.name].values)
        steps = np.diff(ticks)
        back, usual = steps[steps < 0.0], float(np.median(steps))
        for period in _PERIODS if len(back) and usual > 0.0 else ():
            if np.all((back + period > 0.0) & (back + period < _MAX_LOST * usual)) and np.nanmax(ticks) < period:
                return period
        return 0

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


def trials_of(logs: Sequence[Log]) -> list[list[Log]]:
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


def _family(seen: ColumnSurvey) -> str:
    """What the names of columns that differ in numbers alone have in common."""
    return re.sub(r"\d+", "#", seen.name)
