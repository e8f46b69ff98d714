"""Columns of a trial from the variables of a recording, in SI units on the trial's clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfinger.data.expressions import ExpressionError, evaluate
from jaxfinger.data.findings import Report
from jaxfinger.data.mapping import Column, ColumnSpec, MappedTrial, Reading, terms
from jaxfinger.data.readings import compare_units, converted, period
from jaxfinger.data.recording import Recording, Variable
from jaxfinger.data.toml import Place
from jaxfinger.data.units import whole_turns
from jaxfinger.errors import UserError, counted, listed

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Ratio of the durations and intervals of two clocks, from which one is taken to be in other units: about the geometric
# mean of one, for clocks in the same units, and a thousand, for mistaken ones. Slow sensors have a smaller one.
_MAX_CLOCK_RATIO = 30.0
_MIN_COVERAGE = 0.5  # of a trial: a clock that covers less is taken to be a wrong one.
_MIN_SAMPLES = 10  # within the trial: fewer show no motion.
_MAX_INTERVAL = 0.2  # s: a clock with longer intervals is probably in other units.
# A stamp that is late is so by less than this, in s and in samples, since loggers write more often; and one that runs
# back between two longer runs of samples begins another recording, or wraps.
_MAX_LATE, _MAX_LATE_SAMPLES = 1.0, 10
_PARTS = "choose one part by `where`, or by `rate_hz` and `span`"
_OWN_PARTS = "give each part a file of its own"


@dataclass(frozen=True)
class Source:
    """A recording, with the variables that a mapping derives from it."""

    recording: Recording
    constants: Mapping[str, Any] = field(default_factory=dict)
    derived: Mapping[str, str] = field(default_factory=dict)

    def variable(self, name: str, where: Place, within: tuple[str, ...] = ()) -> Variable:
        """Variable of this name: the derived one, else the recording's.

        `within` are the names of the derived variables that are being computed; `where` is the place to blame.

        Raises:
            UserError: there is no such variable, or it gives no numbers, or it is derived from itself.
        """
        if name in self.derived and name not in within:
            return self._derive(name, where, within)
        if name in self.recording.variables:
            return self.recording.variables[name]
        said = f"reads the variable {name!r} of {self.recording.path.name}"
        for candidate in (name, *(name[:i] for i in range(len(name) - 1, 0, -1) if name[i] == ".")):
            if candidate in self.recording.unusable:
                where.fail(f"{said}, but {candidate} {self.recording.unusable[candidate]}")
        if name in within:
            where.fail(f"derives {name!r} from itself, and the recording has no variable of this name; name another")
        there = sorted([*self.recording.variables, *self.derived])
        elsewhere = "; move what only some recordings hold to their trials" if where.keys[:1] == ("channels",) else ""
        return where.fail(f"{said}, which the recording has not; it has {listed(there, 30)}{elsewhere}")

    @property
    def words(self) -> dict[str, np.ndarray]:
        """Recorded variables of words that no derived variable replaces."""
        return {name: words for name, words in self.recording.words.items() if name not in self.derived}

    def _derive(self, name: str, where: Place, within: tuple[str, ...]) -> Variable:
        where = where / "derived" / name
        text = self.derived[name]
        clocks: dict[str, str] = {}

        def lookup(inner: str, column: Any) -> np.ndarray:
            if inner == name and inner in self.recording.variables:
                variable = self.recording.variables[inner]
            else:
                variable = self.variable(inner, where, (*within, name))
            clocks[inner] = variable.clock
            if variable.present is not None:
                where.fail(f"uses {inner!r}, whose names change from message to message; map its columns by name")
            return variable.values if column is None else _column(variable, inner, column, where)[0]

        try:
            values = np.asarray(evaluate(text, lookup, self.constants, self.words), np.float64)
        except ExpressionError as error:
            where.fail(f"{text!r} {error}")
        if len(set(clocks.values())) > 1:
            of = ", ".join(f"{inner} on {clock or 'none'}" for inner, clock in clocks.items())
            where.fail(f"joins variables that have different clocks ({of}); derive one variable for each clock")
        if values.ndim not in (1, 2):
            where.fail("gives a single number and no samples; put it into [constants]")
        return Variable(values, clock=next(iter(clocks.values()), ""))


def _column(variable: Variable, name: str, column: Any, where: Place) -> tuple[np.ndarray, int]:
    """Column of a variable by its number or name, and its number."""
    values, names = variable.values, variable.columns
    if values.ndim == 1:
        if column not in (None, 0):
            where.fail(f"reads column {column!r} of {name!r}, which has one column; leave `column` out")
        return np.atleast_1d(values), 0
    if isinstance(column, str):
        if column not in names:
            there = listed(names) if names else "no names of columns"
            where.fail(f"reads column {column!r} of {name!r}, which has {there}; choose one of them")
        column = names.index(column)
    elif variable.present is not None:
        groups = np.unique(variable.present, axis=0)[::-1]
        kinds = "; ".join(", ".join(np.array(names)[row]) for row in groups if row.any())
        where.fail(
            f"reads {name!r}, whose names change from message to message ({kinds}); choose by name, as column = "
            f"{names[0]!r}"
        )
    elif column is None and values.shape[1] == 1:
        column = 0
    if isinstance(column, bool) or not isinstance(column, int) or not 0 <= column < values.shape[1]:
        called = f" ({listed(names)})" if names else ""
        where.fail(f"reads {name!r}, which has {values.shape[1]} columns{called}; choose one by `column`, from 0")
    return values[:, column], column


def scale_of(reading: Reading, source: Source, where: Place) -> float:
    """Scale of a reading: a number, or the single one of the constant or variable that it names."""
    name, where = reading.scale, where / "scale"
    if not isinstance(name, str):
        return name
    values = np.asarray(source.constants.get(name) if name in source.constants else source.variable(name, where).values)
    if values.size != 1:
        where.fail(f"is scaled by {name!r}, which holds {values.size} values; name a single number")
    return float(values.reshape(-1)[0])


@dataclass(frozen=True)
class Clock:
    """Times of a trial's samples, and their rows in the recording."""

    time: Float[np.ndarray, " N"]  # s
    rows: Int[np.ndarray, " N"]
    total: int  # number of rows of the recording
    source: Source
    name: str = ""  # name of the clock's variable; empty where the sampling rate is given
    units: str = "s"
    sort: bool = False
    restarts: bool = False  # whether the recording's times begin again within it
    origin: float = 0.0  # s, the time from which `span` counts

    def keep(self, rows: np.ndarray) -> Clock:
        """Clock of these samples only, by mask or index."""
        return replace(self, time=self.time[rows], rows=self.rows[rows])


