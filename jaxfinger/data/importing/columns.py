"""Columns of a trial from the variables of a recording, in SI units on the trial's clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.importing.expressions import ExpressionError, evaluate
from jaxfinger.data.importing.mapping import Column, ColumnSpec, MappedTrial, Reading, terms
from jaxfinger.data.importing.names import is_time_step
from jaxfinger.data.importing.readings import compare_units, converted, is_slower, period
from jaxfinger.data.importing.recording import Variable
from jaxfinger.data.importing.rounding import evened
from jaxfinger.data.importing.stamps import coarse_rate, increasing_order, restarts
from jaxfinger.data.importing.variables import Source, column_of, scale_of
from jaxfinger.data.signals.clock import gaps
from jaxfinger.data.signals.sizes import MAX_RATE
from jaxfinger.data.signals.unmeasured import placeholder
from jaxfinger.data.toml import Place
from jaxfinger.data.units import TO_SI, limits_of_turns, near_limits, unit_name, whole_turns
from jaxfinger.errors import UserError, counted, listed

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Ratio of the durations and intervals of two clocks, from which one is taken to be in other units: about the geometric
# mean of one, for clocks in the same units, and a thousand, for mistaken ones. Slow sensors have a smaller one.
_MAX_CLOCK_RATIO = 30.0
_MIN_COVERAGE = 0.5  # of a trial: a clock that covers less is taken to be a wrong one.
_MIN_SAMPLES = 10  # within the trial: fewer show no motion.
# Least range, degrees, over which a trial moves a joint. Numbers that are called rad, and run over less than this, are
# not degrees by mistake: the joint turns on.
_MIN_DEGREES = 20.0
_PARTS = "choose one part by `where`, or by `rate_hz` and `span`"
_OWN_PARTS = "give each part a file of its own"


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
        count = len(column_of(source.variable(first.from_, where), first.from_, first.column, where)[0])
        rows = _chosen(trial, source, np.arange(count), count, where)
        return _cut(Clock(rows / trial.rate_hz, rows, count, source), trial, where, report)
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
    coarse = None if trial.sort else coarse_rate(time[rows])
    if coarse is not None:
        step, rate = coarse
        if rate > MAX_RATE:
            place.fail(
                f"the clock `{reading.from_}` gives {rate:.3g} samples a second, as no sensor does; it is not in "
                f"{reading.units or 's'}: write its `units`, or rate_hz in place of `time`"
            )
        place.fail(
            f"the clock `{reading.from_}` changes every {step:.4g} s only, after {rate * step:.3g} samples on average; "
            f"write rate_hz = {rate:.4g} in place of `time`, or `sort = true` if samples are repeated with their stamps"
        )
    order = increasing_order(time[rows], f"`{reading.from_}`", trial.sort, _PARTS, place, report)
    rows, units = rows[order], reading.units or "s"
    clock = Clock(evened(time[rows]), rows, len(time), source, reading.from_, units, trial.sort, begins_again)
    return _cut(clock, trial, where, report)


def _times(reading: Reading, source: Source, where: Place, report: Report) -> Float[np.ndarray, " N"]:
    """Times of a clock, s."""
    variable = source.variable(reading.from_, where)
    values, _ = column_of(variable, reading.from_, reading.column, where)
    if is_time_step(reading.from_, values):
        known = f"{reading.from_}.time" in source.recording.variables
        mend = f"their sum, {reading.from_}.time" if known else "the clock, or write `rate_hz`"
        where.fail(f"reads {reading.from_!r}, which holds the times between samples; name {mend}")
    compare_units(variable, reading, "s", report, where, reading.from_ in source.derived)
    return converted(values, reading, "s", scale_of(reading, source, where), where)


def _first_rows(first: Column, source: Source, where: Place) -> np.ndarray | None:
    """Mask of the messages with the trial's first joint on a topic of several publishers; None on other topics."""
    if first.file is not None:
        return None
    variable = source.variable(first.from_, where)
    if variable.present is None:
        return None
    return variable.present[:, column_of(variable, first.from_, first.column, where)[1]]


def _chosen(trial: MappedTrial, source: Source, rows: np.ndarray, total: int, where: Place) -> np.ndarray:
    """Those of the rows for which the trial's `where`, a condition on the recording's `total` rows, holds."""
    if trial.where is None:
        return rows
    place, text = where / "where", trial.where

    def lookup(name: str, column: Any) -> np.ndarray:
        return column_of(source.variable(name, place), name, column, place)[0]

    try:
        chosen = np.asarray(evaluate(text, lookup, source.constants, source.words))
    except ExpressionError as error:
        place.fail(f"{text!r} {error}")
    if chosen.shape != (total,) or chosen.dtype != bool:
        place.fail(f"{text!r} is no condition on the {total} samples; write one, as 'phase == 2'")
    return rows[chosen[rows]]


