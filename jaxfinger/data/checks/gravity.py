"""Check the direction of gravity in the base frame against the torques of ID.3.

At one posture of the other joints the weight of a joint's links cannot be told from its elastic torque: both are curves
over the joint's angle. At another posture the weight is another curve, and the elastic torque the same one. So torques
at several postures show the gravity vector g, which acts with levers(q) · g (`gravity_levers`), along the directions
that the postures tell apart:

    τ = elastic(qᵢ) + zero + friction sign(q̇ᵢ) + damping q̇ᵢ + inertia q̈ᵢ − levers(q) · g

Each trial has its own zero, as of a sensor that is tared, and its own friction. Only the shapes of curves count.

Where one trial moves several joints, as of an arm, other joints' angles change all the time, and each torque shows its
own multiple of levers · g: far from one it has another unit, a wrong sign, or belongs to a motor before its gear. Where
too little is left of the weight beside curves over the joint's own angle, as of an upright arm, springs could explain
torques that go against it; but hardly at several joints at once, each with about twice the weight. One alone is noted.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxfinger.data.checks.blocks import MIN_POSTURE, Motion, motion_of
from jaxfinger.data.findings import Report
from jaxfinger.data.mounting import gravity_levers
from jaxfinger.data.session import FingerDescription, Session, Trial, moving_joints
from jaxfinger.errors import listed

_ANGLES = 30  # Parts of a joint's range. Departures from the model are alike within one, so it counts as one value.
_DEGREE = 5  # of the elastic torque over the angle: a spring that stiffens towards both of its ends
_MAX_STD = 0.12  # of gravity: the change that is reported is then six standard deviations.
# Of gravity, the length of its change: that of a turn by 45°, half of the quarter turn that the smallest mistake makes.
_MIN_TURN = 0.77
# Of gravity: the largest that torques may show. Masses and their places are right to some per cent, and torques that
# show more have another reason.
_MAX_GRAVITY = 1.25
_MAX_SCALE = 2.0  # of a torque, up or down: masses and their places are known better than that.
# Of the weight's torque: what must be left of it beside curves over the joint's own angle. At this share, another
# torque of a twentieth of the weight passes for half of its scale. Less is left where joints move in proportion.
_MIN_REST = 0.1
# Of a torque's variance, what the weight explains where the torque follows it.
_MIN_FOLLOWED = 0.9


class _Equations(NamedTuple):
    """levers · g = torques, without the parts that the other terms explain."""

    levers: np.ndarray  # (N, 3)
    torques: np.ndarray  # (N,)
    free: int  # values that differ from each other beyond the number of other terms


def check_gravity(session: Session, report: Report) -> None:
    """Report a gravity vector that contradicts the torques which hold the finger's weight."""
    finger, size = session.finger, float(np.linalg.norm(session.finger.gravity))
    if any(finger.prismatic) or size == 0.0:
        return
    coupled = _coupled(finger)
    motions: dict[int, list[Motion]] = defaultdict(list)
    for trial in session.select("ID.3-static", "ID.3-dynamic"):
        if (i := finger.joint(trial.joint)) is not None and i not in coupled:
            motions[i] += motion_of(trial, i, [i])
    told = [i for i, of in motions.items() if _postures(of, i) > MIN_POSTURE]
    parts = [_equations(finger, i, motions[i]) for i in told]
    if not parts:
        return
    levers, torques = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    _, sizes, ways = np.linalg.svd(levers, full_matrices=False)
    misfit = torques - levers @ np.linalg.lstsq(levers, torques)[0]
    noise = np.sqrt(misfit @ misfit / max(sum(part.free for part in parts), 1))
    # Directions along which torques show gravity. Smaller sizes are rounding.
    known = ways[(noise < _MAX_STD * size * sizes) & (sizes > 1e-6 * sizes[0])]
    if not len(known):
        return
    seen = np.linalg.lstsq(levers @ known.T, torques)[0]
    change = seen - known @ finger.gravity
    if np.linalg.norm(change) > _MIN_TURN * size and np.linalg.norm(seen) < _MAX_GRAVITY * size:
        way = change @ known / np.linalg.norm(change)
        names = [finger.joint_names[i] for i in told]
        report.warning(
            "/finger",
            f"has `gravity` with {way @ finger.gravity:.2g} m s-2 along ({', '.join(f'{x:.2f}' for x in way)}), and "
            f"torques at several postures (ID.3) show {way @ (seen @ known):.2g}: correct `gravity`, `axis` or `com`, "
            f"or the signs of q and joint_torque of {listed(names)}",
        )


