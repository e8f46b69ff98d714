"""Predictions compared with measurements, column by column.

Columns are compared about their means in each trial, since zeros of encoders and tares are arbitrary.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.data import Predictions, Session, without_spikes
from jaxfinger.data.predictions import predicted_at
from jaxfinger.experiments import EXPERIMENTS

# E of predictions that may hold a mistake. Parameters that are off by half miss a quarter of the motion.
MIN_MISSED = 0.5
# Motion over the noise between samples, as mean squares. White noise has 1; a column that moves has far more.
MIN_MOTION_TO_NOISE = 10.0
# Share of the measured rms. Predictions that move less are constant but for rounding.
MAX_STILL = 1e-6


@dataclass(frozen=True)
class Comparison:
    """A channel of one trial, or of several added up: k measured columns y_j and predicted ones p_i about their means.

    Row j has the samples in which y_j was measured. Columns that were not measured or predicted are zero.
    """

    channel: str
    trials: tuple[str, ...]
    samples: Float[np.ndarray, " k"]
    moved: Float[np.ndarray, "k k"]  # ‖y_j‖² where p_i is predicted
    told: Float[np.ndarray, "k k"]  # ‖p_i‖² in the samples of y_j
    cross: Float[np.ndarray, "k k"]  # y_j · p_i
    moves: Bool[np.ndarray, " k"]  # whether y_j is motion, and not noise alone

    def missed(self, factor: float = 1.0) -> Float[np.ndarray, "k k"]:
        """E of every measured column and predicted column times the factor; infinite without a pair that moves."""
        left = self.moved - 2.0 * factor * self.cross + factor**2 * self.told
        return np.where((self.moved > 0.0) & self.moves[:, None], left / np.maximum(self.moved, 1e-300), np.inf)

    @property
    def size(self) -> Float[np.ndarray, " k"]:
        """Mean square of every measured column that is predicted too."""
        return np.diag(self.moved) / np.maximum(self.samples, 1.0)

    @property
    def unlike(self) -> Bool[np.ndarray, " k"]:
        """Columns of which the predictions miss most of the motion."""
        own = np.diag(self.missed())
        return (own >= MIN_MISSED) & np.isfinite(own)

    @property
    def still(self) -> Bool[np.ndarray, " k"]:
        """Columns whose predictions are constant while the measured ones move."""
        return self.moves & (np.diag(self.told) <= MAX_STILL**2 * np.diag(self.moved))

    def without(self, columns: Bool[np.ndarray, " k"]) -> Comparison:
        """The comparison without some of its measured columns."""
        kept = ~columns
        moved, told, cross = (x * kept[:, None] for x in (self.moved, self.told, self.cross))
        return Comparison(self.channel, self.trials, self.samples * kept, moved, told, cross, self.moves & kept)

    def __add__(self, other: Comparison) -> Comparison:
        """Both together; a column that does not move in one of them counts there as well."""
        return Comparison(
            self.channel,
            self.trials + other.trials,
            self.samples + other.samples,
            self.moved + other.moved,
            self.told + other.told,
            self.cross + other.cross,
            self.moves | other.moves,
        )


def comparisons(session: Session, predictions: Predictions) -> Iterator[Comparison]:
    """Comparisons of every channel and trial that a diagnosis judges.

    The excursions of held joints are not among them: they stretch, and a simulator without stretch predicts none.
    """
    for trial in session:
        experiment, prediction = EXPERIMENTS[trial.experiment], predictions.get(trial.name, {})
        for channel in experiment.channels:
            values = getattr(trial, channel)
            if values is None or channel not in prediction or (experiment.held and channel == "tendon_excursion"):
                continue
            yield compare(trial.name, channel, values, predicted_at(prediction, channel, trial, values.shape))


def compare(
    trial: str, channel: str, measured: Float[np.ndarray, "N k"], predicted: Float[np.ndarray, "N k"]
) -> Comparison:
    """Compare what was measured of a trial's channel with what is predicted at the same samples."""
    k = measured.shape[1]
    there = np.isfinite(predicted).all(axis=0)
    moved, told, cross = np.zeros((3, k, k))
    samples, moves = np.zeros(k), np.zeros(k, bool)
    for j in range(k):
        rows = np.isfinite(measured[:, j])
        if rows.sum() < 3:
            continue
        y = without_spikes(measured[rows, j : j + 1])[:, 0]
        p = np.where(there, predicted[rows], 0.0)
        y, p = y - y.mean(), p - p.mean(axis=0)
        square = float(y @ y)
        samples[j], moves[j] = len(y), square > MIN_MOTION_TO_NOISE * 0.5 * float(np.sum(np.diff(y) ** 2))
        moved[j], told[j], cross[j] = np.where(there, square, 0.0), np.sum(p**2, axis=0), y @ p
    return Comparison(channel, (trial,), samples, moved, told, cross, moves)
