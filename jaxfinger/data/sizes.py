"""Sizes of a session, so that no constant of one machine decides: a finger pulls with 10 N, a crane does not."""

from dataclasses import dataclass
from statistics import median_low

import numpy as np
from jaxtyping import Float

from jaxfinger.data.filtering import without_spikes
from jaxfinger.data.session import Session, Trial

SLACK = 0.02  # of the highest tension: taut is a fifth of it or more in protocols, and a tare is good to a hundredth
NOISE = 6.0  # times its noise: what a tension sensor reads of a slack tendon is less, but once in a billion samples
TRAVEL = 0.02  # of the highest tension: a tenth of a protocol's step, ten times the noise of a sensor of that range
STRETCH = 0.04  # of the longest excursion at the highest tension: steel and fibre of an arm's length stretch by less
LOOK = 1000  # samples of a trial that tell its sizes
PASSES = 4000  # likewise how quick it is: a minute's trial still shows a motion of 15 ms
# s in which a joint passes a tenth of its way in sweeps of the protocol (ID.3-dynamic of the sessions in datasets/):
# what is reduced to a rate, cut off at a frequency or counted in seconds is meant for these. How fast tendons move a
# finger says less: it sticks, and slips as fast as it does.
SWEEP = 0.11
STEP = 0.27  # s, likewise where it is led or stepped (ID.2, ID.3-static)
# Of paces: what serves one serves motions twice as slow and four times as quick, of which a fit is the same within its
# errors (tests/identify/test_units.py).
PACE_RATIO = 4.0


@dataclass(frozen=True)
class Sizes:
    """What counts as little in a session."""

    tension: float  # N, the highest
    excursion: float  # m, the longest
    noise: float  # N, of a tension sensor
    pace: float = 1.0  # times as long as the protocol's that its motions take: a power of `PACE_RATIO`
    slow_pace: float = 1.0  # likewise of what is led, stepped or held, which need not be as quick as sweeps

    @property
    def slack(self) -> float:
        """N: a tendon whose tension stays below carries neither tension nor friction."""
        return max(SLACK * self.tension, NOISE * self.noise)

    @property
    def travel(self) -> float:
        """N: a change of tension that is one."""
        return max(TRAVEL * self.tension, NOISE * self.noise)

    @property
    def compliance(self) -> float:
        """m/N: a tendon that stretches as much may stand still at the joints while its motor moves."""
        return STRETCH * self.excursion / self.tension if self.tension > 0.0 else 0.0


def sizes_of(session: Session) -> Sizes:
    """The sizes of all trials of a session, so that those of one trial do not depend on which others are read."""
    tensions, excursions, noises, sweeps, steps = [0.0], [0.0], [], [], []
    for trial in session:
        every = max(1, len(trial.time) // LOOK)
        if trial.tendon_force is not None and len(trial.time) > 3:
            measured = np.isfinite(trial.tendon_force).all(axis=0)
            if measured.any():
                f = trial.tendon_force[:, measured]
                tensions.append(float(np.percentile(f[::every], 99, axis=0).max()))
                bend = np.abs(np.diff(f[:LOOK], 2, axis=0))
                noises.append(1.4826 / np.sqrt(6.0) * float(np.median(bend, axis=0).max()))
        if trial.tendon_excursion is not None and len(trial.time) > 3:
            l = np.nan_to_num(trial.tendon_excursion[::every])
            excursions.append(float(np.ptp(np.percentile(l, (1, 99), axis=0), axis=0).max(initial=0.0)))
        if trial.experiment == "ID.3-dynamic":
            sweeps.append(_quick(trial) / SWEEP)
        if trial.experiment in ("ID.2", "ID.3-static"):
            steps.append(_quick(trial) / STEP)
    pace = _pace(sweeps)
    slow = max(pace, min(_pace(steps), 1.0)) if any(steps) else pace  # quick only where its own motions are
    return Sizes(max(tensions), max(excursions), float(np.median(noises)) if noises else 0.0, pace, slow)


def _pace(times: list[float]) -> float:
    """The pace of motions that take so many times as long as the protocol's; of none, the protocol's."""
    powers = [np.log(t) / np.log(PACE_RATIO) for t in times if t > 0.0]
    power = median_low(powers) if powers else 0.0
    return 1.0 if -1.0 < power < 0.0 else PACE_RATIO ** round(power)


def _quick(trial: Trial) -> float:
    """s in which a joint passes a tenth of its way where it is quick, of the joint that takes longest: at rest the way
    is noise, and takes no time. 0 of a trial in which nothing moves. Spikes are no motion.
    """
    every = max(1, len(trial.time) // PASSES)
    columns = [x[np.isfinite(x)] for x in without_spikes(trial.q)[::every].T]
    step = float(np.median(np.diff(trial.time))) * every if len(trial.time) > 1 else 0.0
    return step * max((_lag(x) for x in columns if x.size and np.ptp(x) > 0.0), default=0)


def _lag(x: Float[np.ndarray, " N"]) -> float:
    """The fewest samples over which a hundredth of the changes are a tenth of the way."""
    way, lag, far = 0.1 * np.ptp(np.percentile(x, (1, 99))), 1, [0.0]
    while far[-1] < way and lag < len(x):
        far.append(float(np.percentile(np.abs(x[lag:] - x[:-lag]), 99)))
        lag *= 2
    return float(np.interp(way, far[-2:], (lag / 4.0, lag / 2.0)))
