"""VD.3 at the finger: tendons drive the free joints, both slide with dry friction that is not smoothed.

Moreau's time stepping (Moreau 1988; Acary and Brogliato 2008, ch. 10): over a step h the velocity changes by smooth
forces, taken at the middle position, and by friction impulses λ, which must oppose the sliding that remains:

    M (v⁺ − v) = h F(q + h v / 2, v) − Dᵀ λ,    λ_i ∈ h limit_i Sgn((D v⁺)_i),    D = [1; C]

with the joints' rates first and the tendons' after. Gauss–Seidel projection solves for λ until it stands still.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.errors import UserError
from jaxfinger.model import rigid_body
from jaxfinger.model.finger import Finger
from jaxfinger.synthetic.controller import Controller, feedforward
from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.specimen import Specimen

Array = np.ndarray
SUBSTEPS = 2  # a sample of the rig's clock
SWEEPS = 200  # at most
TOLERANCE = 1e-9  # of the impulses' change, relative to their limits


def drive(specimen: Specimen, finger: Finger, plan: TrialPlan) -> tuple[Float[Array, "m N"], Float[Array, "n N"]]:
    """Motion, rad, and tension, N, at the plan's instants, from rest at the planned first position.

    Raises:
        UserError: a joint leaves its limits.
    """
    inverse_dynamics = eqx.filter_jit(rigid_body.inverse_dynamics)
    needed = np.asarray(inverse_dynamics(finger, jnp.asarray(plan.q), jnp.asarray(plan.qd), jnp.asarray(plan.qdd)))
    controller = feedforward(specimen, plan, needed)
    q, _, tension = simulate(specimen, finger, plan, controller)
    limits = specimen.description.limits
    outside = np.flatnonzero(((q < limits[:, :1]) | (q > limits[:, 1:]) | ~np.isfinite(q)).any(axis=1))
    if outside.size:
        joint = specimen.description.joint_names[outside[0]]
        raise UserError(
            f"recipe: trial {plan.name} drives {joint} beyond its limits; lower trials.vd3.amplitude or change motion_seed"
        )
    return q, tension


def simulate(
    specimen: Specimen, finger: Finger, plan: TrialPlan, controller: Controller
) -> tuple[Float[Array, "m N"], Float[Array, "m N"], Float[Array, "n N"]]:
    """q, rad, q̇, rad/s, and tension, N, at the plan's instants. The tension is constant over a sample of the clock."""
    h = float(plan.time[1] - plan.time[0]) / SUBSTEPS
    m = plan.q.shape[0]

    def sample(state, target):
        q, v, tension, impulse = state
        tension = controller.tension(specimen, q, v, tension, target)

        def substep(_, state):
            return step(specimen, finger, *state, tension, h)

        q_next, v_next, impulse = jax.lax.fori_loop(0, SUBSTEPS, substep, (q, v, impulse))
        return (q_next, v_next, tension, impulse), (q, v, tension)

    @jax.jit
    def run(q0, targets):
        first = jax.tree.map(lambda x: x[0], targets)
        start = (q0, jnp.zeros(m), first.tension, jnp.zeros(m + finger.n))
        return jax.lax.scan(sample, start, targets)[1]

    targets = jax.tree.map(lambda x: jnp.asarray(x.T), controller.targets)
    return tuple(np.asarray(x).T for x in run(jnp.asarray(plan.q[:, 0]), targets))  # type: ignore[return-value]


def step(specimen: Specimen, finger: Finger, q, v, impulse, tension, h):
    """One step of h s: position, velocity and friction impulses (joints, then tendons) after it."""
    middle = q + 0.5 * h * v
    C = specimen.moment_arm(middle)
    resisting = rigid_body.inverse_dynamics(finger, middle, v, jnp.zeros_like(v))
    resisting = resisting + specimen.elastic(middle) + specimen.viscous(v)
    M_inv = jnp.linalg.inv(rigid_body.mass_matrix(finger, middle))
    free = v + h * M_inv @ (C.T @ tension - resisting)

    D = jnp.concatenate([jnp.eye(v.size), C])
    limit = h * jnp.concatenate([specimen.coulomb(middle), specimen.loss(tension)])
    impulse = friction_impulse(D @ M_inv @ D.T, D @ free, limit, impulse)
    v = free - M_inv @ (D.T @ impulse)
    return middle + 0.5 * h * v, v, impulse


def friction_impulse(A, rates, limit, start):
    """λ with |λ_i| ≤ limit_i that opposes w = rates − A λ wherever w_i is not zero, by projected Gauss–Seidel."""
    diagonal = jnp.diagonal(A)
    gain = jnp.where(diagonal > 0.0, 1.0 / jnp.where(diagonal > 0.0, diagonal, 1.0), 0.0)
    scale = jnp.maximum(limit, 1e-3 * jnp.max(limit)) + 1e-300

    def sweep(state):
        old, _, count = state
        new = old
        for i in range(limit.size):
            new = new.at[i].set(jnp.clip(new[i] + gain[i] * (rates[i] - A[i] @ new), -limit[i], limit[i]))
        return new, jnp.max(jnp.abs(new - old) / scale), count + 1

    def moving(state):
        return (state[1] > TOLERANCE) & (state[2] < SWEEPS)

    return jax.lax.while_loop(moving, sweep, (jnp.clip(start, -limit, limit), jnp.inf, 0))[0]