def trial_clock(trial: MappedTrial, first: Column, source: Source, where: Place, report: Report) -> Clock:
    """Clock of a trial by its `time` or `rate_hz`, cut to its `span` and `where`.

    `first` is the column of the first joint: it has the number of samples, and shows which messages count.

    Raises:
        UserError: a variable cannot be read, times are out of order without `sort`, or no sample is left.
    """
    if trial.time is None:
        assert trial.rate_hz is not None
        count = len(_column(source.variable(first.from_, where), first.from_, first.column, where)[0])
        rows = _chosen(trial, source, np.arange(count), count, where)
        return _cut(Clock(rows / trial.rate_hz, rows, count, source), trial, where)
    rows_of = _first_rows(first, source, where)
    place = where / "time"
    reading = Reading(trial.time) if isinstance(trial.time, str) else trial.time
    time = _times(reading, source, place, report)
    rows = np.arange(len(time))
    if rows_of is not None and len(rows_of) == len(rows):
        rows = rows[rows_of]
    begins_again = len(restarts(time[rows])) > 0
    rows = _chosen(trial, source, rows, len(time), where)
    rows = rows[_stamped(time[rows], f"`{reading.from_}`", place, report)]
    order = increasing_order(time[rows], f"`{reading.from_}`", trial.sort, _PARTS, place, report)
    rows, units = rows[order], reading.units or "s"
    clock = Clock(time[rows], rows, len(time), source, reading.from_, units, trial.sort, begins_again)
    return _cut(clock, trial, where)


def _times(reading: Reading, source: Source, where: Place, report: Report) -> Float[np.ndarray, " N"]:
    """Times of a clock, s."""
    variable = source.variable(reading.from_, where)
    values, _ = _column(variable, reading.from_, reading.column, where)
    compare_units(variable, reading, "s", report, where)
    return converted(values, reading, "s", scale_of(reading, source, where), where)


