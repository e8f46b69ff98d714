"""Vectors turned about the origin."""

import jax.numpy as jnp
from jaxtyping import Array, Float

# Added to an angle squared: far below that of any rotation, and above zero, where a root has no derivative. JAX's own
# class of rotations has none there.
TINY = 1e-300


def turned(v: Float[Array, "xyz ..."], by: Float[Array, " xyz"]) -> Float[Array, "xyz ..."]:
    """Vectors turned by the rotation vector φ, rad (Rodrigues): v + sin θ/θ φ × v + (1 − cos θ)/θ² φ × (φ × v)."""
    angle = jnp.sqrt(by @ by + TINY)
    axis = by.reshape(3, *(1,) * (v.ndim - 1))
    first = jnp.cross(axis, v, axis=0)
    second = jnp.cross(axis, first, axis=0)
    return v + jnp.sinc(angle / jnp.pi) * first + 0.5 * jnp.sinc(angle / (2.0 * jnp.pi)) ** 2 * second
