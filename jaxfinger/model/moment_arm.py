"""Tendon excursion l = f(q), equation (2): polynomials of the joints' angles, and C = ∂f/∂q, never fitted apart."""

from itertools import combinations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class MomentArm(eqx.Module):
    """l_k = Σ_t coefficients[k, t] Π_i q_i^exponents[t, i], zero at q = 0; positive when the tendon is pulled in.

    The nominal form has the powers 1 … degree of one joint at a time; cross terms between joints are further rows of
    `exponents`. Units of a coefficient: m/rad^(sum of its exponents).
    """

    coefficients: Float[Array, "n terms"]
    exponents: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @classmethod
    def zeros(cls, n: int, m: int, degree: int = 4, cross: bool = False) -> "MomentArm":
        """All coefficients zero; with `cross`, the terms q_a q_b, q_a² q_b and q_a q_b² of every pair of joints."""
        exponents = [tuple(p * (i == j) for j in range(m)) for i in range(m) for p in range(1, degree + 1)]
        if cross:
            exponents += [
                tuple(p * (j == a) + r * (j == b) for j in range(m))
                for a, b in combinations(range(m), 2)
                for p, r in ((1, 1), (2, 1), (1, 2))
            ]
        return cls(jnp.zeros((n, len(exponents))), tuple(exponents))

    def excursion(self, q: Float[Array, "m *T"]) -> Float[Array, "n *T"]:
        """f(q), m."""
        return jnp.tensordot(self.coefficients, jnp.stack([_monomial(q, e) for e in self.exponents]), 1)

    def coupling(self, q: Float[Array, "m *T"]) -> Float[Array, "n m *T"]:
        """C(q) = ∂f/∂q, m/rad: the moment arm of tendon k about joint i at [k, i]."""
        gradient = jnp.stack([jnp.stack([_derivative(q, e, i) for i in range(len(q))]) for e in self.exponents])
        return jnp.tensordot(self.coefficients, gradient, 1)


def _monomial(q: Float[Array, "m *T"], exponents: tuple[int, ...]) -> Float[Array, "*T"]:
    value = jnp.ones_like(q[0])
    for q_i, p in zip(q, exponents, strict=True):
        for _ in range(p):
            value = value * q_i
    return value


def _derivative(q: Float[Array, "m *T"], exponents: tuple[int, ...], i: int) -> Float[Array, "*T"]:
    p = exponents[i]
    if p == 0:
        return jnp.zeros_like(q[0])
    return p * _monomial(q, tuple(e - (j == i) for j, e in enumerate(exponents)))
