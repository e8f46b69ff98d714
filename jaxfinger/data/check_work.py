"""Do the channels of a session agree with each other? Two laws hold for every finger, whatever its model.

1. Virtual work. A tendon that pulls in dl while a joint turns by dq puts the torque f dl/dq on it. So the moment arm
   seen by the encoders (ID.2: dl/dq) and that seen by the sensors of force (ID.4: −dτ/df, the motor holding against it)
   are one. Friction takes a part of what arrives at the joint, never its sign.
2. Passivity. Over a cycle the external motor puts work into a joint, and never takes any out: ∮ τ dq > 0.

Where they fail, a sign, a unit or a column is wrong, in one of the channels that the sentence names.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping

import numpy as np

from jaxfinger.data.filtering import low_pass, smooth
from jaxfinger.data.findings import Report
from jaxfinger.data.motion import STILL_SHARE, directions, fitting_cutoff
from jaxfinger.data.session import FingerDescription, Session, Trial

_DEGREE = 3  # of l(q) over a joint's range
_SAMPLES = 400  # of a trial; slopes of a motion need no more
_CLEAR = 0.25  # of the largest arm at a joint: smaller ones may change sign with the posture
# What arrives at a joint is less than what is pulled, by friction: routed tendons lose up to two thirds (the shipped
# session). Units that people mistake are at least four times apart (N and lbf).
_LEAST, _MOST = 0.2, 1.5
_APART = 3.0  # of two measurements of one excursion, without friction between them
_TIP = (0.002, 1.0)  # N at the fingertip for each N of tension: a moment arm over a finger's length, with room
_LONGEST_ARM = 0.4  # of the finger's length
_SHORTEST_ARM = 0.004
CUTOFF_HZ = 10.0  # faster than any commanded motion of the protocol, slower than most of the noise of sensors
_TURNS = 3  # of a motion: with fewer, what accelerates it passes for what turns with its direction
_TAKEN = 0.05  # of the torque's spread that a motor may seem to take out, by a delay between the channels

Arms = Mapping[tuple[int, int], float]  # (tendon, joint): m


def check_work(session: Session, report: Report) -> None:
    """Report channels that contradict each other."""
    finger = session.finger
    if any(finger.prismatic) or not finger.n:
        _passivity(session, report)
        return
    kinematic = _Excursions(session)
    _lengths(kinematic.arms, finger, report)
    _virtual_work(session, kinematic, report)
    _paths(session, kinematic, report)
    _tip(session, report)
    _passivity(session, report)


class _Excursions:
    """Excursion of each tendon over each joint's angle, as ID.2 shows it: polynomials l(q)."""

    def __init__(self, session: Session):
        self.polynomials: dict[tuple[int, int], np.polynomial.Polynomial] = {}
        together: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
        finger = session.finger
        for trial in session.select("ID.2"):
            if trial.joint not in finger.joint_names or trial.tendon_excursion is None:
                continue
            i = finger.joint_names.index(trial.joint)
            q, l = thinned(trial.q[:, i]), thinned(trial.tendon_excursion)
            for k in np.flatnonzero(finger.active & finger.crosses[:, i]):
                good = np.isfinite(q) & np.isfinite(l[:, k])
                if good.sum() > 10 * _DEGREE and np.ptp(q[good]) > 0.0:
                    together[int(k), i].append((q[good], l[good, k] - l[good, k].mean()))
        for key, parts in together.items():
            q, l = (np.concatenate(columns) for columns in zip(*parts, strict=True))
            self.polynomials[key] = np.polynomial.Polynomial.fit(q, l, _DEGREE)
        self.arms = {key: float(np.diff(p(p.domain))[0] / np.diff(p.domain)[0]) for key, p in self.polynomials.items()}

    def arm(self, tendon: int, joint: int, angle: float) -> float | None:
        """dl/dq at an angle, m/rad; None where it is not known, or so small that it may change sign."""
        p = self.polynomials.get((tendon, joint))
        largest = max((abs(arm) for (_, i), arm in self.arms.items() if i == joint), default=0.0)
        if p is None or not p.domain[0] - 0.1 <= angle <= p.domain[1] + 0.1:
            return None
        arm = float(p.deriv()(angle))
        return arm if abs(arm) > _CLEAR * largest and arm * self.arms[tendon, joint] > 0.0 else None


