"""Rows stored by column give the same products as whole rows."""

import numpy as np
import pytest
from scipy.sparse import csc_array

from jaxfinger.gap.by_column import ByColumn, Products
from jaxfinger.gap.columns import Column, Columns
from jaxfinger.gap.smooth_laws import orthonormal_basis

SIZES = (60, 80, 50)  # rows of each column


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def columns(rng):
    starts = np.cumsum([0, *SIZES])
    return Columns(
        tuple(
            Column(
                "VD.1", "tendon_excursion", k, start + np.arange(n), orthonormal_basis(rng.standard_normal((k + 2, n)))
            )
            for k, (start, n) in enumerate(zip(starts, SIZES, strict=False))
        )
    )


def rows(columns, rng, count):
    """Random rows, each zero in some columns, the last in all."""
    x = rng.standard_normal((count, sum(SIZES)))
    for c, column in enumerate(columns.items):
        x[c::2, column.rows] = 0.0
    x[-1] = 0.0
    return x


def whole(columns, x, z):
    """Products of whole rows in every column."""
    return np.stack([x[:, c.rows] @ z[:, c.rows].T for c in columns.items])


def test_products_are_those_of_whole_rows(columns, rng):
    x, more, z = (rows(columns, rng, n) for n in (4, 3, 6))
    X, M, Z = (ByColumn.of(columns, a) for a in (x, more, z))
    both = np.vstack([x, more])
    found, expected = Products.stacked([X.products(Z), M.products(Z)]), whole(columns, both, z)
    np.testing.assert_allclose(found.dense, expected, atol=1e-12)
    weights, along = rng.uniform(0.1, 3.0, len(SIZES)), rng.standard_normal(len(both))
    np.testing.assert_allclose(found.summed(weights), np.tensordot(weights, expected, 1), atol=1e-12)
    np.testing.assert_allclose(found.along(along), np.einsum("i,cij->cj", along, expected), atol=1e-12)
    some = np.array([5, 0, 3])
    np.testing.assert_allclose(found.with_rows(some), expected[:, :, some], atol=1e-12)
    a, b = rng.standard_normal((len(both), 5)), rng.standard_normal((len(z), 5)) * (rng.uniform(size=(len(z), 5)) < 0.5)
    bilinear = np.einsum("in,cij,jn->cn", a, expected, b)
    np.testing.assert_allclose(found.bilinear(a, csc_array(b)), bilinear, atol=1e-12)
    np.testing.assert_allclose(Z.among(some), whole(columns, z, z)[:, some][:, :, some], atol=1e-12)


def test_rows_joined_and_scaled_are_the_same_rows(columns, rng):
    x, z = rows(columns, rng, 4), rows(columns, rng, 5)
    both, by = np.vstack([x, z]), rng.uniform(0.5, 2.0, 9)
    found = ByColumn.joined(columns, [ByColumn.of(columns, x), ByColumn.of(columns, z)]).scaled(by)
    expected = by[:, None] * both
    np.testing.assert_allclose(found.dense(np.arange(9), sum(SIZES)), expected, atol=1e-12)
    np.testing.assert_allclose(found.B, ByColumn.of(columns, expected).B, atol=1e-12)
    assert found.count == 9


def test_nothing_is_stored_of_a_column_where_all_rows_are_zero(columns, rng):
    x = np.zeros((3, sum(SIZES)))
    x[:, columns.items[1].rows] = rng.standard_normal((3, SIZES[1]))
    assert [rows.values.size for rows in ByColumn.of(columns, x).nonzero] == [0, 3 * SIZES[1], 0]
    assert ByColumn.joined(columns, []).count == 0
