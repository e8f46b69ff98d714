"""h(q, q̇) = τ_k(q) + τ_d(q̇) + τ_f(q, q̇), equation (3): elastic torque, damping and friction of the joints."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class JointTorque(eqx.Module):
    """Polynomials of each joint's own angle, lowest power first; all torques resist as they stand on the left of (1).

    τ_k,i = Σ_p elastic[i, p] q_i^p,   τ_d,i = damping[i] q̇_i,   τ_f,i = s(q̇_i) Σ_p friction[i, p] q_i^p.
    """

    elastic: Float[Array, "m powers"]  # N m/rad^p
    damping: Float[Array, " m"]  # N m s/rad
    friction: Float[Array, "m powers_f"]  # N m/rad^p, magnitude of the Coulomb torque

    @classmethod
    def zeros(cls, m: int, elastic_degree: int = 2, friction_degree: int = 2) -> "JointTorque":
        """No elasticity, damping or friction."""
        return cls(jnp.zeros((m, elastic_degree + 1)), jnp.zeros(m), jnp.zeros((m, friction_degree + 1)))

    def elastic_torque(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_k(q), N m."""
        return _polynomial(self.elastic, q)

    def damping_torque(self, qd: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_d(q̇), N m."""
        return self.damping.reshape(-1, *(1,) * (qd.ndim - 1)) * qd

    def friction_magnitude(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """|τ_f(q)|, N m."""
        return _polynomial(self.friction, q)


def _polynomial(coefficients: Float[Array, "m powers"], q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """Horner's rule, one polynomial a joint."""
    columns = coefficients.reshape(*coefficients.shape, *(1,) * (q.ndim - 1))
    value = jnp.zeros_like(q)
    for p in reversed(range(coefficients.shape[1])):
        value = value * q + columns[:, p]
    return value
