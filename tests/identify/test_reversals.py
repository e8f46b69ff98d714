"""Torques beside reversals: their rows are white where the time of each reversal is uncertain."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.identify.linearise import Tangent, white_of, white_tangent
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.reversals import with_reversals
from jaxfinger.identify.sources import Source
from tests.identify.test_noise import stack_of

T, COLUMNS, TRIALS = 60, 2, 2
TORQUE = "joint_torque"


def changes(sizes=(8.0, 3.0, 0.5)):
    """Changes of the torque by three reversals in one column of one trial, earlier and later; and those of each."""
    t, at = np.arange(T), np.array([10, 30, 50])
    later = np.array(sizes)[:, None] * np.exp(-0.5 * (t - at[:, None]) ** 2)
    later[later < 1e-2] = 0.0
    earlier = -np.roll(later, -1, axis=1)
    out = np.zeros((2, COLUMNS, TRIALS, T))
    out[:, 0, 1] = earlier.sum(axis=0), later.sum(axis=0)
    return out, earlier, later


def source_with(change, mask=None):
    mask = np.ones((COLUMNS, TRIALS, T)) if mask is None else mask
    batch = stack_of(np.zeros(mask.shape), mask, ("a", "b"), 0.02).batch
    filters = {TORQUE: jnp.asarray(Noise.white(np.ones(COLUMNS), "none").coefficients)}
    return with_reversals(Source(batch, filters, np.arange(0)), change)


def test_rows_beside_reversals_are_white_when_their_times_are_as_uncertain_as_stated():
    change, earlier, later = changes()
    V = np.concatenate([earlier, later, later.sum(axis=0, keepdims=True)])
    C = source_with(change).reversals[TORQUE][0].toarray()[T:, T:]  # of the second trial
    whitening = np.eye(T) + C
    np.testing.assert_allclose(whitening @ (np.eye(T) + V.T @ V) @ whitening.T, np.eye(T), atol=1e-9)


def test_rows_away_from_reversals_and_of_other_trials_stay_as_they_are():
    change, _, _ = changes()
    away = np.flatnonzero(~change[:, 0].any(axis=0).ravel())
    first, second = (C.toarray() for C in source_with(change).reversals[TORQUE])
    assert first.any()
    assert not first[away].any()
    assert not first[:, away].any()
    assert not second.any()


def test_samples_beside_reversals_count_and_no_others():
    change, _, _ = changes()
    mask = np.zeros((COLUMNS, TRIALS, T))
    mask[:, :, 40:45] = 1.0
    counts = np.asarray(source_with(change, mask).batch.mask[TORQUE])
    np.testing.assert_array_equal(counts, np.where(change.any(axis=0), 1.0, mask))


def test_residuals_and_derivatives_are_whitened_alike():
    rng = np.random.default_rng(0)
    source = source_with(changes()[0])
    x, y = rng.standard_normal((2, COLUMNS, TRIALS, T))
    along = Tangent({TORQUE: x}, {TORQUE: np.stack([y, np.zeros_like(y)])})
    white = white_tangent(along, source.batch, source.filters, source.reversals)

    def alone(r):
        return white_of({TORQUE: r}, source.batch, source.filters, source.reversals)

    np.testing.assert_allclose(white.white, alone(x), atol=1e-12)
    np.testing.assert_allclose(white.jacobian[..., 0], alone(y), atol=1e-12)
    np.testing.assert_allclose(alone(x + 2.0 * y), alone(x) + 2.0 * alone(y), atol=1e-12)
    assert not np.allclose(alone(x), white_of({TORQUE: x}, source.batch, source.filters))


@pytest.mark.parametrize("size", [3.0, 30.0])
def test_what_does_not_look_like_another_time_keeps_its_energy(size):
    """An inertia that is missing is wider than the jump of friction; a change of time costs nothing."""
    change, _, later = changes((size,) * 3)
    C = source_with(change).reversals[TORQUE][0].toarray()[T:, T:]
    inertia = np.exp(-0.5 * ((np.arange(T) - 30) / 4.0) ** 2)
    assert np.linalg.norm(inertia + C @ inertia) > 0.5 * np.linalg.norm(inertia)
    assert np.linalg.norm(later[1] + C @ later[1]) < 1.0
