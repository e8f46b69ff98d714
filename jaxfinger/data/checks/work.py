"""Check that the channels of a session agree with each other. Two laws hold for every finger, whatever its model.

1. Virtual work. A tendon that pulls in dl while a joint turns by dq exerts the torque f dl/dq on it. So the encoders
   (ID.2: dl/dq) and the force sensors (ID.4: −dτ/df, since the motor holds against it) show one moment arm. Friction
   reduces the torque that arrives at the joint but never changes its sign.
2. Passivity. Over a cycle the external motor puts work into a joint and never takes any out: ∮ τ dq > 0.

Where a law fails, a sign, a unit or a column is wrong in one of the channels that the finding names.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.arms import Excursions, slope, thinned
from jaxfinger.data.signals.filtering import low_pass, smooth_rate
from jaxfinger.data.signals.motion import CUTOFF_HZ, STILL_SHARE, directions, fitting_cutoff
from jaxfinger.errors import listed

# Share of the largest arm at a joint: a tendon whose torque shows more should not stand still, but for its stretch
# (`Excursions.still`), nor have a small arm (`Excursions.small_arm`), of which friction would leave less still.
_MIN_FELT_SHARE = 0.5
# Ratio of the arm that torques show to the arm that excursions show. Friction reduces it: routed tendons lose up to two
# thirds of their tension (the shipped session). Units that people confuse differ at least fourfold (N and lbf).
_MIN_ARM_RATIO, _MAX_ARM_RATIO = 0.2, 1.5
# Largest ratio of the arm that excursions show to the largest one that torques allow (`_most_felt`). It lies half-way,
# as ratios count, between 1 and 2, which a diameter for a radius gives, or a load cell at a pulley.
_MAX_SCALE = np.sqrt(2.0)
# Shares of the highest tension. Below the first a tendon is slack before it is pulled. Once it is let go to the last,
# it has slid back, if it loses two thirds of its tension at most: (1 − 2/3) / (1 + 2/3).
# Below the second, noise is large.
_SLACK_SHARE, _LEAST_SHARE, _SLID_SHARE = 0.05, 0.1, 0.2
_MIN_LET_GO = 5  # samples of a thinned trial while the tendon is slack, and while it slides back
_FORCE_RATIOS = (0.002, 1.0)  # N at the fingertip for each N of tension: a moment arm over a finger's length, with room
# Moment arms as shares of the finger's length: neither nearly as long as a finger nor thinner than a hair.
_MIN_ARM, _MAX_ARM = 0.004, 0.4
_MIN_SAMPLES = 70  # ten for each of the regressors of a torque
_MIN_TURNS = 3  # of a motion: with fewer, torque that accelerates the joint looks like friction.
_MAX_NEGATIVE_FRICTION = 0.05  # of the torque's spread: a delay between the channels makes friction seem this negative.


def check_work(session: Session, kinematic: Excursions, report: Report) -> None:
    """Report channels that contradict each other. `kinematic`: the excursions of ID.2."""
    finger = session.finger
    if any(finger.prismatic) or not finger.n:
        _passivity(session, report)
        return
    _arm_lengths(kinematic.arms, finger, report)
    _virtual_work(session, kinematic, report)
    _fingertip(session, report)
    _passivity(session, report)


def _arm_lengths(arms: Mapping[tuple[int, int], float], finger: FingerDescription, report: Report) -> None:
    """Report joints whose largest moment arm does not fit the finger's length; `arms`, m, by tendon and joint."""
    length = finger.length
    for i, joint in enumerate(finger.joint_names):
        largest = max((abs(arm) for (_, k), arm in arms.items() if k == i), default=np.nan)
        if largest > _MAX_ARM * length or largest < _MIN_ARM * length:
            report.warning(
                "/trials",
                f"ID.2 gives moment arms of {1e3 * largest:.3g} mm at joint {joint} of a finger {1e3 * length:.3g} mm "
                "long; check the units of tendon_excursion and q",
            )


