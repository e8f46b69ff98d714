"""Check that excursions along a free path (VD.1) follow the angles of the joints that the tendons cross.

A taut tendon's excursion is a sum of functions of these angles: those that ID.2 or the finger's file tell, or else any
of a low degree. Where it is none, a column of an angle or of an excursion is wrong; and where it is one after the
angles of two joints are exchanged, these are.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.arms import Excursions, known_excursions, thinned
from jaxfinger.data.signals.motion import STILL_ANGLE
from jaxfinger.errors import listed

if TYPE_CHECKING:
    from jaxtyping import Float

_DEGREE = 3  # of l(q) by joint, as in `signals.arms`
_MIN_PATH = 0.01  # of the finger's length, of excursion: over less, stretch and noise may be all that there is.
# Share of the variance of an excursion that the angles leave: stretch, and arms of CAD that are right to a tenth, leave
# a hundredth; a joint that is not measured leaves a tenth where its arm is a third of the largest.
_MAX_LEFT = 0.1
_MIN_GAIN = 4.0  # by which an exchange must shrink it
_MIN_SAMPLES = 100


def check_paths(session: Session, report: Report) -> None:
    """Report free paths whose excursions do not follow the angles."""
    if any(session.finger.prismatic):
        return
    kinematic = Excursions(session)
    for trial in session.select("VD.1"):
        l = trial.tendon_excursion
        if l is not None and np.isfinite(trial.q).all() and len(l) >= _MIN_SAMPLES:
            _path(trial, thinned(trial.q), thinned(l), session.finger, kinematic, report)


def _path(
    trial: Trial,
    q: Float[np.ndarray, "N m"],
    l: Float[np.ndarray, "N n"],
    finger: FingerDescription,
    kinematic: Excursions,
    report: Report,
) -> None:
    """Report one free path, of angles `q` and excursions `l`."""
    least = _MIN_PATH * finger.length
    tendons = [k for k in np.flatnonzero(finger.active & finger.crosses.any(axis=1)) if np.ptp(l[:, k]) > least]
    left = np.array([_left(l[:, k], q, int(k), finger, kinematic) for k in tendons])
    if not left.size or left.max() < _MAX_LEFT:
        return
    found = {}
    for i, j in combinations(range(finger.m), 2):
        other = q.copy()
        other[:, [i, j]] = q[:, [j, i]]
        found[i, j] = np.array([_left(l[:, k], other, int(k), finger, kinematic) for k in tendons]).max()
    best = min(found, key=lambda pair: found[pair], default=None)
    joints = [finger.joint_names[i] for i in best or ()]
    if best is not None and found[best] < min(_MAX_LEFT, left.max() / _MIN_GAIN):
        report.warning(
            trial.place("q"),
            f"columns {joints[0]} and {joints[1]} look exchanged: the excursions follow the angles only if they are; "
            "exchange them, or correct tendon_excursion or the finger's `crosses`",
        )
        return
    names = [finger.tendon_names[k] for k, share in zip(tendons, left, strict=True) if share > _MAX_LEFT]
    still = [name for name, x in zip(finger.joint_names, q.T, strict=True) if np.ptp(x) < STILL_ANGLE]
    mend = f"check the columns of q, first {listed(still)}, which stand still" if still else "check the columns of q"
    report.warning(
        trial.place("tendon_excursion"),
        f"the travel of {listed(names)} does not follow the angles of the joints that they cross, though taut tendons "
        f"do; {mend}, then these columns and the finger's `crosses`",
    )


def _left(
    l: Float[np.ndarray, " N"], q: Float[np.ndarray, "N m"], tendon: int, finger: FingerDescription, by: Excursions
) -> float:
    """Share of the variance of a tendon's excursion that the angles of the joints which it crosses leave; 0 if unclear.

    The size of the excursion is left free, since units and arms have checks of their own.
    """
    joints = [int(i) for i in np.flatnonzero(finger.crosses[tendon])]
    if all((tendon, i) in by.polynomials for i in joints):
        laws = [by.polynomials[tendon, i] for i in joints]
        parts = [law(q[:, i].clip(law.domain[0], law.domain[1])) for law, i in zip(laws, joints, strict=True)]
        X = np.sum(parts, axis=0)[:, None]
    else:
        known = np.sum([known_excursions(finger, i, q[:, i])[tendon] for i in joints], axis=0)
        if np.isfinite(known).all() and known.any():
            X = known[:, None]
        else:
            X = np.column_stack([np.polynomial.polynomial.polyvander(q[:, i], _DEGREE)[:, 1:] for i in joints])
    good = np.isfinite(l)
    if good.sum() < _MIN_SAMPLES:
        return 0.0
    X, y = X[good] - X[good].mean(axis=0), l[good] - l[good].mean()
    rest = y - X @ np.linalg.lstsq(X, y)[0]
    return float(rest @ rest / (y @ y))
