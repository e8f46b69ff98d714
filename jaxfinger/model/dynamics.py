"""Equation (1), written once:

    M(q) q̈ + N(q, q̇) + G(q) + h(q, q̇) = Cᵀ(q) (f_t − f_f) + Jᵀ(q) f_ext + τ_ext − s(q̇) μ |τ_ext|

(Li et al. 2024). The last term is the friction of the joints' own drives in proportion to their torque, an addition to
the paper, where μ = 0. Each function solves (1) for one channel, given the others. All functions broadcast over batch
axes, which are last.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.model import rigid_body
from jaxfinger.model.finger import Finger
from jaxfinger.model.joint_torque import delivered_torque, drive_torque
from jaxfinger.model.memory import memories
from jaxfinger.model.model import Memory, Model, SharedFriction
from jaxfinger.model.motion import Motion
from jaxfinger.model.tendon_friction import bounded, held


class Terms(NamedTuple):
    """Terms of (1) for one motion, except those of the rigid body."""

    finger: Finger
    f_t: Float[Array, "n *T"]  # tension that enters the tendon's path, N
    C: Float[Array, "n m *T"]  # coupling matrix, m/rad
    loss: Float[Array, "n *T"]  # tension lost by a sliding tendon, |f_f|, N
    f_j: Float[Array, "n *T"]  # f_t − f_f: tension at the joints, N
    h: Float[Array, "m *T"]  # h without friction, τ_k + τ_d, N m
    friction: Float[Array, "m *T"]  # magnitude of τ_f, N m
    direction: Float[Array, "m *T"]  # of τ_f, −1 … 1: sign of q̇, or the share of friction that is built up
    tendon_direction: Float[Array, "n *T"]  # of f_f, likewise
    torque_friction: Float[Array, "m *#T"]  # μ, 1
    shared: tuple[SharedFriction, ...]  # friction that acts on several joints


def terms(model: Model, x: Motion, memory: tuple[Memory, ...], nominal: Terms | None = None) -> Terms:
    """Evaluate the terms of (1): those of the nominal model, changed by the effects in order.

    `nominal`: terms of the same motion without effects (`terms_without_effects`), where they are known. Terms that no
    effect changes are taken from it. They are recognised by identity, since a hook that is not overridden returns its
    argument.
    """
    effects = list(zip(model.effects, memory, strict=True))
    finger, f_t = model.finger, x.tension
    direction, tendon_direction = x.joint_direction, x.tendon_direction
    for effect, state in effects:
        finger = effect.finger(finger)
        f_t = effect.tension(x, state, f_t)
        direction, tendon_direction = effect.directions(x, state, direction, tendon_direction)

    C = model.moment_arm.coupling(x.q) if nominal is None else nominal.C
    for effect, _ in effects:
        C = effect.coupling(x, f_t, C)
    affine = loss = model.tendon_friction.loss(f_t)
    for effect, _ in effects:
        loss = effect.loss(x, f_t, C, loss)
    as_before = f_t is x.tension and loss is affine and (x.held or tendon_direction is x.tendon_direction)
    loss = bounded(loss, f_t)
    if nominal is not None and as_before:
        f_j = nominal.f_j
    elif x.held:
        f_j = held(f_t, loss)
    else:
        f_j = f_t - tendon_direction * loss
    if x.held:
        for effect, state in effects:
            f_j = effect.held_tension(x, state, f_t, loss, f_j)
    for effect, _ in effects:
        f_j = effect.delivered(x, f_j)

    if nominal is None:
        h = model.joint_torque.elastic_torque(x.q) + model.joint_torque.damping_torque(x.qd)
        h = h + model.joint_torque.directional_torque(x.qd, slides=not x.held)
        friction = model.joint_torque.friction_magnitude(x.q)
    else:
        h, friction = nominal.h, nominal.friction
    for effect, state in effects:
        h = effect.torque(x, state, h)
        if not x.held:  # a fixture that holds the joints carries their friction
            friction = effect.joint_friction(x, f_j, C, friction)
    shared = tuple(s for effect, state in effects for s in effect.shared_friction(x, state))
    mu = _torque_friction(model, x)
    return Terms(finger, f_t, C, loss, f_j, h, friction, direction, tendon_direction, mu, shared)


def _torque_friction(model: Model, x: Motion) -> Float[Array, "m *#T"]:
    mu = model.joint_torque.torque_friction
    for effect in model.effects:
        mu = effect.torque_friction(mu)
    return mu.reshape(-1, *(1,) * (x.q.ndim - 1))


def terms_without_effects(model: Model, x: Motion) -> Terms:
    """Terms of (1) without the model's effects."""
    return terms(model, x, ())


def resisting(e: Terms) -> Float[Array, "m *T"]:
    """h − Cᵀ(f_t − f_f), N m, from the terms `e`."""
    return _h(e) - jnp.sum(e.C * e.f_j[:, None], axis=0)


def _h(e: Terms) -> Float[Array, "m *T"]:
    """h = τ_k + τ_d + τ_f of (1), N m, with the friction that acts on several joints."""
    return e.h + e.direction * e.friction + _shared_torque(e)


