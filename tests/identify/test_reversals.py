"""Torques beside reversals: their rows are white where the time of each reversal is uncertain."""

import numpy as np
import pytest

from jaxfinger.identify.noise import whiten
from jaxfinger.identify.reversals import change_by_reversals

T = 60


def bumps(sizes=(8.0, 3.0, 0.5)):
    """Changes of white rows by three reversals in one column of one trial, earlier and later."""
    t, at = np.arange(T), np.array([10, 30, 50])
    each = np.array(sizes)[:, None] * np.exp(-0.5 * (t - at[:, None]) ** 2)
    each[each < 1e-2] = 0.0
    return np.stack([-np.roll(each.sum(axis=0), -1), each.sum(axis=0)])[:, None, None], each


def test_rows_beside_reversals_are_white_when_their_times_are_as_uncertain_as_stated():
    v, later = bumps()
    earlier = -np.roll(later, -1, axis=1)
    V = np.concatenate([earlier, later, later.sum(axis=0, keepdims=True)])
    C = change_by_reversals(v).toarray()
    whitening = np.eye(T) + C
    np.testing.assert_allclose(whitening @ (np.eye(T) + V.T @ V) @ whitening.T, np.eye(T), atol=1e-9)


def test_rows_away_from_reversals_and_of_other_trials_stay_as_they_are():
    v, _ = bumps()
    both = np.concatenate([v, np.zeros_like(v)], axis=2)
    C = change_by_reversals(both).toarray()
    away = np.flatnonzero(~both.any(axis=0).ravel())
    assert not C[away].any()
    assert not C[:, away].any()


def test_whitening_with_reversals_is_linear_and_keeps_the_shape():
    rng = np.random.default_rng(0)
    v, _ = bumps()
    v = np.tile(v, (1, 2, 3, 1))
    mask, filters = np.ones((2, 3, T)), np.tile(np.diag([1.0, 0.0])[None] + np.diag([0.0, 1.0]), (2, 1, 1))
    x, y = rng.standard_normal((2, 4, 2, 3, T))

    def white(r):
        return whiten(r, mask, filters, False, v)

    assert white(x).shape == x.shape
    np.testing.assert_allclose(white(x + 2.0 * y), white(x) + 2.0 * white(y), atol=1e-12)
    for c in range(2):
        np.testing.assert_allclose(
            white(x)[:, c], whiten(x[:, c : c + 1], mask[c : c + 1], filters[c : c + 1], False, v[:, c : c + 1])[:, 0]
        )


@pytest.mark.parametrize("size", [3.0, 30.0])
def test_what_does_not_look_like_another_time_keeps_its_energy(size):
    """An inertia that is missing is wider than the jump of friction; a change of time costs nothing."""
    v, later = bumps((size,) * 3)
    C = change_by_reversals(v)
    inertia = np.exp(-0.5 * ((np.arange(T) - 30) / 4.0) ** 2)
    kept = inertia + C @ inertia
    late = later[1] + C @ later[1]
    assert np.linalg.norm(kept) > 0.5 * np.linalg.norm(inertia)
    assert np.linalg.norm(late) < 1.0
