"""Check for sensors whose values repeat while what they measure changes, as those of no coarse sensor do.

1. A held column takes a new value only at every n-th sample, as of a sensor that is read more slowly than the rest. Its
   runs of equal values are equally long and its steps differ. Those of a coarse sensor are the other way round.
2. A column stands still, for longer than at any rest, while the column that it is tied to goes on: torque and angle of
   the joint that a motor sweeps (ID.3), excursion and angle of the one that is led (ID.2).
"""

from __future__ import annotations

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.schema import MEASURED, measured_columns
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.quantiles import median
from jaxfinger.data.signals.sizes import travel_time
from jaxfinger.errors import counted, listed

_MOVES = ("ID.2", "ID.3-static", "ID.3-dynamic", "VD.1", "VD.3")  # experiments in which a late value is a wrong one
_MIN_RUNS = 20  # Fewer runs of equal values show no regularity.
_MIN_HELD = 3  # samples. A sensor with a clock of its own often repeats one or two.
_REGULAR = 0.8  # of the runs are as long as the usual one, within a sample. The others are rests and lost values.
# Ratio of large to small steps (90th and 10th percentile). Those of a coarse sensor are one or two units of its
# resolution, also where a joint sticks and slips in even steps.
_MIN_STEP_RATIO = 3.0
# Of the time in which a joint passes a tenth of its travel: it then passes a hundredth between a value and its sample.
_MAX_AGE = 0.1
# A stretch is told from the sensor's resolution if it is this many times as long as 99 of 100 runs of equal values. At
# the turn of a smooth motion the last step of the resolution is held up to five times as long as the one before it.
_STILL, _MIN_STILL = 10, 10
_MIN_STEPS = 30  # of a column's resolution in its range: a coarser one stands still while the other goes on.
# Share of its travel by which the other column must go on. Where a joint rests, tendons stretch by a twentieth of their
# excursion; where it turns round, a motor that keeps the tension may rest for some of the travel.
_MIN_TRAVEL = 0.25
_MIN_SWINGS = 4.0  # ranges of the torque, there and back: a joint at rest holds against one ramp of it, or a push.
_MIN_JUMP = 5.0  # of the largest step elsewhere: a joint that was stuck does not slip at five times its top speed.
_BLOCKS = 40  # of a stretch, whose means show the way of a torque without its noise


def check_held(session: Session, report: Report) -> None:
    """Report columns that are held or stand still."""
    for trial in session.select(*_MOVES):
        _held(trial, session.finger, report)
    for trial in session.select("ID.2", "ID.3-static", "ID.3-dynamic"):
        if (joint := session.finger.joint(trial.joint)) is not None:
            _standing(trial, session.finger, joint, report)


