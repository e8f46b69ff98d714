"""White rows, column by column: their coefficients on the smooth laws' features, and their products.

Most rows are zero in most columns, a signature of one tendon in the columns of another; only the others are held.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array

from jaxfinger.gap.columns import Columns


class Held(NamedTuple):
    """Of some rows, those that are not zero in a column."""

    at: Int[np.ndarray, " k"]  # their numbers, ascending
    rows: Float[np.ndarray, "k n"]


class Block(NamedTuple):
    """X_cᵀ Z_c of one column c."""

    i: Int[np.ndarray, " k"]  # numbers of the rows of X that are not zero there
    j: Int[np.ndarray, " l"]  # and of Z
    values: Float[np.ndarray, "k l"]


class ByColumn:
    """Rows by column, zero ones left out."""

    def __init__(self, columns: Columns, count: int, held: list[Held]):
        self.columns, self.count, self.held = columns, count, held
        self._with: WeakKeyDictionary[ByColumn, Products] = WeakKeyDictionary()
        self._among: dict[tuple[int, ...], np.ndarray] = {}

    @classmethod
    def of(cls, columns: Columns, x: Float[np.ndarray, "k N"]) -> "ByColumn":
        """Of whole rows."""
        return cls(columns, len(x), [_held(x[:, c.rows]) for c in columns.items])

    @classmethod
    def joined(cls, columns: Columns, members: Sequence["ByColumn"]) -> "ByColumn":
        """The rows of all members, one after the other."""
        starts = np.cumsum([0, *(m.count for m in members)])
        held = []
        for c, column in enumerate(columns.items):
            mine = [m.held[c] for m in members]
            at = [x.at + start for x, start in zip(mine, starts, strict=False)]
            none = np.empty((0, len(column.rows)))
            held.append(Held(np.concatenate([np.empty(0, int), *at]), np.concatenate([none, *(x.rows for x in mine)])))
        return cls(columns, int(starts[-1]), held)

    def scaled(self, by: Float[np.ndarray, " k"]) -> "ByColumn":
        """Every row times a factor."""
        return ByColumn(self.columns, self.count, [Held(at, rows * by[at, None]) for at, rows in self.held])

    @cached_property
    def B(self) -> Float[np.ndarray, "features k"]:
        """Coefficients on the features."""
        out = np.zeros((int(self.columns.counts.K.sum()), self.count))
        ends = np.cumsum(self.columns.counts.K)
        for c, end, (at, rows) in zip(self.columns.items, ends, self.held, strict=True):
            out[end - c.basis.shape[1] : end, at] = c.basis.T @ rows.T
        return out

    def dense(self, at: Int[np.ndarray, " k"], N: int) -> Float[np.ndarray, "k N"]:
        """Some of the rows as whole ones, zero in columns that are not judged."""
        out = np.zeros((len(at), N))
        for c, place, (_, rows) in zip(self.columns.items, self._places[:, at], self.held, strict=True):
            there = np.flatnonzero(place >= 0)
            out[there[:, None], c.rows] = rows[place[there]]
        return out

    def products(self, other: "ByColumn") -> "Products":
        """With other rows."""
        if other not in self._with:
            pairs = zip(self.held, other.held, strict=True)
            self._with[other] = Products(
                (self.count, other.count), [Block(x.at, z.at, x.rows @ z.rows.T) for x, z in pairs]
            )
        return self._with[other]

    def among(self, at: Int[np.ndarray, " k"]) -> Float[np.ndarray, "C k k"]:
        """Products of some of the rows with one another."""
        key = tuple(at.tolist())
        if key not in self._among:
            places = self._places[:, at]
            out = np.zeros((len(places), len(at), len(at)))
            for c in np.flatnonzero((places >= 0).any(axis=1)):
                there = np.flatnonzero(places[c] >= 0)
                rows = self.held[c].rows[places[c, there]]
                out[c, there[:, None], there] = rows @ rows.T
            self._among[key] = out
        return self._among[key]

    @cached_property
    def _places(self) -> Int[np.ndarray, "C k"]:
        """Where a column holds each row; −1 where it is zero."""
        out = np.full((len(self.held), self.count), -1)
        for c, (at, _) in enumerate(self.held):
            out[c, at] = np.arange(len(at))
        return out


def _held(x: Float[np.ndarray, "k n"]) -> Held:
    at = np.flatnonzero(x.any(axis=1))
    return Held(at, x[at])


class Products:
    """X_cᵀ Z_c of every column c."""

    def __init__(self, shape: tuple[int, int], blocks: list[Block]):
        self.shape, self.blocks = shape, blocks

    @classmethod
    def stacked(cls, members: Sequence["Products"]) -> "Products":
        """Of all rows X of the members, one after the other, with the same Z."""
        starts = np.cumsum([0, *(m.shape[0] for m in members)])
        blocks = []
        for mine in zip(*(m.blocks for m in members), strict=True):
            i = np.concatenate([b.i + start for b, start in zip(mine, starts, strict=False)])
            blocks.append(Block(i, mine[0].j, np.concatenate([b.values for b in mine])))
        return cls((int(starts[-1]), members[0].shape[1]), blocks)

    @property
    def dense(self) -> Float[np.ndarray, "C k l"]:
        """With zeros."""
        out = np.zeros((len(self.blocks), *self.shape))
        for c, (i, j, values) in enumerate(self.blocks):
            out[c, i[:, None], j] = values
        return out

    def summed(self, weights: Float[np.ndarray, " C"]) -> Float[np.ndarray, "k l"]:
        """Σ_c w_c X_cᵀ Z_c."""
        out = np.zeros(self.shape)
        for w, (i, j, values) in zip(weights, self.blocks, strict=True):
            out[i[:, None], j] += w * values
        return out

    def along(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "C l"]:
        """xᵀ X_cᵀ Z_c."""
        out = np.zeros((len(self.blocks), self.shape[1]))
        for c, (i, j, values) in enumerate(self.blocks):
            out[c, j] = x[i] @ values
        return out

    def bilinear(self, x: Float[np.ndarray, "k n"], y: csc_array) -> Float[np.ndarray, "C n"]:
        """x_mᵀ X_cᵀ Z_c y_m of every m, for y (l, n) that is zero for the most part."""
        rows = y.tocsr()
        return np.stack([np.sum(x[i] * (rows[j].T @ values.T).T, axis=0) for i, j, values in self.blocks])

    def with_rows(self, at: Int[np.ndarray, " m"]) -> Float[np.ndarray, "C k m"]:
        """With some of the rows Z."""
        out = np.zeros((len(self.blocks), self.shape[0], len(at)))
        for c, (i, j, values) in enumerate(self.blocks):
            there = np.flatnonzero(np.isin(at, j))
            out[c, i[:, None], there] = values[:, np.searchsorted(j, at[there])]
        return out
