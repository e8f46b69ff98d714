"""Derivatives, shrinking and spikes, compared with closed forms."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from jaxfinger.data.filtering import smooth
from jaxfinger.data.spikes import longest_spike, outlier_mask, without_spikes
from jaxfinger.errors import UserError
from jaxfinger.experiments.driven import ACCELERATION_DOF
from jaxfinger.experiments.shrink import PASSED, shrink
from jaxfinger.synthetic import motions


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


def test_spikes_are_found_and_motion_is_not():
    rng = np.random.default_rng(3)
    time = np.arange(20_000) / 1000
    clean = np.sin(2 * np.pi * time) + 1e-3 * rng.standard_normal(len(time))
    hit = rng.choice(len(time), 600, replace=False)
    x = clean.copy()
    x[hit] += rng.choice([-1, 1], 600) * rng.uniform(0.1, 1.0, 600)
    mask = outlier_mask(x)
    assert mask[hit].mean() > 0.99
    assert np.delete(mask, hit).mean() < 1e-3
    assert outlier_mask(clean).mean() < 1e-4


def test_a_quantised_channel_has_no_spikes():
    time = np.arange(10_000) / 1000
    noisy = 0.3 * time + 2e-4 * np.random.default_rng(0).standard_normal(len(time))
    step = 3.8e-4
    assert not outlier_mask(np.round(noisy / step) * step).any()
    assert not outlier_mask(np.round(2e-4 * np.random.default_rng(1).standard_normal(10_000) / step) * step).any()
    assert not outlier_mask(np.full((100, 2), np.nan)).any()


def test_a_shrunk_regressor_is_rid_of_most_of_its_bias():
    """The regressor has bursts of acceleration between long quiet stretches, and noise.

    Least squares with weights that favour fast changes, as whitening does, underestimates inertia from the noisy
    regressor.
    """
    rng = np.random.default_rng(0)
    n = np.arange(40_000)
    burst = np.exp(-0.5 * (((n % 1000) - 500) / 30.0) ** 2) * np.sign((n // 1000) % 2 - 0.5)
    noise = gaussian_filter1d(rng.standard_normal(n.size), 10.0)
    seen = (burst + 0.03 * noise / noise.std())[:, None]
    y = 2.0 * burst + 0.01 * rng.standard_normal(n.size)

    def slope(x):
        x, v = x[20:, 0] - x[:-20, 0], y[20:] - y[:-20]
        return (x @ v) / (x @ x)

    assert slope(seen) < 1.85
    assert slope(shrink(seen, 100, ACCELERATION_DOF)) == pytest.approx(2.0, abs=(2.0 - slope(seen)) / 3)


@pytest.mark.parametrize(("cutoff", "rate"), [(10.0, 1000), (40.0, 1000), (10.0, 200)])
def test_shrinking_leaves_little_of_a_resting_encoders_noise(cutoff, rate):
    """Little more stays of the noise of q̈ than of its running mean, over as long as one period of the cut-off."""
    noise, window = 2e-4 * np.random.default_rng(0).standard_normal((60_000, 1)), round(rate / cutoff)
    qdd = smooth(np.arange(len(noise)) / rate, noise, cutoff)[2]
    mean = uniform_filter1d(qdd, 2 * (window // 2) + 1, axis=0)
    shrunk = shrink(qdd, window, ACCELERATION_DOF)
    assert shrunk.std() < 1.25 * mean.std()
    assert np.mean(shrunk != mean) < 2.0 * PASSED


def test_shrinking_leaves_a_smooth_motion_and_a_constant_alone():
    slow = np.sin(2 * np.pi * np.arange(5000) / 5000)[:, None]
    np.testing.assert_allclose(shrink(slow, 100, ACCELERATION_DOF), slow, atol=3e-3)  # This includes both ends.
    np.testing.assert_array_equal(shrink(np.ones((500, 2)), 100, ACCELERATION_DOF), np.ones((500, 2)))


def test_spikes_are_bridged_and_everything_else_is_left_alone():
    rng = np.random.default_rng(0)
    time = np.arange(5000) / 1000
    clean = np.stack([np.sin(2 * np.pi * time), np.full(5000, 3.0), np.full(5000, np.nan)], axis=1)
    x = clean + 2e-4 * rng.standard_normal(clean.shape)
    thrown = rng.random(x.shape) < 0.005
    spiked = np.where(thrown, x + 0.5, x)
    found = without_spikes(spiked)
    np.testing.assert_allclose(found[:, :2], clean[:, :2], atol=1.6e-3)
    np.testing.assert_array_equal(found[~thrown & np.isfinite(x)], x[~thrown & np.isfinite(x)])
    np.testing.assert_array_equal(without_spikes(x), x)


@pytest.mark.parametrize("rate", [100.0, 250.0, 1000.0])
def test_a_reversal_without_noise_is_no_spike_that_matters(rate):
    """Coarse samples may be taken for spikes at a reversal, but a line across one or two of them changes little."""
    time = np.arange(0.0, 10.0, 1.0 / rate)
    q = 1.0 - np.cos(np.pi * np.maximum(time - 2.0, 0.0))[:, None]  # The joint rests, then turns back every second.
    np.testing.assert_allclose(without_spikes(q), q, atol=(np.pi / rate) ** 2)


@settings(max_examples=40, deadline=None)
@given(
    rate=st.sampled_from([20.0, 50.0, 100.0, 333.0, 1000.0]),
    stroke=st.floats(0.4, 3.0),
    noise=st.sampled_from([0.0, 1e-4, 1e-3]),
    seed=st.integers(0, 99),
)
@example(rate=20.0, stroke=1.7544745778404764, noise=0.0, seed=64)  # The motion starts at the last samples.
def test_a_motion_is_no_spike_at_any_rate_and_spikes_in_it_are(rate, stroke, noise, seed):
    """The motion is a hand's strokes, sampled at 20 to 1000 Hz."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(20 * rate)) / rate
    x = motions.wander(time, 0.0, 1.0, rng, (stroke, 1.5 * stroke)).x + noise * rng.standard_normal(time.size)
    longest = longest_spike(1.0 / rate)
    assert not outlier_mask(x, longest=longest).any()
    hit = rng.choice(time.size // 8, time.size // 80, replace=False) * 8 + 4
    steepest = np.abs(np.diff(x)).max()
    x[hit] += rng.choice([-1, 1], hit.size) * (0.05 + 20.0 * noise + 4.0 * steepest)
    found = outlier_mask(x, longest=longest)
    assert found[hit].all()
    assert not np.delete(found, hit).any()
