"""Tendon friction: bounded by the tension; a held tendon slips only where the loss is exceeded."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from jaxfinger.model import TendonFriction
from jaxfinger.model.tendon_friction import bounded, held

tensions = arrays(float, (2, 12), elements=st.floats(-0.5, 20.0))


@given(f=tensions, a0=st.floats(-1, 3), a1=st.floats(-0.5, 1.5))
@settings(max_examples=50, deadline=None)
def test_held_tendon_slips_only_past_its_loss(f, a0, a1):
    loss = bounded(TendonFriction(jnp.full(2, a0), jnp.full(2, a1)).loss(jnp.asarray(f)), jnp.asarray(f))
    f_j = np.asarray(held(jnp.asarray(f), loss))
    for k in range(2):  # the format's law, sample by sample, starting from slack
        before = 0.0
        for t in range(f.shape[1]):
            lost = min(max(a0 + a1 * f[k, t], 0.0), max(f[k, t], 0.0))
            before = min(max(before, f[k, t] - lost), f[k, t] + lost)
            np.testing.assert_allclose(f_j[k, t], before, atol=1e-12)


@given(f=tensions, a0=st.floats(-1, 3), a1=st.floats(-0.5, 1.5))
@settings(max_examples=50, deadline=None)
def test_a_tendon_never_loses_more_than_its_tension(f, a0, a1):
    loss = np.asarray(bounded(TendonFriction(jnp.full(2, a0), jnp.full(2, a1)).loss(jnp.asarray(f)), jnp.asarray(f)))
    assert np.all(loss >= 0)
    assert np.all(loss <= np.maximum(f, 0))


def test_release_stays_on_a_plateau():
    """With a₁ = 0.25, 6 N of 8 N reach the joint; on release f_j keeps 6 N until 1.25 f_t falls to it, at 4.8 N."""
    friction = TendonFriction(jnp.zeros(1), jnp.full(1, 0.25))
    f = jnp.array([[0.0, 4.0, 8.0, 6.0, 5.0, 4.0, 0.0]])
    expected = [[0.0, 3.0, 6.0, 6.0, 6.0, 5.0, 0.0]]
    np.testing.assert_allclose(held(jnp.asarray(f), bounded(friction.loss(jnp.asarray(f)), jnp.asarray(f))), expected)
