"""Random serial chains for the tests of the model, and the same chain in Pinocchio."""

import jax.numpy as jnp
import numpy as np
import pinocchio as pin

from jaxfinger.data import FingerDescription
from jaxfinger.model import Finger, JointTorque, Model, MomentArm, TendonFriction


def description(seed: int, m: int, n: int = 2, prismatic: bool = True) -> FingerDescription:
    """Random finger of m joints with any axes, a fifth of them prismatic, and full inertia tensors."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal((m, 3))
    root = rng.standard_normal((m, 3, 3))
    return FingerDescription(
        gravity=rng.standard_normal(3) * 9.81,
        joint_names=tuple(f"J{i}" for i in range(m)),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        origin=rng.standard_normal((m, 3)),
        limits=np.tile([-3.0, 3.0], (m, 1)),
        mass=rng.uniform(0.1, 2.0, m),
        com=rng.standard_normal((m, 3)),
        inertia=root @ root.transpose(0, 2, 1),
        fingertip=rng.standard_normal(3),
        tendon_names=tuple(f"T{k}" for k in range(n)),
        active=np.ones(n, bool),
        crosses=np.ones((n, m), bool),
        prismatic=tuple(bool(p) for p in rng.random(m) < 0.2) if prismatic else (),
    )


def model(d: FingerDescription, seed: int = 0, **sizes) -> Model:
    """Model of the finger with random coefficients and positive friction."""
    rng = np.random.default_rng(seed)
    zeros = Model.zeros(Finger.from_description(d), **sizes)
    draw = lambda a: jnp.asarray(rng.standard_normal(a.shape))  # noqa: E731
    torque = zeros.joint_torque
    friction = jnp.abs(draw(torque.friction)).at[:, 1::2].set(0.0)
    return Model(
        zeros.finger,
        MomentArm(draw(zeros.moment_arm.coefficients), zeros.moment_arm.exponents),
        JointTorque.of(draw(torque.elastic), jnp.abs(draw(torque.damping)), friction),
        TendonFriction(jnp.abs(draw(zeros.tendon_friction.constant)), jnp.full(zeros.finger.n, 0.2)),
    )


def in_pinocchio(d: FingerDescription) -> tuple[pin.Model, int]:
    """Chain in Pinocchio, and the frame number of its fingertip."""
    chain, joint = pin.Model(), 0
    chain.gravity.linear = d.gravity
    for i in range(d.m):
        kind = pin.JointModelPrismaticUnaligned if d.prismatic[i] else pin.JointModelRevoluteUnaligned
        joint = chain.addJoint(joint, kind(*d.axis[i]), pin.SE3(np.eye(3), d.origin[i]), d.joint_names[i])
        chain.appendBodyToJoint(joint, pin.Inertia(d.mass[i], d.com[i], d.inertia[i]), pin.SE3.Identity())
    tip = chain.addFrame(pin.Frame("tip", joint, 0, pin.SE3(np.eye(3), d.fingertip), pin.FrameType.OP_FRAME))
    return chain, tip
