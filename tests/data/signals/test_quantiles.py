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


@pytest.mark.parametrize("shape", ["constant", "two values", "drift", "in step with the sample"])
def test_they_are_those_of_numpy_for_uneven_values(shape):
    n = np.arange(54_872)  # 38³: every 38th value is drawn
    values = {
        "constant": np.ones(n.size),
        "two values": (n % 3 == 0).astype(float),
        "drift": np.sin(n / 9000.0),
        "in step with the sample": np.where(n % 38 == 0, 100.0, n / n.size),
    }[shape]
    for share in (0.0, 0.01, 0.5, 0.66, 0.99, 1.0):
        assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-14, abs=1e-300)


@pytest.mark.parametrize("size", [5, 5000])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_missing_value_shows(share, size):
    values = np.arange(float(size))
    values[2] = np.nan
    assert np.isnan(quantile(values, share))


def test_an_infinite_value_counts_as_large():
    assert median(np.array([1.0, np.inf, 2.0])) == 2.0
