"""The simulated rig's tension controller for VD.3: feed-forward for the desired motion, and feedback of its error.

The joints are to get the torque τ = τ_ff + K (e + 2 T ė), with the error e = q_d − q and the tension loop's lag T. A
joint that has inertia alone gets the natural frequency ω and the damping ratio ω T from K = M ω². Springs, gravity and
friction have torques of the size of the plan's, which K gives at an error of a quarter of the plan's travel. So the
gains follow from the finger and its motion.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.specimen import Specimen

Array = Any  # NumPy or JAX
TENSION_LAG = 0.01  # s, time constant T of the tension loop
DAMPING_RATIO = 0.6  # of a joint that has inertia alone: its natural frequency is DAMPING_RATIO / TENSION_LAG, 9.5 Hz.
ERROR_SHARE = 0.25  # of the plan's travel: the error at which feedback gives the plan's pull
CROSSOVER = 0.7  # rad from sample to sample, of a joint of little inertia. A quicker loop would be unstable.
# Of the plan's pull: tension at the joints, so that no tendon falls slack. At the actuator it is at least half of that.
MIN_SHARE = 0.1
# Of a joint's fastest planned motion: below it the feed-forward of friction fades, so that tension does not jump at a
# reversal.
FADE_SHARE = 0.1
RIDGE = 1e-3  # of the largest Σ c² of a tendon. Small beside the torque, it keeps antagonists from pulling in vain.
SWEEPS, FIRST_SWEEPS = 10, 300  # of `distribute`: from the last sample's tensions, and from none


class Targets(NamedTuple):
    """Desired motion and the torque that it takes. Time is the last axis."""

    q: Float[Array, "m N"]  # rad
    qd: Float[Array, "m N"]  # rad/s
    torque: Float[Array, "m N"]  # N m


class Tensions(NamedTuple):
    """Tensions of the tendons, N."""

    joint: Float[Array, " n"]  # as the joints are to get them
    actuator: Float[Array, " n"]


class TensionController(NamedTuple):
    """Controller that tracks `targets` by the tendons' tensions."""

    targets: Targets
    stiffness: Float[Array, "m m"]  # K, N m/rad
    arm: Float[Array, " m"]  # m: a joint's moment arms, root of their sum of squares
    fade: Float[Array, " m"]  # rad/s
    least: Float[Array, " n"]  # N at the joints; 0 for tendons that are not active

    def at_rest(self, specimen: Specimen, target: Targets) -> Tensions:
        """Return the tensions that hold the finger in the first sample's posture."""
        f = self._distributed(specimen, target.q, target.torque, self.least, FIRST_SWEEPS)
        return Tensions(f, self._command(specimen, target.q, f, target))

    def tension(self, specimen: Specimen, q, v, before: Tensions, target: Targets, dt) -> Tensions:
        """Return the next tensions. The tension loop follows its command with a first-order lag."""
        torque = target.torque + self.stiffness @ (target.q - q + 2.0 * TENSION_LAG * (target.qd - v))
        f = self._distributed(specimen, q, torque, before.joint, SWEEPS)
        share = 1.0 - jnp.exp(-dt / TENSION_LAG)
        return Tensions(f, before.actuator + share * (self._command(specimen, q, f, target) - before.actuator))

    def _distributed(self, specimen: Specimen, q, torque, start, sweeps: int):
        """Tensions at the joints. Torques over their arms are in N for joints that turn and for those that slide."""
        C = jnp.where(self.least[:, None] > 0.0, specimen.moment_arm(q), 0.0)
        return distribute(C / self.arm[None], torque / self.arm, self.least, start, sweeps)

    def _command(self, specimen: Specimen, q, f, target: Targets):
        """Tension at the actuators that gives the joints the tension f while the tendons slide as planned."""
        C = specimen.moment_arm(q)
        direction = jnp.tanh(C @ target.qd / (jnp.abs(C) @ self.fade + 1e-300))
        return jnp.where(self.least > 0.0, jnp.maximum(at_actuator(specimen, f, direction), 0.5 * self.least), 0.0)


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
    return TensionController(Targets(plan.q, plan.qd, torque), stiffness, arm, fade, MIN_SHARE * pull * active)


def distribute(
    C: Float[Array, "n m"],
    torque: Float[Array, " m"],
    least: Float[Array, " n"],
    start: Float[Array, " n"],
    sweeps: int,
) -> Float[Array, " n"]:
    """Return tensions f ≥ `least`, N, that nearly minimise ‖Cᵀ f − τ‖² + ε ‖f‖², by projected coordinate descent."""
    A = C @ C.T
    A = A + RIDGE * jnp.max(jnp.diagonal(A)) * jnp.eye(len(A))
    pull = C @ torque

    def project(k, f):
        return f.at[k].set(jnp.maximum(f[k] + (pull[k] - A[k] @ f) / (A[k, k] + 1e-300), least[k]))

    return jax.lax.fori_loop(0, sweeps, lambda _, f: jax.lax.fori_loop(0, len(A), project, f), start)


def at_actuator(specimen: Specimen, tension: Float[Array, " n"], direction: Float[Array, " n"]) -> Float[Array, " n"]:
    """Tension f_t at the actuator, N, that gives `tension` f_j at the joints while the tendons slide.

    `direction` is 1 for a tendon that is pulled in, f_j = f_t − loss, and −1 for one that runs out, f_j = f_t + loss;
    values between are interpolated. The loss a₀ + a₁ f_t is never negative.
    """
    a0, a1 = np.asarray(specimen.loss_constant), np.asarray(specimen.loss_proportional)
    pulled = jnp.maximum(tension, (tension + a0) / (1.0 - a1))
    released = jnp.minimum(tension, (tension - a0) / (1.0 + a1))
    share = 0.5 * (1.0 + direction)
    return share * pulled + (1.0 - share) * released
