"""Check for recordings that are copies: a trial of another trial, and a column of another column of its channel."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.schema import CHANNELS, MEASURED
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.motion import STILL_ANGLE
from jaxfinger.errors import listed

_FIRST_SAMPLES = 100  # Most pairs of trials and of columns differ in them, so few need to be compared whole.
# Values of a column that turn round more often than both are noisy: a motion needs several samples from turn to turn,
# while white noise turns round at two of three. Sensors at rest, which switch now and then, may agree in a few turns.
_MIN_TURNS, _MIN_TURN_SHARE = 20, 0.25
_MIN_STEP = 1e-6  # of the largest value: smaller steps are rounding errors of single precision.


def check_copied_trials(session: Session, report: Report) -> None:
    """Report trials that are copies of another: a copy would pass for a repeat without noise."""
    alike: dict[tuple, list[Trial]] = defaultdict(list)
    for trial in session:
        measured = {name: values for name in MEASURED if (values := getattr(trial, name)) is not None}
        start = tuple((name, np.ascontiguousarray(x[:_FIRST_SAMPLES]).tobytes()) for name, x in measured.items())
        earlier = alike[(len(trial.time), start)]
        for other in earlier if len(trial.time) > 1 else ():
            if all(np.array_equal(values, getattr(other, name), equal_nan=True) for name, values in measured.items()):
                said = f"is the same recording as trial {other.name}, sample for sample"
                if trial.experiment == other.experiment:
                    report.error(trial.place(), f"{said}; remove one of them")
                else:
                    said = f"{said}, which is {other.experiment}"
                    report.warning(trial.place(), f"{said}; give each its own part of the recording")
                break
        earlier.append(trial)


def check_copied_columns(session: Session, report: Report) -> None:
    """Report columns of one channel that are copies of another: two sensors have noise of their own.

    Tensions of VD.3 are left out: those that a controller gives to symmetric tendons may swing alike in a simulation.
    """
    for trial in session:
        for channel in MEASURED:
            values = getattr(trial, channel)
            if values is not None and not (trial.experiment == "VD.3" and channel == "tendon_force"):
                for alike in _copies(channel, values, session.finger):
                    report.warning(
                        trial.place(channel),
                        f"columns {listed(alike)} hold the same numbers at every sample, noise included, as no two "
                        "sensors do; map each from its own column, and leave out those that have no sensor",
                    )


def _copies(channel: str, values: np.ndarray, finger: FingerDescription) -> list[list[str]]:
    """Names of columns that hold the same noisy numbers, by group."""
    names, out = CHANNELS[channel].columns(finger), []
    for some in _alike(values[:_FIRST_SAMPLES], range(values.shape[1])):
        for group in _alike(values, some):
            x = values[:, group[0]]
            still = channel == "q" and np.ptp(x) < STILL_ANGLE  # One angle may stand for all joints that are held.
            if not still and _is_noisy(x):
                out.append([names[k] for k in group])
    return out


def _alike(values: np.ndarray, columns: Iterable[int]) -> list[list[int]]:
    """Groups of two or more columns that hold the same numbers."""
    groups: dict[bytes, list[int]] = defaultdict(list)
    for k in columns:
        groups[values[:, k].tobytes()].append(k)
    return [group for group in groups.values() if len(group) > 1]


def _is_noisy(x: np.ndarray) -> bool:
    """Whether a column shows the noise of a sensor: its values go up and down without end.

    Computed values, also if they are rounded to steps, turn round with the motion only.
    """
    steps = np.diff(x)
    steps = steps[np.abs(steps) > _MIN_STEP * np.nanmax(np.abs(x), initial=0.0)]
    turns = np.count_nonzero(np.sign(steps[1:]) != np.sign(steps[:-1]))
    return bool(turns > max(_MIN_TURNS, _MIN_TURN_SHARE * len(steps)))
