"""Vectors turned about the origin."""

import jax.numpy as jnp
from jaxtyping import Array, Float

TINY = 1e-300  # of an angle squared. It keeps the derivative at no rotation finite, which JAX's own class lacks.


def turned(v: Float[Array, "xyz ..."], by: Float[Array, " xyz"]) -> Float[Array, "xyz ..."]:
    """Vectors turned by the rotation vector φ, rad (Rodrigues): v + sin θ/θ φ × v + (1 − cos θ)/θ² φ × (φ × v)."""
    angle = jnp.sqrt(by @ by + TINY)
    axis = by.reshape(3, *(1,) * (v.ndim - 1))
    first = jnp.cross(axis, v, axis=0)
    second = jnp.cross(axis, first, axis=0)
    return v + jnp.sinc(angle / jnp.pi) * first + 0.5 * jnp.sinc(angle / (2.0 * jnp.pi)) ** 2 * second
