"""What happens at the finger when a plan is run: channels without noise, at the plan's instants, batch last."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.model import rigid_body
from jaxfinger.model.finger import Finger
from jaxfinger.synthetic.driven import drive
from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.specimen import Specimen

Array = np.ndarray
Channels = dict[str, Float[Array, "channels N"]]
BLOCK = 4096  # samples: one compiled rigid-body call serves trials of any length


class Plant(Protocol):
    """Anything that can stand in for the finger on the rig: a specimen, or a fitted model."""

    def prescribed(self, plan: TrialPlan) -> Channels:
        """Motion and tension as planned: `q`, `tendon_force`, and the channels that they cause."""
        ...

    def driven(self, plan: TrialPlan) -> Channels:
        """VD.3: the motion that tendons make of the planned one, and their tensions."""
        ...


class SpecimenPlant:
    """The finger as it really is: equation (1) with the specimen's terms."""

    def __init__(self, specimen: Specimen):
        self.specimen = specimen
        self.finger = Finger.from_description(specimen.description)

    def prescribed(self, plan: TrialPlan) -> Channels:
        """All channels of the plan's experiment; those that the rig does not measure are left out later."""
        channels = {"q": plan.q, "tendon_force": plan.tension, "tendon_excursion": self.specimen.excursion(plan.q)}
        if plan.experiment.startswith("ID.3"):
            channels["joint_torque"] = self._torque(plan, np.zeros_like(plan.tension))
        elif plan.held:
            torque = self._torque(plan, joint_tension(plan.tension, self.specimen.loss(plan.tension)))
            channels["fingertip_force" if plan.experiment == "VD.2" else "joint_torque"] = (
                self._contact_force(plan.q, torque) if plan.experiment == "VD.2" else torque
            )
        return channels

    def driven(self, plan: TrialPlan) -> Channels:
        """Forward simulation under the rig's tracking controller.

        Raises:
            UserError: the motion leaves the joints' limits.
        """
        q, tension = drive(self.specimen, self.finger, plan)
        return {"q": q, "tendon_force": tension, "tendon_excursion": self.specimen.excursion(q)}

    def _torque(self, plan: TrialPlan, tension: Float[Array, "n N"]) -> Float[Array, "m N"]:
        """τ_ext of (1), N m: M q̈ + N + G + τ_k + τ_d + τ_f − Cᵀ (f_t − f_f). A held joint carries no friction."""
        direction = np.zeros_like(plan.q) if plan.joint_direction is None else plan.joint_direction
        tau = self._rigid_body(plan.q, plan.qd, plan.qdd)
        tau = tau + self.specimen.elastic(plan.q) + self.specimen.viscous(plan.qd)
        tau = tau + direction * self.specimen.coulomb(plan.q)
        if tension.any():
            tau = tau - np.einsum("nmt,nt->mt", self.specimen.moment_arm(plan.q), tension)
        return tau

    def _contact_force(self, q: Float[Array, "m N"], torque: Float[Array, "m N"]) -> Float[Array, "3 N"]:
        """Least-squares solution of Jᵀ f_ext = τ, N; the joints do not move, so that one Jacobian serves the trial.

        What a planar contact force cannot take is taken by the joints' static friction (dataset format, VD.2).
        """
        _, jacobian = rigid_body.fingertip(self.finger, jnp.asarray(q[:, 0]))
        return np.linalg.pinv(np.asarray(jacobian).T, rcond=1e-9) @ torque

    @cached_property
    def _inverse_dynamics(self) -> Callable:
        return eqx.filter_jit(rigid_body.inverse_dynamics)

    def _rigid_body(self, *state: Float[Array, "m N"]) -> Float[Array, "m N"]:
        """M q̈ + N + G, in blocks of equal length."""
        samples = state[0].shape[1]
        padded = -(-samples // BLOCK) * BLOCK
        state = tuple(np.pad(x, ((0, 0), (0, padded - samples)), mode="edge") for x in state)
        blocks = [
            np.asarray(self._inverse_dynamics(self.finger, *(jnp.asarray(x[:, k : k + BLOCK]) for x in state)))
            for k in range(0, padded, BLOCK)
        ]
        return np.concatenate(blocks, axis=1)[:, :samples]


def joint_tension(tension: Float[Array, "n N"], loss: Float[Array, "n N"]) -> Float[Array, "n N"]:
    """Tension at a held joint, N, from slack on: f_j = clip(f_j before, f_t − loss, f_t + loss), sample by sample."""
    reached = np.zeros_like(tension)
    for k in np.flatnonzero(tension.any(axis=1)):
        f = 0.0
        low, high = (tension[k] - loss[k]).tolist(), (tension[k] + loss[k]).tolist()
        for i, bounds in enumerate(zip(low, high, strict=True)):
            f = min(max(f, bounds[0]), bounds[1])
            reached[k, i] = f
    return reached
