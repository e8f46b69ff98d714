"""Rigid-body terms of equation (1) by recursive Newton–Euler (Luh, Walker, Paul 1980; Featherstone 2008, ch. 5).

Every function takes joint arrays `(m, *T)` with the batch last and broadcasts over it. A 3-vector is either one array
`(3, *T)`, which compiles quickly, or a tuple of three components, which runs quickly, since every product is then one
loop along the long axis. The recursion is the same for both. A long batch is computed by components, in blocks that fit
into the processor's cache.
"""

import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.model.angles import sin_cos
from jaxfinger.model.finger import Finger

Scalar = Float[Array, "*#T"]
Vector = Float[Array, "3 *#T"] | tuple[Scalar, ...]
Matrix = Float[Array, "3 3 *#T"] | tuple[tuple[Scalar, ...], ...]  # rows


def _add(*vectors: Vector) -> Vector:
    return jax.tree.map(lambda *components: functools.reduce(jnp.add, components), *vectors)


def _scale(s: Scalar, v: Vector) -> Vector:
    return tuple(s * component for component in v) if isinstance(v, tuple) else s[None] * v


def _dot(a: Vector, b: Vector) -> Scalar:
    if isinstance(a, tuple):
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return jnp.sum(a * jnp.asarray(b), axis=0)


def _cross(a: Vector, b: Vector) -> Vector:
    if isinstance(a, tuple):
        return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]

    def roll(v, k):
        return jnp.concatenate([v[k:], v[:k]])

    return roll(a, 1) * roll(b, 2) - roll(a, 2) * roll(b, 1)


def _mul(R: Matrix, v: Vector) -> Vector:
    if isinstance(R, tuple):
        return tuple(_dot(row, v) for row in R)
    return jnp.sum(R * jnp.asarray(v)[None], axis=1)


def _transposed(R: Matrix) -> Matrix:
    return tuple(zip(*R, strict=True)) if isinstance(R, tuple) else jnp.swapaxes(R, 0, 1)


def _rotation(axis: Vector, angle: Scalar) -> Matrix:
    """Rodrigues: R = cos θ I + sin θ [a]ₓ + (1 − cos θ) a aᵀ."""
    s, c = sin_cos(angle)
    if isinstance(axis, tuple):
        (x, y, z), (u, v, w) = (s * a for a in axis), ((1.0 - c) * a for a in axis)
        return (
            (c + u * axis[0], v * axis[0] - z, w * axis[0] + y),
            (u * axis[1] + z, c + v * axis[1], w * axis[1] - x),
            (u * axis[2] - y, v * axis[2] + x, c + w * axis[2]),
        )
    x, y, z = axis
    o = jnp.zeros_like(x)
    skew = jnp.stack([jnp.stack([o, -z, y]), jnp.stack([z, o, -x]), jnp.stack([-y, x, o])])
    identity = jnp.eye(3).reshape(3, 3, *(1,) * angle.ndim)
    return c[None, None] * identity + s[None, None] * skew + (1.0 - c)[None, None] * axis[:, None] * axis[None]


def _spin(omega: Vector, alpha: Vector) -> Matrix:
    """[α]ₓ + [ω]ₓ[ω]ₓ = [α]ₓ + ω ωᵀ − ω² I, which maps the position of a body's point to its relative acceleration."""
    (x, y, z), (u, v, w) = omega, alpha
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    rows = ((-yy - zz, xy - w, xz + v), (xy + w, -xx - zz, yz - u), (xz - v, yz + u, -xx - yy))
    return rows if isinstance(omega, tuple) else jnp.stack([jnp.stack(row) for row in rows])


BLOCK = 1024  # samples in a block, 8 KiB for each array: the arrays of a link fit into the processor's cache
LONG = 8192  # samples above which components are used: they run in a tenth of the time and compile 0.5 s longer
CHAIN = 3  # links that XLA may fuse into one loop; beyond, it computes links repeatedly


class _Joint(NamedTuple):
    """One joint and its link, or all of them, from base to tip along the first axis of every array."""

    axis: Vector
    origin: Vector
    com: Vector
    mass: Scalar
    inertia: Matrix
    q: Scalar
    qd: Scalar
    qdd: Scalar


