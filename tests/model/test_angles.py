"""Sine and cosine of the rotation matrices against NumPy's, and their derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from jaxfinger.model.angles import sin_cos


@pytest.mark.parametrize("size", [1e-300, 1e-8, 1.0, 100.0, 1e5])
def test_values_are_exact_to_the_last_bits(size):
    angle = size * np.random.default_rng(0).uniform(-1.0, 1.0, 10_000)
    s, c = sin_cos(jnp.asarray(angle))
    np.testing.assert_allclose(s, np.sin(angle), rtol=2**-51, atol=2**-52 * min(size, 1.0))
    np.testing.assert_allclose(c, np.cos(angle), rtol=2**-51, atol=2**-52 * min(size, 1.0))


def test_quarter_turns():
    angle = np.arange(-8, 9) * (np.pi / 2)
    s, c = sin_cos(jnp.asarray(angle))
    np.testing.assert_allclose(s, np.sin(angle), atol=1e-16)
    np.testing.assert_allclose(c, np.cos(angle), atol=1e-16)


def test_an_unknown_angle_has_no_sine():
    s, c = sin_cos(jnp.array([jnp.nan, jnp.inf]))
    assert np.isnan(s).all()
    assert np.isnan(c).all()


def test_derivatives():
    angles = (jnp.array([-3.0, -0.8, 0.0, 0.7, 2.0, 40.0]),)
    check_grads(lambda x: sin_cos(jnp.asarray(x)), angles, order=2)
    angle = jnp.array(0.3)
    np.testing.assert_allclose(jax.grad(lambda x: sin_cos(x)[0])(angle), np.cos(0.3), rtol=1e-15)
