"""The rig's tension controller for VD.3: feed-forward of what the motion needs, and feedback along the moment arms."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.specimen import Specimen

Array = Any  # NumPy or JAX
LEAST = 0.7  # N at the joints, so that no tendon falls slack
FLOOR = 0.5  # N at the actuator
SLOW = 0.05  # rad/s: below it the feed-forward of friction fades, so that tension does not jump at a reversal
STIFFNESS = 0.3  # N m/rad
DAMPING = 0.006  # N m s/rad
LAG = 0.01  # s, of the tension loop


class Targets(NamedTuple):
    """Desired motion and feed-forward tension, time last."""

    q: Float[Array, "m N"]  # rad
    qd: Float[Array, "m N"]  # rad/s
    tension: Float[Array, "n N"]  # N


class Controller(NamedTuple):
    """Tension that tracks `targets`."""

    targets: Targets
    active: Float[Array, " n"]  # 1 or 0
    leverage: Float[Array, " m"]  # m²: sum of the squared moment arms at each joint

    def tension(self, specimen: Specimen, q, v, before, target: Targets, dt):
        """Next tension, N: the tension loop follows its command with a first-order lag.

        Feedback torque τ becomes tension C τ / Σ c², whose torque CᵀC τ / Σ c² always acts against the error.
        """
        torque = STIFFNESS * (target.q - q) + DAMPING * (target.qd - v)
        command = target.tension + specimen.moment_arm(q) @ (torque / self.leverage)
        command = self.active * jnp.maximum(command, FLOOR)
        return before + (1.0 - jnp.exp(-dt / LAG)) * (command - before)


def feedforward(specimen: Specimen, plan: TrialPlan, rigid_body: Float[Array, "m N"]) -> Controller:
    """The controller of a plan, whose motion takes the torque `rigid_body`, N m, without elasticity and friction."""
    C = specimen.moment_arm(plan.q)
    needed = rigid_body + specimen.elastic(plan.q) + specimen.viscous(plan.qd)
    needed = needed + np.tanh(plan.qd / SLOW) * specimen.coulomb(plan.q)
    active = np.asarray(specimen.description.active, dtype=float)
    at_joint = distribute(C * active[:, None, None], needed) * active[:, None]
    rate = np.einsum("nmt,mt->nt", C, plan.qd)
    arm = np.abs(C).max(axis=(1, 2))[:, None] + 1e-12
    tension = at_actuator(specimen, at_joint, np.tanh(rate / (SLOW * arm))) * active[:, None]
    leverage = (C * active[:, None, None] ** 2).mean(axis=2)
    return Controller(
        Targets(plan.q, plan.qd, np.maximum(tension, FLOOR * active[:, None])),
        active,
        np.maximum((leverage**2).sum(axis=0), 1e-6),
    )


def distribute(C: Float[Array, "n m N"], torque: Float[Array, "m N"], sweeps: int = 300) -> Float[Array, "n N"]:
    """Tensions of at least `LEAST` N with Cᵀ f = τ as nearly as they can, and small: coordinate descent, all samples
    at once, on ‖Cᵀ f − τ‖² + ε ‖f‖²."""
    f = np.full((C.shape[0], C.shape[2]), LEAST)
    gram = np.einsum("kmt,jmt->kjt", C, C)
    ridge = 1e-3 * np.einsum("kkt->kt", gram).max(axis=0)
    pull = np.einsum("nmt,mt->nt", C, torque)
    for _ in range(sweeps):
        for k in range(len(f)):
            slope = pull[k] - np.einsum("jt,jt->t", gram[k], f) - ridge * f[k]
            f[k] = np.maximum(f[k] + slope / (gram[k, k] + ridge + 1e-300), LEAST)
    return f


def at_actuator(
    specimen: Specimen, tension: Float[Array, "n N"], direction: Float[Array, "n N"]
) -> Float[Array, "n N"]:
    """Tension at the actuator, N, that brings `tension` to the joints while the tendon slides in `direction` (−1 … 1).

    Sliding in: f_j = f_t − loss; out: f_j = f_t + loss; the loss a₀ + a₁ f_t is never negative.
    """
    a0 = np.asarray(specimen.loss_constant)[:, None]
    a1 = np.asarray(specimen.loss_proportional)[:, None]
    pulled = np.maximum(tension, (tension + a0) / (1.0 - a1))
    released = np.minimum(tension, (tension - a0) / (1.0 + a1))
    share = 0.5 * (1.0 + direction)
    return share * pulled + (1.0 - share) * released
