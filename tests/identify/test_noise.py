"""Noise of a channel, from repeats and from residuals, with columns that have few samples."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxfinger.experiments import EXPERIMENTS, Batch, Stack
from jaxfinger.identify.noise import (
    LONG_SIGNAL_WINDOW,
    MIN_SAMPLES_FOR_STD,
    Noise,
    estimate,
    whiten,
    without_recurring_laws,
)
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


@pytest.mark.parametrize("size", [1e-3, 1.0, 30.0])
def test_a_column_with_few_repeated_samples_has_the_size_that_its_other_samples_show(size):
    """A column of another unit, say: of each repeat 20 samples count, and 400 of a trial that nothing repeats."""
    sizes = np.array([1.0, size])
    found = []
    for seed in range(6):
        residual = sizes[:, None, None] * coloured(np.random.default_rng(seed), (2, 3))
        mask = np.zeros_like(residual)
        mask[0, :, 100:1100] = mask[1, :2, 100:120] = mask[1, 2, 100:500] = 1.0
        stack = replace(stack_of(residual, mask, ("a", "a", None), 0.01), trials=("1", "2", "3"))
        found.append(estimate(stack, "joint_torque", residual).innovation)
    np.testing.assert_allclose(np.mean(found, axis=0), sizes, rtol=0.15)


def swept(law, seed, passes=4, samples=120):
    """A trial that sweeps a joint to and fro, with a law of its angle and direction in coloured noise."""
    forth = np.linspace(-1.0, 1.0, samples)
    q = np.concatenate([forth * (-1.0) ** k for k in range(passes)])
    direction = np.repeat((-1.0) ** np.arange(passes), samples)
    e = coloured(np.random.default_rng(seed), (1, 1))[..., : q.size]
    residual, mask = e + law(q, direction), np.ones((1, 1, q.size))
    mask[..., ::samples] = 0.0
    stack = stack_of(residual, mask, (None,), 0.02)
    x = eqx.tree_at(lambda x: (x.q, x.joint_direction), stack.batch.x, (q[None, None], direction[None, None]))
    return replace(stack, trials=("1",), batch=eqx.tree_at(lambda b: b.x, stack.batch, x)), residual, e


def recurring(stack, residual):
    return without_recurring_laws(estimate(stack, "joint_torque", residual), stack, "joint_torque", residual)


@pytest.mark.parametrize("cycles", [1, 6])
@pytest.mark.parametrize("odd", [False, True])
def test_a_law_that_recurs_within_a_trial_is_no_noise(cycles, odd):
    """However large it is: the same way of the joint shows it again, and noise of the same state differs."""
    size, long_run, true = [], [], 1.0 / (1.0 - COLOUR.sum())
    for seed in range(8):

        def law(q, direction):
            return 20.0 * np.sin(np.pi * cycles * q + 1.0) * (direction if odd else 1.0)

        stack, residual, e = swept(law, seed)
        noise = recurring(stack, residual)
        assert noise.source == "residuals"
        size.append(noise.std[0] / e.std())
        long_run.append(noise.innovation[0] / (1.0 - noise.ar[0].sum()) / true)
    assert np.mean(size) == pytest.approx(1.0, abs=0.1)
    assert np.mean(long_run) == pytest.approx(1.0, abs=0.3)


def test_without_a_law_recurrence_takes_nothing_from_the_noise():
    """The least of three estimates is a little less than each, by chance."""
    ratio = []
    for seed in range(12):
        stack, residual, _ = swept(lambda q, _: 0.0 * q, seed)
        ratio.append(recurring(stack, residual).std[0] / estimate(stack, "joint_torque", residual).std[0])
    assert 0.9 < np.mean(ratio) <= 1.0
