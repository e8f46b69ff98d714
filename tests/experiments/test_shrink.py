"""Shrinking of a noisy regressor: little of its noise stays, and all of a motion."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d, uniform_filter1d

from jaxfinger.data.signals.filtering import smooth
from jaxfinger.experiments.driven import ACCELERATION_DOF
from jaxfinger.experiments.shrink import PASSED, shrink


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
