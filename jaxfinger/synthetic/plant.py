"""Plants: what the finger does when a plan is run, as channels without noise at the plan's instants, time last."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.compilation import quick_options
from jaxfinger.errors import UserError
from jaxfinger.model import rigid_body
from jaxfinger.model.finger import Finger
from jaxfinger.synthetic.controller import TensionController, controller
from jaxfinger.synthetic.driven import Simulator
from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.specimen import Specimen

Array = np.ndarray
Channels = dict[str, Float[Array, "_channels N"]]  # channels of one trial, by name, SI
BLOCK_SAMPLES = 4096  # samples of one rigid-body call, so that one compilation serves trials of any length


@runtime_checkable
class Plant(Protocol):
    """Anything that the rig can record in place of a finger: a specimen, or a model."""

    depends_on_session_time: bool  # whether repeats of one motion differ with the session's time

    def prescribed(self, plan: TrialPlan) -> Channels:
        """Return motion and tension as planned (`q`, `tendon_force`) and the channels that follow from them."""
        ...

    def driven(self, plan: TrialPlan) -> Channels:
        """Return motion, tensions and excursions of VD.3, in which the tendons drive the finger along the plan."""
        ...


class SpecimenPlant:
    """A specimen as a plant: equation (1) with the specimen's terms."""

    depends_on_session_time = False

    def __init__(self, specimen: Specimen):
        self.specimen = specimen
        self.finger = Finger.from_description(specimen.description)

    def prescribed(self, plan: TrialPlan) -> Channels:
        """Return all channels of the plan's experiment; `sensors.record` leaves out what the rig does not measure."""
        channels = {"q": plan.q, "tendon_force": plan.tension}
        if plan.held:
            pose = plan.q[:, :1]  # The joints are held: one sample gives the terms that depend on q.
            torque = self._holding_torque(pose, joint_tension(plan.tension, self.specimen.loss(plan.tension)))
            channels["tendon_excursion"] = np.repeat(self.specimen.excursion(pose), plan.time.size, axis=1)
            if plan.experiment == "VD.2":
                channels["fingertip_force"] = self._contact_force(pose, torque)
            else:
                channels["joint_torque"] = torque
        elif plan.experiment.startswith("ID.3"):
            channels["joint_torque"] = self._moving_torque(plan)
        else:
            channels["tendon_excursion"] = self.specimen.excursion(plan.q)
        return channels

    def driven(self, plan: TrialPlan) -> Channels:
        """Return the channels of VD.3, simulated forward under the rig's tension controller.

        Raises:
            UserError: the motion leaves the joints' limits.
        """
        dt = float(plan.time[1] - plan.time[0])
        q, _, tension = self.simulator(plan.q[:, 0], dt, self.controller(plan))
        limits = self.specimen.description.limits
        within = ((q >= limits[:, :1]) & (q <= limits[:, 1:])).all(axis=1)
        if not within.all():
            joint = self.specimen.description.joint_names[np.argmin(within)]
            raise UserError(
                f"recipe: trial {plan.name} drives {joint} beyond its limits; "
                "lower trials.vd3.amplitude or change trials.motion_seed"
            )
        return {"q": q, "tendon_force": tension, "tendon_excursion": self.specimen.excursion(q)}

    def _moving_torque(self, plan: TrialPlan) -> Float[Array, "m N"]:
        """τ_ext of (1) with slack tendons, N m: M q̈ + N + G + τ_k + τ_d + τ_f, friction in the commanded direction."""
        resisting = self.specimen.elastic(plan.q) + self.specimen.viscous(plan.qd)
        resisting = resisting + plan.joint_direction * self.specimen.coulomb(plan.q)
        return self._rigid_body(plan.q, plan.qd, plan.qdd) + resisting

    def _holding_torque(self, pose: Float[Array, "m 1"], tension: Float[Array, "n N"]) -> Float[Array, "m N"]:
        """τ_ext of (1) at rest, N m: G + τ_k − Cᵀ (f_t − f_f); a joint that a fixture holds carries no friction."""
        rest = np.zeros_like(pose)
        gravity = self._rigid_body(pose, rest, rest)
        return gravity + self.specimen.elastic(pose) - self.specimen.moment_arm(pose)[:, :, 0].T @ tension

    def _contact_force(self, pose: Float[Array, "m 1"], torque: Float[Array, "m N"]) -> Float[Array, "3 N"]:
        """Contact force f_ext (3, N), N: least-squares solution of Jᵀ f_ext = τ.

        The joints' static friction takes the rest of the torque (dataset format, VD.2).
        """
        _, jacobian = self._fingertip(self.finger, jnp.asarray(pose[:, 0]))
        return np.linalg.pinv(np.asarray(jacobian).T, rcond=1e-9) @ torque

    def controller(self, plan: TrialPlan) -> TensionController:
        """Return the rig's tension controller for a VD.3 plan."""
        middle = jnp.asarray(plan.q.mean(axis=1, keepdims=True))
        M = np.asarray(self._mass_matrix(self.finger, middle))[:, :, 0]
        return controller(self.specimen, plan, self._rigid_body(plan.q, plan.qd, plan.qdd), M)

    @cached_property
    def simulator(self) -> Simulator:
        """Forward simulation of the specimen."""
        return Simulator(self.specimen, self.finger)

    @cached_property
    def _inverse_dynamics(self) -> Callable:
        return jax.jit(rigid_body.inverse_dynamics, compiler_options=quick_options())

    @cached_property
    def _mass_matrix(self) -> Callable:
        return jax.jit(rigid_body.mass_matrix, compiler_options=quick_options())

    @cached_property
    def _fingertip(self) -> Callable:
        return jax.jit(rigid_body.fingertip, compiler_options=quick_options())

    def _rigid_body(self, *state: Float[Array, "m N"]) -> Float[Array, "m N"]:
        """M q̈ + N + G, N m, computed in blocks of BLOCK_SAMPLES."""
        samples = state[0].shape[1]
        padded = -(-samples // BLOCK_SAMPLES) * BLOCK_SAMPLES
        state = tuple(np.pad(x, ((0, 0), (0, padded - samples)), mode="edge") for x in state)
        blocks = [
            np.asarray(self._inverse_dynamics(self.finger, *(jnp.asarray(x[:, k : k + BLOCK_SAMPLES]) for x in state)))
            for k in range(0, padded, BLOCK_SAMPLES)
        ]
        return np.concatenate(blocks, axis=1)[:, :samples]


def joint_tension(tension: Float[Array, "n N"], loss: Float[Array, "n N"]) -> Float[Array, "n N"]:
    """Tension at a held joint, N: f_j = clip(previous f_j, f_t − loss, f_t + loss), sample by sample, from slack on."""
    reached = np.zeros_like(tension)
    for k in np.flatnonzero(tension.any(axis=1)):
        f = 0.0
        low, high = (tension[k] - loss[k]).tolist(), (tension[k] + loss[k]).tolist()
        for i, bounds in enumerate(zip(low, high, strict=True)):
            f = min(max(f, bounds[0]), bounds[1])
            reached[k, i] = f
    return reached
