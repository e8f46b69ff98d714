"""Equation (1), once:

    M(q) q̈ + N(q, q̇) + G(q) + h(q, q̇) = Cᵀ(q) (f_t − f_f) + Jᵀ(q) f_ext + τ_ext − s(q̇) μ |τ_ext|

The last term is what the joints' own drives lose of their torque; the paper has none, μ = 0.
Every experiment reads one of its unknowns from the others; all functions broadcast over the batch, which is last.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.model import rigid_body
from jaxfinger.model.finger import Finger
from jaxfinger.model.joint_torque import drive_torque
from jaxfinger.model.memory import memories
from jaxfinger.model.model import Memory, Model, SharedFriction
from jaxfinger.model.motion import Motion
from jaxfinger.model.tendon_friction import bounded, held


class Terms(NamedTuple):
    """The terms of (1) other than the rigid body's, for one motion."""

    finger: Finger
    f_t: Float[Array, "n *T"]  # tension that enters the tendon's path, N
    C: Float[Array, "n m *T"]
    loss: Float[Array, "n *T"]  # of a sliding tendon, N
    f_j: Float[Array, "n *T"]  # f_t − f_f: tension at the joints, N
    h: Float[Array, "m *T"]  # τ_k + τ_d, N m
    friction: Float[Array, "m *T"]  # |τ_f|, N m
    direction: Float[Array, "m *T"]  # share of it that is built up
    tendon_direction: Float[Array, "n *T"]
    torque_friction: Float[Array, "m *#T"]  # μ
    shared: tuple[SharedFriction, ...]  # friction of what turns with several joints


def terms(model: Model, x: Motion, memory: tuple[Memory, ...], plain: Terms | None = None) -> Terms:
    """Each term as the nominal model has it, then as the effects change it.

    `plain`: the terms of the same motion without effects, where they are known. What no effect changes is taken from
    there: a hook that is not overridden returns the very array that it was given.
    """
    effects = list(zip(model.effects, memory, strict=True))
    finger, f_t = model.finger, x.tension
    direction, tendon_direction = x.joint_direction, x.tendon_direction
    for effect, state in effects:
        finger = effect.finger(finger)
        f_t = effect.tension(x, state, f_t)
        direction, tendon_direction = effect.directions(x, state, direction, tendon_direction)

    C = model.moment_arm.coupling(x.q) if plain is None else plain.C
    for effect, _ in effects:
        C = effect.coupling(x, f_t, C)
    affine = loss = model.tendon_friction.loss(f_t)
    for effect, _ in effects:
        loss = effect.loss(x, f_t, C, loss)
    as_before = f_t is x.tension and loss is affine and (x.held or tendon_direction is x.tendon_direction)
    loss = bounded(loss, f_t)
    if plain is not None and as_before:
        f_j = plain.f_j
    elif x.held:
        f_j = held(f_t, loss)
    else:
        f_j = f_t - tendon_direction * loss
    if x.held:
        for effect, state in effects:
            f_j = effect.held_tension(x, state, f_t, loss, f_j)
    for effect, _ in effects:
        f_j = effect.delivered(x, f_j)

    if plain is None:
        h = model.joint_torque.elastic_torque(x.q) + model.joint_torque.damping_torque(x.qd)
        h = h + model.joint_torque.directional_torque(x.qd, slides=not x.held)
        friction = model.joint_torque.friction_magnitude(x.q)
    else:
        h, friction = plain.h, plain.friction
    for effect, state in effects:
        h = effect.torque(x, state, h)
        if not x.held:  # else a fixture carries it
            friction = effect.joint_friction(x, f_j, C, friction)
    shared = tuple(s for effect, state in effects for s in effect.shared_friction(x, state))
    mu = _torque_friction(model, x)
    return Terms(finger, f_t, C, loss, f_j, h, friction, direction, tendon_direction, mu, shared)


def _torque_friction(model: Model, x: Motion) -> Float[Array, "m *#T"]:
    mu = model.joint_torque.torque_friction
    for effect in model.effects:
        mu = effect.torque_friction(mu)
    return mu.reshape(-1, *(1,) * (x.q.ndim - 1))


def plain_terms(model: Model, x: Motion) -> Terms:
    """The terms of a model without effects."""
    return terms(model, x, ())


def resisting_torque(model: Model, x: Motion, plain: Terms | None = None) -> Float[Array, "m *T"]:
    """h − Cᵀ(f_t − f_f): all of (1) but the rigid body and the surroundings, N m."""
    return resisting(terms(model, x, memories(model, x), plain))


def resisting(e: Terms) -> Float[Array, "m *T"]:
    """`resisting_torque` of its terms, N m."""
    return e.h + e.direction * e.friction + _shared(e) - jnp.sum(e.C * e.f_j[:, None], axis=0)


