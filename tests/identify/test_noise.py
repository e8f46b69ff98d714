"""Noise of a channel, from repeats and from residuals, with columns that have few samples."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxfinger.experiments import EXPERIMENTS, Batch, Stack
from jaxfinger.identify.noise import LONG_SIGNAL_WINDOW, MIN_SAMPLES_FOR_STD, Noise, estimate, whiten
from jaxfinger.model import Motion

SIZES, COUNTS, LENGTH = np.array([1.0, 5.0, 0.2]), (2000, 150, 20), 2400
COLOUR = np.array([1.1, -0.6, 0.15])  # of white noise after a low-pass at a fifth of the sampling rate


def coloured(rng, shape):
    """Stationary autoregressive noise of unit innovation along the last axis."""
    e = rng.standard_normal((*shape, LENGTH + 200))
    for t in range(3, e.shape[-1]):
        e[..., t] += e[..., t - 3 : t] @ COLOUR[::-1]
    return e[..., 200:]


def stack_of(residual, mask, motions, dt):
    still, whenever = jnp.zeros(mask.shape), jnp.zeros(mask.shape[1:])
    x = Motion(whenever, still, still, still, still, still, still, whenever, still)
    batch = Batch(x, {"joint_torque": jnp.asarray(residual)}, {"joint_torque": jnp.asarray(mask)})
    holds, measured = np.full(mask.shape[1:], -1), {"joint_torque": True}
    return Stack(EXPERIMENTS["VD.3"], batch, ("1", "2"), motions, holds, dt, measured)


def repeated(seed):
    """Two trials of one motion; each column is valid in one run of COUNTS samples."""
    residual = SIZES[:, None, None] * coloured(np.random.default_rng(seed), (3, 2))
    mask = np.zeros_like(residual)
    for column, count in zip(mask, COUNTS, strict=True):
        column[:, 100 : 100 + count] = 1.0
    return stack_of(residual, mask, ("a", "a"), 0.01), residual, mask


@pytest.fixture(scope="module")
def estimates():
    out = []
    for seed in range(12):
        stack, residual, mask = repeated(seed)
        noise = estimate(stack, "joint_torque", residual)
        white = np.asarray(whiten(jnp.asarray(residual), jnp.asarray(mask), jnp.asarray(noise.coefficients), False))
        out.append((noise, (white**2).sum(axis=(1, 2)) / (white != 0).sum(axis=(1, 2))))
    return out


def test_every_column_with_samples_of_its_own_comes_out_white(estimates):
    energy = np.array([white for _, white in estimates])
    assert COUNTS[2] < MIN_SAMPLES_FOR_STD < COUNTS[1]
    np.testing.assert_allclose(energy.mean(axis=0)[:2], 1.0, atol=0.08)
    assert np.abs(energy[:, :2] - 1.0).max() < 0.35  # of 300 rows, in a single estimate


@pytest.mark.parametrize("valid", [40, 12])
def test_noise_that_nothing_repeats_keeps_its_size_where_few_samples_count(valid):
    energy = []
    for seed in range(12):
        residual = np.random.default_rng(seed).standard_normal((1, 2, LENGTH))
        mask = np.tile(np.arange(LENGTH) % 80 < valid, (1, 2, 1)).astype(float)
        noise = estimate(stack_of(residual, mask, (None, None), 0.02), "joint_torque", residual, LONG_SIGNAL_WINDOW)
        energy.append(noise.std[0] ** 2)
    assert np.mean(energy) == pytest.approx(1.0, abs=0.02)


def test_noise_that_nothing_repeats_keeps_its_slow_part():
    """The long-run variance determines the interval of a constant; the moving average may remove a third at most."""
    energy, long_run, true = [], [], 1.0 / (1.0 - COLOUR.sum()) ** 2
    for seed in range(12):
        residual = coloured(np.random.default_rng(seed), (1, 2))
        mask = np.tile(np.arange(residual.shape[-1]) % 80 < 40, (1, 2, 1)).astype(float)
        noise = estimate(stack_of(residual, mask, (None, None), 0.02), "joint_torque", residual, LONG_SIGNAL_WINDOW)
        assert noise.source == "residuals"
        white = whiten(residual, mask, noise.coefficients, False)
        energy.append(np.sum(white**2) / mask.sum())
        long_run.append((noise.innovation[0] / (1.0 - noise.ar[0].sum())) ** 2 / true)
    assert np.mean(energy) == pytest.approx(1.0, abs=0.08)
    assert 0.67 < np.mean(long_run) < 1.1


def test_after_a_gap_the_whitening_is_that_of_what_is_left():
    """With a gap between two runs, the white energy of each is eᵀC⁻¹e, with C from the spectrum."""
    noise = Noise(np.ones(1), np.array([0.7]), COLOUR[None], "given")
    spectrum = np.abs(0.7 / np.fft.rfft(np.r_[1.0, -COLOUR], 4096)) ** 2
    covariance = scipy.linalg.toeplitz(np.fft.irfft(spectrum)[:5])
    e, mask = np.random.default_rng(3).standard_normal(10), np.ones(10)
    mask[[5, 6]] = 0.0
    white = np.asarray(whiten(*map(jnp.asarray, (e[None, None], mask[None, None], noise.coefficients)), False))[0, 0]
    for run in (slice(0, 5), slice(7, 10)):
        n = run.stop - run.start
        exact = e[run] @ np.linalg.solve(covariance[:n, :n], e[run])
        assert white[run] @ white[run] == pytest.approx(exact, rel=1e-9)
    assert not white[5:7].any()


def test_a_column_with_few_samples_borrows_the_colour_of_all(estimates):
    for noise, _ in estimates:
        assert noise.source == "repeats"
        np.testing.assert_array_equal(noise.ar[1], noise.ar[2])
        np.testing.assert_allclose(noise.ar[1], COLOUR, atol=0.12)


def test_a_column_that_hardly_counts_borrows_the_size_of_the_channel(estimates):
    assert all(0.2 * SIZES[0] < noise.innovation[2] < SIZES[1] for noise, _ in estimates)