def _joints(finger: Finger, q, qd, qdd, by_components: bool) -> _Joint:
    f = jax.tree.map(lambda a: a.reshape(a.shape + (1,) * (q.ndim - 1)), finger)
    axis, origin, com, inertia = f.axis, f.origin, f.com, f.inertia
    if by_components:
        axis, origin, com = (tuple(jnp.unstack(a, axis=1)) for a in (axis, origin, com))
        inertia = tuple(tuple(jnp.unstack(row, axis=1)) for row in jnp.unstack(inertia, axis=1))
    return _Joint(axis, origin, com, f.mass, inertia, q, qd, qdd)


def _frame(j: _Joint, slides: bool) -> tuple[Matrix, Vector]:
    """Rotation and position of the link's frame in its parent's frame."""
    if slides:
        return _rotation(j.axis, jnp.zeros_like(j.q)), _add(j.origin, _scale(j.q, j.axis))
    return _rotation(j.axis, j.q), _add(j.origin, _scale(jnp.zeros_like(j.q), j.axis))


def _recursion(step, state, links, finger: Finger, reverse: bool = False):
    """Run `step(state, link, slides)` along the chain; where all joints are of one kind a scan compiles faster."""
    slides = finger.prismatic
    if len(set(slides)) == 1:
        return jax.lax.scan(functools.partial(step, slides=slides[0]), state, links, reverse=reverse)
    each = [jax.tree.map(lambda a, i=i: a[i], links) for i in range(finger.m)]
    state, out = _unrolled(step, state, each, finger, reverse)
    return state, jax.tree.map(lambda *a: jnp.stack(a), *out)


def _unrolled(step, state, links: list, finger: Finger, reverse: bool = False) -> tuple:
    """Run `step(state, link, slides)` along the chain, unrolled in the program."""
    out = {}
    for i in reversed(range(finger.m)) if reverse else range(finger.m):
        if out and finger.m > CHAIN:
            # A conditional ends XLA's loop fusion, so that a link's state is stored and not computed again.
            never = finger.mass[0] < 0.0
            state = jax.lax.cond(never, lambda s: jax.tree.map(jnp.negative, s), lambda s: s, state)
        state, out[i] = step(state, links[i], finger.prismatic[i])
    return state, [out[i] for i in range(finger.m)]


@jax.jit
def inverse_dynamics(
    finger: Finger, q: Float[Array, "m *T"], qd: Float[Array, "m *T"], qdd: Float[Array, "m *T"]
) -> Float[Array, "m *T"]:
    """M(q) q̈ + N(q, q̇) + G(q), N m (N for a prismatic joint), with the inertia of rotors in M."""
    return _chain_dynamics(finger, q, qd, qdd) + jnp.tensordot(finger.rotor_inertia, qdd, 1)