def _shared(e: Terms) -> Float[Array, "m *T"]:
    """Torque of the friction of what turns with several joints, N m."""
    parts = (jnp.multiply.outer(s.ways, s.magnitude * s.direction) for s in e.shared)
    return sum(parts, start=jnp.zeros_like(e.h))


def resisting_change(model: Model, x: Motion, plain: Terms) -> Float[Array, "m *T"]:
    """What the effects add to `resisting_torque`, N m: of the terms that they change."""
    e = terms(model, x, memories(model, x), plain)
    change = e.h - plain.h if e.h is not plain.h else jnp.zeros_like(plain.h)
    if e.friction is not plain.friction or e.direction is not x.joint_direction:
        change += e.direction * e.friction - plain.direction * plain.friction
    if e.shared:
        change += _shared(e)
    if e.C is not plain.C or e.f_j is not plain.f_j:
        change -= jnp.sum(e.C * e.f_j[:, None] - plain.C * plain.f_j[:, None], axis=0)
    return change


def external_torque(
    model: Model, x: Motion, f_ext: Float[Array, "3 *T"] | None = None, plain: Terms | None = None
) -> Float[Array, "m *T"]:
    """τ_ext of (1): the torque that must act on the joints from outside for the motion to be as it is, N m."""
    e = terms(model, x, memories(model, x), plain)
    tau = rigid_body.inverse_dynamics(e.finger, x.q, x.qd, x.qdd) + resisting(e)
    if f_ext is not None:
        _, J = rigid_body.fingertip(model.finger, x.q)
        tau = tau - jnp.sum(J * f_ext[:, None], axis=0)
    return tau if x.held else drive_torque(tau, e.direction, e.torque_friction)


def fingertip_force(model: Model, x: Motion) -> Float[Array, "3 *T"]:
    """f_ext at rest, base frame, N: the least-squares solution of Jᵀ f_ext = G + h − Cᵀ(f_t − f_f).

    The joints over-determine a planar contact force; what it cannot take is taken by the joints' static friction. A
    direction in which the fingertip cannot be moved carries no force.
    """
    return jnp.sum(contact_map(model, x) * external_torque(model, x)[None], axis=1)


def contact_map(model: Model, x: Motion) -> Float[Array, "3 m *T"]:
    """Pseudo-inverse of Jᵀ: the fingertip force that balances joint torques best, N/(N m)."""
    _, J = rigid_body.fingertip(model.finger, x.q)
    # (J Jᵀ + ε I) f = J τ, the minimum-norm solution as ε → 0.
    gram = jnp.sum(J[:, None] * J[None], axis=2)
    eps = 1e-10 * (gram[0, 0] + gram[1, 1] + gram[2, 2])
    return _solved(gram + eps[None, None] * jnp.eye(3).reshape(3, 3, *(1,) * eps.ndim), J)


def _solved(A: Float[Array, "3 3 *T"], B: Float[Array, "3 m *T"]) -> Float[Array, "3 m *T"]:
    """A⁻¹ B for positive definite A = L D Lᵀ, sample by sample.

    A formula, since two programs that call LAPACK for thousands of samples at once can hold all of XLA's processor
    threads and wait for ever.
    """
    A = A[:, :, None]  # beside the columns of B
    d0, l1, l2 = A[0, 0], A[1, 0] / A[0, 0], A[2, 0] / A[0, 0]
    d1, c = A[1, 1] - l1 * A[1, 0], A[2, 1] - l2 * A[1, 0]
    l3 = c / d1
    d2 = A[2, 2] - l2 * A[2, 0] - l3 * c
    y1 = B[1] - l1 * B[0]
    z = (B[2] - l2 * B[0] - l3 * y1) / d2
    y = y1 / d1 - l3 * z
    return jnp.stack([B[0] / d0 - l1 * y - l2 * z, y, z])


def excursion(model: Model, x: Motion, plain: Float[Array, "n *T"] | None = None) -> Float[Array, "n *T"]:
    """l, m: f(q), which is `plain` where it is known, and what the effects add."""
    l = model.moment_arm.excursion(x.q) if plain is None else plain
    f = x.tension
    states = memories(model, x)
    for effect, state in zip(model.effects, states, strict=True):
        f = effect.tension(x, state, f)
    for effect, state in zip(model.effects, states, strict=True):
        l = effect.excursion(x, state, f, l)
    return l


def joint_tension(model: Model, x: Motion) -> Float[Array, "n *T"]:
    """f_t − f_f: the tension that reaches the joints, N."""
    return terms(model, x, memories(model, x)).f_j


def elastic_and_friction(model: Model, x: Motion) -> Float[Array, "m *T"]:
    """h of (1), N m."""
    e = terms(model, x, memories(model, x))
    return e.h + e.direction * e.friction + _shared(e)
