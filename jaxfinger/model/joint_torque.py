"""h(q, q̇) = τ_k(q) + τ_d(q̇) + τ_f(q, q̇), equation (3) of the paper: elastic torque, damping and joint friction.

Beyond the paper, friction may differ between the two directions of motion, and grow with the torque of the joint's
drive.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


class JointTorque(eqx.Module):
    """Coefficients of h, polynomials of each joint's own angle from the lowest power on; h stands on the left of (1).

    τ_k,i = Σ_p elastic[i, p] q_i^p,   τ_d,i = damping[i] q̇_i,   τ_f,i = s(q̇_i) Σ_p friction[i, p] q_i^p,

    and, where directions differ, friction_by_direction[i] + damping_by_direction[i] |q̇_i|, half the difference between
    friction forwards and back. `torque_friction` is μ: a drive of torque τ loses μ|τ| (`drive_torque`).
    """

    elastic: Float[Array, "m powers"]  # N m/rad^p
    damping: Float[Array, " m"]  # N m s/rad
    friction: Float[Array, "m powers_f"]  # N m/rad^p, magnitude of the Coulomb torque
    friction_by_direction: Float[Array, " m"]  # N m
    damping_by_direction: Float[Array, " m"]  # N m s/rad
    torque_friction: Float[Array, " m"]  # 1

    @classmethod
    def zeros(cls, m: int, elastic_degree: int = 2, friction_degree: int = 2) -> "JointTorque":
        """Joint torques of zero for `m` joints, with polynomials of these degrees."""
        none = np.zeros(m)
        elastic, friction = np.zeros((m, elastic_degree + 1)), np.zeros((m, friction_degree + 1))
        return cls(*jax.device_put((elastic, none, friction, none, none, none)))

    @classmethod
    def of(
        cls, elastic: Float[Array, "m powers"], damping: Float[Array, " m"], friction: Float[Array, "m powers_f"]
    ) -> "JointTorque":
        """Joint torques with the paper's three terms only."""
        return cls(elastic, damping, friction, *jnp.zeros((3, len(damping))))

    def elastic_torque(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_k(q), N m."""
        return _polynomial(self.elastic, q)

    def damping_torque(self, qd: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_d(q̇), N m."""
        return self.damping.reshape(-1, *(1,) * (qd.ndim - 1)) * qd

    def directional_torque(self, qd: Float[Array, "m *T"], slides: bool) -> Float[Array, "m *T"]:
        """Torque by which friction forwards differs from friction back, N m.

        Coulomb friction of F + Δ forwards and F − Δ back equals F in either direction plus a constant Δ. A joint that
        does not slide, `slides` false, is held by a fixture, which carries Δ.
        """
        coulomb, viscous = (
            a.reshape(-1, *(1,) * (qd.ndim - 1)) for a in (self.friction_by_direction, self.damping_by_direction)
        )
        return viscous * jnp.abs(qd) + (coulomb if slides else 0.0)

    def friction_magnitude(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """Magnitude of τ_f(q), N m."""
        return _polynomial(self.friction, q)


def drive_torque(
    needed: Float[Array, "m *T"], direction: Float[Array, "m *T"], mu: Float[Array, "m *#T"]
) -> Float[Array, "m *T"]:
    """Torque τ of a drive with friction μ|τ|, N m: the solution of τ − μ|τ| s = `needed`, with s the direction.

    μ is 1 minus the efficiency of a gear. It is below 1, since the gear would lock otherwise.
    """
    return needed / (1.0 - mu * direction * jnp.sign(needed))


def delivered_torque(
    tau: Float[Array, "m *T"], direction: Float[Array, "m *T"], mu: Float[Array, "m *#T"]
) -> Float[Array, "m *T"]:
    """Torque τ − μ|τ| s, N m, that a drive of torque `tau` delivers: the inverse of `drive_torque`."""
    return tau - mu * jnp.abs(tau) * direction


def _polynomial(coefficients: Float[Array, "m powers"], q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """Evaluate one polynomial for each joint by Horner's rule."""
    columns = coefficients.reshape(*coefficients.shape, *(1,) * (q.ndim - 1))
    value = jnp.zeros_like(q)
    for p in reversed(range(coefficients.shape[1])):
        value = value * q + columns[:, p]
    return value