def _cut(clock: Clock, trial: MappedTrial, where: Place, report: Report) -> Clock:
    """Cut a clock by the trial's `span`, s from the first sample."""
    if len(clock.time):
        clock = replace(clock, origin=float(clock.time[0]))
    if trial.span is not None:
        begin, end = trial.span
        lasts = float(clock.time[-1] - clock.origin) if len(clock.time) else 0.0
        # In ms, a tenth of the recording or more is a hundred times as long as the recording in s.
        if 100.0 * lasts < end - begin and end <= 1000.0 * lasts:
            said = f"ends at {end:g} s, and the recording at {lasts:.4g} s"
            report.warning((where / "span").key, f"{said}; write s from its first sample, not ms")
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
        if units == "rad" and np.isfinite(x).any():
            self._refuse_turns(spec, x, limits, where)
        return x

    def _refuse_turns(self, spec: ColumnSpec, x: Float[np.ndarray, " N"], limits: np.ndarray, where: Place) -> None:
        """Refuse an angle beyond a turn and the range of its limits in the recording's own units, which are right."""
        low, high = np.nanquantile(x[x != placeholder(x)], (0.01, 0.99))
        if max(-low, high) < 2.0 * np.pi or high - low < np.ptp(limits):
            return
        of = [(term, self._source(term, where).variable(term.from_, where)) for term in terms(spec)]
        if all(unit_name(v.units) == (term.units or "rad") and term.scale in (1.0, -1.0) for term, v in of):
            stated = listed(list(dict.fromkeys(variable.units for _, variable in of)))
            fits = near_limits(np.radians(low), np.radians(high), limits)
            fits = fits and stated == "rad" and high - low > _MIN_DEGREES
            wrong = 'if they are degrees, write units = "deg" all the same; ' if fits else ""
            where.fail(
                f"runs from {low:.3g} to {high:.3g} rad, more than a turn, and the recording states {stated}; {wrong}"
                f"if the joint turns on, write {limits_of_turns(low, high)}"
            )

    def _source(self, spec: Column, where: Place) -> Source:
        return self.clock.source if spec.file is None else self.sources(spec.file, where)

    def _term(self, spec: Column, units: str, whole: bool, where: Place) -> np.ndarray:
        """One term, variable · scale + offset, in SI units on the trial's clock."""
        clock = self.clock
        source = self._source(spec, where)
        name = spec.from_
        variable = source.variable(name, where)
        values, k = column_of(variable, name, spec.column, where)
        compare_units(variable, spec, units, self.report, where, name in source.derived)
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
            values = values[clock.rows]
            if not is_slower(clock.time, np.isfinite(values)):
                return values
            return self._between(clock.time, values, f"`{clock.name or 'rate_hz'}`", whole, where)
        own_name, time = own
        if clock.restarts:
            where.fail(
                f"is on the clock {own_name}, and the trial's clock `{clock.name}` begins again within the recording: "
                f"times do not tell which part it belongs to; {_OWN_PARTS}"
            )
        if len(time) != len(values):
            where.fail(f"has {len(values)} samples, and its clock {own_name} has {len(time)}; name its own clock")
        present = present & (np.isfinite(time) | np.isfinite(values))  # A shorter column ends in blank cells.
        present = present & _stamped(np.where(present, time, 0.0), own_name, where, self.report)
        time, values = time[present], values[present]
        order = increasing_order(time, own_name, clock.sort, _OWN_PARTS, where, self.report)
        time, values = evened(time[order]), values[order]
        onto = self._between if is_slower(time, np.isfinite(values)) else self._onto
        return onto(time, values, own_name, whole, where)

    def _between(self, time: np.ndarray, values: np.ndarray, name: str, whole: bool, where: Place) -> np.ndarray:
        """Values at the trial's times of a slower column, which is blank between its samples."""
        there = np.isfinite(values)
        self.report.warning(
            where.key,
            f"has a value at {there.sum()} of {len(there)} samples, one every {np.diff(time[there]).mean():.3g} s, "
            "and is interpolated between them; if the trial is to have these samples only, choose them by `where`",
        )
        return self._onto(time[there], values[there], name, whole, where)

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
        units = unit_name(known_clocks[own].units) or clock.units
        return f"`{own}`", known_clocks[own].values * TO_SI[units].factor

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
        if (lost := gaps(steps)).any():
            count = f"{counted(int(lost.sum()), 'gap')}, the longest {float(steps.max()):.3g} s"
            self.report.warning(where.key, f"the clock {name} has {count}; values in gaps are interpolated")
        ends = {"begins {:.3g} s after": time[0] - trial[0], "ends {:.3g} s before": trial[-1] - time[-1]}
        if max(ends.values()) > 2.0 * step:
            # In s since 1970 both would read the same.
            said = " and ".join(end.format(lost) for end, lost in ends.items() if lost > 0.0)
            self.report.warning(where.key, f"the clock {name} {said} the trial; the trial is cut to what both cover")

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
        where.fail(f"reads the file '{name}', which was not given; there are {listed([str(path) for path in paths])}")
    if len(found) > 1:
        raise UserError(
            f"{where.file}: {where.key}: {len(found)} of the recordings are called {name} "
            f"({listed([str(p) for p in found])}); write enough of the folder to tell them apart, as file = '"
            + "/".join(found[0].parts[-len(parts) - 1 :])
            + "'"
        )
    return found[0]
