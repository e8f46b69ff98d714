"""Low-pass and derivatives, compared with closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.data.signals.filtering import smooth, smooth_rate
from jaxfinger.errors import UserError


def jittered(count, rate, seed=0):
    return np.cumsum(1.0 + 0.1 * np.random.default_rng(seed).uniform(-1, 1, count)) / rate


def inner(time, cutoff):
    return (time > time[0] + 2 / cutoff) & (time < time[-1] - 2 / cutoff)


@pytest.mark.parametrize("even", [True, False])
def test_derivatives_of_a_sine_in_the_pass_band(even):
    time = np.arange(4000) / 1000 if even else jittered(4000, 1000)
    w = 2 * np.pi * 1.5
    x, xd, xdd = smooth(time, np.sin(w * time)[:, None], 20.0)
    k = inner(time, 20.0)
    gain = 2.0 ** (-0.5 * (1.5 / 20.0) ** 2)  # Gaussian. Linear resampling adds an error of (w h)^2 / 8 = 1.1e-5.
    np.testing.assert_allclose(x[k, 0], gain * np.sin(w * time[k]), atol=5e-5)
    np.testing.assert_allclose(xd[k, 0], gain * w * np.cos(w * time[k]), atol=1e-3 * w)
    np.testing.assert_allclose(xdd[k, 0], -gain * (w**2) * np.sin(w * time[k]), atol=1e-3 * w**2)


@pytest.mark.parametrize("cutoff", [5.0, 20.0, 60.0])
def test_the_stated_cutoff_is_where_half_the_power_is_left(cutoff):
    time = np.arange(8000) / 1000
    x = smooth(time, np.sin(2 * np.pi * cutoff * time), cutoff)[0]
    assert np.sqrt(2) * x[inner(time, cutoff)].std() == pytest.approx(np.sqrt(0.5), rel=5e-3)


def test_zero_phase():
    time = np.arange(4000) / 1000
    pulse = np.exp(-(((time - 2.0) / 0.05) ** 2))
    x = smooth(time, pulse, 10.0)[0]
    assert time[np.argmax(x)] == pytest.approx(2.0, abs=1.1e-3)
    np.testing.assert_allclose(x[1000:2000], x[3000:2000:-1], atol=1e-9)


def test_white_noise_in_velocity_is_what_the_bandwidth_says():
    sigma, rate, cutoff = 1e-3, 1000.0, 10.0
    time = np.arange(100_000) / rate
    xd = smooth(time, sigma * np.random.default_rng(1).standard_normal(len(time)), cutoff)[1]
    frequency = np.linspace(0, 500, 200_001)
    gain = 2.0 ** (-0.5 * (frequency[:-1] / cutoff) ** 2)
    density = (2 * np.pi * frequency[:-1] * gain) ** 2 * 2 * sigma**2 / rate
    assert xd.std() == pytest.approx(np.sqrt(density.sum() * frequency[1]), rel=0.05)


def test_nan_columns_stay_and_holes_are_bridged():
    time = jittered(2000, 1000)
    x = np.column_stack([np.sin(time), np.full(2000, np.nan), np.sin(time)])
    x[700:720, 2] = np.nan
    out = smooth(time, x, 10.0)
    for derivative in out:
        assert np.isfinite(derivative[:, 0]).all()
        assert np.isnan(derivative[:, 1]).all()
        np.testing.assert_array_equal(np.isnan(derivative[:, 2]), np.isnan(x[:, 2]))


@pytest.mark.parametrize("cutoff", [0.0, -1.0, 500.0, 1e4])
def test_a_cutoff_beyond_the_sampling_is_refused(cutoff):
    with pytest.raises(UserError, match="half the sampling rate"):
        smooth(np.arange(1000) / 1000, np.zeros(1000), cutoff)


@given(count=st.integers(1, 40))
@settings(max_examples=20, deadline=None)
def test_short_recordings_give_finite_derivatives(count):
    time = np.arange(count) / 1000
    for x in smooth(time, np.cos(time)[:, None], 20.0):
        assert x.shape == (count, 1)
        assert np.isfinite(x).all()


@pytest.mark.parametrize("even", [True, False])
@pytest.mark.parametrize("count", [2, 500])
def test_the_rate_alone_is_that_of_all_derivatives(even, count):
    time = np.arange(count) / 1000 if even else jittered(count, 1000)
    x = np.random.default_rng(0).standard_normal((count, 2))
    np.testing.assert_array_equal(smooth_rate(time, x, 20.0), smooth(time, x, 20.0)[1])
