"""White rows in the basis of the smooth laws' features, column by column: what every evidence of the search is made of.

A column c is one joint, tendon or axis of one channel of one experiment. U_c (rows, K_c) spans what a smooth law could
leave there; a residual and a signature enter every formula through their coefficients on U_c and through products of
what lies outside of it. That is some hundreds of numbers where there are tens of thousands of rows.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signatures import whitened
from jaxfinger.gap.smooth_laws import features

FEWEST = 50  # rows of a column, below which nothing smooth is told from noise
DISTINCT = 0.1  # of the largest singular value: nearly collinear features differ in single samples


@dataclass(frozen=True)
class Column:
    """One column that is judged."""

    experiment: str
    channel: str
    column: int
    rows: Int[np.ndarray, " n"]
    basis: Float[np.ndarray, "n K"]  # orthonormal


@dataclass(frozen=True)
class Counts:
    """Of every column, its features, and its rows less these."""

    K: Int[np.ndarray, " C"]
    outside: Int[np.ndarray, " C"]


@dataclass(frozen=True)
class Columns:
    """All columns of a problem."""

    items: tuple[Column, ...]

    @classmethod
    def of(cls, problem: Problem) -> "Columns":
        """The columns with samples enough."""
        return cls(tuple(_columns(problem)))

    @cached_property
    def counts(self) -> Counts:
        """Features and rows of every column."""
        K = np.array([c.basis.shape[1] for c in self.items], int)
        return Counts(K, np.array([len(c.rows) for c in self.items], int) - K)

    def sums(self, values: Float[np.ndarray, "features *n"]) -> Float[np.ndarray, "C *n"]:
        """Of features, column by column."""
        return np.add.reduceat(values, np.r_[0, np.cumsum(self.counts.K)[:-1]], axis=0)


def _columns(problem: Problem):
    for e, rows in problem.rows.items():
        for number, c in enumerate(problem.stacks[e].experiment.channels):
            for k in np.unique(rows.column[rows.channel == number]):
                pick = np.flatnonzero((rows.channel == number) & (rows.column == k))
                if len(pick) >= FEWEST:
                    white = np.concatenate(list(white_features(problem, e, c, int(k), pick).values()))
                    yield Column(e, c, int(k), rows.start + pick, orthonormal(white))


def white_features(problem: Problem, e: str, c: str, k: int, pick: Int[np.ndarray, " n"]) -> dict[str, np.ndarray]:
    """Features of a column in its white rows `pick`, (features, n) by variable."""
    out, shape = {}, problem.stacks[e].batch.y[c].shape
    for variable, members in features(problem, e, c, k).items():
        if members:
            raw = np.zeros((len(members), *shape))
            raw[:, k] = np.stack(members)
            out[variable] = whitened(raw, problem, problem.rows[e], pick, c)
    return out


def orthonormal(features: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "n K"]:
    """A basis of what features span that are no near copies of each other."""
    A = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-300)
    U, s, _ = np.linalg.svd(A.T, full_matrices=False)
    return U[:, s > DISTINCT * s[0]]
