"""Sizes of a session, so that no constant of one machine decides: a finger pulls with 10 N, a crane does not."""

from dataclasses import dataclass

import numpy as np

from jaxfinger.data.session import Session

SLACK = 0.02  # of the highest tension: taut is a fifth of it or more in protocols, and a tare is good to a hundredth
NOISE = 6.0  # times its noise: what a tension sensor reads of a slack tendon is less, but once in a billion samples
TRAVEL = 0.02  # of the highest tension: a tenth of a protocol's step, ten times the noise of a sensor of that range
STRETCH = 0.04  # of the longest excursion at the highest tension: steel and fibre of an arm's length stretch by less
LOOK = 1000  # samples of a trial that tell its sizes


@dataclass(frozen=True)
class Sizes:
    """What counts as little in a session."""

    tension: float  # N, the highest
    excursion: float  # m, the longest
    noise: float  # N, of a tension sensor

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
    tensions, excursions, noises = [0.0], [0.0], []
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
    return Sizes(max(tensions), max(excursions), float(np.median(noises)) if noises else 0.0)
