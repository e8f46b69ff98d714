"""White rows in the basis of the smooth laws' features, column by column: what every evidence of the search is made of.

A column c is one joint, tendon or axis of one channel of one experiment. U_c (rows, K_c) spans what a smooth law could
leave there; a residual and a signature enter every formula through their coefficients on U_c and through products of
what lies outside of it. That is some hundreds of numbers where there are tens of thousands of rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

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


class ByColumn:
    """Rows, column by column: their coefficients on the features, and their products, each made once."""

    def __init__(self, columns: Columns, x: Float[np.ndarray, "k N"], dtype: type = np.float64):
        """`dtype`: of the rows that are kept; single precision holds a signature that leaves 1e-3 of itself to 6e-5."""
        self.columns, self.N = columns, x.shape[1]
        self.B: Float[np.ndarray, "features k"] = np.concatenate([c.basis.T @ x[:, c.rows].T for c in columns.items])
        self.parts = [x[:, c.rows].astype(dtype) for c in columns.items]
        self._with: WeakKeyDictionary[ByColumn, np.ndarray] = WeakKeyDictionary()
        self._among: dict[tuple[int, ...], np.ndarray] = {}

    def take(self, others: Sequence["ByColumn"]) -> None:
        """Rows of others behind its own; these are empty afterwards, so that none is held twice."""
        self.B = np.concatenate([self.B, *(x.B for x in others)], axis=1)
        self.parts = [np.concatenate([mine, *(x.parts.pop(0) for x in others)]) for mine in self.parts]

    def rows(self, at: Int[np.ndarray, " k"]) -> Float[np.ndarray, "k N"]:
        """Some of the rows, zero in columns that are not judged."""
        out = np.zeros((len(at), self.N))
        for c, part in zip(self.columns.items, self.parts, strict=True):
            out[:, c.rows] = part[at]
        return out

    def products(self, other: "ByColumn") -> Float[np.ndarray, "C k l"]:
        """With other rows."""
        if other not in self._with:
            self._with[other] = np.stack([x @ y.T for x, y in zip(self.parts, other.parts, strict=True)])
        return self._with[other]

    def among(self, at: Int[np.ndarray, " k"]) -> Float[np.ndarray, "C k k"]:
        """Of some of the rows with one another."""
        key = tuple(at.tolist())
        if key not in self._among:
            some = [x[at].astype(np.float64) for x in self.parts]
            self._among[key] = np.stack([x @ x.T for x in some])
        return self._among[key]


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
