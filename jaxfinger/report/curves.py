"""Curves of the paper's figures, computed from a fit, and measured points beside them, in units for people."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.data import Session, joints_of
from jaxfinger.data.signals.quantiles import quantile
from jaxfinger.data.signals.sizes import highest_tension
from jaxfinger.experiments import prepare
from jaxfinger.identify import Fit
from jaxfinger.identify.parameters import describe
from jaxfinger.model import Model, rigid_body
from jaxfinger.report.measured import Points, arm_points, hold_points, loss_points

ROUNDING = 1e-12  # of the largest torque of gravity: less is what rounding leaves of none
SAMPLES = 61  # Points of a curve: two degrees apart over a range of 120°, closer than a figure resolves.
EXTREME = 0.01  # share of a trial's angles that spikes may be: a curve leaves out as many at either end
MAX_TENSION = 12.0  # N, where curves of lost tension end without a session: a fifth above the paper's highest, 10 N


@dataclass(frozen=True)
class Curve:
    """A function of one variable with its standard deviation."""

    x: Float[np.ndarray, " S"]
    y: Float[np.ndarray, " S"]
    std: Float[np.ndarray, " S"]

    def range(self) -> tuple[float, float, float]:
        """Largest value, smallest value and largest standard deviation."""
        return float(self.y.max()), float(self.y.min()), float(self.std.max())


@dataclass(frozen=True)
class JointCurves:
    """One joint where ID.3 moved it, torques in N mm (N for a prismatic joint) against degrees (mm)."""

    elastic: Curve
    friction: Curve
    forwards: Curve  # elastic torque and friction while the joint moves slowly in the positive direction
    backwards: Curve  # and in the negative direction
    gravity: Float[np.ndarray, " S"]
    damping: tuple[float, float]  # value and standard deviation, N mm s/rad (N s/m)
    prismatic: bool
    flexing: Points | None = None  # torque of holds that were reached in the positive direction
    extending: Points | None = None  # and in the negative direction


@dataclass(frozen=True)
class Curves:
    """The curves that the paper draws of a model, and measured points if a session was given."""

    moment_arm: dict[tuple[str, str], Curve]  # by tendon and joint: mm against degrees
    joints: dict[str, JointCurves]
    tendon_friction: dict[str, Curve]  # by tendon: tension lost while it slides against tension, both N
    arm_points: dict[tuple[str, str], Points] = field(default_factory=dict)
    loss_points: dict[str, Points] = field(default_factory=dict)


def curves(fit: Fit, session: Session | None = None) -> Curves:
    """Compute the curves of a fit over each joint's range, the other joints in the middle of theirs.

    Curves without an estimated parameter are left out. A session adds measured points: slopes of the excursions of
    ID.2, torques of the holds of ID.3-static, losses of the holds of ID.4. The loss goes to its highest tension, and
    the other curves end where its trials do that the fit has read: a polynomial says nothing beyond.
    """
    return model_curves(fit) if session is None else _with_points(model_curves(fit, session), fit, session)


def _with_points(found: Curves, fit: Fit, session: Session) -> Curves:
    stacks = prepare(session, [t.name for t in session if t.experiment in ("ID.2", "ID.3-static", "ID.4")])
    arms = arm_points(session, stacks["ID.2"]) if "ID.2" in stacks else {}
    holds = hold_points(fit.model, stacks["ID.3-static"]) if "ID.3-static" in stacks else {}
    losses = loss_points(fit.model, session, stacks["ID.4"]) if "ID.4" in stacks else {}
    joints = {j: replace(c, flexing=holds.get((j, 1)), extending=holds.get((j, -1))) for j, c in found.joints.items()}
    return replace(
        found,
        joints=joints,
        arm_points={k: p for k, p in arms.items() if k in found.moment_arm},
        loss_points={t: p for t, p in losses.items() if t in found.tendon_friction},
    )


def model_curves(fit: Fit, session: Session | None = None) -> Curves:
    """Compute the curves without measured points, over the angles and tensions of `session` (`curves`)."""
    tension = MAX_TENSION if session is None else highest_tension(session) or MAX_TENSION
    model, finger = fit.model, fit.model.finger
    m, S = finger.m, SAMPLES
    led, swept = (_each_through(_moved(fit, session, stage)) for stage in ("ID.2", "ID.3"))
    f = np.linspace(0.0, tension, S)
    values, std = fit.function(_Values(*jax.device_put((led, swept, np.tile(f, (finger.n, 1))))))
    cuts = np.cumsum((finger.n * m * S, 4 * m * S, m))
    arms, torques, damping, loss = zip(np.split(values, cuts), np.split(std, cuts), strict=True)
    gravity = np.asarray(_gravity_torque(model.finger, jax.device_put(swept)))
    gravity = np.where(np.abs(gravity) > ROUNDING * np.abs(gravity).max(initial=0.0), gravity, 0.0)

    def shaped(pair, shape):
        return tuple(a.reshape(shape) for a in pair)

    arms, torques = shaped(arms, (finger.n, m, S)), shaped(torques, (4, m, S))
    # A clipped loss keeps the standard deviation of the unclipped law.
    loss = np.clip(loss[0].reshape(finger.n, S), 0.0, f), loss[1].reshape(finger.n, S)
    angle = [(1e3 if p else 180 / np.pi) for p in finger.prismatic]
    torque = [(1.0 if p else 1e3) for p in finger.prismatic]
    estimated = _estimated(fit)
    return Curves(
        {
            (t, j): Curve(led[i, i] * angle[i], arms[0][k, i] * torque[i], arms[1][k, i] * torque[i])
            for k, t in enumerate(finger.tendon_names)
            for i, j in enumerate(finger.joint_names)
            if (t, j) in estimated
        },
        {
            j: JointCurves(
                *(Curve(swept[i, i] * angle[i], *(a[k, i] * torque[i] for a in torques)) for k in range(4)),
                gravity=gravity[i, i] * torque[i],
                damping=(float(damping[0][i] * torque[i]), float(damping[1][i] * torque[i])),
                prismatic=finger.prismatic[i],
            )
            for i, j in enumerate(finger.joint_names)
            if j in estimated
        },
        {t: Curve(f, loss[0][k], loss[1][k]) for k, t in enumerate(finger.tendon_names) if t in estimated},
    )


def _moved(fit: Fit, session: Session | None, experiment: str) -> Float[np.ndarray, "m 2"]:
    """Range of each joint in the trials of an experiment that the fit has read, rad or m; its limits without one."""
    ranges = np.asarray(fit.model.finger.limits).copy()
    if session is None:
        return ranges
    read = {name for stage in fit.stages for name in stage.trials}
    trials = [t for t in session if t.name in read and t.experiment.startswith(experiment) and len(t.time)]
    for i, joint in enumerate(fit.model.finger.joint_names):
        seen = [t.q[:, i] for t in trials if joint in joints_of(t, session.finger)]
        if seen:
            ranges[i] = min(quantile(q, EXTREME) for q in seen), max(quantile(q, 1.0 - EXTREME) for q in seen)
    return ranges


def _each_through(ranges: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m m S"]:
    """Angles of all joints, one joint after another through its range and the others in the middle of theirs."""
    m = len(ranges)
    q = np.tile(ranges.mean(axis=1)[:, None, None], (1, m, SAMPLES))
    for i, (low, high) in enumerate(ranges):
        q[i, i] = np.linspace(low, high, SAMPLES)
    return q


def _estimated(fit: Fit) -> set:
    """Joints, tendons and (tendon, joint) pairs of the parameters that the fit has estimated."""
    found, parameters = set(), describe(fit.model)
    for i in fit.estimated:
        p = parameters[i]
        if p.group == "moment_arm":
            found.add((p.tendon, p.joint))
        elif p.group in ("elastic", "friction", "damping"):
            found.add(p.joint)
        elif p.group == "tendon_friction":
            found.add(p.tendon)
    return found


class _Values(eqx.Module):
    """Function of a model that returns all curves as one flat vector: one derivative gives all standard deviations."""

    led: Float[Array, "m m S"]  # angles at which moment arms are wanted
    swept: Float[Array, "m m S"]  # and torques
    tension: Float[Array, "n S"]

    def __call__(self, model: Model) -> Float[Array, " k"]:
        own, h = np.arange(len(self.led)), model.joint_torque
        C = model.moment_arm.coupling(self.led)  # (n, m, m, S); a joint's own angle varies in its own row
        elastic, friction = (f(self.swept)[own, own] for f in (h.elastic_torque, h.friction_magnitude))
        middle = elastic + h.friction_by_direction[:, None]
        parts = (
            C[:, own, own],
            *(elastic, friction, middle + friction, middle - friction),
            h.damping,
            model.tendon_friction.loss(self.tension),
        )
        return jnp.concatenate([jnp.ravel(p) for p in parts])


_gravity_torque = quick_jit(rigid_body.gravity_torque)
