"""h(q, q̇) = τ_k(q) + τ_d(q̇) + τ_f(q, q̇), equation (3): elastic torque, damping and friction of the joints.

Real drives add friction that differs between the two ways, and friction that grows with the torque that they give.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class JointTorque(eqx.Module):
    """Polynomials of each joint's own angle, lowest power first; all torques resist as they stand on the left of (1).

    τ_k,i = Σ_p elastic[i, p] q_i^p,   τ_d,i = damping[i] q̇_i,   τ_f,i = s(q̇_i) Σ_p friction[i, p] q_i^p,

    and by direction: friction_by_direction[i] + damping_by_direction[i] |q̇_i|, half of what friction forwards and back
    differ by. `torque_friction` μ: a drive that gives τ loses μ|τ| of it (`drive_torque`).
    """

    elastic: Float[Array, "m powers"]  # N m/rad^p
    damping: Float[Array, " m"]  # N m s/rad
    friction: Float[Array, "m powers_f"]  # N m/rad^p, magnitude of the Coulomb torque
    friction_by_direction: Float[Array, " m"]  # N m
    damping_by_direction: Float[Array, " m"]  # N m s/rad
    torque_friction: Float[Array, " m"]  # 1

    @classmethod
    def zeros(cls, m: int, elastic_degree: int = 2, friction_degree: int = 2) -> "JointTorque":
        """No elasticity, damping or friction."""
        none = jnp.zeros(m)
        return cls(jnp.zeros((m, elastic_degree + 1)), none, jnp.zeros((m, friction_degree + 1)), none, none, none)

    @classmethod
    def of(
        cls, elastic: Float[Array, "m powers"], damping: Float[Array, " m"], friction: Float[Array, "m powers_f"]
    ) -> "JointTorque":
        """The paper's three terms, and nothing else."""
        return cls(elastic, damping, friction, *jnp.zeros((3, len(damping))))

    def elastic_torque(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_k(q), N m."""
        return _polynomial(self.elastic, q)

    def damping_torque(self, qd: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_d(q̇), N m."""
        return self.damping.reshape(-1, *(1,) * (qd.ndim - 1)) * qd

    def directional_torque(self, qd: Float[Array, "m *T"], slides: bool) -> Float[Array, "m *T"]:
        """What friction forwards and back differ by, N m, both parts of it where the joint `slides`.

        Coulomb friction of F + Δ forwards and F − Δ back is F to either side of Δ, at rest as well. A fixture carries
        it.
        """
        coulomb, viscous = (
            a.reshape(-1, *(1,) * (qd.ndim - 1)) for a in (self.friction_by_direction, self.damping_by_direction)
        )
        return viscous * jnp.abs(qd) + (coulomb if slides else 0.0)

    def friction_magnitude(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """|τ_f(q)|, N m."""
        return _polynomial(self.friction, q)


def drive_torque(
    needed: Float[Array, "m *T"], direction: Float[Array, "m *T"], mu: Float[Array, "m *#T"]
) -> Float[Array, "m *T"]:
    """τ, N m, of a drive that loses μ|τ| on the way: the solution of τ − μ|τ| s = needed, s the direction.

    μ is one less the efficiency of a gear; below one, so that it does not lock itself.
    """
    return needed / (1.0 - mu * direction * jnp.sign(needed))


def _polynomial(coefficients: Float[Array, "m powers"], q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """Horner's rule, one polynomial a joint."""
    columns = coefficients.reshape(*coefficients.shape, *(1,) * (q.ndim - 1))
    value = jnp.zeros_like(q)
    for p in reversed(range(coefficients.shape[1])):
        value = value * q + columns[:, p]
    return value
