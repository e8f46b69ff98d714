"""The sandwich by stretches equals Laplace's covariance where the model is right, and covers where it is wrong."""

import numpy as np

from jaxfinger.identify.cluster_robust import STRETCH_DURATION, growth, stretch_scores, stretches

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
        covariance = np.linalg.inv(J.T @ J)
        g = stretch_scores(y - J @ estimate, J, stretches(np.zeros(time.size, int), time))
        yield estimate, np.sqrt(np.diag(covariance)), growth(covariance, g, np.zeros((0, 2)))


def test_intervals_cover_where_the_model_misses_something_of_every_movement():
    found = list(records(np.random.default_rng(0), missed=1.0))
    error = np.array([np.abs(e - [1.0, 2.0]) for e, *_ in found])
    laplace = np.array([s for _, s, _ in found])
    wide = np.array([s * g for _, s, g in found])
    assert np.mean(error < 1.96 * laplace) < 0.6  # from the noise alone
    assert 0.92 < np.mean(error < 1.96 * wide) < 0.98


def test_intervals_stay_where_the_model_is_right():
    found = np.array([g for *_, g in records(np.random.default_rng(1), missed=0.0)])
    assert np.mean(found == 1.0) > 0.99


def test_stretches_do_not_run_over_from_one_trial_to_the_next():
    trial = np.repeat([0, 1, 4], 40)
    time = np.tile(np.arange(40) * 0.05, 3)
    number = stretches(trial, time)
    assert number.max() == 5
    for k in range(6):
        assert len(set(trial[number == k])) == 1
        assert np.ptp(time[number == k]) < STRETCH_DURATION
