"""Routes: the path of a tendon over one joint, with its excursion and the exact derivative.

A route lies in the plane across the joint's axis, with the axis at the origin. Its coordinates are (along, above):
along the finger, and towards extension.
Flexion by q turns a point of the distal link by (x, z) → (x cos q + z sin q, −x sin q + z cos q).
All functions take NumPy arrays or traced JAX arrays alike (Python array API standard).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

Point = tuple[float, float]


@runtime_checkable
class Route(Protocol):
    """Path of a tendon over one joint, as a function of the joint's angle q (rad)."""

    def excursion(self, q: Float[np.ndarray, "*T"]) -> Float[np.ndarray, "*T"]:
        """l(q), m, zero at q = 0, positive when the tendon is pulled in."""
        ...

    def moment_arm(self, q: Float[np.ndarray, "*T"]) -> Float[np.ndarray, "*T"]:
        """dl/dq, m/rad."""
        ...


@dataclass(frozen=True)
class PolynomialRoute:
    """Route l = Σ_p coefficients[p − 1] q^p: the nominal model's form, for exact truth."""

    coefficients: tuple[float, ...]  # m/rad^p

    def excursion(self, q):
        """l(q), m."""
        value = 0.0 * q
        for c in reversed(self.coefficients):
            value = (value + c) * q
        return value

    def moment_arm(self, q):
        """dl/dq, m/rad."""
        value = 0.0 * q
        for p, c in reversed(list(enumerate(self.coefficients, start=1))):
            value = value * q + p * c
        return value


@dataclass(frozen=True)
class WrappedRoute:
    """Route along the shortest path from `proximal` to `distal` on one side of a circular surface. Lengths in m.

    The surface need not be concentric with the axis (eccentric contact). The tendon lifts off it where the straight
    line clears it. With `radius` zero there is no surface.
    """

    proximal: Point  # via point on the proximal link
    distal: Point  # via point on the distal link, at q = 0
    centre: Point = (0.0, 0.0)
    radius: float = 0.0
    dorsal: bool = False  # which side of the surface the tendon passes
    on_distal: bool = False  # which link carries the surface

    def excursion(self, q):
        """l(q) = L(0) − L(q), m."""
        return self._length_at_zero - self._path(q)[0]

    def moment_arm(self, q):
        """dl/dq = −u · dP/dq, m/rad. The last straight piece reaches the moving point P in the direction u."""
        return -self._path(q)[1]

    @cached_property
    def _length_at_zero(self) -> float:
        return float(self._path(np.zeros(()))[0])

    def _path(self, q):
        """Length L (m) and dL/dq, seen from the link that carries the surface: only the other link's point moves."""
        xp = q.__array_namespace__()
        moving, fixed, turn = (
            (self.proximal, self.distal, -1.0) if self.on_distal else (self.distal, self.proximal, 1.0)
        )
        s, c = xp.sin(turn * q), xp.cos(turn * q)
        x, z = moving[0] * c + moving[1] * s, moving[1] * c - moving[0] * s
        dx, dz = turn * z, -turn * x

        fx, fz = fixed[0] + 0.0 * q, fixed[1] + 0.0 * q
        straight = xp.hypot(x - fx, z - fz)
        slope_straight = ((x - fx) * dx + (z - fz) * dz) / straight
        if self.radius == 0.0:
            return straight, slope_straight

        # Seen from the circle's centre, the tangent point lies acos(r/D) from a point at distance D, towards the arc.
        px, pz, gx, gz = x - self.centre[0], z - self.centre[1], fx - self.centre[0], fz - self.centre[1]
        D_p, D_g = xp.hypot(px, pz), xp.hypot(gx, gz)
        to_p, to_g = xp.arccos(self.radius / D_p), xp.arccos(self.radius / D_g)
        angle_p, angle_g = xp.arctan2(pz, px), xp.arctan2(gz, gx)
        # Over the back the path turns clockwise from the proximal point to the distal one.
        sense = (1.0 if self.dorsal else -1.0) * (1.0 if self.on_distal else -1.0)
        arc = xp.mod(sense * (angle_p - angle_g), 2 * np.pi) - to_p - to_g
        t_p = xp.sqrt(D_p**2 - self.radius**2)
        wrapped = t_p + xp.sqrt(D_g**2 - self.radius**2) + self.radius * arc
        phi = angle_p - sense * to_p
        ux, uz = (px - self.radius * xp.cos(phi)) / t_p, (pz - self.radius * xp.sin(phi)) / t_p
        touches = arc > 0.0
        return xp.where(touches, wrapped, straight), xp.where(touches, ux * dx + uz * dz, slope_straight)
