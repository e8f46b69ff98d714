"""What is compiled for a common shape says of the trials what the plain equations say."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfinger.experiments import predict, prepare, roomy, widened
from jaxfinger.identify.linearise import linearise, residuals_of, white_rows
from jaxfinger.identify.parameters import Free, describe
from jaxfinger.identify.stages import first_noise, sources_of

EXPERIMENT, CHANNELS = "ID.4", ("joint_torque", "tendon_excursion")


@given(st.integers(1, 10**6), st.sampled_from([2, 8, 256, 512]))
def test_a_stack_has_room_and_no_more_than_half_as_much_again(size, least):
    room = roomy(size, least)
    assert size <= room <= max(least, 1.5 * size)
    assert roomy(room, least) == room


@pytest.fixture(scope="module")
def stack(short):
    return prepare(short, [t.name for t in short if t.experiment == EXPERIMENT])[EXPERIMENT]


def test_the_common_shape_changes_no_derivative(stack, short_truth):
    model, parameters = short_truth.model, describe(short_truth.model)
    noise = {(EXPERIMENT, c): first_noise(stack, c) for c in CHANNELS}
    source = sources_of({EXPERIMENT: stack}, {EXPERIMENT: CHANNELS}, noise, parameters)[EXPERIMENT]
    free = Free.at(model, source.positions)
    B, T = stack.batch.x.time.shape
    assert widened(stack.batch).x.time.shape != (B, T)
    weights = np.random.default_rng(0).uniform(0.5, 1.0, (B, T * sum(len(f) for f in source.filters.values())))

    def white(theta):
        return white_rows(free.set(model, theta), stack.batch, source.filters)[1]

    theta = jnp.asarray(free.get(model))
    r, J = np.asarray(white(theta)), np.asarray(jax.jacobian(white)(theta))
    found = linearise(model, free, stack.batch, source.filters, weights)
    np.testing.assert_allclose(found.white, r, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.jacobian, J, rtol=1e-7, atol=1e-7 * np.abs(J).max())
    whole = np.concatenate([J, r[..., None]], axis=-1) * weights[..., None]
    expected = np.einsum("brp,brq->bpq", whole, whole)
    scale = np.sqrt(np.einsum("bpp->bp", expected)).max(axis=0)
    seen = scale > 1e-10 * scale.max()  # f(q) of joints that are held leaves nothing but rounding
    assert seen.sum() > 20
    gram = np.einsum("bkp,bkq->bpq", found.factor, found.factor)
    gram, expected = ((x / (scale + 1e-300) / (scale + 1e-300)[:, None])[:, seen][:, :, seen] for x in (gram, expected))
    np.testing.assert_allclose(gram, expected, atol=1e-9)


def test_the_common_shape_changes_no_residual(stack, short_truth):
    predicted = predict(short_truth.model, stack.batch.x, CHANNELS)
    for c, residual in residuals_of(short_truth.model, stack.batch, CHANNELS).items():
        np.testing.assert_allclose(residual, stack.batch.y[c] - predicted[c], atol=1e-12)
