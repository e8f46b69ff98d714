"""Tendon excursion l = f(q), equation (2) of the paper, as polynomials of the joints' angles, and C = ∂f/∂q."""

from functools import reduce
from itertools import accumulate, combinations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


class MomentArm(eqx.Module):
    """l_k = Σ_t coefficients[k, t] Π_i q_i^exponents[t, i], zero at q = 0; positive when the tendon is pulled in.

    The nominal terms are the powers 1 … degree of each joint; cross terms of two joints are further rows of
    `exponents`. The unit of a coefficient is m/rad^(sum of its exponents).
    """

    coefficients: Float[Array, "n terms"]
    exponents: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @classmethod
    def zeros(cls, n: int, m: int, degree: int = 4, cross: bool = False) -> "MomentArm":
        """Moment arms of zero for `n` tendons and `m` joints.

        `cross` adds the terms q_a q_b, q_a² q_b and q_a q_b² of every pair of joints.
        """
        exponents = [tuple(p * (i == j) for j in range(m)) for i in range(m) for p in range(1, degree + 1)]
        if cross:
            exponents += [
                tuple(p * (j == a) + r * (j == b) for j in range(m))
                for a, b in combinations(range(m), 2)
                for p, r in ((1, 1), (2, 1), (1, 2))
            ]
        return cls(jax.device_put(np.zeros((n, len(exponents)))), tuple(exponents))

    def of(self, tendon: Int[Array, ""]) -> "MomentArm":
        """Moment arms of a single tendon, given its index."""
        return MomentArm(self.coefficients[tendon][None], self.exponents)

    # Compiled apart, so that Python traces them once for all effects and experiments.
    @jax.jit
    def excursion(self, q: Float[Array, "m *T"]) -> Float[Array, "n *T"]:
        """Excursion f(q), m."""
        powers = self._powers(q)
        return jnp.tensordot(self.coefficients, jnp.stack([_monomial(powers, e) for e in self.exponents]), 1)

    @jax.jit
    def coupling(self, q: Float[Array, "m *T"]) -> Float[Array, "n m *T"]:
        """Coupling matrix C(q) = ∂f/∂q, m/rad; entry [k, i] is the moment arm of tendon k about joint i."""
        powers, columns = self._powers(q), []
        for i in range(len(q)):
            mine = [t for t, e in enumerate(self.exponents) if e[i]]
            slopes = jnp.stack([_derivative(powers, self.exponents[t], i) for t in mine])
            columns.append(jnp.tensordot(self.coefficients[:, np.array(mine)], slopes, 1))
        return jnp.stack(columns, axis=1)

    def _powers(self, q: Float[Array, "m *T"]) -> list[Float[Array, "m *T"]]:
        """Powers 1, q, q², … up to the highest exponent."""
        return list(accumulate([q] * max(map(max, self.exponents)), jnp.multiply, initial=jnp.ones_like(q)))


def _monomial(powers: list[Float[Array, "m *T"]], exponents: tuple[int, ...]) -> Float[Array, "*T"]:
    factors = [powers[p][i] for i, p in enumerate(exponents) if p]
    return reduce(jnp.multiply, factors) if factors else powers[0][0]


def _derivative(powers: list[Float[Array, "m *T"]], exponents: tuple[int, ...], i: int) -> Float[Array, "*T"]:
    """Derivative of a monomial by an angle of which it is a function."""
    return exponents[i] * _monomial(powers, tuple(e - (j == i) for j, e in enumerate(exponents)))
