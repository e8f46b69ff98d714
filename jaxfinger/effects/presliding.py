"""Presliding: bodies in contact deform before they slide, so friction depends on how far they moved since it turned."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects.base import shape


def dahl(z: Float[Array, "*T"], dx: Float[Array, "*T"], delta: Float[Array, ""]) -> Float[Array, "*T"]:
    """Presliding state z in [−1, 1] after the displacement dx: dz = (1 − z sgn dx)^δ dx (Dahl 1968).

    z is the friction over its Coulomb value, dx the displacement over the presliding length. With δ = 1 friction builds
    up exponentially. With δ = ½ it turns from −1 to 1 within 2√2 lengths, as that of parallel Maxwell-slip elements
    whose strengths are evenly spread. The solution is exact for a displacement in one direction.
    """
    way = jnp.sign(dx)
    lacking, length = 1.0 - z * way, jnp.abs(dx)
    root = jnp.sqrt(jnp.maximum(lacking, 1e-12))  # The derivative of a root is infinite at zero.
    left = jnp.where(delta > 0.75, lacking * jnp.exp(-length), jnp.square(jnp.maximum(root - 0.5 * length, 0.0)))
    return jnp.where(dx == 0.0, z, way * (1.0 - left))


def delta() -> Any:
    """Declare a shape that chooses the exponent of `dahl`."""
    return shape("1", (1.0, 0.5), moves="not", says=("built up exponentially", "fully built up within 2.8 lengths"))
