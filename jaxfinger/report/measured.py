"""Measured points of a model's curves: slopes of excursions, torques of holds, losses of tension."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxfinger.data import Session
from jaxfinger.experiments import Stack, predict_compiled
from jaxfinger.model import Model, TendonFriction, rigid_body

# Of the largest moment arm at the joint: with a shorter one an error of the torque is a large error of the tension.
MIN_ARM_SHARE = 0.1
STROKE_PARTS = 6  # Parts of a joint's stroke in ID.2, with one slope each: enough to show a moment arm of degree 4.
MIN_SAMPLES = 8  # Samples of a part: twice the four coefficients that are fitted to them.
# Of the highest tension, by which a hold's must exceed that of all holds before it, so that tension was rising.
MIN_STEP_SHARE = 0.01


@dataclass(frozen=True)
class Points:
    """Measured values y at x, without error bars: their scatter shows their error."""

    x: Float[np.ndarray, " P"]
    y: Float[np.ndarray, " P"]


def arm_points(session: Session, stack: Stack) -> dict[tuple[str, str], Points]:
    """Moment arms by tendon and joint, in mm against degrees (dimensionless against mm for a sliding joint).

    A trial of ID.2 moves one joint, so that the moment arm is the slope of a tendon's excursion over the angle. One
    slope is taken in each sixth of the stroke, from both directions together, so that the tendon's friction cancels.
    """
    finger = session.finger
    q, time = np.asarray(stack.batch.x.q), np.asarray(stack.batch.x.time)
    y, mask = (np.asarray(a["tendon_excursion"]) for a in (stack.batch.y, stack.batch.mask))
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for b, name in enumerate(stack.trials):
        joint = session[name].joint
        if joint is None:
            continue
        i = finger.joint_names.index(joint)
        angle, arm = (1e3, 1.0) if finger.prismatic[i] else (180 / np.pi, 1e3)
        for k, tendon in enumerate(finger.tendon_names):
            seen = mask[k, b] > 0
            if not (finger.crosses[k][i] and seen.any()):
                continue
            x, length, t = q[i, b][seen], y[k, b][seen], time[b][seen]
            edges = np.linspace(x.min(), x.max(), STROKE_PARTS + 1)
            for low, high in pairwise(edges):
                part = (x >= low) & (x <= high)
                if part.sum() >= MIN_SAMPLES and np.ptp(x[part]) > 0.5 * (high - low):
                    slope = _slope(x[part], length[part], t[part])
                    found.setdefault((tendon, joint), []).append((x[part].mean() * angle, slope * arm))
    return {key: Points(*np.array(rows).T) for key, rows in found.items()}


def _slope(x, y, time) -> float:
    """Slope of y over x at the mean of x, from a least-squares parabola in x plus a linear drift in time."""
    x = x - x.mean()
    columns = np.stack([np.ones_like(x), x, x**2, time - time.mean()], axis=1)
    norm = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return float(np.linalg.lstsq(columns / norm, y, rcond=1e-6)[0][1] / norm[1])


def hold_points(model: Model, stack: Stack) -> dict[tuple[str, int], Points]:
    """Resisting torques τ_ext − G of holds by joint and direction of approach (±1), in N mm against degrees (N, mm)."""
    finger, x = model.finger, stack.batch.x
    y, mask = np.asarray(stack.batch.y["joint_torque"]), np.asarray(stack.batch.mask["joint_torque"])
    h = y - np.asarray(rigid_body.gravity_torque(finger, x.q))
    q, way = np.asarray(x.q), np.asarray(x.joint_direction)
    found: dict[tuple[str, int], list[tuple[float, float]]] = {}
    for i, b in np.ndindex(y.shape[:2]):
        angle, torque = (1e3, 1.0) if finger.prismatic[i] else (180 / np.pi, 1e3)
        for run in stack.samples_of_holds(b, mask[i, b]):
            key = finger.joint_names[i], int(np.sign(way[i, b, run].mean()))
            found.setdefault(key, []).append((q[i, b, run].mean() * angle, h[i, b, run].mean() * torque))
    return {key: Points(*np.array(rows).T) for key, rows in found.items()}


def loss_points(model: Model, session: Session, stack: Stack) -> dict[str, Points]:
    """Tension lost by tendon, in N against tension in N, in each hold of rising tension.

    The loss is the measured torque less that of equation (1) without tendon friction, over the moment arm.
    """
    frictionless = eqx.tree_at(lambda m: m.tendon_friction, model, TendonFriction.zeros(model.finger.n))
    x = stack.batch.x
    y, mask = np.asarray(stack.batch.y["joint_torque"]), np.asarray(stack.batch.mask["joint_torque"])
    without = np.asarray(predict_compiled(frictionless, x, ("joint_torque",))["joint_torque"])
    C = np.asarray(model.moment_arm.coupling(x.q))
    found: dict[str, list[tuple[float, float]]] = {}
    for b, name in enumerate(stack.trials):
        trial = session[name]
        if trial.tendon is None or trial.joint is None:
            continue
        k, i = session.finger.tendon_names.index(trial.tendon), session.finger.joint_names.index(trial.joint)
        f = np.asarray(x.tension)[k, b]
        min_arm, min_step = MIN_ARM_SHARE * np.abs(C[:, i]).max(), MIN_STEP_SHARE * f.max()
        highest = 0.0
        for run in stack.samples_of_holds(b, mask[i, b]):
            arm = C[k, i, b, run].mean()
            if f[run].mean() > highest + min_step and abs(arm) > min_arm:
                lost = (y[i, b, run] - without[i, b, run]).mean() / arm
                found.setdefault(trial.tendon, []).append((f[run].mean(), lost))
            highest = max(highest, f[run].mean())
    return {tendon: Points(*np.array(rows).T) for tendon, rows in found.items()}