def _chain_dynamics(finger: Finger, q, qd, qdd) -> Float[Array, "m *T"]:
    """Inverse dynamics of the links without rotors, N m."""
    samples = math.prod(q.shape[1:])
    if samples <= LONG:
        return jnp.asarray(_newton_euler(finger, q, qd, qdd, by_components=False))
    count = -(-samples // BLOCK)
    size = -(-samples // count)

    def blocks(a):
        flat = jnp.pad(a.reshape(finger.m, samples), [(0, 0), (0, count * size - samples)])
        return jnp.moveaxis(flat.reshape(finger.m, count, size), 1, 0)

    parts = (blocks(q), blocks(qd), blocks(qdd))
    torques = jax.lax.map(lambda x: tuple(_newton_euler(finger, *x, by_components=True)), parts)
    return jnp.stack([t.reshape(-1)[:samples] for t in torques]).reshape(q.shape)


def _newton_euler(finger: Finger, q, qd, qdd, by_components: bool) -> Float[Array, "m *T"] | list[Scalar]:
    """Recursive Newton–Euler without rotors, N m; by components it returns a list with one entry for each joint."""

    def outward(state, j: _Joint, slides: bool):
        """Propagate ω, α and a of the link's frame, in that frame, and return the link's force and moment."""
        omega, alpha, a = state
        R, p = _frame(j, slides)
        back = _transposed(R)
        a = _mul(back, _add(a, _mul(_spin(omega, alpha), p)))
        omega, alpha = _mul(back, omega), _mul(back, alpha)
        rate = _scale(j.qd, j.axis)
        change = _add(_scale(j.qdd, j.axis), _cross(omega, rate))
        if slides:
            a = _add(a, change, _cross(omega, rate))
        else:
            omega, alpha = _add(omega, rate), _add(alpha, change)
        force = _scale(j.mass, _add(a, _mul(_spin(omega, alpha), j.com)))
        moment = _add(_mul(j.inertia, alpha), _cross(omega, _mul(j.inertia, omega)), _cross(j.com, force))
        return (omega, alpha, a), (R, p, force, moment)

    def inward(wrench, link, slides: bool):
        """Sum the force and moment that the parent applies to the link, take the joint's torque, and turn both."""
        (force, moment), (j, (R, p, f, n)) = wrench, link
        force, moment = _add(f, force), _add(n, moment)
        torque = _dot(j.axis, force if slides else moment)
        force, moment = _mul(R, force), _mul(R, moment)
        return (force, _add(moment, _cross(p, force))), torque

    zero = jnp.zeros((3, *q.shape[1:]))
    upward = zero - finger.gravity.reshape(3, *(1,) * (q.ndim - 1))  # gravity enters as an acceleration of the base
    if by_components:
        zero, upward = tuple(zero), tuple(upward)
    joints = _joints(finger, q, qd, qdd, by_components)
    if by_components:
        each = [jax.tree.map(lambda a, i=i: a[i], joints) for i in range(finger.m)]
        _, links = _unrolled(outward, (zero, zero, upward), each, finger)
        return _unrolled(inward, (zero, zero), list(zip(each, links, strict=True)), finger, reverse=True)[1]
    _, links = _recursion(outward, (zero, zero, upward), joints, finger)
    return _recursion(inward, (zero, zero), (joints, links), finger, reverse=True)[1]


def gravity_torque(finger: Finger, q: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """Gravity torque G(q), N m."""
    zero = jnp.zeros_like(q)
    return inverse_dynamics(finger, q, zero, zero)


def coriolis(finger: Finger, q: Float[Array, "m *T"], qd: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """Coriolis and centrifugal torque N(q, q̇), N m."""
    return inverse_dynamics(_weightless(finger), q, qd, jnp.zeros_like(q))


def mass_matrix(finger: Finger, q: Float[Array, "m *T"]) -> Float[Array, "m m *T"]:
    """Mass matrix M(q), kg m²; column i is the torque of a unit acceleration of joint i without gravity."""
    zero = jnp.zeros_like(q)
    unit = jnp.stack([zero.at[i].set(1.0) for i in range(finger.m)])
    weightless = _weightless(finger)
    return jax.vmap(lambda qdd: inverse_dynamics(weightless, q, zero, qdd), out_axes=1)(unit)


def _weightless(finger: Finger) -> Finger:
    return eqx.tree_at(lambda f: f.gravity, finger, jnp.zeros(3))


@jax.jit
def fingertip(finger: Finger, q: Float[Array, "m *T"]) -> tuple[Float[Array, "3 *T"], Float[Array, "3 m *T"]]:
    """Position of the fingertip, m, and its Jacobian J, m/rad, in the base frame."""

    def outward(pose, j: _Joint, slides: bool):
        """Propagate the link's frame in the base frame, and return the joint's axis and position there."""
        (R, p), (turn, shift) = pose, _frame(j, slides)
        p = _add(p, _mul(R, shift))
        R = jnp.sum(R[:, :, None] * jnp.asarray(turn)[None], axis=1)
        return (R, p), (_mul(R, j.axis), p)

    zero = jnp.zeros((3, *q.shape[1:]))
    base = (jnp.eye(3).reshape(3, 3, *(1,) * (q.ndim - 1)) + zero[None], zero)
    joints = _joints(finger, q, q, q, by_components=False)
    (R, p), links = _recursion(outward, base, joints, finger)
    axes, places = (jnp.asarray(a) for a in links)
    tip = jnp.asarray(_add(p, _mul(R, finger.fingertip.reshape(3, *(1,) * (q.ndim - 1)))))
    slides = jnp.array(finger.prismatic, dtype=float).reshape(-1, *(1,) * q.ndim)
    columns = slides * axes + (1.0 - slides) * jnp.asarray(jax.vmap(_cross)(axes, tip[None] - places))
    return tip, jnp.moveaxis(columns, 0, 1)