def check_torque_scales(session: Session, report: Report) -> None:
    """Report torques that are no plausible multiple of what gravity takes, in trials that move several joints."""
    finger = session.finger
    if not finger.gravity.any():
        return
    coupled = _coupled(finger)
    for trial in session.select("ID.3-static", "ID.3-dynamic"):
        moving = [finger.joint_names.index(name) for name in moving_joints(trial, finger)]
        if trial.joint is not None or len(moving) < 2:
            continue
        told = [i for i in moving if i not in coupled and not finger.prismatic[i]]
        scales = {i: _torque_scale(finger, i, motion) for i in told for motion in motion_of(trial, i, moving)}
        wrong = [
            f"{scale:.2g} of it at {finger.joint_names[i]}"
            for i, scale in scales.items()
            if scale is not None and not 1.0 / _MAX_SCALE < scale < _MAX_SCALE
        ]
        if wrong:
            report.warning(
                trial.place("joint_torque"),
                f"is not what gravity takes, with {listed(wrong)}: correct its scale (of a motor's current, or of its "
                "torque before the gear) or its sign, or `mass` and `com`",
            )
            continue
        follows = _following_gravity(finger, trial, [i for i, scale in scales.items() if scale is None], moving)
        against = {name: s for name, s in follows.items() if -_MAX_SCALE < s < -1.0 / _MAX_SCALE}
        named = listed([f"{scale:.2g} of what it takes at {name}" for name, scale in against.items()])
        if len(against) > 1 and all(scale < 0.0 for scale in follows.values()):
            report.warning(
                trial.place("joint_torque"),
                f"goes against gravity, with {named}: correct its sign, that of q, or `gravity`, unless springs of "
                "twice the weight act at each of these joints",
            )
        elif against:
            report.note(
                trial.place("joint_torque"),
                f"goes against gravity, with {named}: springs of twice the weight act there, or its sign or that of q "
                "is wrong",
            )


def _following_gravity(
    finger: FingerDescription, trial: Trial, joints: Sequence[int], moving: Sequence[int]
) -> dict[str, float]:
    """Joints whose torque goes as the weight or against it, with its multiple."""
    follows = {}
    for i in joints:
        for motion in motion_of(trial, i, moving):
            weight = -gravity_levers(finger, motion.q)[:, i] @ finger.gravity
            own = np.column_stack([np.ones(len(weight)), motion.direction])
            wanted = np.column_stack([weight, motion.torque])
            left = wanted - own @ np.linalg.lstsq(own, wanted)[0]
            (size, product), (_, whole) = left.T @ left
            if product**2 > _MIN_FOLLOWED * size * whole:
                follows[finger.joint_names[i]] = float(product / size)
    return follows


def _torque_scale(finger: FingerDescription, i: int, motion: Motion) -> float | None:
    """Torque of joint i over the one that gravity takes; None where the motion does not tell."""
    levers, torques, free = _equations(finger, i, [motion])
    weight = levers @ finger.gravity
    size, whole = weight @ weight, np.var(gravity_levers(finger, motion.q)[:, i] @ finger.gravity)
    if size == 0.0 or size < _MIN_REST**2 * whole * len(weight):
        return None
    scale = weight @ torques / size
    misfit = torques - scale * weight
    noise = np.sqrt(misfit @ misfit / max(free, 1) / size)
    return float(scale) if noise < _MAX_STD else None


def _coupled(finger: FingerDescription) -> set[int]:
    """Joints that share a passive tendon with another joint: their elastic torque depends on the other's angle."""
    shared = ~finger.active & (finger.crosses.sum(axis=1) > 1)
    return set(np.flatnonzero(finger.crosses[shared].any(axis=0)).tolist())


def _postures(motions: list[Motion], i: int) -> float:
    """Largest change of another joint's angle from trial to trial, rad."""
    if not motions:
        return 0.0
    means = np.delete([motion.q.mean(axis=0) for motion in motions], i, axis=1)
    return float(np.ptp(means, axis=0).max(initial=0.0))


def _equations(finger: FingerDescription, i: int, motions: list[Motion]) -> _Equations:
    """What the trials of joint i say of gravity."""
    q = np.concatenate([motion.q for motion in motions])
    angle = (q[:, i] - q[:, i].min()) / np.ptp(q[:, i])
    own, values, end = np.zeros((len(q), 3 * len(motions))), 0, 0  # `own`: zero and friction of each trial
    for k, motion in enumerate(motions):
        begin, end = end, end + len(motion.q)
        x = angle[begin:end]
        own[begin:end, 3 * k : 3 * k + 3] = np.column_stack([np.ones(len(x)), motion.direction, motion.direction * x])
        values += len(np.unique((_ANGLES * x).astype(int)))
    dynamics = np.concatenate([motion.dynamics for motion in motions])
    others = np.column_stack([np.vander(angle, _DEGREE + 1)[:, :-1], dynamics, own])
    wanted = np.column_stack([-gravity_levers(finger, q)[:, i], np.concatenate([motion.torque for motion in motions])])
    wanted -= others @ np.linalg.lstsq(others, wanted)[0]
    return _Equations(wanted[:, :3], wanted[:, 3], values - others.shape[1])
