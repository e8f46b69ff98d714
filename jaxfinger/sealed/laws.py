"""The true finger: nominal laws of a specimen, and its departures from them.

Every law takes a `Situation` and broadcasts over the leading axes of its arrays: a whole recording (time first), or one
instant of several trials that are simulated together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from .departures.base import Departure, Memory
from .plant import Plant
from .specimens import Specimen


@dataclass
class Situation:
    """State of the finger. Angles rad, tension at the actuator N, time s; directions −1, 0, +1."""

    t: Float[np.ndarray, "..."]
    session: Float[np.ndarray, "..."]  # seconds since the session began
    q: Float[np.ndarray, "... m"]
    qd: Float[np.ndarray, "... m"]
    qdd: Float[np.ndarray, "... m"]
    f: Float[np.ndarray, "... n"]
    sj: Float[np.ndarray, "... m"]  # direction in which each joint slides; 0 in a fixture
    st: Float[np.ndarray, "... n"] | None = None  # direction in which each tendon slides
    held: bool = False  # Every joint is at rest in a fixture.
    memory: dict = field(default_factory=dict)  # States (..., k) by id of the departure.


class Finger:
    """A specimen with its departures; the nominal plant where there are none."""

    def __init__(self, specimen: Specimen, departures: Sequence[Departure] = (), plant: Plant | None = None):
        self.specimen = specimen
        self.departures = tuple(departures)
        body = specimen.finger
        for d in self.departures:
            body = d.body(body)
        self.plant = plant if plant is not None and body is specimen.finger else Plant(body)
        self.m, self.n = body.m, body.n
        self._last: tuple | None = None

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Exponents 1 … 4, and the matrices that map all qᵖ to l and all qᵖ⁻¹ to C, each in one product."""
        arms = self.specimen.excursion
        n, m, degree = arms.shape
        powers = np.arange(1, degree + 1)
        slopes = np.zeros((m, degree, n, m))
        for j in range(m):
            slopes[j, :, :, j] = (arms[:, j] * powers).T
        return powers, arms.reshape(n, m * degree).T.copy(), slopes.reshape(m * degree, n * m)

    def geometry(
        self, q: Float[np.ndarray, "... m"]
    ) -> tuple[Float[np.ndarray, "... n"], Float[np.ndarray, "... n m"]]:
        """Nominal excursion l = f(q), m, and C = ∂f/∂q. The last result is cached, since many laws need it."""
        if self._last is not None and self._last[0] is q:
            return self._last[1]
        powers, to_length, to_arm = self._maps
        low = q[..., None] ** (powers - 1)
        flat = (*q.shape[:-1], len(to_length))
        length = (low * q[..., None]).reshape(flat) @ to_length
        result = length, (low.reshape(flat) @ to_arm).reshape(*q.shape[:-1], self.n, self.m)
        self._last = q, result
        return result

    def path(self, s: Situation) -> tuple[Float[np.ndarray, "... n"], Float[np.ndarray, "... n m"]]:
        """Excursion (positive pulled in), m, and its derivative by q, with departures."""
        length, arm = self.geometry(s.q)
        for d in self._ready(s):
            length, arm = d.path(self, s, length, arm)
        return length, arm

    def speed(self, s: Situation) -> Float[np.ndarray, "... n"]:
        """Nominal l̇ = C q̇, m/s."""
        return (self.geometry(s.q)[1] @ s.qd[..., None])[..., 0]

    def passive(self, s: Situation) -> Float[np.ndarray, "... m"]:
        """τ_k + τ_d, N m: elastic and viscous torque, with departures."""
        c = self.specimen.elastic
        torque = c[:, 0] + c[:, 1] * s.q + c[:, 2] * s.q**2 + self.specimen.damping * s.qd
        for d in self._ready(s):
            torque = d.passive(self, s, torque)
        return torque

    def coulomb(self, s: Situation) -> tuple[Float[np.ndarray, "... m"], Float[np.ndarray, "... m"]]:
        """Limit of the joints' dry friction, and the friction that a memory state determines, N m."""
        c = self.specimen.coulomb
        limit, decided = c[:, 0] + c[:, 1] * s.q + c[:, 2] * s.q**2, np.zeros_like(s.q)
        for d in self._ready(s):
            limit, decided = d.coulomb(self, s, limit, decided)
        return limit, decided

    def loss(self, s: Situation) -> tuple[Float[np.ndarray, "... n"], Float[np.ndarray, "... n"]]:
        """Limit of the tendons' dry friction, never above the tension, and the friction that a state determines, N."""
        a = self.specimen.friction
        limit, decided = np.clip(a[:, 0] + a[:, 1] * s.f, 0.0, np.maximum(s.f, 0.0)), np.zeros_like(s.f)
        for d in self._ready(s):
            limit, decided = d.loss(self, s, limit, decided)
        return np.clip(limit, 0.0, np.maximum(s.f, 0.0)), decided

    def delivered(self, s: Situation, reaching: Float[np.ndarray, "... n"]) -> Float[np.ndarray, "... n"]:
        """Tension that acts on the joints, N. `reaching`: what friction leaves of each tendon's own tension."""
        for d in self._ready(s):
            reaching = d.deliver(self, s, reaching)
        return reaching

    def friction(self, s: Situation) -> Float[np.ndarray, "... m"]:
        """Joint friction for known directions, N m."""
        limit, decided = self.coulomb(s)
        return limit * s.sj + decided

    def reaching_sliding(self, s: Situation) -> Float[np.ndarray, "... n"]:
        """f_j = f_t − s(l̇) loss of sliding tendons, N."""
        limit, decided = self.loss(s)
        assert s.st is not None
        return s.f - s.st * limit - decided

    def reaching_held(self, s: Situation) -> Float[np.ndarray, "N n"]:
        """f_j at joints held at rest, N. Starting from slack, a tendon slips only where the loss is exceeded."""
        limit, decided = self.loss(s)
        high, low = s.f + limit, s.f - limit
        reaching = np.empty_like(s.f)
        for k in range(self.n):
            if np.ptp(s.f[:, k]) == 0.0 and s.f[0, k] == 0.0:
                reaching[:, k] = 0.0
                continue
            value = 0.0
            column = np.empty(len(s.f))
            for i, (lower, upper) in enumerate(zip(low[:, k].tolist(), high[:, k].tolist(), strict=True)):
                value = min(max(value, lower), upper)
                column[i] = value
            reaching[:, k] = column
        return reaching - decided

    def remember(self, s: Situation) -> Situation:
        """Drive every memory along the recording."""
        memory = {}
        for d in self.departures:
            if not isinstance(d, Memory):
                continue
            u = d.inputs(self, s)
            z = np.empty((len(u), d.states))
            z[0] = d.start(u)
            steps = np.diff(s.t, prepend=s.t[0])
            current = z[0]
            for i in range(1, len(u)):
                current = d.step(current, u[i - 1], u[i], steps[i])
                z[i] = current
            memory[id(d)] = z
        return replace(s, memory=memory)

    def _ready(self, s: Situation):
        """Yield the departures that can act. One with a memory can once its state is known."""
        for d in self.departures:
            if not isinstance(d, Memory) or id(d) in s.memory:
                yield d
