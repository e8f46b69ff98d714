"""Check that what a tendon pulls on is in time with its tension. Laws hold at every instant, whatever the model.

1. ID.4: the torque that holds a joint follows from the tension of the tendon that is pulled, and from the way of it.
2. VD.2: so does the force at the fingertip.

Where a joint is held, the tension rests between its steps: what is late then still moves, and hysteresis does not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxfinger.data.checks.delay import say_delays
from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.delays import (
    LONGEST_SHARE,
    MAX_CHANGE,
    MIN_DELAY,
    MIN_GAIN,
    MIN_SAMPLES,
    UNIQUE_TRAVELS,
    best_shifts,
    even,
    stops,
)
from jaxfinger.data.signals.motion import HOLD_CUTOFF_HZ, fitting_cutoff
from jaxfinger.data.signals.sizes import MAX_SAMPLES, SWEEP_TIME, travel_time

_DEGREE = 2  # of the tension, beside its hysteresis: friction and stiffness change a little with load
# Where columns are shifted alike, each may gain less. Without a delay, the median of a session gains up to a sixth.
_MIN_COLUMNS, _MIN_USUAL_GAIN = 4, 1.25
_WIDTHS = 0.01, 0.05, 0.2, 0.4, 0.7  # of the highest tension: routed tendons lose up to two thirds of it


def check_pulls(session: Session, report: Report) -> None:
    """Report torques (ID.4) and fingertip forces (VD.2) that come late, and tensions that come late against them."""
    finger = session.finger
    pulls = [pull for trial in session.select("ID.4", "VD.2") if (pull := _pull(trial, finger)) is not None]
    hysteresis = _hysteresis_of([pull.tension for pull in pulls])
    found = [pull.delays(of) for pull, of in zip(pulls, hysteresis, strict=True)]
    is_sure = _sure([delay for delays in found for delay in delays])
    for pull, delays in zip(pulls, found, strict=True):
        late = [(delay.column, delay.time) for delay in delays if abs(delay.time) > pull.least and is_sure(delay)]
        say_delays(pull.trial, pull.channel, "tendon_force", str(pull.trial.tendon), finger, late, report)


class _Pull(NamedTuple):
    """A trial in which one tendon is pulled while all joints are held, at even steps.

    What the tendon pulls on then follows the tension, with the hysteresis of the tendon's friction.
    """

    trial: Trial
    channel: str  # of what the tendon pulls on
    columns: np.ndarray  # (k,) of the channel
    cutoff: float  # Hz, of the filter
    longest: int  # samples, delay that is looked for
    time: np.ndarray  # (N,), s
    tension: np.ndarray  # (N,), N
    values: np.ndarray  # (N, k), N m or N

    @property
    def least(self) -> float:
        """Shortest delay, s, that is reported."""
        return max(MIN_DELAY / self.cutoff, float(np.median(np.diff(self.trial.time))))

    def delays(self, hysteresis: np.ndarray) -> list[_Delay]:
        """Delay of each column by which it follows best from the tension and its `hysteresis` (N, w)."""
        step, f = float(self.time[1] - self.time[0]), self.tension
        X = np.column_stack([np.polynomial.polynomial.polyvander((f - f.mean()) / np.ptp(f), _DEGREE), hysteresis])
        inner = np.zeros(len(f), bool)
        inner[self.longest : len(f) - self.longest] = True
        found = best_shifts((self.values - self.values[inner].mean(axis=0)).T, X, inner, self.longest)
        return [_Delay(int(k), x.samples * step, x.gain) for k, x in zip(self.columns, found, strict=True)]


class _Delay(NamedTuple):
    """Delay of a column against a tension."""

    column: int
    time: float  # s, negative if the tension is late
    gain: float  # factor by which the delay shrinks what the law leaves


def _sure(delays: Sequence[_Delay]) -> Callable[[_Delay], bool]:
    """Which delays of a session are sure: those that gain much, or are the usual one where most columns show the same.

    Noise, and hysteresis that the law lacks, shift each column by another time.
    """
    if len(delays) < _MIN_COLUMNS:
        return lambda delay: delay.gain > MIN_GAIN
    low, usual, high = np.percentile([delay.time for delay in delays], (25, 50, 75))
    gains = float(np.median([delay.gain for delay in delays])) > _MIN_USUAL_GAIN
    shared = gains and high - low < MAX_CHANGE * abs(usual)
    return lambda delay: delay.gain > MIN_GAIN or (shared and abs(delay.time - usual) < MAX_CHANGE * abs(usual))


def _pull(trial: Trial, finger: FingerDescription) -> _Pull | None:
    """The pull of an ID.4 or a VD.2; None where channels are missing or too short to tell."""
    channel = "joint_torque" if trial.experiment == "ID.4" else "fingertip_force"
    values, tension, pulled = getattr(trial, channel), trial.tendon_force, finger.tendon(trial.tendon)
    if values is None or tension is None or pulled is None or len(trial.time) < MIN_SAMPLES:
        return None
    f = tension[:, pulled]
    columns = np.flatnonzero(np.isfinite(values).all(axis=0) & (np.ptp(values, axis=0) > 0.0))
    some = slice(None, None, max(1, len(f) // MAX_SAMPLES))  # A step takes a good part of the trial.
    travel = travel_time(trial.time[some], f[some, None]) if np.isfinite(f).all() else 0.0
    if not columns.size or travel <= 0.0:
        return None
    cutoff = HOLD_CUTOFF_HZ * SWEEP_TIME / travel
    time, f, y = even(cutoff, trial.time, f, values[:, columns])
    if len(time) < MIN_SAMPLES:
        return None
    longest = int(min(LONGEST_SHARE * len(time), UNIQUE_TRAVELS * travel / float(time[1] - time[0])))
    return _Pull(trial, channel, columns, fitting_cutoff(time, cutoff), longest, time, f, y)


def _hysteresis_of(tensions: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Stop operators of several tensions at once (N, w), with the widths `_WIDTHS`."""
    lengths = [len(f) for f in tensions]
    padded = np.zeros((max(lengths, default=0), len(tensions), 1))
    for k, f in enumerate(tensions):
        padded[: len(f), k, 0] = f
    widths = np.reshape([np.ptp(f) for f in tensions], (-1, 1)) * np.array(_WIDTHS)
    return [out[:length] for length, out in zip(lengths, np.swapaxes(stops(padded, widths), 0, 1), strict=True)]