def _first_rows(first: Column, source: Source, where: Place) -> np.ndarray | None:
    """Mask of the messages with the trial's first joint on a topic of several publishers; None on other topics."""
    if first.file is not None:
        return None
    variable = source.variable(first.from_, where)
    if variable.present is None:
        return None
    return variable.present[:, _column(variable, first.from_, first.column, where)[1]]


def _chosen(trial: MappedTrial, source: Source, rows: np.ndarray, total: int, where: Place) -> np.ndarray:
    """Those of the rows for which the trial's `where`, a condition on the recording's `total` rows, holds."""
    if trial.where is None:
        return rows
    place, text = where / "where", trial.where

    def lookup(name: str, column: Any) -> np.ndarray:
        return _column(source.variable(name, place), name, column, place)[0]

    try:
        chosen = np.asarray(evaluate(text, lookup, source.constants, source.words))
    except ExpressionError as error:
        place.fail(f"{text!r} {error}")
    if chosen.shape != (total,) or chosen.dtype != bool:
        place.fail(f"{text!r} is no condition on the {total} samples; write one, as 'phase == 2'")
    return rows[chosen[rows]]


def _cut(clock: Clock, trial: MappedTrial, where: Place) -> Clock:
    """Cut a clock by the trial's `span`, s from the first sample."""
    if len(clock.time):
        clock = replace(clock, origin=float(clock.time[0]))
    if trial.span is not None:
        begin, end = trial.span
        clock = clock.keep((clock.time - clock.origin >= begin) & (clock.time - clock.origin < end))
    if len(clock.time) == 0:
        where.fail("holds no sample; " + ("correct its `where`" if trial.span is None else "widen its `span`"))
    return clock


def _stamped(time: np.ndarray, name: str, where: Place, report: Report) -> np.ndarray:
    """Mask of the samples that have a time. Others are left out, with a warning."""
    good = np.isfinite(time)
    if not good.all():
        count = counted(int((~good).sum()), "sample")
        report.warning(where.key, f"the clock {name} gives no time for {count}, left out; mend the recording")
    return good


def restarts(time: np.ndarray) -> np.ndarray:
    """Indices of the samples after which a clock, s, begins again or wraps: it runs back further than late stamps do,
    and runs on from there."""
    steps = np.diff(time)
    back = np.flatnonzero(steps < 0.0)
    if not len(back):
        return back
    late = max(_MAX_LATE, _MAX_LATE_SAMPLES * float(np.nanmedian(np.abs(steps))))
    runs = np.diff(np.concatenate([[-1], back, [len(time) - 1]]))
    return back[(steps[back] < -late) & (np.minimum(runs[:-1], runs[1:]) > _MAX_LATE_SAMPLES)]


def increasing_order(time: np.ndarray, name: str, sort: bool, choice: str, where: Place, report: Report) -> np.ndarray:
    """Indices that put times into increasing order, without repeated ones. `choice` says how to read one part of them.

    Raises:
        UserError: the times begin again, or do not increase and `sort` is false.
    """
    late = np.diff(time) <= 0.0
    if not late.any():
        return np.arange(len(time))
    begins = restarts(time)
    if len(begins):
        far = f"runs back by {time[begins[0]] - time[begins[0] + 1]:.4g} s after sample {begins[0]}"
        far += f", and at {counted(len(begins), 'place')} in all" if len(begins) > 1 else ""
        where.fail(
            f"the clock {name} {far}: it begins again or wraps, and sorting would mix different times; {choice}, or "
            "unwrap a counter by its period, as time = { from = …, unwrap = 4294967296 }"
        )
    at, back, twice = int(np.argmax(late)), int((np.diff(time) < 0.0).sum()), int((np.diff(np.sort(time)) == 0.0).sum())
    if not sort:
        count = f"does not increase at {int(late.sum())} of {len(time)} samples, first after sample {at}"
        mend = "the samples must be sorted by their time"
        mend += f", without the {counted(twice, 'sample')} at repeated stamps" if twice else ""
        where.fail(f"the clock {name} {count}: {mend}; have import do so by `sort = true` in the trial")
    order = np.argsort(time, kind="stable")
    first = np.concatenate([[True], np.diff(time[order]) > 0.0])
    left = f"{counted(back, 'stamp')} ran back, and {counted(twice, 'sample')} at repeated stamps left out"
    report.warning(where.key, f"the clock {name} was sorted, {left}")
    return order[first]


