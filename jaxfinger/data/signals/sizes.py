"""Sizes of a session: its tensions, excursions, noise and pace.

Thresholds are relative to them, so that no constant depends on one machine: a finger pulls with 10 N, a crane with kN.
"""

from __future__ import annotations

from dataclasses import dataclass
from statistics import median_low
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.session import Session, Trial
from jaxfinger.data.signals.crossing import crossing_of
from jaxfinger.data.signals.noise import STD_PER_MAD
from jaxfinger.data.signals.quantiles import median, quantile
from jaxfinger.data.signals.spikes import without_spikes

if TYPE_CHECKING:
    from jaxtyping import Float

# Of the highest tension. A protocol holds taut tendons at a fifth of it or more, and a tare is good to a hundredth.
SLACK_SHARE = 0.02
NOISE_FACTOR = 6.0  # times its noise: a tension sensor on a slack tendon exceeds it once in a billion samples.
TRAVEL_SHARE = 0.02  # of the highest tension: a tenth of a protocol's step, ten times a sensor's noise
STRETCH_SHARE = 0.04  # of the longest excursion at the highest tension: steel and fibre of an arm's length stretch less
MAX_SAMPLES = 1000  # of a trial that are read for its sizes. Limits the time; percentiles need no more.
MAX_PACE_SAMPLES = 4000  # of a trial that are read for its pace: in a minute's trial a motion of 15 ms still shows.
# Time, s, in which a joint passes a tenth of its travel in the protocol's sweeps (ID.3-dynamic of the sessions in
# datasets/). Rates, cut-off frequencies and durations of the experiments are set for these sweeps. Motion driven by
# tendons would be a poor standard: it sticks, and its slips are fast on every machine.
SWEEP_TIME = 0.11
STEP_TIME = 0.27  # s, likewise in the protocol's led and stepped motions (ID.2, ID.3-static)
MAX_RATE = 1e5  # Hz: the rates of sensors of a machine end far below it.
# Paces are rounded to powers of this ratio. The rates for one pace serve motions up to twice as slow and four times as
# quick: fits agree within their errors (tests/identify/test_units.py).
PACE_RATIO = 4.0


@dataclass(frozen=True)
class Sizes:
    """Sizes of a session, to which thresholds are relative.

    The pace is the factor by which motions take longer than the protocol's, rounded to a power of `PACE_RATIO`.
    """

    tension: float  # N, highest
    excursion: float  # m, longest
    noise: float  # N, standard deviation of a tension sensor
    pace: float = 1.0  # of sweeps (ID.3-dynamic)
    slow_pace: float = 1.0  # of led, stepped and held motions, which need not be as quick as sweeps
    crossing: float = np.inf  # Hz: above it noise of angles hides a sweep's inertia (`crossing_of`)

    @property
    def slack(self) -> float:
        """Tension, N, below which a tendon is slack: it carries neither tension nor friction."""
        return max(SLACK_SHARE * self.tension, NOISE_FACTOR * self.noise)

    @property
    def travel(self) -> float:
        """Smallest change of tension, N, that counts as a change."""
        return max(TRAVEL_SHARE * self.tension, NOISE_FACTOR * self.noise)

    @property
    def compliance(self) -> float:
        """Compliance, m/N, that a tendon may have: one that stretches this much may rest while its motor moves."""
        return STRETCH_SHARE * self.excursion / self.tension if self.tension > 0.0 else 0.0


def sizes_of(session: Session) -> Sizes:
    """Sizes of a session, from all of its trials."""
    excursions, noises, sweeps, steps = [0.0], [], [], []
    for trial in session:
        every = max(1, len(trial.time) // MAX_SAMPLES)
        if (f := _tensions(trial)).size:
            bend = np.abs(np.diff(f[:MAX_SAMPLES], 2, axis=0))
            noises.append(STD_PER_MAD / np.sqrt(6.0) * max(map(median, bend.T)))
        if trial.tendon_excursion is not None and len(trial.time) > 3:
            l = np.nan_to_num(trial.tendon_excursion[::every])
            excursions.append(max((quantile(x, 0.99) - quantile(x, 0.01) for x in l.T), default=0.0))
        if trial.experiment == "ID.3-dynamic":
            sweeps.append(travel_time(trial.time, trial.q) / SWEEP_TIME)
        if trial.experiment in ("ID.2", "ID.3-static"):
            steps.append(travel_time(trial.time, trial.q) / STEP_TIME)
    pace = _pace(sweeps)
    slow = _pace(steps) if any(steps) else pace
    if slow >= 1.0:  # Quick steps count as measured. Slow ones follow the sweeps' pace, which is better known.
        slow = max(pace, 1.0)
    noise = float(np.median(noises)) if noises else 0.0
    return Sizes(highest_tension(session), max(excursions), noise, pace, slow, crossing_of(session, pace))


def highest_tension(session: Session) -> float:
    """Highest tension, N, that a tendon has in a hundredth of a trial; 0 where no tension is measured."""
    highest = [0.0]
    for trial in session:
        if (f := _tensions(trial)).size:
            every = max(1, len(f) // MAX_SAMPLES)
            highest.append(max(quantile(x, 0.99) for x in f[::every].T))
    return max(highest)


def _tensions(trial: Trial) -> Float[np.ndarray, "N k"]:
    """Tensions that are measured throughout a trial; none of a trial too short to show noise."""
    f = trial.tendon_force
    if f is None or len(f) <= 3:
        return np.zeros((0, 0))
    return f[:, np.isfinite(f).all(axis=0)]


def _pace(ratios: list[float]) -> float:
    """Pace of motions by the ratios of their times to the protocol's; 1 where there are none."""
    powers = [np.log(t) / np.log(PACE_RATIO) for t in ratios if t > 0.0]
    power = median_low(powers) if powers else 0.0
    return 1.0 if -1.0 < power < 0.0 else PACE_RATIO ** round(power)


def travel_time(time: Float[np.ndarray, " N"], q: Float[np.ndarray, "N k"]) -> float:
    """Time, s, in which a joint at its fastest passes a tenth of its travel; 0 where nothing moves.

    The slowest joint counts: the travel of a joint at rest is noise and takes no time. Spikes are removed first.
    """
    every = max(1, len(time) // MAX_PACE_SAMPLES)
    columns = [x[np.isfinite(x)] for x in without_spikes(q)[::every].T]
    step = median(np.diff(time)) * every if len(time) > 1 else 0.0
    return step * max((_lag(x) for x in columns if x.size and np.ptp(x) > 0.0), default=0)


def _lag(x: Float[np.ndarray, " N"]) -> float:
    """Number of samples over which one in a hundred changes reaches a tenth of the travel, by doubling the lag.

    0 where less than one sample in a hundred differs from the others: the column rests.
    """
    way, lag, far = 0.1 * (quantile(x, 0.99) - quantile(x, 0.01)), 1, [0.0]
    if way == 0.0:
        return 0.0
    while far[-1] < way and lag < len(x):
        far.append(quantile(np.abs(x[lag:] - x[:-lag]), 0.99))
        lag *= 2
    return float(np.interp(way, far[-2:], (lag / 4.0, lag / 2.0)))