def _shared_torque(e: Terms) -> Float[Array, "m *T"]:
    """Torque of the friction that acts on several joints, N m."""
    parts = (jnp.multiply.outer(s.ways, s.magnitude * s.direction) for s in e.shared)
    return sum(parts, start=jnp.zeros_like(e.h))


def resisting_change(model: Model, x: Motion, nominal: Terms) -> Float[Array, "m *T"]:
    """Change of `resisting` by the effects, N m, computed from the terms that they change."""
    return _resisting_change(terms(model, x, memories(model, x), nominal), x, nominal)


def _resisting_change(e: Terms, x: Motion, nominal: Terms) -> Float[Array, "m *T"]:
    change = e.h - nominal.h if e.h is not nominal.h else jnp.zeros_like(nominal.h)
    if e.friction is not nominal.friction or e.direction is not x.joint_direction:
        change += e.direction * e.friction - nominal.direction * nominal.friction
    if e.shared:
        change += _shared_torque(e)
    if e.C is not nominal.C or e.f_j is not nominal.f_j:
        change -= jnp.sum(e.C * e.f_j[:, None] - nominal.C * nominal.f_j[:, None], axis=0)
    return change


def changed_torque(model: Model, x: Motion, nominal: Terms, tau: Float[Array, "m *T"]) -> Float[Array, "m *T"]:
    """`external_torque`, N m, with effects that leave the rigid body as it is, from that without effects, `tau`."""
    e = terms(model, x, memories(model, x), nominal)
    change = _resisting_change(e, x, nominal)
    if x.held:
        return tau + change
    needed = delivered_torque(tau, nominal.direction, nominal.torque_friction) + change
    return drive_torque(needed, e.direction, e.torque_friction)


def external_torque(
    model: Model,
    x: Motion,
    f_ext: Float[Array, "3 *T"] | None = None,
    nominal: Terms | None = None,
    memory: tuple[Memory, ...] | None = None,
) -> Float[Array, "m *T"]:
    """τ_ext of (1), N m: the external torque on the joints that the motion requires.

    `memory`: states of the effects, where they are known.
    """
    e = terms(model, x, memories(model, x) if memory is None else memory, nominal)
    tau = rigid_body.inverse_dynamics(e.finger, x.q, x.qd, x.qdd) + resisting(e)
    if f_ext is not None:
        _, J = rigid_body.fingertip(model.finger, x.q)
        tau = tau - jnp.sum(J * f_ext[:, None], axis=0)
    return tau if x.held else drive_torque(tau, e.direction, e.torque_friction)


def fingertip_force(model: Model, x: Motion) -> Float[Array, "3 *T"]:
    """f_ext at rest, base frame, N: the least-squares solution of Jᵀ f_ext = G + h − Cᵀ(f_t − f_f).

    The joints may over-determine the force; the rest of their torque is carried by their static friction. The force is
    zero along directions in which the joints cannot move the fingertip.
    """
    return jnp.sum(contact_map(model, x) * external_torque(model, x)[None], axis=1)


def contact_map(model: Model, x: Motion) -> Float[Array, "3 m *T"]:
    """Pseudo-inverse of Jᵀ, 1/m: the map from joint torques to the fingertip force that balances them best."""
    _, J = rigid_body.fingertip(model.finger, x.q)
    # (J Jᵀ + ε I) f = J τ, the minimum-norm solution as ε → 0. ε is 1e-10 of the trace: far above rounding, and without
    # effect unless the posture is nearly singular.
    gram = jnp.sum(J[:, None] * J[None], axis=2)
    eps = 1e-10 * (gram[0, 0] + gram[1, 1] + gram[2, 2])
    return _solved(gram + eps[None, None] * jnp.eye(3).reshape(3, 3, *(1,) * eps.ndim), J)


def _solved(A: Float[Array, "3 3 *T"], B: Float[Array, "3 m *T"]) -> Float[Array, "3 m *T"]:
    """A⁻¹ B for positive definite A = L D Lᵀ, sample by sample.

    The formula avoids LAPACK: two programs that call it for thousands of samples at once can hold all of XLA's
    processor threads and deadlock.
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


def excursion(model: Model, x: Motion, nominal: Float[Array, "n *T"] | None = None) -> Float[Array, "n *T"]:
    """Tendon excursion l, m: f(q) changed by the effects. `nominal`: f(q), where it is known."""
    l = model.moment_arm.excursion(x.q) if nominal is None else nominal
    f = x.tension
    states = memories(model, x)
    for effect, state in zip(model.effects, states, strict=True):
        f = effect.tension(x, state, f)
    for effect, state in zip(model.effects, states, strict=True):
        l = effect.excursion(x, state, f, l)
    return l


def joint_tension(model: Model, x: Motion) -> Float[Array, "n *T"]:
    """Tension that reaches the joints, f_t − f_f, N."""
    return terms(model, x, memories(model, x)).f_j


def elastic_and_friction(model: Model, x: Motion) -> Float[Array, "m *T"]:
    """h of (1), N m: elastic torque, damping and joint friction."""
    return _h(terms(model, x, memories(model, x)))
