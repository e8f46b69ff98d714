"""Check that excursions along free paths follow the angles of the joints that the tendons cross.

A taut tendon's excursion is a sum of functions of these angles: those that ID.2 or the finger's file tell, or else any
of a low degree. Where ID.2 tells it, its size is known too (VD.1, VD.3). Where it is no such sum (VD.1), a column of an
angle or of an excursion is wrong; and where it is one after the angles of two joints are exchanged, these are.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.arms import Excursions, known_excursions, slope, thinned
from jaxfinger.data.signals.motion import STILL_ANGLE
from jaxfinger.errors import listed

if TYPE_CHECKING:
    from jaxtyping import Float

_DEGREE = 3  # of l(q) by joint, as in `signals.arms`
# Share of the finger's length that an excursion must span: over less, stretch and noise may be all that there is.
_MIN_PATH = 0.01
_MAX_RATIO = 3.0  # of two measurements of one excursion: units that people confuse differ by more.
# Share of the variance of an excursion that the angles leave: stretch, and arms of CAD that are right to a tenth, leave
# a hundredth; a joint that is not measured leaves a tenth where its arm is a third of the largest.
_MAX_LEFT = 0.1
_MIN_GAIN = 4.0  # by which an exchange must shrink it
_MIN_SAMPLES = 100


def check_paths(session: Session, kinematic: Excursions, report: Report) -> None:
    """Report free paths whose excursions do not follow the angles. `kinematic`: the excursions of ID.2."""
    if any(session.finger.prismatic):
        return
    _sizes(session, kinematic, report)
    for trial in session.select("VD.1"):
        l = trial.tendon_excursion
        if l is not None and np.isfinite(trial.q).all() and len(l) >= _MIN_SAMPLES:
            _path(trial, thinned(trial.q), thinned(l), session.finger, kinematic, report)


def _sizes(session: Session, kinematic: Excursions, report: Report) -> None:
    """Report excursions that are several times those of ID.2, or a fraction of them."""
    finger, found = session.finger, []
    for trial in session.select("VD.1", "VD.3"):
        if trial.tendon_excursion is None:
            continue
        q, l = thinned(trial.q), thinned(trial.tendon_excursion)
        for k in np.flatnonzero(finger.active):
            expected = _of_id2(q, int(k), finger, kinematic)
            if expected is None or np.ptp(expected) <= _MIN_PATH * finger.length:
                continue
            ratio = slope(expected, l[:, k])
            if np.isfinite(ratio) and not 1.0 / _MAX_RATIO < ratio < _MAX_RATIO:
                found.append(f"{finger.tendon_names[k]} in {trial.name} ({ratio:.2g} times)")
    if found:
        report.warning(
            "/trials",
            f"excursions along free paths are not those that ID.2 shows: {listed(found, 3)}; check sign, units and "
            "columns of tendon_excursion and q in these trials",
        )


def _of_id2(
    q: Float[np.ndarray, "N m"], tendon: int, finger: FingerDescription, kinematic: Excursions
) -> Float[np.ndarray, " N"] | None:
    """Excursion of a tendon by ID.2; None where it crosses no joint, or one that ID.2 does not tell of.

    Beyond the angles of ID.2 it is that at their end.
    """
    joints = [int(i) for i in np.flatnonzero(finger.crosses[tendon])]
    laws = [kinematic.polynomials.get((tendon, i)) for i in joints]
    if not joints or any(law is None for law in laws):
        return None
    known = [(law, q[:, i]) for law, i in zip(laws, joints, strict=True) if law is not None]
    return np.sum([law(angle.clip(law.domain[0], law.domain[1])) for law, angle in known], axis=0)


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
    l: Float[np.ndarray, " N"],
    q: Float[np.ndarray, "N m"],
    tendon: int,
    finger: FingerDescription,
    kinematic: Excursions,
) -> float:
    """Share of the variance of a tendon's excursion that the angles of the joints which it crosses leave; 0 if unclear.

    The size of the excursion is left free, since units and arms have checks of their own.
    """
    joints = [int(i) for i in np.flatnonzero(finger.crosses[tendon])]
    expected = _of_id2(q, tendon, finger, kinematic)
    if expected is None:
        expected = np.sum([known_excursions(finger, i, q[:, i])[tendon] for i in joints], axis=0)
    if np.isfinite(expected).all() and expected.any():
        X = expected[:, None]
    else:
        X = np.column_stack([np.polynomial.polynomial.polyvander(q[:, i], _DEGREE)[:, 1:] for i in joints])
    good = np.isfinite(l)
    if good.sum() < _MIN_SAMPLES:
        return 0.0
    X, y = X[good] - X[good].mean(axis=0), l[good] - l[good].mean()
    rest = y - X @ np.linalg.lstsq(X, y)[0]
    return float(rest @ rest / (y @ y))
