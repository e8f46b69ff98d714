"""Intervals from the scores of stretches: Laplace's where the model is right, and wide enough where it is wrong."""

import numpy as np
import pytest

from jaxfinger.identify.intervals import STRETCH_DURATION, evidence, laplace, stretches

RATE, MOVEMENTS = 50.0, 60  # Hz; movements last one stretch each


def records(rng: np.random.Generator, missed: float, count: int = 300):
    """Fits of y = a + b v to movements at random speeds v, each with an offset of its own that the model misses."""
    n = int(RATE * STRETCH_DURATION)
    time = np.arange(MOVEMENTS * n) / RATE
    for _ in range(count):
        v = np.repeat(rng.uniform(-1.0, 1.0, MOVEMENTS), n)
        J = np.stack([np.ones_like(v), v], axis=1)
        y = J @ [1.0, 2.0] + rng.normal(size=v.size) + missed * np.repeat(rng.normal(size=MOVEMENTS), n)
        estimate, *_ = np.linalg.lstsq(J, y, rcond=None)
        one = np.zeros(time.size, int)
        told = evidence(y - J @ estimate, J, one, stretches(one, time))
        stated = laplace([told], np.zeros((0, 2))).covariance
        yield estimate - [1.0, 2.0], np.sqrt(np.diag(np.linalg.inv(J.T @ J))), np.sqrt(np.diag(stated))


def coverage(missed: float, seed: int) -> tuple[float, float, float]:
    """Share of the intervals of the noise alone, and of the stated ones, that hold the truth; mean ratio of widths."""
    error, noise, stated = (np.array(x) for x in zip(*records(np.random.default_rng(seed), missed), strict=True))
    inside = [float(np.mean(np.abs(error) < 1.96 * std)) for std in (noise, stated)]
    return *inside, float(np.mean(stated / noise))


def test_intervals_cover_where_the_model_misses_something_of_every_movement():
    noise, stated, _ = coverage(missed=1.0, seed=0)
    assert noise < 0.6
    assert 0.92 < stated < 0.98


@pytest.mark.parametrize("missed", [0.12, 0.15])
def test_intervals_cover_what_no_single_parameter_shows(missed):
    """The slow part makes intervals of the noise alone a fourth or a third too narrow: too little to see in one."""
    noise, stated, _ = coverage(missed, seed=2)
    assert noise < 0.88
    assert 0.92 < stated < 0.98


def test_intervals_hardly_widen_where_the_model_is_right():
    noise, stated, ratio = coverage(missed=0.0, seed=1)
    assert 0.93 < noise <= stated < 0.98
    assert ratio < 1.06


def test_stretches_do_not_run_over_from_one_trial_to_the_next():
    trial = np.repeat([0, 1, 4], 40)
    time = np.tile(np.arange(40) * 0.05, 3)
    number = stretches(trial, time)
    assert number.max() == 5
    for k in range(6):
        assert len(set(trial[number == k])) == 1
        assert np.ptp(time[number == k]) < STRETCH_DURATION


def test_a_column_that_the_model_misses_does_not_widen_what_another_column_tells():
    """Two columns share nothing but their trial; the second has an offset of its own in every movement."""
    rng, n = np.random.default_rng(3), int(RATE * STRETCH_DURATION) * MOVEMENTS
    stretch = np.arange(n) // int(RATE * STRETCH_DURATION)
    r = np.concatenate([rng.normal(size=n), rng.normal(size=n) + rng.normal(size=MOVEMENTS)[stretch]])
    J = np.kron(np.eye(2), np.ones((n, 1)))
    told = evidence(r - J @ (J.T @ r) / n, J, np.repeat([0, 1], n), np.tile(stretch, 2))
    std = np.sqrt(np.diag(laplace([told], np.zeros((0, 2))).covariance) * n)
    assert 1.0 <= std[0] < 1.3
    assert 5.0 < std[1] < 10.0  # √(1 + 50) of 50 samples a movement
