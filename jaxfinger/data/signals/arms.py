"""Moment arms that ID.2 shows, by the excursions of the tendons over the angle of the joint that turns."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.session import FingerDescription, Session
from jaxfinger.data.signals.motion import STILL_ANGLE
from jaxfinger.data.signals.sizes import STRETCH_SHARE

if TYPE_CHECKING:
    from jaxtyping import Float

_DEGREE = 3  # of l(q): the moment arm is then a parabola over a joint's range, enough to tell a sign or a unit
_MIN_ARM_SHARE = 0.25  # of the largest arm at a joint: smaller arms may change sign with the posture.
_MAX_BEYOND = 0.1  # of the range that ID.2 sweeps, by which an angle may lie outside: there l(q) still holds.
_SAMPLES = 400  # of a trial: slopes of a motion need no more.


@dataclass(frozen=True)
class Arms:
    """Moment arms of all tendons at one joint, m/rad: `seen` in ID.2; `known` by the finger's file, or NaN."""

    seen: Float[np.ndarray, " n"]
    known: Float[np.ndarray, " n"]


def measured_arms(session: Session) -> dict[int, Arms]:
    """Moment arms by joint, of its motion: medians over the ID.2 trials in which no other joint turns."""
    found: dict[int, list[np.ndarray]] = defaultdict(list)
    for trial in session.select("ID.2"):
        spans = np.ptp(trial.q, axis=0)
        i = int(np.argmax(np.nan_to_num(spans)))
        if trial.tendon_excursion is not None and np.all(np.delete(spans, i) < STILL_ANGLE) and spans[i] > STILL_ANGLE:
            q = thinned(trial.q[:, i])
            columns = [thinned(l) for l in trial.tendon_excursion.T] + list(known_excursions(session.finger, i, q))
            found[i].append(np.reshape([slope(q, l) for l in columns], (2, -1)))
    return {i: Arms(*np.median(arms, axis=0)) for i, arms in found.items()}


def known_excursions(finger: FingerDescription, i: int, q: Float[np.ndarray, " N"]) -> Float[np.ndarray, "n N"]:
    """Excursions at joint i by the finger's file, m; NaN where they are unknown."""
    if finger.excursion is None:
        return np.full((finger.n, len(q)), np.nan)
    powers = np.arange(1, finger.excursion.shape[2] + 1)
    return finger.excursion[:, i] @ q ** powers[:, None]


class Excursions:
    """Excursions that ID.2 shows: a polynomial l(q), m, for each pair of tendon and joint, and its mean moment arm."""

    def __init__(self, session: Session):
        self.polynomials: dict[tuple[int, int], np.polynomial.Polynomial] = {}
        together: dict[tuple[int, int], list[tuple[np.ndarray, np.ndarray]]] = defaultdict(list)
        finger = session.finger
        for trial in session.select("ID.2"):
            i = finger.joint(trial.joint)
            if i is None or trial.tendon_excursion is None:
                continue
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
        """Moment arm dl/dq, m/rad, at an angle; None where it is unknown or so small that it may change sign."""
        arm = self._slope(tendon, joint, angle)
        if arm is None or abs(arm) <= _MIN_ARM_SHARE * self.largest(joint):
            return None
        return arm if arm * self.arms[tendon, joint] > 0.0 else None

    def small_arm(self, tendon: int, joint: int, angle: float) -> float | None:
        """Moment arm dl/dq, m/rad, at an angle, where it is small beside the largest at the joint; None elsewhere."""
        arm = self._slope(tendon, joint, angle)
        return arm if arm is not None and abs(arm) < _MIN_ARM_SHARE * self.largest(joint) else None

    def _slope(self, tendon: int, joint: int, angle: float) -> float | None:
        """The polynomial's dl/dq, m/rad, at an angle; None where it is unknown."""
        p = self.polynomials.get((tendon, joint))
        if p is None:
            return None
        beyond = _MAX_BEYOND * np.ptp(p.domain)
        return float(p.deriv()(angle)) if p.domain[0] - beyond <= angle <= p.domain[1] + beyond else None

    def largest(self, joint: int) -> float:
        """Size of the largest mean moment arm at a joint, m/rad; 0 where none is known."""
        return max((abs(arm) for (_, i), arm in self.arms.items() if i == joint), default=0.0)

    def still(self, tendon: int, joint: int) -> bool:
        """Whether the tendon stands still over the whole range of a joint that it crosses, but for its stretch."""
        p = self.polynomials.get((tendon, joint))
        if p is None:
            return False
        return bool(np.abs(p.deriv()(p.linspace()[0])).max() < STRETCH_SHARE * self.largest(joint))


def thinned(x: Float[np.ndarray, "N *k"]) -> Float[np.ndarray, "M *k"]:
    """Every k-th sample of a trial, so that some hundreds are left."""
    return x[:: max(1, len(x) // _SAMPLES)]


def slope(x: Float[np.ndarray, " N"], y: Float[np.ndarray, " N"]) -> float:
    """Slope of y over x by least squares; NaN where x stands still or few samples are finite."""
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good] - x[good].mean() if good.any() else x[good], y[good]
    return float(x @ y / (x @ x)) if len(x) > 10 and np.ptp(x) > 0.0 else np.nan