def _virtual_work(session: Session, kinematic: Excursions, report: Report) -> None:
    """Report moment arms of ID.4 that contradict those of ID.2."""
    finger = session.finger
    turned: dict[tuple[str, str], str] = {}  # by tendon and joint: what is said of them
    far: dict[tuple[str, str], str] = {}
    scaled: dict[tuple[str, str], str] = {}
    agreed: list[tuple[str, str]] = []
    for trial in session.select("ID.4"):
        i, k = finger.joint(trial.joint), finger.tendon(trial.tendon)
        if i is None or k is None or trial.joint_torque is None or trial.tendon_force is None:
            continue
        angle = float(np.nanmedian(trial.q[:, i]))
        seen = kinematic.arm(k, i, angle)
        felt = -slope(thinned(trial.tendon_force[:, k]), thinned(trial.joint_torque[:, i]))
        strong = abs(felt) > _MIN_FELT_SHARE * kinematic.largest(i)
        still = strong and kinematic.still(k, i)
        if still:
            seen = kinematic.arms[k, i]
        elif strong and seen is None:
            seen = kinematic.small_arm(k, i, angle)
        if seen is None or not np.isfinite(felt):
            continue
        pair = finger.tendon_names[k], finger.joint_names[i]
        said = f"{pair[0]} at {pair[1]} ({1e3 * seen:.3g} against {1e3 * felt:.3g} mm)"
        ratio = np.inf if still or seen == 0.0 else felt / seen
        if ratio < -_MIN_ARM_RATIO:
            turned[pair] = said
        elif not _MIN_ARM_RATIO < ratio < _MAX_ARM_RATIO:
            far[pair] = said
        elif abs(seen) > _MAX_SCALE * _most_felt(trial.tendon_force[:, k], trial.joint_torque[:, i]):
            scaled[pair] = said
        else:
            agreed.append(pair)
    scale = "the scale, of which a diameter for a radius gives twice as much,"
    for found, what in ((turned, "the sign"), (far, "the units or the column"), (scaled, scale)):
        if found:
            report.warning(
                "/trials",
                "moment arms that excursions show (ID.2) and those that torques show (ID.4) contradict each other: "
                f"{listed(list(found.values()), 3)}; check {what} of {suspects(found, agreed)}",
            )


def _most_felt(tension: np.ndarray, torque: np.ndarray) -> float:
    """Largest moment arm, m, that the torques (N,) at a held joint allow, by a tendon's tensions (N,) in N.

    While the tension rises, friction lets no more than the tension come to the joint; once the tendon slides back, no
    less. So for each N between slack and sliding back the torque changes by the arm or more. The result is infinite
    where the tendon was not slack before the pull, or was not let go.
    """
    f, y = thinned(tension), thinned(torque)
    good = np.isfinite(f) & np.isfinite(y)
    if not good.any():
        return np.inf
    f, y, top = f[good], y[good], float(np.max(f[good]))
    falls = np.arange(len(f)) > np.argmax(f)
    slack, slid = ~falls & (f < _SLACK_SHARE * top), falls & (f > _LEAST_SHARE * top) & (f < _SLID_SHARE * top)
    if min(slack.sum(), slid.sum()) < _MIN_LET_GO:
        return np.inf
    return float(np.max(np.abs(y[slid] - np.median(y[slack])) / (f[slid] - np.median(f[slack]))))


def suspects(found: Collection[tuple[str, str]], agreed: Collection[tuple[str, str]]) -> str:
    """Channels that may be wrong, given the pairs of tendon and joint that contradict each other and those that agree.

    A joint at which another tendon agrees has a sound angle and torque; a tendon that agrees at another joint has sound
    tension and excursion.
    """
    tendons, joints = ({pair[k] for pair in found} for k in (0, 1))
    sound_tendons, sound_joints = ({pair[k] for pair in agreed} for k in (0, 1))
    if len(tendons) == 1 and joints <= sound_joints and not tendons & sound_tendons:
        return f"tendon_excursion or tendon_force of {min(tendons)}"
    if len(joints) == 1 and tendons <= sound_tendons and not joints & sound_joints:
        return f"joint_torque or q of {min(joints)}"
    return "joint_torque, tendon_excursion, tendon_force or q"


