"""Rigid-body terms of equation (1) by recursive Newton–Euler (Luh, Walker, Paul 1980; Featherstone 2008, ch. 5).

Every function takes joint arrays `(m, *T)` with the batch last and broadcasts over it: products of 3-vectors are
written out, so that XLA fuses the whole recursion into loops along the long axis.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.model.finger import Finger

Vector = Float[Array, "3 *T"]
Rotation = Float[Array, "3 3 *T"]


def _cross(a: Vector, b: Vector) -> Vector:
    return jnp.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _dot(a: Vector, b: Vector) -> Float[Array, "*T"]:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _mul(R: Rotation, v: Vector) -> Vector:
    return jnp.stack([_dot(R[i], v) for i in range(3)])


def _mul_transposed(R: Rotation, v: Vector) -> Vector:
    return jnp.stack([_dot(R[:, i], v) for i in range(3)])


def _rotation(axis: Vector, angle: Float[Array, "*T"]) -> Rotation:
    """Rodrigues: R = cos θ I + sin θ [a]ₓ + (1 − cos θ) a aᵀ."""
    s, c = jnp.sin(angle), jnp.cos(angle)
    x, y, z = axis
    d = 1.0 - c
    return jnp.stack(
        [
            jnp.stack([c + d * x * x, d * x * y - s * z, d * x * z + s * y]),
            jnp.stack([d * x * y + s * z, c + d * y * y, d * y * z - s * x]),
            jnp.stack([d * x * z - s * y, d * y * z + s * x, c + d * z * z]),
        ]
    )


def _placements(f: Finger, q: Float[Array, "m *T"]) -> list[tuple[Rotation | None, Vector]]:
    """Rotation and position of each link's frame in its parent's; None where a prismatic joint does not turn."""
    return [
        (None, f.origin[i] + f.axis[i] * q[i])
        if f.prismatic[i]
        else (_rotation(f.axis[i], q[i]), f.origin[i] + 0.0 * q[i])
        for i in range(f.m)
    ]


def _to_link(R: Rotation | None, v: Vector) -> Vector:
    return v if R is None else _mul_transposed(R, v)


def _to_parent(R: Rotation | None, v: Vector) -> Vector:
    return v if R is None else _mul(R, v)


def inverse_dynamics(
    finger: Finger, q: Float[Array, "m *T"], qd: Float[Array, "m *T"], qdd: Float[Array, "m *T"]
) -> Float[Array, "m *T"]:
    """M(q) q̈ + N(q, q̇) + G(q), in N m (N for a prismatic joint)."""
    f = finger.expand(q.ndim - 1)
    placements = _placements(f, q)
    zero = jnp.zeros((3, *q.shape[1:]))
    # Outward: angular velocity ω, angular acceleration α and linear acceleration a of each link's frame, in that frame.
    # Gravity enters as an upward acceleration of the base.
    omega, alpha, acc = zero, zero, zero - f.gravity
    forces, moments = [], []
    for i, (R, p) in enumerate(placements):
        acc = _to_link(R, acc + _cross(alpha, p) + _cross(omega, _cross(omega, p)))
        omega, alpha = _to_link(R, omega), _to_link(R, alpha)
        rate = f.axis[i] * qd[i]
        if f.prismatic[i]:
            acc = acc + 2.0 * _cross(omega, rate) + f.axis[i] * qdd[i]
        else:
            alpha = alpha + _cross(omega, rate) + f.axis[i] * qdd[i]
            omega = omega + rate
        c = f.com[i]
        forces.append(f.mass[i] * (acc + _cross(alpha, c) + _cross(omega, _cross(omega, c))))
        moments.append(_mul(f.inertia[i], alpha) + _cross(omega, _mul(f.inertia[i], omega)))
    # Inward: force and moment that the parent applies to each link, at the link's frame.
    torques = [zero[0]] * f.m
    force, moment = zero, zero
    for i in reversed(range(f.m)):
        if i + 1 < f.m:
            R, p = placements[i + 1]
            force = _to_parent(R, force)
            moment = _to_parent(R, moment) + _cross(p, force)
        force = forces[i] + force
        moment = moments[i] + _cross(f.com[i] + zero, forces[i]) + moment
        torques[i] = _dot(f.axis[i], force if f.prismatic[i] else moment)
    return jnp.stack(torques)


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
    weightless = _weightless(finger)
    return jnp.stack([inverse_dynamics(weightless, q, zero, zero.at[i].set(1.0)) for i in range(finger.m)], axis=1)


def _weightless(finger: Finger) -> Finger:
    return eqx.tree_at(lambda f: f.gravity, finger, jnp.zeros(3))


def fingertip(finger: Finger, q: Float[Array, "m *T"]) -> tuple[Vector, Float[Array, "3 m *T"]]:
    """Position of the fingertip, m, and its Jacobian J, m/rad, in the base frame."""
    f = finger.expand(q.ndim - 1)
    R: Rotation | None = None
    position = jnp.zeros((3, *q.shape[1:]))
    axes, joints = [], []
    for i, (R_i, p) in enumerate(_placements(f, q)):
        position = position + _to_parent(R, p)
        if R_i is not None:
            R = R_i if R is None else jnp.stack([_mul(R, R_i[:, k]) for k in range(3)], axis=1)
        axes.append(_to_parent(R, f.axis[i]) + jnp.zeros_like(position))
        joints.append(position)
    tip = position + _to_parent(R, f.fingertip)
    columns = [
        a if prismatic else _cross(a, tip - p)
        for a, p, prismatic in zip(axes, joints, finger.prismatic, strict=True)
    ]
    return tip, jnp.stack(columns, axis=1)
