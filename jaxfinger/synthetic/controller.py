"""The simulated rig's tension controller for VD.3: feed-forward for the desired motion, and feedback of its error.

The joints are to get the torque τ = τ_ff + K (e + 2 T ė), with the error e = q_d − q and the tension loop's lag T. A
joint that has inertia alone gets the natural frequency ω and the damping ratio ω T from K = M ω². Springs, gravity and
friction have torques of the size of the plan's, which K gives at an error of a quarter of the plan's travel. So the
gains follow from the finger and its motion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.specimen import Specimen

Array = Any  # NumPy or JAX
TENSION_LAG = 0.01  # s, time constant T of the tension loop
DAMPING_RATIO = 0.6  # of a joint that has inertia alone: its natural frequency is DAMPING_RATIO / TENSION_LAG, 9.5 Hz.
# Of the plan's travel: the error at which feedback gives the plan's pull. Friction of a tenth of the pull, which fades
# from the feed-forward at a reversal, is then made up for at a fortieth of the travel.
ERROR_SHARE = 0.25
# rad from sample to sample: highest frequency at which feedback, whose gain above the loop's lag is 2 K, may equal a
# joint's inertia. The half sample for which a tension is held on average is a phase of 0.35 rad there.
CROSSOVER = 0.7
# Of the plan's pull: tension at the joints, so that no tendon falls slack. At the actuator it is at least half of that.
# The paper's finger, whose DIP has no flexor, can hold 0.15 at most.
MIN_SHARE = 0.1
# Times the dead zone of a tendon's friction: the other lower bound of the tension at the joints. Half of it at the
# actuator is still outside of that zone, in which the loss shows neither a₀ nor a₁.
MIN_TO_DEAD = 3.0
# Of a joint's fastest planned motion: below it the feed-forward of friction fades, so that tension does not jump at a
# reversal.
FADE_SHARE = 0.1
# ε, beside moment arms that are scaled to about one. It keeps antagonists from pulling in vain, and the feedback of
# joints that no tendon crosses defined. The torques, over their arms, are off by ε N per N of tension at most.
RIDGE = 1e-4


class Targets(NamedTuple):
    """Desired motion and feed-forward tension. Time is the last axis."""

    q: Float[Array, "m N"]  # rad
    qd: Float[Array, "m N"]  # rad/s
    tension: Float[Array, "n N"]  # N, at the actuators


class TensionController(NamedTuple):
    """Controller that tracks `targets` by the tendons' tensions."""

    targets: Targets
    stiffness: Float[Array, "m m"]  # K, N m/rad
    arm: Float[Array, " m"]  # m: a joint's moment arms, root of their sum of squares
    least: Float[Array, " n"]  # N at the actuators; 0 for tendons that are not active

    def tension(self, specimen: Specimen, q, v, before, target: Targets, dt):
        """Return the next tension (n,), N. The tension loop follows its command with a first-order lag.

        The feedback's torques become the smallest tensions that give them, positive or negative. Torques over their
        arms are in N for joints that turn and for those that slide.
        """
        torque = self.stiffness @ (target.q - q + 2.0 * TENSION_LAG * (target.qd - v))
        C = jnp.where(self.least[:, None] > 0.0, specimen.moment_arm(q), 0.0) / self.arm[None]
        feedback = C @ jnp.linalg.solve(C.T @ C + RIDGE * jnp.eye(len(torque)), torque / self.arm)
        command = jnp.maximum(target.tension + feedback, self.least)
        return before + (1.0 - jnp.exp(-dt / TENSION_LAG)) * (command - before)


def controller(
    specimen: Specimen, plan: TrialPlan, rigid_body: Float[Array, "m N"], mass_matrix: Float[Array, "m m"]
) -> TensionController:
    """Return the controller of a VD.3 plan.

    `rigid_body` is M q̈ + N + G along the plan, N m, and `mass_matrix` M in its middle, kg m².
    """
    active = np.asarray(specimen.description.active, dtype=float)
    fade = FADE_SHARE * np.abs(plan.qd).max(axis=1)
    torque = rigid_body + specimen.elastic(plan.q) + specimen.viscous(plan.qd)
    torque = torque + np.tanh(plan.qd / (fade[:, None] + 1e-300)) * specimen.coulomb(plan.q)
    C = specimen.moment_arm(plan.q).mean(axis=2) * active[:, None]
    arm = np.sqrt((C**2).sum(axis=0))
    arm = np.where(arm > 0.0, arm, np.inf)  # A joint that no tendon crosses gets no torque.
    pull = np.max(np.abs(torque).max(axis=1) / arm)  # N
    travel = np.maximum(np.ptp(plan.q, axis=1), 1e-3 * np.ptp(specimen.description.limits, axis=1))
    most = 0.5 * np.diagonal(mass_matrix) * (CROSSOVER / (plan.time[1] - plan.time[0])) ** 2
    held = np.minimum(np.where(np.isfinite(arm), pull * arm, 0.0) / (ERROR_SHARE * travel), most)
    stiffness = mass_matrix * (DAMPING_RATIO / TENSION_LAG) ** 2 + np.diag(held)
    C = specimen.moment_arm(plan.q) * active[:, None, None]
    taut = np.maximum(MIN_SHARE * pull, MIN_TO_DEAD * dead_zone(specimen)) * active
    at_joint = distribute(C / arm[:, None], torque / arm[:, None], taut)
    direction = np.tanh(np.einsum("nmt,mt->nt", C, plan.qd) / (np.einsum("nmt,m->nt", np.abs(C), fade) + 1e-300))
    least = 0.5 * taut
    tension = np.maximum(at_actuator(specimen, at_joint, direction) * active[:, None], least[:, None])
    return TensionController(Targets(plan.q, plan.qd, tension), stiffness, arm, least)


def dead_zone(specimen: Specimen) -> Float[np.ndarray, " n"]:
    """Tension, N, below which friction keeps the pull of a tendon from the joints: a₀ / (1 − a₁)."""
    a0, a1 = (np.asarray(a) for a in (specimen.loss_constant, specimen.loss_proportional))
    return np.maximum(a0, 0.0) / (1.0 - a1)


def distribute(
    C: Float[np.ndarray, "n m N"], torque: Float[np.ndarray, "m N"], least: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n N"]:
    """Return tensions f ≥ `least`, N, that minimise ‖Cᵀ f − τ‖² + ε² ‖f‖² at each sample, with ε `RIDGE`."""
    f = np.empty((len(least), torque.shape[1]))
    for t, (arms, wanted) in enumerate(zip(np.moveaxis(C, 2, 0), torque.T, strict=True)):
        A = np.concatenate([arms.T, RIDGE * np.eye(len(least))])
        f[:, t] = least + nnls(A, np.append(wanted, 0.0 * least) - A @ least)[0]
    return f


def at_actuator(
    specimen: Specimen, tension: Float[Array, "n N"], direction: Float[Array, "n N"]
) -> Float[Array, "n N"]:
    """Tension f_t at the actuator, N, that gives `tension` f_j at the joints while the tendons slide.

    `direction` is 1 for a tendon that is pulled in, f_j = f_t − loss, and −1 for one that runs out, f_j = f_t + loss;
    values between are interpolated. The loss a₀ + a₁ f_t is never negative.
    """
    a0, a1 = (np.asarray(a)[:, None] for a in (specimen.loss_constant, specimen.loss_proportional))
    pulled = np.maximum(tension, (tension + a0) / (1.0 - a1))
    released = np.minimum(tension, (tension - a0) / (1.0 + a1))
    share = 0.5 * (1.0 + direction)
    return share * pulled + (1.0 - share) * released
