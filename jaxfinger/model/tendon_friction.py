"""f_f: the tension lost between the actuator and the joint."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class TendonFriction(eqx.Module):
    """Affine in tension: the loss of a sliding tendon is a₀ + a₁ f_t, at least zero and never more than f_t."""

    constant: Float[Array, " n"]  # a₀, N
    proportional: Float[Array, " n"]  # a₁, 1

    @classmethod
    def zeros(cls, n: int) -> "TendonFriction":
        """A frictionless transmission."""
        return cls(jnp.zeros(n), jnp.zeros(n))

    def loss(self, tension: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
        """a₀ + a₁ f_t, N, before it is kept within [0, f_t] (`bounded`)."""
        a0, a1 = (a.reshape(-1, *(1,) * (tension.ndim - 1)) for a in (self.constant, self.proportional))
        return a0 + a1 * tension


def bounded(loss: Float[Array, "n *T"], tension: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
    """A tendon cannot lose more than its tension; a slack one loses nothing."""
    return jnp.clip(loss, 0.0, jnp.maximum(tension, 0.0))


def held(tension: Float[Array, "n *T"], loss: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
    """Tension at a joint that is held: it follows only when the loss is exceeded, starting from slack.

    f_j = clip(f_j before, f_t − loss, f_t + loss), along the last axis, which is time.
    """

    def slip(f_j, bounds):
        f_j = jnp.clip(f_j, *bounds)
        return f_j, f_j

    low, high = (jnp.moveaxis(b, -1, 0) for b in (tension - loss, tension + loss))
    _, f_j = jax.lax.scan(slip, jnp.zeros_like(low[0]), (low, high))
    return jnp.moveaxis(f_j, 0, -1)
