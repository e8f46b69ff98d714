"""White rows stored column by column, with their coefficients on the smooth features and their products.

Rows are residuals, derivatives and signatures, each of N numbers. Most are zero in most columns, as a tendon's
signature in another tendon's columns, and only the others are stored.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array

from jaxfinger.gap.columns import Columns


class NonzeroRows(NamedTuple):
    """The rows that are not zero in one column."""

    index: Int[np.ndarray, " k"]  # which rows, ascending
    values: Float[np.ndarray, "k n"]


class Block(NamedTuple):
    """Products X_c Z_cᵀ in one column c."""

    i: Int[np.ndarray, " k"]  # rows of X that are not zero there, ascending
    j: Int[np.ndarray, " l"]  # rows of Z that are not zero there, ascending
    values: Float[np.ndarray, "k l"]


class ByColumn:
    """`count` rows, of which each column stores those that are not zero there."""

    def __init__(self, columns: Columns, count: int, nonzero: list[NonzeroRows]):
        self.columns, self.count, self.nonzero = columns, count, nonzero
        self._products: WeakKeyDictionary[ByColumn, Products] = WeakKeyDictionary()
        self._among: dict[tuple[int, ...], np.ndarray] = {}

    @classmethod
    def of(cls, columns: Columns, x: Float[np.ndarray, "k N"]) -> "ByColumn":
        """Split whole rows into columns. Rows of the problem that belong to no column are left out."""
        nonzero, x = [], np.ascontiguousarray(x)  # `take` would copy all of a transposed array at every call
        for c in columns.items:
            there = np.take(x, c.rows, axis=1)
            index = np.flatnonzero(there.any(axis=1))
            nonzero.append(NonzeroRows(index, there[index]))
        return cls(columns, len(x), nonzero)

    @classmethod
    def joined(cls, columns: Columns, members: Sequence["ByColumn"]) -> "ByColumn":
        """Concatenate the rows of all members."""
        starts = np.cumsum([0, *(m.count for m in members)])
        nonzero = []
        for c, column in enumerate(columns.items):
            mine = [m.nonzero[c] for m in members]
            index = [x.index + start for x, start in zip(mine, starts, strict=False)]
            # Empty arrays in front give the result its type where there are no members.
            values = [np.empty((0, len(column.rows))), *(x.values for x in mine)]
            nonzero.append(NonzeroRows(np.concatenate([np.empty(0, int), *index]), np.concatenate(values)))
        return cls(columns, int(starts[-1]), nonzero)

    def scaled(self, by: Float[np.ndarray, " k"]) -> "ByColumn":
        """Multiply every row by its factor."""
        scaled = [NonzeroRows(index, values * by[index, None]) for index, values in self.nonzero]
        return ByColumn(self.columns, self.count, scaled)

    @cached_property
    def B(self) -> Float[np.ndarray, "features k"]:
        """Coefficients U_cᵀ x_c of every row on the features of all columns."""
        out = np.zeros((int(self.columns.counts.K.sum()), self.count))
        ends = np.cumsum(self.columns.counts.K)
        for c, end, (index, values) in zip(self.columns.items, ends, self.nonzero, strict=True):
            out[end - c.basis.shape[1] : end, index] = c.basis.T @ values.T
        return out

    def dense(self, at: Int[np.ndarray, " k"], N: int) -> Float[np.ndarray, "k N"]:
        """Assemble the rows `at` as whole rows of N numbers, zero outside of all columns."""
        out = np.zeros((len(at), N))
        for c, place, (_, values) in zip(self.columns.items, self._places[:, at], self.nonzero, strict=True):
            there = np.flatnonzero(place >= 0)
            out[there[:, None], c.rows] = values[place[there]]
        return out

    def products(self, other: "ByColumn") -> "Products":
        """Products X_c Z_cᵀ of these rows X with other rows Z in every column; computed once for each Z."""
        if other not in self._products:
            pairs = zip(self.nonzero, other.nonzero, strict=True)
            blocks = [Block(x.index, z.index, x.values @ z.values.T) for x, z in pairs]
            self._products[other] = Products((self.count, other.count), blocks)
        return self._products[other]

    def among(self, at: Int[np.ndarray, " k"]) -> Float[np.ndarray, "C k k"]:
        """Products of the rows `at` with one another in every column; computed once for each selection."""
        key = tuple(at.tolist())
        if key not in self._among:
            places = self._places[:, at]
            out = np.zeros((len(places), len(at), len(at)))
            for c in np.flatnonzero((places >= 0).any(axis=1)):
                there = np.flatnonzero(places[c] >= 0)
                values = self.nonzero[c].values[places[c, there]]
                out[c, there[:, None], there] = values @ values.T
            self._among[key] = out
        return self._among[key]

    @cached_property
    def _places(self) -> Int[np.ndarray, "C k"]:
        """Position of every row among those that a column stores; −1 where the row is zero there."""
        out = np.full((len(self.nonzero), self.count), -1)
        for c, (index, _) in enumerate(self.nonzero):
            out[c, index] = np.arange(len(index))
        return out


class Products:
    """Products X_c Z_cᵀ of rows X (k, N) and Z (l, N) in every column c, one block of nonzero rows a column."""

    def __init__(self, shape: tuple[int, int], blocks: list[Block]):
        self.shape, self.blocks = shape, blocks

    @classmethod
    def stacked(cls, members: Sequence["Products"]) -> "Products":
        """Concatenate members with the same Z along the rows X."""
        starts = np.cumsum([0, *(m.shape[0] for m in members)])
        blocks = []
        for mine in zip(*(m.blocks for m in members), strict=True):
            i = np.concatenate([b.i + start for b, start in zip(mine, starts, strict=False)])
            blocks.append(Block(i, mine[0].j, np.concatenate([b.values for b in mine])))
        return cls((int(starts[-1]), members[0].shape[1]), blocks)

    @property
    def dense(self) -> Float[np.ndarray, "C k l"]:
        """All products, zeros included."""
        out = np.zeros((len(self.blocks), *self.shape))
        for c, (i, j, values) in enumerate(self.blocks):
            out[c, i[:, None], j] = values
        return out

    def summed(self, weights: Float[np.ndarray, " C"]) -> Float[np.ndarray, "k l"]:
        """Σ_c w_c X_c Z_cᵀ."""
        out = np.zeros(self.shape)
        for w, (i, j, values) in zip(weights, self.blocks, strict=True):
            out[i[:, None], j] += w * values
        return out

    def along(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, "C l"]:
        """xᵀ X_c Z_cᵀ in every column, for coefficients x of the rows X."""
        out = np.zeros((len(self.blocks), self.shape[1]))
        for c, (i, j, values) in enumerate(self.blocks):
            out[c, j] = x[i] @ values
        return out

    def bilinear(self, x: Float[np.ndarray, "k n"], y: csc_array) -> Float[np.ndarray, "C n"]:
        """x_mᵀ X_c Z_cᵀ y_m in every column, for n pairs of coefficients x_m and y_m; y (l, n) is mostly zero."""
        rows = y.tocsr()
        return np.stack([np.sum(x[i] * (rows[j].T @ values.T).T, axis=0) for i, j, values in self.blocks])

    def with_rows(self, at: Int[np.ndarray, " m"]) -> Float[np.ndarray, "C k m"]:
        """Products with the rows `at` of Z only."""
        out = np.zeros((len(self.blocks), self.shape[0], len(at)))
        for c, (i, j, values) in enumerate(self.blocks):
            if j.size:
                place = np.minimum(np.searchsorted(j, at), j.size - 1)
                there = np.flatnonzero(j[place] == at)
                out[c, i[:, None], there] = values[:, place[there]]
        return out
