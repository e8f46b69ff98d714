"""Check that trials of ID.3 at one posture show one torque of a joint over its angle.

Elastic torque and weight depend on the angles alone. So at one posture of the other joints the curves of two trials
have one shape and one size, whatever the speed and whatever zero each trial has:

    τ = curve(qᵢ) + zero + friction sign(q̇ᵢ) + damping q̇ᵢ + inertia q̈ᵢ

Where one is several times the other or goes the other way, a trial's torque or angle has a wrong unit, scale or sign.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import combinations
from typing import NamedTuple

import numpy as np

from jaxfinger.data.checks.blocks import MIN_POSTURE, Motion, motion_of
from jaxfinger.data.findings import Report
from jaxfinger.data.session import Session
from jaxfinger.data.signals.arms import slope
from jaxfinger.errors import listed

_DEGREE = 5  # of the torque over the angle: a spring that stiffens towards both of its ends
_MIN_COMMON = 0.5  # of the smaller of two ranges of the angle, which two trials must share
_INNER = 0.05, 0.95  # of the common range: a polynomial is unsure at its ends.
# Squared correlation of two curves, from which one is a multiple of the other but for a tenth of its variance.
_MIN_ALIKE = 0.9
# Of a friction torque, the range of the curve: below, what the regression leaves of friction passes for a curve.
_MIN_CURVE = 2.0
# Units that people confuse differ at least fourfold; springs that warm up, and gain errors, make far less than two.
_MAX_RATIO = 2.0


class _Curve(NamedTuple):
    """Torque of one joint over its angle, as one trial shows it."""

    trial: str
    posture: np.ndarray  # (m − 1,), rad: means of the other joints' angles
    law: np.polynomial.Polynomial  # N m over rad
    friction: float  # N m; negative where the motor takes work out of the joint


def check_curves(session: Session, report: Report) -> None:
    """Report trials of ID.3 whose torque over the angle is not that of other trials at the same posture."""
    found = []
    for i, name in enumerate(session.finger.joint_names):
        trials = session.select("ID.3-static", "ID.3-dynamic", joint=name)
        curves = [_curve(t.name, motion, i) for t in trials for motion in motion_of(t, i, [i])]
        ratios: dict[int, dict[int, float]] = defaultdict(dict)
        for a, b in combinations(range(len(curves)), 2):
            if (ratio := _ratio(curves[a], curves[b])) is not None:
                ratios[a][b], ratios[b][a] = ratio, 1.0 / ratio
        # The trial that most others agree with is taken for right; of equals the first whose friction is positive.
        ranks = {k: (sum(map(_agrees, others.values())), curves[k].friction > 0.0, -k) for k, others in ratios.items()}
        best = max(ranks, key=ranks.__getitem__, default=0)
        found += [
            f"{ratio:.2g} times at {name} in {curves[k].trial} as in {curves[best].trial}"
            for k, ratio in ratios[best].items()
            if not _agrees(ratio)
        ]
    if found:
        report.warning(
            "/trials",
            f"the torque over a joint's angle (ID.3) differs between trials at one posture: it is {listed(found, 3)}; "
            "check the sign, the units and the columns of joint_torque and q in these trials",
        )


def _agrees(ratio: float) -> bool:
    return 1.0 / _MAX_RATIO < ratio < _MAX_RATIO


def _curve(trial: str, motion: Motion, i: int) -> _Curve:
    """Curve of joint i by a regression on its angle and the other terms."""
    q = motion.q[:, i]
    middle, half = 0.5 * (q.max() + q.min()), 0.5 * np.ptp(q)
    powers = np.vander((q - middle) / half, _DEGREE + 1, increasing=True)
    found = np.linalg.lstsq(np.column_stack([powers, motion.direction, motion.dynamics]), motion.torque)[0]
    law = np.polynomial.Polynomial(found[: _DEGREE + 1], domain=(middle - half, middle + half))
    return _Curve(trial, np.delete(motion.q.mean(axis=0), i), law, float(found[_DEGREE + 1]))


def _ratio(a: _Curve, b: _Curve) -> float | None:
    """Torque of b over that of a; None where their postures or angles differ, or they are no multiples."""
    low, high = max(a.law.domain[0], b.law.domain[0]), min(a.law.domain[1], b.law.domain[1])
    smaller = min(np.ptp(a.law.domain), np.ptp(b.law.domain))
    if high - low < _MIN_COMMON * smaller or np.abs(a.posture - b.posture).max(initial=0.0) > MIN_POSTURE:
        return None
    q = low + (high - low) * np.linspace(*_INNER)
    x, y = a.law(q), b.law(q)
    if any(np.ptp(values) < _MIN_CURVE * abs(curve.friction) for values, curve in ((x, a), (y, b))):
        return None
    ratio = slope(x, y)
    return ratio if ratio * slope(y, x) > _MIN_ALIKE else None