def _fingertip(session: Session, report: Report) -> None:
    """Report fingertip forces that are too large or too small for the tension, or without a lever."""
    finger, found = session.finger, []
    without_lever = not np.cross(finger.axis[-1], finger.fingertip).any()
    if without_lever and any(t.fingertip_force is not None for t in session.select("VD.2")):
        report.warning(
            "/finger/fingertip",
            f"lies on the axis of joint {finger.joint_names[-1]}, so that no force there turns it, though VD.2 "
            "presses with the fingertip; write the contact point in the last link's frame",
        )
    for trial in session.select("VD.2"):
        k = finger.tendon(trial.tendon)
        if k is None or trial.fingertip_force is None or trial.tendon_force is None:
            continue
        pull = thinned(trial.tendon_force[:, k])
        size = float(np.linalg.norm([slope(pull, thinned(x)) for x in trial.fingertip_force.T]))
        if np.isfinite(size) and not _FORCE_RATIOS[0] < size < _FORCE_RATIOS[1]:
            found.append(f"{size:.3g} N for each N of {trial.tendon} in {trial.name}")
    if found:
        report.warning(
            "/trials",
            f"the fingertip presses with {listed(found, 3)}; check the units of fingertip_force and tendon_force",
        )


def _passivity(session: Session, report: Report) -> None:
    """Report joints whose torque has friction of the wrong sign."""
    finger = session.finger
    shares: dict[str, list[float]] = defaultdict(list)
    for trial in session.select("ID.3-static", "ID.3-dynamic"):
        i = finger.joint(trial.joint)
        if i is None or trial.joint_torque is None or len(trial.time) < _MIN_SAMPLES:
            continue
        share = _friction_share(trial, i)
        if np.isfinite(share):
            shares[finger.joint_names[i]].append(share)
    found = [joint for joint, of_trials in shares.items() if np.median(of_trials) < -_MAX_NEGATIVE_FRICTION]
    if found:
        report.warning(
            "/trials",
            f"the external motor takes work out of the joint in every cycle: {listed(found, 3)}; check the sign of "
            "joint_torque and of q, and whether one of the two is late",
        )


def _friction_share(trial: Trial, joint: int) -> float:
    """Friction torque over the torque's standard deviation, by regression on direction and angle; NaN where unclear."""
    assert trial.joint_torque is not None
    q, torque = trial.q[:, [joint]], trial.joint_torque[:, [joint]]
    if not (np.isfinite(q).all() and np.isfinite(torque).all() and np.ptp(torque) > 0.0):
        return np.nan
    cutoff = fitting_cutoff(trial.time, CUTOFF_HZ)
    direction = _direction(trial, joint, cutoff)
    q, torque = (low_pass(trial.time, x, cutoff)[:, 0] for x in (q, torque))
    moves, powers = direction != 0.0, np.polynomial.polynomial.polyvander((q - q.mean()) / np.ptp(q), 5)
    columns = np.column_stack([direction, powers])[moves]
    if len(columns) < _MIN_SAMPLES or np.ptp(columns[:, 0]) == 0.0:
        return np.nan  # In one direction only, friction and elastic torque cannot be told apart.
    if trial.experiment != "ID.3-static" and np.count_nonzero(np.diff(columns[:, 0])) < _MIN_TURNS:
        return np.nan
    R = np.asarray(np.linalg.qr(np.column_stack([columns, torque[moves]]), mode="r"))
    # There may be fewer held angles than coefficients, so `lstsq` gives the smallest coefficients that fit.
    least = np.linalg.lstsq(R[:-1, :-1], R[:-1, -1])[0]
    return float(least[0] / np.std(torque))


def _direction(trial: Trial, joint: int, cutoff: float) -> np.ndarray:
    """Direction (N,) of a joint's motion: the file's channel, or derived from its filtered speed."""
    if trial.joint_direction is not None:
        return trial.joint_direction[:, joint].astype(float)
    rate = smooth_rate(trial.time, trial.q[:, [joint]], cutoff)
    return directions(rate, STILL_SHARE * np.percentile(np.abs(rate), 99, axis=0))[:, 0]