def _held(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report columns whose values are older than those of other columns by more than the motion allows."""
    found: dict[tuple[str, str], int] = {}  # samples for which a column holds each value
    newest = np.inf  # the shortest time, in samples, for which any column holds its values
    for name, column, x in measured_columns(trial, finger):
        if np.isfinite(x).all():
            usual, short, regular = _hold_lengths(x)
            newest = min(newest, short)
            if regular:
                found[name, column] = usual
    if not found or max(found.values()) <= newest:
        return
    step, most = median(np.diff(trial.time)), _MAX_AGE * travel_time(trial.time, trial.q)
    for name in MEASURED:
        late = {c: n for (channel, c), n in found.items() if channel == name and 0.5 * (n - newest) * step > most}
        if late:
            n = max(late.values())
            report.warning(
                trial.place(name),
                f"holds each value of {listed(list(late))} for {n} samples, {0.5e3 * (n - 1) * step:.0f} ms late on "
                "average; record it at the rate of the other columns, or import it with the clock of its own values "
                "(`time` of a column in a mapping)",
            )


def _hold_lengths(x: np.ndarray) -> tuple[int, float, bool]:
    """Samples for which a column usually holds a value, for which it holds some, and whether it does so regularly."""
    steps = np.abs(np.diff(x))
    changes = np.flatnonzero(steps)
    if len(changes) <= _MIN_RUNS:
        return len(x), np.inf, False
    if _MIN_HELD * len(changes) > len(x):
        return 1, 1.0, False
    lengths, (small, large) = np.diff(changes), np.percentile(steps[changes], (10.0, 90.0))
    usual, short = int(np.median(lengths)), float(np.percentile(lengths, 10.0))
    alike = (np.abs(lengths - usual) <= 1).mean() > _REGULAR
    return usual, short, bool(alike and usual >= _MIN_HELD and large > _MIN_STEP_RATIO * small)


def _standing(trial: Trial, finger: FingerDescription, joint: int, report: Report) -> None:
    """Report columns that stand still while the column that they are tied to goes on."""
    q, name, led = trial.q[:, joint], finger.joint_names[joint], trial.experiment == "ID.2"
    channel, names = ("tendon_excursion", finger.tendon_names) if led else ("joint_torque", finger.joint_names)
    values = getattr(trial, channel)
    if values is None or len(q) < _MIN_STILL or not np.isfinite(q).all():
        return
    own, others, shown = _stretches(q), "", []  # stretches of the angle, and the column that shows most of them
    for k in np.flatnonzero(finger.active & finger.crosses[:, joint]).tolist() if led else [joint]:
        x = values[:, k]
        if np.isfinite(x).all():
            parts = [part for part in _stretches(x) if _goes_through(q, part) and (led or not _at_a_limit(x, part))]
            _say(trial, channel, names[k], x, parts, f"q of {name}", report)
            goes_on = [part for part in own if (_goes_through(x, part) if led else _swings(x, part) or _jumps(q, part))]
            others, shown = (names[k], goes_on) if len(goes_on) > len(shown) else (others, shown)
    _say(trial, "q", name, q, shown, f"{channel} of {others}", report)


def _say(
    trial: Trial, channel: str, column: str, x: np.ndarray, parts: list[slice], other: str, report: Report
) -> None:
    """Report the stretches in which a column stands still, if there are any."""
    if parts:
        first = parts[0]
        lasts = trial.time[first.stop - 1] - trial.time[first.start]
        report.warning(
            trial.place(channel),
            f"column {column} stands still at {x[first.start]:.4g} while {other} goes on, in "
            f"{counted(len(parts), 'place')}, first from {trial.time[first.start]:.4g} s for {lasts:.3g} s: its sensor "
            "loses its signal or is at an end of its range; cut these samples out (`span` or `where` in a mapping), or "
            "record the trial again",
        )


def _stretches(x: np.ndarray) -> list[slice]:
    """Stretches in which x stands still for longer than its resolution or a usual rest explains."""
    steps = np.abs(np.diff(x))
    if np.ptp(x) < _MIN_STEPS * steps[steps > 0.0].min(initial=np.inf):
        return []
    starts = np.flatnonzero(np.diff(x, prepend=np.nan) != 0.0)
    lengths = np.diff(starts, append=len(x))
    within = lengths[~np.isin(x[starts], (x.min(), x.max()))]  # A sensor may be at an end of its range many times.
    long = lengths > max(_STILL * np.percentile(within, 99.0), _MIN_STILL)
    return [slice(a, a + n) for a, n in zip(starts[long].tolist(), lengths[long].tolist(), strict=True)]


def _at_a_limit(x: np.ndarray, part: slice) -> bool:
    """Whether a torque is at an end of its range, which `checks.values` reports, or at a zero that it crosses.

    Small torques may be read as zero. A torque that leaps to zero is not small.
    """
    value = x[part.start]
    if value != 0.0:
        return bool(value in (x.min(), x.max()))
    steps, beside = np.abs(np.diff(x)), x[[max(part.start - 1, 0), min(part.stop, len(x) - 1)]]
    small = np.abs(x[x != 0.0]).min(initial=np.inf) + np.percentile(steps[steps > 0.0], 90.0)
    return bool(x.min() < 0.0 < x.max() and np.abs(beside).max() <= small)


def _goes_through(x: np.ndarray, part: slice) -> bool:
    """Whether a column goes through a good part of its travel."""
    return bool(np.ptp(x[part]) > _MIN_TRAVEL * np.ptp(x))


def _swings(x: np.ndarray, part: slice) -> bool:
    """Whether a torque goes through its range several times."""
    size = max(1, (part.stop - part.start) // _BLOCKS)
    means = x[part][: (part.stop - part.start) // size * size].reshape(-1, size).mean(axis=1)
    return bool(np.abs(np.diff(means)).sum() > _MIN_SWINGS * np.ptp(x))


def _jumps(x: np.ndarray, part: slice) -> bool:
    """Whether a joint goes on after a stretch with a step that its speed elsewhere does not allow."""
    steps = np.abs(np.diff(x))
    ends = [other.stop - 1 for other in _stretches(x) if other.stop < len(x)]
    return part.stop < len(x) and bool(steps[part.stop - 1] > _MIN_JUMP * np.delete(steps, ends).max(initial=0.0))
