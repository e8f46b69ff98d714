"""Tendon friction f_f, the tension lost between the actuator and the joints."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class TendonFriction(eqx.Module):
    """Loss of a sliding tendon, affine in its tension: a₀ + a₁ f_t, clipped to [0, f_t] (`bounded`)."""

    constant: Float[Array, " n"]  # a₀, N
    proportional: Float[Array, " n"]  # a₁, 1

    @classmethod
    def zeros(cls, n: int) -> "TendonFriction":
        """Frictionless transmission of `n` tendons."""
        return cls(*jax.device_put((np.zeros(n), np.zeros(n))))

    def loss(self, tension: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
        """a₀ + a₁ f_t, N, before it is clipped (`bounded`)."""
        a0, a1 = (a.reshape(-1, *(1,) * (tension.ndim - 1)) for a in (self.constant, self.proportional))
        return a0 + a1 * tension


def bounded(loss: Float[Array, "n *T"], tension: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
    """Clip a loss to [0, f_t], N: a tendon cannot lose more than its tension, and a slack one loses nothing."""
    return jnp.clip(loss, 0.0, jnp.maximum(tension, 0.0))


def held(tension: Float[Array, "n *T"], loss: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
    """Tension f_j at a held joint, N: the tendon slips only where the loss is exceeded, and starts from slack.

    f_j = clip(f_j before, f_t − loss, f_t + loss), along time, the last axis.
    """

    def slip(f_j, bounds):
        f_j = jnp.clip(f_j, *bounds)
        return f_j, f_j

    low, high = (jnp.moveaxis(b, -1, 0) for b in (tension - loss, tension + loss))
    _, f_j = jax.lax.scan(slip, jnp.zeros_like(low[0]), (low, high))
    return jnp.moveaxis(f_j, 0, -1)