@dataclass
class ColumnReader:
    """Reader of columns onto a trial's clock. `begin` and `end` bound the time, s, for which all columns are known."""

    clock: Clock
    sources: Callable[[str, Place], Source]  # other recordings by name
    report: Report
    begin: float = -np.inf
    end: float = np.inf

    def column(self, spec: ColumnSpec, units: str, whole: bool, where: Place) -> Float[np.ndarray, " N"]:
        """One column in `units` (SI): a term or a sum of terms. `whole` marks labels, which are not interpolated."""
        return np.sum([self._term(term, units, whole, where) for term in terms(spec)], axis=0)

    def position(self, spec: ColumnSpec, units: str, limits: np.ndarray, where: Place) -> Float[np.ndarray, " N"]:
        """Position of a joint with `limits` (2,), in `units` (SI).

        An encoder that wraps gives it up to whole periods. Where the limits span less than a period, they tell which.
        """
        x = self.column(spec, units, False, where)
        for term in terms(spec):
            length = period(term, units, scale_of(term, self._source(term, where), where))
            if length > np.ptp(limits) and np.isfinite(x).any():
                x = x + whole_turns(0.5 * (np.nanmin(x) + np.nanmax(x)), length, limits)
        return x

    def _source(self, spec: Column, where: Place) -> Source:
        return self.clock.source if spec.file is None else self.sources(spec.file, where)

    def _term(self, spec: Column, units: str, whole: bool, where: Place) -> np.ndarray:
        """One term, variable · scale + offset, in SI units on the trial's clock."""
        clock = self.clock
        source = self._source(spec, where)
        name = spec.from_
        variable = source.variable(name, where)
        values, k = _column(variable, name, spec.column, where)
        compare_units(variable, spec, units, self.report, where)
        values = converted(values, spec, units, scale_of(spec, source, where), where)
        present = np.ones(len(values), bool) if variable.present is None else variable.present[:, k]
        own = self._own_clock(spec, variable, source, present, where)
        if own is None:
            if len(values) != clock.total and np.ndim(variable.values) == 2 and variable.values.shape[1] == clock.total:
                where.fail(
                    f"{name!r} has {variable.values.shape[1]} columns and {len(variable.values)} rows where the trial "
                    f"has {clock.total} samples; it is stored joints first: transpose it and save it again"
                )
            if len(values) != clock.total:
                where.fail(
                    f"has {len(values)} samples where the trial's time has {clock.total}; give it its own `time`"
                )
            return values[clock.rows]
        own_name, time = own
        if clock.restarts:
            where.fail(
                f"is on the clock {own_name}, and the trial's clock `{clock.name}` begins again within the recording: "
                f"times do not tell which part it belongs to; {_OWN_PARTS}"
            )
        if len(time) != len(values):
            where.fail(f"has {len(values)} samples, and its clock {own_name} has {len(time)}; name its own clock")
        present = present & _stamped(np.where(present, time, 0.0), own_name, where, self.report)
        time, values = time[present], values[present]
        order = increasing_order(time, own_name, clock.sort, _OWN_PARTS, where, self.report)
        return self._onto(time[order], values[order], own_name, whole, where)

    def _own_clock(
        self, spec: Column, variable: Variable, source: Source, present: np.ndarray, where: Place
    ) -> tuple[str, np.ndarray] | None:
        """Name and times, s, of a variable's own clock; None for a variable that shares the trial's rows."""
        clock = self.clock
        if spec.time is not None:
            place = where / "time"
            reading = Reading(spec.time, units=clock.units) if isinstance(spec.time, str) else spec.time
            return f"`{reading.from_}`", _times(reading, source, place, self.report)
        known_clocks = source.recording.variables
        main = known_clocks.get(clock.name)
        shared = source.recording is clock.source.recording
        same_rows = shared and variable.clock in (clock.name, main.clock if main else "")
        if not shared and not variable.clock:
            where.fail(f"is of {source.recording.path.name}, not of the trial's own file; name its clock by `time`")
        if (not variable.clock or same_rows) and (present.all() or present[clock.rows].all()):
            return None
        if not clock.name:
            where.fail("is on a clock of its own, which `rate_hz` cannot be compared with; name the trial's `time`")
        own = variable.clock or clock.name
        # A trial that goes by the headers' stamps compares them with stamps, not with times of logging.
        stamp = own.removesuffix(".time") + ".stamp"
        if clock.name.endswith(".stamp") and stamp in known_clocks:
            own = stamp
        return f"`{own}`", known_clocks[own].values

    def _onto(self, time: np.ndarray, values: np.ndarray, name: str, whole: bool, where: Place) -> np.ndarray:
        """Values at the trial's times, interpolated between the samples of their own clock, and NaN beyond its ends.

        Raises:
            UserError: the two clocks do not fit each other.
        """
        trial = self.clock.time
        if len(time) < 2:
            where.fail(f"the clock {name} holds {len(time)} samples; name a clock that runs through the trial")
        self._check_clock(time, name, where)
        self.begin, self.end = max(self.begin, time[0]), min(self.end, time[-1])
        if whole:
            values = values[np.clip(np.searchsorted(time, trial, "right") - 1, 0, len(time) - 1)]
            return np.where((trial >= time[0]) & (trial <= time[-1]), values, np.nan)
        return np.interp(trial, time, values, left=np.nan, right=np.nan)

    def _check_clock(self, time: np.ndarray, name: str, where: Place) -> None:
        """Refuse a clock that does not fit the trial's, and warn of gaps in it and of samples that it cuts off."""
        trial = self.clock.time
        runs = (
            f"the clock {name} runs from {time[0]:.10g} to {time[-1]:.10g} s, "
            f"the trial from {trial[0]:.10g} to {trial[-1]:.10g} s"
        )
        inside = (trial >= time[0]) & (trial <= time[-1])
        if not inside.any():
            where.fail(f"{runs}; they do not overlap: name a clock that counts from the same start, in the same units")
        steps = np.diff(time)
        step = float(np.median(steps))
        longer = (time[-1] - time[0]) / max(trial[-1] - trial[0], 1e-12)
        slower = step / max(float(np.median(np.diff(trial))) if len(trial) > 1 else 0.0, 1e-12)
        few = int(((time >= trial[0]) & (time <= trial[-1])).sum())
        units_differ = min(longer, slower) > _MAX_CLOCK_RATIO or max(longer, slower) < 1.0 / _MAX_CLOCK_RATIO
        if units_differ or few < _MIN_SAMPLES <= len(time):
            where.fail(
                f"{runs}; they do not share their units: write time = {{ from = {name.strip('`')!r}, units = 'ms' }}, "
                "or so"
            )
        if inside.mean() < _MIN_COVERAGE:
            begin, end = trial[inside][0] - self.clock.origin, trial[inside][-1] - self.clock.origin
            where.fail(
                f"{runs}: it covers only a part; name another clock, or cut the trial by span = "
                f"[{begin:.4g}, {end:.4g}]"
            )
        if step > _MAX_INTERVAL:
            self.report.warning(
                where.key,
                f"the clock {name} ticks every {step:.3g} s; write time = {{ from = {name.strip('`')!r}, "
                "units = 'ms' }} if that is what it is",
            )
        gaps = steps > max(20.0 * step, 0.1)  # Jitter is shorter than 20 intervals, commanded motion slower than 0.1 s.
        if gaps.any():
            count = f"{counted(int(gaps.sum()), 'gap')}, the longest {float(steps.max()):.3g} s"
            self.report.warning(where.key, f"the clock {name} has {count}; values in gaps are interpolated")
        if max(time[0] - trial[0], trial[-1] - time[-1]) > 2.0 * step:
            self.report.warning(where.key, f"{runs}; the trial is cut to what both cover")

    @property
    def covered(self) -> np.ndarray:
        """Mask of the samples at which every clock runs."""
        return (self.clock.time >= self.begin) & (self.clock.time <= self.end)


def find(name: str, paths: Mapping[Path, Any], where: Place) -> Path:
    """Path of the given recording that `file` names, by the last parts of its path.

    Raises:
        UserError: no recording or several have this name.
    """
    if not name:
        where.fail("has a `file` without a name; write that of a recording")
    parts = Path(name).parts
    found = [path for path in paths if path.parts[-len(parts) :] == parts]
    if not found:
        where.fail(f"reads the file {name!r}, which was not given; there are {listed([str(path) for path in paths])}")
    if len(found) > 1:
        raise UserError(
            f"{where.file}: {where.key}: {len(found)} of the recordings are called {name} "
            f"({listed([str(p) for p in found])}); write enough of the folder to tell them apart, as file = '"
            + "/".join(found[0].parts[-len(parts) - 1 :])
            + "'"
        )
    return found[0]
