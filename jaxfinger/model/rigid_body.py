"""Rigid-body terms of equation (1) by recursive Newton–Euler (Luh, Walker, Paul 1980; Featherstone 2008, ch. 5).

Every function takes joint arrays `(m, *T)` with the batch last and broadcasts over it. The recursion is a scan over the
joints of a few products of 3-vectors, each a loop along the long axis: quick to compile for any m, and to run. A long
batch goes through in blocks that stay in the processor's cache.
"""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.model.finger import Finger

Vector = Float[Array, "3 *T"]
Rotation = Float[Array, "3 3 *T"]


def _cross(a: Vector, b: Vector) -> Vector:
    def roll(v, k):
        return jnp.concatenate([v[k:], v[:k]])

    return roll(a, 1) * roll(b, 2) - roll(a, 2) * roll(b, 1)


def _mul(R: Rotation, v: Vector) -> Vector:
    return jnp.sum(R * v[None], axis=1)


def _mul_transposed(R: Rotation, v: Vector) -> Vector:
    return jnp.sum(R * v[:, None], axis=0)


def _rotation(axis: Vector, angle: Float[Array, "*T"]) -> Rotation:
    """Rodrigues: R = cos θ I + sin θ [a]ₓ + (1 − cos θ) a aᵀ."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y, z = axis
    o = jnp.zeros_like(x)
    skew = jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])
    identity = jnp.eye(3).reshape(3, 3, *(1,) * angle.ndim)
    return c * identity + s * skew + (1.0 - c) * axis[:, None] * axis[None]


BLOCK = 2048  # samples


class _Joint(NamedTuple):
    """One joint and its link, ready to broadcast against the batch."""

    axis: Vector
    com: Vector
    mass: Float[Array, "*T"]
    inertia: Rotation
    slides: Float[Array, "*T"]  # 1 for a prismatic joint
    R: Rotation  # the link's frame in its parent's
    p: Vector


def _joints(finger: Finger, q: Float[Array, "m *T"]) -> _Joint:
    """Stacked along the first axis, base to tip."""
    f = finger.expand(q.ndim - 1)
    slides = jnp.array(finger.prismatic, dtype=float).reshape(-1, *(1,) * (q.ndim - 1))
    R = jax.vmap(_rotation)(f.axis, q * (1.0 - slides))
    p = f.origin + f.axis * (q * slides)[:, None]
    return _Joint(f.axis, f.com, f.mass, f.inertia, slides, R, p)


def inverse_dynamics(
    finger: Finger, q: Float[Array, "m *T"], qd: Float[Array, "m *T"], qdd: Float[Array, "m *T"]
) -> Float[Array, "m *T"]:
    """M(q) q̈ + N(q, q̇) + G(q), in N m (N for a prismatic joint)."""
    samples = math.prod(q.shape[1:])
    if samples <= 4 * BLOCK:
        return _newton_euler(finger, q, qd, qdd, unroll=False)

    def blocks(a):
        flat = jnp.pad(a.reshape(finger.m, samples), [(0, 0), (0, -samples % BLOCK)])
        return jnp.moveaxis(flat.reshape(finger.m, -1, BLOCK), 1, 0)

    torques = jax.lax.map(lambda x: _newton_euler(finger, *x, unroll=True), (blocks(q), blocks(qd), blocks(qdd)))
    return jnp.moveaxis(torques, 0, 1).reshape(finger.m, -1)[:, :samples].reshape(q.shape)


def _newton_euler(finger: Finger, q, qd, qdd, unroll: bool) -> Float[Array, "m *T"]:
    joints = _joints(finger, q)
    zero = jnp.zeros((3, *q.shape[1:]))
    gravity = finger.gravity.reshape(3, *(1,) * (q.ndim - 1))

    def outward(state, joint_and_rates):
        """Angular velocity ω, angular and linear acceleration α, a of the link's frame, in that frame."""
        (omega, alpha, a), (j, qd, qdd) = state, joint_and_rates
        a = _mul_transposed(j.R, a + _cross(alpha, j.p) + _cross(omega, _cross(omega, j.p)))
        omega, alpha = _mul_transposed(j.R, omega), _mul_transposed(j.R, alpha)
        rate, change = j.axis * qd, j.axis * qdd + _cross(omega, j.axis * qd)
        a = a + j.slides * (change + _cross(omega, rate))
        alpha = alpha + (1.0 - j.slides) * change
        omega = omega + (1.0 - j.slides) * rate
        force = j.mass * (a + _cross(alpha, j.com) + _cross(omega, _cross(omega, j.com)))
        moment = _mul(j.inertia, alpha) + _cross(omega, _mul(j.inertia, omega)) + _cross(j.com + zero, force)
        return (omega, alpha, a), (force, moment)

    # Gravity enters as an upward acceleration of the base.
    _, (forces, moments) = jax.lax.scan(outward, (zero, zero, zero - gravity), (joints, qd, qdd), unroll=unroll)

    def inward(wrench, link):
        """Force and moment that the parent applies to the link, at its joint; then both in the parent's frame."""
        (force, moment), (j, f, n) = wrench, link
        force, moment = f + force, n + moment
        torque = jnp.sum(j.axis * (j.slides * force + (1.0 - j.slides) * moment), axis=0)
        force, moment = _mul(j.R, force), _mul(j.R, moment)
        return (force, moment + _cross(j.p, force)), torque

    _, torques = jax.lax.scan(inward, (zero, zero), (joints, forces, moments), reverse=True, unroll=unroll)
    return torques


def gravity_torque(finger: Finger, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """G(q), N m."""
    zero = jnp.zeros_like(q)
    return inverse_dynamics(finger, q, zero, zero)


def coriolis(finger: Finger, q: Float[Array, "m *T"], qd: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """N(q, q̇): Coriolis and centrifugal torque, N m."""
    return inverse_dynamics(_weightless(finger), q, qd, jnp.zeros_like(q))


def mass_matrix(finger: Finger, q: Float[Array, "m *T"]) -> Float[Array, "m m *T"]:
    """M(q), kg m²: its columns are the torques of a unit acceleration of one joint, without gravity."""
    zero = jnp.zeros_like(q)
    unit = jnp.stack([zero.at[i].set(1.0) for i in range(finger.m)])
    weightless = _weightless(finger)
    return jax.vmap(lambda qdd: inverse_dynamics(weightless, q, zero, qdd), out_axes=1)(unit)


def _weightless(finger: Finger) -> Finger:
    return eqx.tree_at(lambda f: f.gravity, finger, jnp.zeros(3))


def fingertip(finger: Finger, q: Float[Array, "m *T"]) -> tuple[Vector, Float[Array, "3 m *T"]]:
    """Position of the fingertip, m, and its Jacobian J, m/rad, in the base frame."""
    joints = _joints(finger, q)
    zero = jnp.zeros((3, *q.shape[1:]))

    def outward(pose, j):
        R, p = pose
        p = p + _mul(R, j.p)
        R = jax.vmap(_mul, in_axes=(None, 1), out_axes=1)(R, j.R)
        return (R, p), (_mul(R, j.axis + zero), p)

    start = (jnp.eye(3).reshape(3, 3, *(1,) * (q.ndim - 1)) + zero[None], zero)
    (R, p), (axes, places) = jax.lax.scan(outward, start, joints)
    tip = p + _mul(R, finger.fingertip.reshape(3, *(1,) * (q.ndim - 1)) + zero)
    slides = joints.slides[:, None]
    columns = slides * axes + (1.0 - slides) * jax.vmap(_cross)(axes, tip - places)
    return tip, jnp.moveaxis(columns, 0, 1)
