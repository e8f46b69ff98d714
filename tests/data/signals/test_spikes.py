"""Spikes are found and bridged, and no motion is taken for one."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxfinger.data.signals.spikes import longest_spike, outlier_mask, without_spikes
from jaxfinger.synthetic import motions


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
