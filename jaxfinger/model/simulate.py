"""Forward dynamics, and simulation in time under measured tension.

Coulomb friction is a set-valued law. Regularised with a narrow tanh it is stiff, and explicit steps give plausible
trajectories with meaningless derivatives. Moreau's midpoint rule (Moreau 1988; Acary & Brogliato 2008, ch. 10) instead
solves for the friction impulses of a step, so that joints and tendons stick and slide without a smoothing width.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.model import rigid_body
from jaxfinger.model.dynamics import resisting, terms
from jaxfinger.model.model import Drive, Memory, Model
from jaxfinger.model.motion import Motion

# Sweeps of projected Gauss–Seidel over the frictions of a step, from the last step's frictions on. More of them change
# angles 0.1 s ahead by less than an encoder's resolution (tests/identify/test_shooting.py).
SWEEPS = 12


def forward_dynamics(
    model: Model, x: Motion, memory: tuple[Memory, ...], tau_ext: Float[Array, " m"] | float = 0.0
) -> Float[Array, " m"]:
    """q̈ of (1) at one sample, rad/s², with friction in the directions given by `x`."""
    e = terms(model, x, memory)
    bias = rigid_body.inverse_dynamics(e.finger, x.q, x.qd, jnp.zeros_like(x.q))
    drive = tau_ext - e.direction * e.torque_friction * jnp.abs(tau_ext)
    return jnp.linalg.solve(rigid_body.mass_matrix(e.finger, x.q), drive - bias - resisting(e))


class _State(NamedTuple):
    q: Float[Array, " m"]
    qd: Float[Array, " m"]
    drive: tuple[Drive, ...]  # of the memories, at the midpoint of the last step
    memory: tuple[Memory, ...]
    friction: Float[Array, " k"]  # of joints, N m, tendons, N, and shared friction, N m


def simulate(
    model: Model,
    time: Float[Array, " T"],
    tension: Float[Array, "n T"],
    q0: Float[Array, " m"],
    qd0: Float[Array, " m"],
    tau_ext: Float[Array, "m T"] | None = None,
    session_start: Float[Array, ""] | float = 0.0,
    substeps: int = 2,
) -> tuple[Float[Array, "m T"], Float[Array, "m T"]]:
    """Simulate q, rad, and q̇, rad/s, from `q0` and `qd0` at the first of the uniform instants `time`, s.

    `tension`, N, and `tau_ext`, N m (default zero), are interpolated linearly. `session_start`: session's time, s, at
    time 0. `substeps`: integration steps for each sample.
    """
    dt = (time[1] - time[0]) / substeps
    if tau_ext is None:
        tau_ext = jnp.zeros((model.finger.m, time.size))

    def motion(t, q, qd, f):
        unresolved = jnp.zeros_like(q), jnp.zeros_like(f)  # directions are solved for
        return Motion(t, q, qd, jnp.zeros_like(q), f, *unresolved, t + session_start, jnp.zeros_like(q))

    x0 = motion(time[0], q0, qd0, tension[:, 0])
    drive0 = tuple(effect.drive(model, x0) for effect in model.effects)
    memory0 = tuple(effect.initial_memory(d) for effect, d in zip(model.effects, drive0, strict=True))
    shared = [s for e, z in zip(model.effects, memory0, strict=True) for s in e.shared_friction(x0, z)]
    state0 = _State(q0, qd0, drive0, memory0, jnp.zeros(model.finger.m + model.finger.n + len(shared)))

    def sample(state, inputs):
        t, f0, f1, tau0, tau1 = inputs

        @jax.checkpoint  # reverse mode stores only the states between steps
        def substep(state, share):
            f, tau = f0 + share * (f1 - f0), tau0 + share * (tau1 - tau0)
            return _step(model, state, motion, t + share * dt * substeps, f, tau, dt), None

        state, _ = jax.lax.scan(substep, state, (jnp.arange(substeps, dtype=float) + 0.5) / substeps)
        return state, (state.q, state.qd)

    inputs = (time[:-1], tension.T[:-1], tension.T[1:], tau_ext.T[:-1], tau_ext.T[1:])
    _, (q, qd) = jax.lax.scan(sample, state0, inputs)
    return jnp.concatenate([q0[:, None], q.T], axis=1), jnp.concatenate([qd0[:, None], qd.T], axis=1)


def simulated_from(model: Model, x: Motion) -> Float[Array, "m L *T"]:
    """Simulate q, rad, from the state of every sample under `tension_ahead`, at L even instants to its horizon."""
    assert x.tension_ahead is not None
    assert x.horizon is not None
    share = jnp.linspace(0.0, 1.0, x.tension_ahead.shape[0])

    def one(q, qd, tension, time, start, horizon):
        return simulate(model, time + share * horizon, tension, q, qd, session_start=start, substeps=1)[0]

    q, qd = jnp.moveaxis(x.q, 0, -1), jnp.moveaxis(x.qd, 0, -1)
    tension = jnp.moveaxis(x.tension_ahead, (0, 1), (-1, -2))
    each = jnp.vectorize(one, signature="(m),(m),(n,l),(),(),()->(m,l)")
    return jnp.moveaxis(each(q, qd, tension, x.time, x.session_time - x.time, x.horizon), (-2, -1), (0, 1))


def simulated_ahead(model: Model, x: Motion) -> Float[Array, "m *T"]:
    """Simulated q, rad, at the horizon of every sample."""
    return simulated_from(model, x)[:, -1]


def _step(model: Model, state: _State, motion, t, f, tau, dt) -> _State:
    """One midpoint step: forces at the midpoint, friction that opposes the velocity at the end of the step."""
    qd = state.qd
    x = motion(t, state.q + 0.5 * dt * qd, qd, f)
    drive = tuple(effect.drive(model, x) for effect in model.effects)
    memory = tuple(
        effect.next_memory(*now) for effect, *now in zip(model.effects, state.memory, state.drive, drive, strict=True)
    )
    e = terms(model, x, memory)  # with the friction built up in memories only
    immediate = _immediate_share(model, x, memory)
    M = rigid_body.mass_matrix(e.finger, x.q)
    bias = rigid_body.inverse_dynamics(e.finger, x.q, qd, jnp.zeros_like(qd))
    M_inv = jnp.linalg.inv(M)
    # Shared friction sticks and slides like that of joints, and is solved for.
    free = qd + dt * M_inv @ (tau - bias - resisting(e._replace(shared=())))

    # D q̇ are the rates of joints, tendons and shared frictions.
    D = jnp.concatenate([jnp.eye(qd.size), e.C, *(s.ways[None] for s in e.shared)])
    joint = immediate[: qd.size] * (e.friction + e.torque_friction * jnp.abs(tau))
    limit = jnp.concatenate([joint, immediate[qd.size :] * e.loss, *(s.magnitude[None] for s in e.shared)])
    A = dt * D @ M_inv @ D.T
    friction = _gauss_seidel(A, D @ free, limit, state.friction)
    qd = free - dt * M_inv @ (D.T @ friction)
    return _State(x.q + 0.5 * dt * qd, qd, drive, memory, friction)


def _immediate_share(model: Model, x: Motion, memory) -> Float[Array, " k"]:
    """Share of each joint's and tendon's friction that follows the sign of its velocity immediately.

    Directions are affine in the sign, so that the share is their difference between sign 1 and sign 0.
    """

    def built(sign):
        joint, tendon = jnp.full_like(x.joint_direction, sign), jnp.full_like(x.tendon_direction, sign)
        for effect, m in zip(model.effects, memory, strict=True):
            joint, tendon = effect.directions(x, m, joint, tendon)
        return jnp.concatenate([joint, tendon])

    return built(1.0) - built(0.0)


def _gauss_seidel(A, rates, limit, start):
    """Friction λ, |λ_i| ≤ limit_i, that opposes the rates v = rates − A λ: λ_i = limit_i sign(v_i) where v_i ≠ 0."""
    diagonal = jnp.maximum(jnp.diagonal(A), 1e-30)

    def sweep(_, friction):
        for i in range(limit.size):
            v = rates[i] - A[i] @ friction
            friction = friction.at[i].set(jnp.clip(friction[i] + v / diagonal[i], -limit[i], limit[i]))
        return friction

    return jax.lax.fori_loop(0, SWEEPS, sweep, jnp.clip(start, -limit, limit))
