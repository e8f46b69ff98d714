"""Specimens: the terms of equation (1) of a simulated finger, of the nominal model's form or not.

All functions take joint arrays `(m, *T)`, NumPy or traced JAX, with the batch last. Units are SI.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from jaxfinger.data import FingerDescription
from jaxfinger.synthetic.routes import Route

Array = Any  # NumPy or JAX
Routes = tuple[Route | None, ...]  # one per joint, None where the tendon does not cross it


@runtime_checkable
class Spring(Protocol):
    """Elastic element whose energy depends on the joints' angles."""

    def torque(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_k, N m, with the sign of the left side of (1): the gradient of the energy."""
        ...

    def energy(self, q: Float[Array, "m *T"]) -> Float[Array, "*T"]:
        """Stored energy, J."""
        ...


@dataclass(frozen=True)
class Band:
    """A rubber band or a passive tendon over one or more joints. Its tension is k (stretch − l(q)) where it is taut."""

    routes: Routes
    stiffness: float  # N/m
    stretch: float  # m at q = 0; negative: it is slack there

    def tension(self, q):
        """k max(stretch − l(q), 0), N."""
        return self.stiffness * q.__array_namespace__().clip(self.stretch - total_excursion(self.routes, q), 0.0, None)

    def torque(self, q):
        """−Cᵀ f, N m."""
        return -moment_arms(self.routes, q) * self.tension(q)

    def energy(self, q):
        """f²/2k, J."""
        return 0.5 * self.tension(q) ** 2 / self.stiffness


@dataclass(frozen=True)
class PolynomialSpring:
    """Springs with τ_k,i = Σ_p coefficients[i][p] q_i^p: the nominal model's form."""

    coefficients: tuple[tuple[float, ...], ...]  # N m/rad^p, one row a joint

    def torque(self, q):
        """τ_k, N m."""
        return _polynomials(self.coefficients, q)

    def energy(self, q):
        """∫ τ_k dq, J."""
        integral = tuple((0.0, *(c / (p + 1) for p, c in enumerate(row))) for row in self.coefficients)
        return _polynomials(integral, q).sum(0)


@runtime_checkable
class Friction(Protocol):
    """Coulomb friction of the joints."""

    def magnitude(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """|τ_f|, N m: the torque that sliding takes, and the most that sticking can hold."""
        ...


@dataclass(frozen=True)
class GrowingFriction:
    """Friction constant + growth (1 − cos q), as if the joint's faces were pressed together while it flexes."""

    constant: tuple[float, ...]  # N m
    growth: tuple[float, ...]  # N m

    def magnitude(self, q):
        """|τ_f|, N m."""
        xp = q.__array_namespace__()
        return xp.stack(
            [c + g * (1.0 - xp.cos(q[i, ...])) for i, (c, g) in enumerate(zip(self.constant, self.growth, strict=True))]
        )


@dataclass(frozen=True)
class PolynomialFriction:
    """Friction |τ_f,i| = Σ_p coefficients[i][p] q_i^p: the nominal model's form."""

    coefficients: tuple[tuple[float, ...], ...]  # N m/rad^p, one row per joint

    def magnitude(self, q):
        """|τ_f|, N m."""
        return _polynomials(self.coefficients, q)


@dataclass(frozen=True)
class Specimen:
    """A simulated finger. `description` is exact; the session's file may have errors of CAD."""

    name: str
    description: FingerDescription
    routes: tuple[Routes, ...]  # n tendons, m joints each
    springs: tuple[Spring, ...]
    friction: Friction
    damping: tuple[float, ...]  # N m s/rad
    loss_constant: tuple[float, ...]  # a₀, N
    loss_proportional: tuple[float, ...]  # a₁

    def excursion(self, q: Float[Array, "m *T"]) -> Float[Array, "n *T"]:
        """l = f(q), m."""
        return q.__array_namespace__().stack([total_excursion(routes, q) for routes in self.routes])

    def moment_arm(self, q: Float[Array, "m *T"]) -> Float[Array, "n m *T"]:
        """C = ∂f/∂q, m/rad, exact."""
        return q.__array_namespace__().stack([moment_arms(routes, q) for routes in self.routes])

    def elastic(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_k(q), N m: the sum over all springs."""
        return sum((spring.torque(q) for spring in self.springs), 0.0 * q)

    def elastic_energy(self, q: Float[Array, "m *T"]) -> Float[Array, "*T"]:
        """Energy of the springs, J."""
        return sum((spring.energy(q) for spring in self.springs), 0.0 * q[0, ...])

    def coulomb(self, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """|τ_f|(q), N m."""
        return self.friction.magnitude(q)

    def viscous(self, qd: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
        """τ_d(q̇), N m."""
        return _column(self.damping, qd) * qd

    def loss(self, tension: Float[Array, "n *T"]) -> Float[Array, "n *T"]:
        """Tension lost along a sliding tendon, N: a₀ + a₁ f_t, at least 0 and at most f_t."""
        xp = tension.__array_namespace__()
        raw = _column(self.loss_constant, tension) + _column(self.loss_proportional, tension) * tension
        return xp.minimum(xp.maximum(raw, 0.0), xp.maximum(tension, 0.0))


def total_excursion(routes: Sequence[Route | None], q: Float[Array, "m *T"]) -> Float[Array, "*T"]:
    """Excursion of one tendon, m: the sum over the joints that it crosses."""
    return sum((route.excursion(q[i, ...]) for i, route in enumerate(routes) if route), 0.0 * q[0, ...])


def moment_arms(routes: Sequence[Route | None], q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """Moment arms of one tendon at all joints, m/rad."""
    return q.__array_namespace__().stack(
        [route.moment_arm(q[i, ...]) if route else 0.0 * q[i, ...] for i, route in enumerate(routes)]
    )


def _polynomials(rows: Sequence[Sequence[float]], q):
    """Σ_p rows[i][p] q_i^p."""

    def polynomial(row, x):
        value = 0.0 * x
        for c in reversed(row):
            value = value * x + c
        return value

    return q.__array_namespace__().stack([polynomial(row, q[i, ...]) for i, row in enumerate(rows)])


def _column(values: Sequence[float], like):
    """Return one value per row, shaped to broadcast along the batch."""
    return np.asarray(values, dtype=float).reshape((-1,) + (1,) * (like.ndim - 1))