def thinned(x: np.ndarray) -> np.ndarray:
    """Some hundreds of a trial's samples, evenly spaced."""
    return x[:: max(1, len(x) // _SAMPLES)]


def slope(x: np.ndarray, y: np.ndarray) -> float:
    """Of y on x, by least squares; NaN where x stands still."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good] - x[good].mean() if good.any() else x[good], y[good]
    return float(x @ y / (x @ x)) if len(x) > 10 and np.ptp(x) > 0.0 else np.nan


def _lengths(arms: Arms, finger: FingerDescription, report: Report) -> None:
    """Moment arms are parts of a finger: neither as long as it is nor thinner than a hair."""
    length = float(np.linalg.norm(finger.origin, axis=1)[1:].sum() + np.linalg.norm(finger.fingertip))
    for i, joint in enumerate(finger.joint_names):
        largest = max((abs(arm) for (_, k), arm in arms.items() if k == i), default=np.nan)
        if largest > _LONGEST_ARM * length or largest < _SHORTEST_ARM * length:
            report.warning(
                "/trials",
                f"ID.2 gives moment arms of {1e3 * largest:.3g} mm at joint {joint} of a finger {1e3 * length:.3g} mm "
                "long; check the units of tendon_excursion and q",
            )


def _virtual_work(session: Session, kinematic: _Excursions, report: Report) -> None:
    finger = session.finger
    turned, far = [], []
    for trial in session.select("ID.4"):
        if trial.joint not in finger.joint_names or trial.tendon not in finger.tendon_names:
            continue
        i, k = finger.joint_names.index(trial.joint), finger.tendon_names.index(trial.tendon)
        if trial.joint_torque is None or trial.tendon_force is None:
            continue
        seen = kinematic.arm(k, i, float(np.nanmedian(trial.q[:, i])))
        felt = -slope(thinned(trial.tendon_force[:, k]), thinned(trial.joint_torque[:, i]))
        if seen is None or not np.isfinite(felt):
            continue
        said = f"{trial.tendon} at {trial.joint} ({1e3 * seen:.3g} against {1e3 * felt:.3g} mm)"
        ratio = felt / seen
        if ratio < -_LEAST:
            turned.append(said)
        elif not _LEAST < ratio < _MOST:
            far.append(said)
    for found, what in ((turned, "the sign"), (far, "the units or the column")):
        if found:
            report.warning(
                "/trials",
                "moment arms that excursions show (ID.2) and those that torques show (ID.4) contradict each other: "
                f"{_some(found)}; check {what} of joint_torque, tendon_excursion, tendon_force or q",
            )


def _paths(session: Session, kinematic: _Excursions, report: Report) -> None:
    """Do free motions show the excursions that ID.2 shows?"""
    finger = session.finger
    found = []
    for trial in session.select("VD.1", "VD.3"):
        if trial.tendon_excursion is None:
            continue
        q, l = thinned(trial.q), thinned(trial.tendon_excursion)
        for k in np.flatnonzero(finger.active):
            joints = np.flatnonzero(finger.crosses[k])
            if any((int(k), int(i)) not in kinematic.polynomials for i in joints) or not len(joints):
                continue
            expected = np.sum([kinematic.polynomials[int(k), int(i)](q[:, i]) for i in joints], axis=0)
            ratio = slope(expected, l[:, k])
            if np.isfinite(ratio) and not 1.0 / _APART < ratio < _APART and np.ptp(expected) > 1e-3:
                found.append(f"{finger.tendon_names[k]} in {trial.name} ({ratio:.2g} times)")
    if found:
        report.warning(
            "/trials",
            f"excursions along free paths are not those that ID.2 shows: {_some(found)}; check sign, units and columns "
            "of tendon_excursion and q in these trials",
        )


def _tip(session: Session, report: Report) -> None:
    found = []
    for trial in session.select("VD.2"):
        if trial.tendon in session.finger.tendon_names and trial.fingertip_force is not None:
            pull = (
                None
                if trial.tendon_force is None
                else trial.tendon_force[:, session.finger.tendon_names.index(trial.tendon)]
            )
            slopes = (
                [slope(thinned(pull), thinned(x)) for x in trial.fingertip_force.T] if pull is not None else [np.nan]
            )
            size = float(np.linalg.norm(slopes))
            if np.isfinite(size) and not _TIP[0] < size < _TIP[1]:
                found.append(f"{size:.3g} N for each N of {trial.tendon} in {trial.name}")
    if found:
        report.warning(
            "/trials", f"the fingertip presses with {_some(found)}; check the units of fingertip_force and tendon_force"
        )


def _passivity(session: Session, report: Report) -> None:
    finger = session.finger
    shares: dict[str, list[float]] = defaultdict(list)
    for trial in session.select("ID.3-static", "ID.3-dynamic"):
        if trial.joint not in finger.joint_names or trial.joint_torque is None or len(trial.time) < 50:
            continue
        share = _friction_share(trial, finger.joint_names.index(trial.joint))
        if np.isfinite(share):
            shares[trial.joint].append(share)
    found = [joint for joint, of_trials in shares.items() if np.median(of_trials) < -_TAKEN]
    if found:
        report.warning(
            "/trials",
            f"the external motor takes work out of the joint in every cycle: {_some(found)}; check the sign of "
            "joint_torque and of q",
        )


def _friction_share(trial: Trial, joint: int) -> float:
    """What of the torque turns with the direction of motion, in parts of its spread; NaN where nothing tells."""
    assert trial.joint_torque is not None
    q, torque = trial.q[:, [joint]], trial.joint_torque[:, [joint]]
    if not (np.isfinite(q).all() and np.isfinite(torque).all() and np.ptp(torque) > 0.0):
        return np.nan
    cutoff = fitting_cutoff(trial.time, CUTOFF_HZ)
    way = _way(trial, joint, cutoff)
    q, torque = (low_pass(trial.time, x, cutoff)[:, 0] for x in (q, torque))
    columns = np.column_stack([way, np.polynomial.polynomial.polyvander((q - q.mean()) / np.ptp(q), 5)])[way != 0.0]
    if len(columns) < 50 or np.ptp(columns[:, 0]) == 0.0:
        return np.nan  # only ever one way: friction and elastic torque trade off
    if trial.experiment != "ID.3-static" and np.count_nonzero(np.diff(columns[:, 0])) < _TURNS:
        return np.nan
    R = np.asarray(np.linalg.qr(np.column_stack([columns, torque[way != 0.0]]), mode="r"))
    # Where there are fewer held angles than coefficients, the smallest ones that fit.
    least = np.linalg.lstsq(R[:-1, :-1], R[:-1, -1])[0]
    return float(least[0] / np.std(torque))


def _way(trial: Trial, joint: int, cutoff: float) -> np.ndarray:
    """(N,) direction of a joint's motion: the file's channel, or where it moves by its filtered speed."""
    if trial.joint_direction is not None:
        return trial.joint_direction[:, joint].astype(float)
    rate = smooth(trial.time, trial.q[:, [joint]], cutoff)[1]
    return directions(rate, STILL_SHARE * np.percentile(np.abs(rate), 99, axis=0))[:, 0]


def _some(found: Iterable[str], most: int = 3) -> str:
    found = list(found)
    return ", ".join(found[:most]) + (f" and {len(found) - most} more" if len(found) > most else "")
