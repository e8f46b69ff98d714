"""The simulated rig's tension controller for VD.3: feed-forward for the desired motion, and feedback of its error."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.specimen import Specimen

Array = Any  # NumPy or JAX
MIN_JOINT_TENSION = 0.7  # N at the joints in the feed-forward, so that no tendon falls slack
MIN_ACTUATOR_TENSION = 0.5  # N at the actuator after feedback, which may ask for less
FADE_SPEED = 0.05  # rad/s. Below it the feed-forward of friction fades, so that tension does not jump at a reversal.
# Feedback on the joints. At the paper finger's MCP (9e-5 kg m² with the finger straight) its natural frequency is 9 Hz
# and its damping ratio 0.6; joints further out are damped more.
STIFFNESS = 0.3  # N m/rad
DAMPING = 0.006  # N m s/rad
TENSION_LAG = 0.01  # s, time constant of the tension loop
MIN_LEVERAGE = 1e-6  # m²: a joint with moment arms below 1 mm gets no more feedback than one of 1 mm.


class Targets(NamedTuple):
    """Desired motion and feed-forward tension. Time is the last axis."""

    q: Float[Array, "m N"]  # rad
    qd: Float[Array, "m N"]  # rad/s
    tension: Float[Array, "n N"]  # N


class TensionController(NamedTuple):
    """Controller that tracks `targets` by the tendons' tensions."""

    targets: Targets
    active: Float[Array, " n"]  # 1 or 0
    leverage: Float[Array, " m"]  # m²: sum over tendons of the squared mean moment arm at each joint

    def tension(self, specimen: Specimen, q, v, before, target: Targets, dt):
        """Return the next tension (n,), N. The tension loop follows its command with a first-order lag.

        The feedback torque τ becomes the tension C (τ / Σ c²), which gives the joints the torque CᵀC (τ / Σ c²). What a
        joint's own error contributes to its torque acts against the error: the diagonal of CᵀC is positive.
        """
        torque = STIFFNESS * (target.q - q) + DAMPING * (target.qd - v)
        command = target.tension + specimen.moment_arm(q) @ (torque / self.leverage)
        command = self.active * jnp.maximum(command, MIN_ACTUATOR_TENSION)
        return before + (1.0 - jnp.exp(-dt / TENSION_LAG)) * (command - before)


def feedforward(specimen: Specimen, plan: TrialPlan, rigid_body: Float[Array, "m N"]) -> TensionController:
    """Return the controller of a VD.3 plan. `rigid_body` is M q̈ + N + G along the plan, N m."""
    C = specimen.moment_arm(plan.q)
    needed = rigid_body + specimen.elastic(plan.q) + specimen.viscous(plan.qd)
    needed = needed + np.tanh(plan.qd / FADE_SPEED) * specimen.coulomb(plan.q)
    active = np.asarray(specimen.description.active, dtype=float)
    at_joint = distribute(C * active[:, None, None], needed) * active[:, None]
    rate = np.einsum("nmt,mt->nt", C, plan.qd)
    arm = np.abs(C).max(axis=(1, 2))[:, None] + 1e-12
    tension = at_actuator(specimen, at_joint, np.tanh(rate / (FADE_SPEED * arm))) * active[:, None]
    mean_arm = (C * active[:, None, None]).mean(axis=2)
    return TensionController(
        Targets(plan.q, plan.qd, np.maximum(tension, MIN_ACTUATOR_TENSION * active[:, None])),
        active,
        np.maximum((mean_arm**2).sum(axis=0), MIN_LEVERAGE),
    )


def distribute(C: Float[Array, "n m N"], torque: Float[Array, "m N"], sweeps: int = 300) -> Float[Array, "n N"]:
    """Return tensions f ≥ MIN_JOINT_TENSION, N, that nearly minimise ‖Cᵀ f − τ‖² + ε ‖f‖² at each sample.

    Projected coordinate descent over the tendons, all samples at once. ε is a thousandth of the largest Σ c² of a
    tendon: small beside the torque, it keeps antagonists from pulling against each other. After 300 sweeps tensions are
    within 0.5 N of the minimum on the paper's finger, and within 2 N on a random one of seven joints. Feedback corrects
    the rest.
    """
    f = np.full((C.shape[0], C.shape[2]), MIN_JOINT_TENSION)
    gram = np.einsum("kmt,jmt->kjt", C, C)
    ridge = 1e-3 * np.einsum("kkt->kt", gram).max(axis=0)
    pull = np.einsum("nmt,mt->nt", C, torque)
    for _ in range(sweeps):
        for k in range(len(f)):
            slope = pull[k] - np.einsum("jt,jt->t", gram[k], f) - ridge * f[k]
            f[k] = np.maximum(f[k] + slope / (gram[k, k] + ridge + 1e-300), MIN_JOINT_TENSION)
    return f


def at_actuator(
    specimen: Specimen, tension: Float[Array, "n N"], direction: Float[Array, "n N"]
) -> Float[Array, "n N"]:
    """Tension f_t at the actuator, N, that gives `tension` f_j at the joints while the tendons slide.

    `direction` is 1 for a tendon that is pulled in, f_j = f_t − loss, and −1 for one that runs out, f_j = f_t + loss;
    values between are interpolated. The loss a₀ + a₁ f_t is never negative.
    """
    a0 = np.asarray(specimen.loss_constant)[:, None]
    a1 = np.asarray(specimen.loss_proportional)[:, None]
    pulled = np.maximum(tension, (tension + a0) / (1.0 - a1))
    released = np.minimum(tension, (tension - a0) / (1.0 + a1))
    share = 0.5 * (1.0 + direction)
    return share * pulled + (1.0 - share) * released
