"""Forward simulation of VD.3: tendons drive the free joints. The dry friction of both is not smoothed.

Moreau's time stepping (Moreau 1988; Acary and Brogliato 2008, ch. 10): over a step h the velocity changes by smooth
forces F, taken at the middle position, and by friction impulses λ, which must oppose the sliding that remains:

    M (v⁺ − v) = h F(q + h v / 2, v) − Dᵀ λ,    λ_i ∈ h limit_i Sgn((D v⁺)_i),    D = [1; C]

with the joints' rates first and the tendons' after. Projected Gauss–Seidel iterations solve for λ.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.compilation import quick_options
from jaxfinger.model import rigid_body
from jaxfinger.model.finger import Finger
from jaxfinger.synthetic.controller import Targets, TensionController
from jaxfinger.synthetic.specimen import Specimen

Array = Any  # NumPy or JAX
# Steps per sample of the recording: 0.5 ms at 1 kHz, at which free motion keeps its energy to 0.5 % over 50 ms
# (`test_frictionless_undriven_finger_keeps_its_energy`).
SUBSTEPS = 2
MAX_SWEEPS = 200  # Gauss–Seidel sweeps of a step: bounds its time. The sweeps start from the last step's impulses.
TOLERANCE = 1e-9  # largest change of an impulse in the last sweep, relative to its limit


class Simulator:
    """Forward simulation of a specimen, compiled once for all trials of one length."""

    def __init__(self, specimen: Specimen, finger: Finger):
        self.specimen, self.finger = specimen, finger
        self._run = jax.jit(self._simulate, compiler_options=quick_options())

    def __call__(
        self, q0: Float[Array, " m"], dt: float, controller: TensionController
    ) -> tuple[Float[Array, "m N"], Float[Array, "m N"], Float[Array, "n N"]]:
        """Return q (rad), q̇ (rad/s) and tension (N) every `dt` s, from rest at `q0` (rad).

        The tension changes at each sample, and is constant between two. The tension of a sample is the mean of those
        before and after it, as a linear interpolation of the samples needs it.
        """
        targets = Targets(*(jnp.asarray(x.T) for x in controller.targets))
        outputs = self._run(jnp.asarray(q0), dt, controller._replace(targets=targets))
        q, v, tension = (np.asarray(x).T for x in outputs)
        return q, v, tension

    def _simulate(self, q0, dt, controller: TensionController):
        def sample(carry, target):
            state, before = carry
            tension = controller.tension(self.specimen, state.q, state.v, before, target, dt)

            def substep(_, state):
                return step(self.specimen, self.finger, state, tension, dt / SUBSTEPS)

            after = jax.lax.fori_loop(0, SUBSTEPS, substep, state)
            return (after, tension), (state.q, state.v, 0.5 * (before + tension))

        start = at_rest(self.finger, q0), controller.targets.tension[0]
        return jax.lax.scan(sample, start, controller.targets)[1]


class PlantState(NamedTuple):
    """State of the simulation between two steps."""

    q: Float[Array, " m"]  # rad
    v: Float[Array, " m"]  # rad/s
    v_before: Float[Array, " m"]  # rad/s, a step before
    impulse: Float[Array, " m+n"]  # friction impulses of the last step: joints (N m s), then tendons (N s)


def at_rest(finger: Finger, q: Float[Array, " m"]) -> PlantState:
    """Return the state of a finger at rest at q, without friction impulses."""
    return PlantState(q, jnp.zeros_like(q), jnp.zeros_like(q), jnp.zeros(finger.m + finger.n))


def step(
    specimen: Specimen, finger: Finger, state: PlantState, tension: Float[Array, " n"], h: float | Float[Array, ""]
) -> PlantState:
    """Advance by one step of h s. Forces that depend on velocity are taken at its value extrapolated to mid-step."""
    q, v, v_before, impulse = state
    middle, v_middle = q + 0.5 * h * v, 1.5 * v - 0.5 * v_before
    C = specimen.moment_arm(middle)
    M, bias = _mass_and_bias(finger, middle, v_middle)
    resisting = bias + specimen.elastic(middle) + specimen.viscous(v_middle)
    M_inv = jnp.linalg.inv(M)
    free = v + h * M_inv @ (C.T @ tension - resisting)

    D = jnp.concatenate([jnp.eye(v.size), C])
    limit = h * jnp.concatenate([specimen.coulomb(middle), specimen.loss(tension)])
    impulse = friction_impulse(D @ M_inv @ D.T, D @ free, limit, impulse)
    v_after = free - M_inv @ (D.T @ impulse)
    return PlantState(middle + 0.5 * h * v_after, v_after, v, impulse)


def _mass_and_bias(finger: Finger, q, v):
    """Return M (m, m) and N + G (m,) from one batched recursion: at rest, at unit accelerations, and at velocity v."""
    m = q.size
    columns = jnp.repeat(q[:, None], m + 2, axis=1)
    qd = jnp.zeros((m, m + 2)).at[:, -1].set(v)
    qdd = jnp.zeros((m, m + 2)).at[:, 1:-1].set(jnp.eye(m))
    tau = rigid_body.inverse_dynamics(finger, columns, qd, qdd)
    return tau[:, 1:-1] - tau[:, :1], tau[:, -1]


def friction_impulse(A, rates, limit, start):
    """Return λ with |λ_i| ≤ limit_i that opposes w = rates − A λ wherever w_i is not zero.

    Projected Gauss–Seidel from `start`, until no impulse changes by more than TOLERANCE of its limit.
    """
    diagonal = jnp.diagonal(A)
    gain = jnp.where(diagonal > 0.0, 1.0 / jnp.where(diagonal > 0.0, diagonal, 1.0), 0.0)
    scale = jnp.maximum(limit, 1e-3 * jnp.max(limit)) + 1e-300

    def project(i, x):
        return x.at[i].set(jnp.clip(x[i] + gain[i] * (rates[i] - A[i] @ x), -limit[i], limit[i]))

    def sweep(state):
        old, _, count = state
        new = jax.lax.fori_loop(0, limit.size, project, old)
        return new, jnp.max(jnp.abs(new - old) / scale), count + 1

    def moving(state):
        return (state[1] > TOLERANCE) & (state[2] < MAX_SWEEPS)

    return jax.lax.while_loop(moving, sweep, (jnp.clip(start, -limit, limit), jnp.inf, 0))[0]
