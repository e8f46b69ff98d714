"""Medians and quantiles are those of NumPy."""

import numpy as np
import pytest

from jaxfinger.data.signals.quantiles import median, quantile


@pytest.mark.parametrize("size", [1, 2, 3, 10, 1001, 54_494])
@pytest.mark.parametrize("coarse", [False, True])
def test_they_are_those_of_numpy(size, coarse):
    values = np.random.default_rng(size).standard_normal(size)
    values = np.round(values) if coarse else values
    assert median(values) == pytest.approx(np.median(values), rel=1e-14, abs=1e-300)
    for share in (0.0, 0.01, 0.05, 0.5, 0.9, 0.99, 1.0):
        assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-14, abs=1e-300)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_missing_value_shows(share):
    values = np.arange(5.0)
    values[2] = np.nan
    assert np.isnan(quantile(values, share))


def test_an_infinite_value_counts_as_large():
    assert median(np.array([1.0, np.inf, 2.0])) == 2.0
