"""The rigid body of a specimen as a MuJoCo model.

It shares no code with `jaxfinger.model`, so that the cases also test the model.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no types.)
from __future__ import annotations

import mujoco
import numpy as np
from jaxtyping import Float

from jaxfinger.data import FingerDescription

# MuJoCo's impedance (solimp) of dry friction, near its upper limit: a sticking joint creeps by less than 1e-3 rad/s.
STICK_IMPEDANCE = (0.9999, 0.9999, 1e-3, 0.5, 2.0)
TYPICAL_ARM = 5e-3  # m. MuJoCo scales the softness of a tendon's friction by its coefficients at compile time.


def build(finger: FingerDescription, timestep: float = 5e-4) -> mujoco.MjModel:
    """Build the MuJoCo model of the serial chain and its active tendons. `timestep`: s.

    Tendons are MuJoCo's fixed tendons. The caller sets their coefficients to C(q), and all friction, before every step.
    MuJoCo solves the dry friction of joints and tendons as one convex problem.
    """
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.option.gravity = finger.gravity
    add_chain(spec, finger)
    for k in np.flatnonzero(finger.active):
        tendon = spec.add_tendon(name=finger.tendon_names[k], frictionloss=1.0)
        for joint in finger.joint_names:
            tendon.wrap_joint(joint, TYPICAL_ARM)
    model = spec.compile()
    fast = [2.0 * timestep, 1.0]
    model.dof_solref[:], model.dof_solimp[:] = fast, STICK_IMPEDANCE
    model.tendon_solref_fri[:], model.tendon_solimp_fri[:] = fast, STICK_IMPEDANCE
    return model


def add_chain(spec: mujoco.MjSpec, finger: FingerDescription) -> list:
    """Add the finger's links to a specification and return the bodies, base first."""
    bodies = [spec.worldbody]
    for i, name in enumerate(finger.joint_names):
        inertia = finger.inertia[i]
        full = [inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2]]
        body = bodies[-1].add_body(
            name=name,
            pos=finger.origin[i],
            mass=finger.mass[i],
            ipos=finger.com[i],
            fullinertia=full,
            explicitinertial=True,
        )
        body.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=finger.axis[i],
            frictionloss=1e-3,
            limited=mujoco.mjtLimited.mjLIMITED_FALSE,
        )
        bodies.append(body)
    return bodies


class Plant:
    """Rigid-body dynamics of one finger. Time is the first axis; angles rad, torques N m."""

    def __init__(self, finger: FingerDescription):
        self.finger = finger
        self.model = build(finger)
        self._data = mujoco.MjData(self.model)

    def inverse_dynamics(
        self, q: Float[np.ndarray, "N m"], qd: Float[np.ndarray, "N m"], qdd: Float[np.ndarray, "N m"]
    ) -> Float[np.ndarray, "N m"]:
        """M(q) q̈ + N(q, q̇) + G(q) by MuJoCo's recursive Newton–Euler."""
        model, data = self.model, self._data
        torque = np.empty_like(q)
        for i in range(len(q)):
            data.qpos, data.qvel, data.qacc = q[i], qd[i], qdd[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 1, torque[i])
        return torque

    def gravity_torque(self, q: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
        """G(q), evaluated once where the whole recording holds one posture."""
        if np.ptp(q, axis=0).max() == 0.0:
            return np.broadcast_to(self.inverse_dynamics(q[:1], 0 * q[:1], 0 * q[:1]), q.shape)
        return self.inverse_dynamics(q, np.zeros_like(q), np.zeros_like(q))

    def mass_matrix(self, q: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m m"]:
        """M(q), kg m²."""
        model, data = self.model, self._data
        data.qpos = q
        mujoco.mj_forward(model, data)
        dense = np.empty((model.nv, model.nv))
        mujoco.mj_fullM(model, data, dense)
        return dense

    def jacobian(self, q: Float[np.ndarray, " m"]) -> Float[np.ndarray, "3 m"]:
        """∂x/∂q of the fingertip, base frame, m."""
        model, data = self.model, self._data
        data.qpos = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        last = model.nbody - 1
        point = data.xpos[last] + data.xmat[last].reshape(3, 3) @ self.finger.fingertip
        jac = np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, jac, None, point, last)
        return jac

    def fingertip(self, q: Float[np.ndarray, " m"]) -> Float[np.ndarray, " xyz"]:
        """Position of the fingertip in the base frame, m."""
        model, data = self.model, self._data
        data.qpos = q
        mujoco.mj_kinematics(model, data)
        last = model.nbody - 1
        return data.xpos[last] + data.xmat[last].reshape(3, 3) @ self.finger.fingertip
