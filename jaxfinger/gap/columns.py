"""Columns: the white rows of one joint, tendon or axis of one channel, with a basis of smooth features.

U_c (n_c, K_c) spans what a smooth law could leave in the n_c rows of column c (`smooth_laws`). Residuals and signatures
enter the formula through their coefficients on U_c and through their products column by column (`by_column`): some
hundreds of numbers a signature, instead of tens of thousands of rows.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfinger.gap.problem import Problem
from jaxfinger.gap.smooth_laws import measured_columns, orthonormal_basis, white_features


@dataclass(frozen=True)
class Column:
    """One column of a channel, with rows enough to tell a smooth law from noise."""

    experiment: str
    channel: str
    column: int  # joint, tendon or axis
    rows: Int[np.ndarray, " n"]  # positions in the problem's stacked rows
    basis: Float[np.ndarray, "n K"]  # U_c, orthonormal
    noise_known: bool = True  # from repeats or holds, not from residuals that may hold a law


@dataclass(frozen=True)
class Counts:
    """Dimensions of every column: K_c on the features, m_c = n_c − K_c outside of them; its channel and its noise."""

    K: Int[np.ndarray, " C"]
    outside: Int[np.ndarray, " C"]
    channel: Int[np.ndarray, " C"]  # number of the experiment and quantity, from 0
    noise_known: Bool[np.ndarray, " C"]  # as of `Column`

    def largest_of_channel(self, values: Float[np.ndarray, " C"]) -> Float[np.ndarray, " C"]:
        """For every column, the largest value in any column of its channel; values are zero or more."""
        most = np.zeros(len(self.channel))
        np.maximum.at(most, self.channel, values)
        return most[self.channel]


@dataclass(frozen=True)
class Columns:
    """All columns of a problem."""

    items: tuple[Column, ...]

    @classmethod
    def of(cls, problem: Problem) -> "Columns":
        """Compute the bases of all columns of a problem that have `smooth_laws.MIN_ROWS` rows."""
        items = []
        for e, c, k, pick in measured_columns(problem):
            features = np.concatenate(list(white_features(problem, e, c, k, pick).values()))
            known = problem.noise[e, c].source != "residuals"
            items.append(Column(e, c, k, problem.rows[e].start + pick, orthonormal_basis(features), known))
        return cls(tuple(items))

    @cached_property
    def counts(self) -> Counts:
        """Dimensions, channel and noise of every column."""
        K = np.array([c.basis.shape[1] for c in self.items], int)
        channels = list(dict.fromkeys((c.experiment, c.channel) for c in self.items))
        channel = np.array([channels.index((c.experiment, c.channel)) for c in self.items], int)
        known = np.array([c.noise_known for c in self.items], bool)
        return Counts(K, np.array([len(c.rows) for c in self.items], int) - K, channel, known)

    def sums(self, values: Float[np.ndarray, "features *n"]) -> Float[np.ndarray, "C *n"]:
        """Sum a value of every feature over each column's features."""
        return np.add.reduceat(values, np.r_[0, np.cumsum(self.counts.K)[:-1]], axis=0)
