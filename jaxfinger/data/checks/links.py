"""Check that the lengths, masses and inertias of a finger's links fit each other.

Mass and inertia say how far a link's mass lies about its centre of mass: `Σ = (tr(I)/2 − I)/m` is the mean of r rᵀ over
the mass. By Cantelli's inequality at most 1/(1 + d²) of it lies d standard deviations away, and beyond. But a link
reaches from its own joint's axis to the next one's (the last link: to the fingertip), so both lie near its mass. A rod
has d = √3 at both; a motor at one joint that is 95 % of the link has d = 4.4 at the other.

Where a joint lies too far away, the mistakes that people make are undone one by one. One that makes a rod of the link
is named. Without one, only a link between two joints is reported, and only from a larger distance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription

_LEAD_DENSITY = 11_300.0  # kg/m³: links are less dense than lead.
# Centre of mass and radius of gyration as shares of the longest link. Compact arms with motors at short links reach
# 1.5; cm, and inertias in g m², exceed 4.5.
_MAX_SIZE = 3.0
# Standard deviations: beyond the first less than 6 % of the mass lies, which is too little if a mistake explains it;
# beyond the second 1.5 %, too little for the bearings of a joint.
_FAR, _TOO_FAR = 4.0, 8.0
# Distances of a rod-like link: a rod has √3 at each joint and 2√3 in sum; 2 in sum have two lumps at its ends.
_MAX_ROD, _MIN_ROD_SUM = 2.5, 2.0
_MIN_THICKNESS = 0.05  # of a link's size: descriptions may take a link for a line or a plate, and joints sit beside it.

Link = tuple[np.ndarray, np.ndarray, np.ndarray]  # com, place of the next joint, Σ: m, m, m²


def check_links(finger: FingerDescription, report: Report) -> None:
    """Report links whose lengths, masses and inertias contradict each other."""
    if any(finger.prismatic):
        return
    _axes(finger, report)
    ends = np.vstack([finger.origin[1:], finger.fingertip])
    longest = float(np.linalg.norm(ends, axis=1).max())
    for i, name in enumerate(finger.joint_names):
        place, said = _density(finger, i) or _size(finger, i, longest) or _spread(finger, i, ends[i]) or ("", "")
        if said:
            report.warning(f"/finger/{place}", f"the link of joint {name} {said}")
        elif i < finger.m - 1 and _about_joint(finger, i, ends[i]):  # A last link may go on beyond its contact point.
            report.note(
                "/finger/links/inertia",
                f"the link of joint {name} has an inertia as if its mass sat at both of its ends, or as if it were "
                "given about the joint; check that it is about the centre of mass",
            )


def _axes(finger: FingerDescription, report: Report) -> None:
    """Report neighbours that turn about one line: their angles cannot be told apart, and no finger is built so."""
    for i in range(1, finger.m):
        parallel = np.linalg.norm(np.cross(finger.axis[i - 1], finger.axis[i])) < 1e-6  # rounding
        if parallel and np.linalg.norm(np.cross(finger.axis[i], finger.origin[i])) == 0.0:
            first, second = finger.joint_names[i - 1 : i + 1]
            report.warning(
                "/finger/joints/origin",
                f"joints {first} and {second} turn about one and the same line; write the place of {second} in the "
                f"frame of {first}",
            )


def _density(finger: FingerDescription, i: int) -> tuple[str, str] | None:
    """Inertia that is too small for the mass: of all bodies of one mass, the densest ball has the smallest trace."""
    mass = float(finger.mass[i])
    radius = np.cbrt(3.0 * mass / (4.0 * np.pi * _LEAD_DENSITY))
    if np.trace(finger.inertia[i]) >= 1.2 * mass * radius**2:  # 3 · 2/5 m r²
        return None
    return "links/inertia", (
        f"weighs {mass:.3g} kg, and even a ball of lead of that mass has a larger inertia; check the units of `mass` "
        "(kg) and of `inertia` (kg m2)"
    )


def _size(finger: FingerDescription, i: int, longest: float) -> tuple[str, str] | None:
    """Centre of mass or radius of gyration that is far larger than the finger's links."""
    com = float(np.linalg.norm(finger.com[i]))
    gyration = float(np.sqrt(np.linalg.eigvalsh(finger.inertia[i])[-1] / finger.mass[i]))
    for key, what, length, other in (("com", "its centre of mass", com, gyration), ("inertia", "mass", gyration, com)):
        # A body that is as large itself may have a short link, such as a wheel on an axis.
        if longest > 0.0 and length > _MAX_SIZE * max(longest, other):
            where = "from its joint" if key == "com" else "from its centre of mass"
            return f"links/{key}", (
                f"has {what} {length:.3g} m {where}, and no link of the finger is longer than {longest:.3g} m; "
                f"convert `{key}` to {'m' if key == 'com' else 'kg m2'}"
            )
    return None


def _spread(finger: FingerDescription, i: int, end: np.ndarray) -> tuple[str, str] | None:
    """Joint that lies far from the link's mass, with the mistakes that explain it."""
    link = finger.com[i], end, _second_moment(finger.inertia[i], finger.mass[i])
    own, other = _distances(finger, i, link)
    far, last = max(own, other), i == finger.m - 1
    if not far > _FAR:
        return None
    found = [(place, mend) for place, mend, mended in _mistakes(finger, i, link) if _like_rod(finger, i, mended)]
    if not found and (last or far < _TOO_FAR):
        return None
    found = found or [("links", "check `com`, `mass` and `inertia`, and the next joint's `origin`")]
    target = "its own joint" if own > other else "the fingertip" if last else f"joint {finger.joint_names[i + 1]}"
    return found[0][0], (
        f"hardly reaches {target}: by `com`, `mass` and `inertia`, less than {np.ceil(100.0 / (1.0 + far**2)):.0f} % "
        f"of its mass lies that far out; {' or '.join(mend for _, mend in found)}"
    )


def _mistakes(finger: FingerDescription, i: int, link: Link) -> Iterator[tuple[str, str, Link]]:
    """Mistakes that people make in describing a link: place, mend, and the link without the mistake."""
    com, end, moment = link
    joint = finger.origin[1 : i + 1].sum(axis=0)  # Place of this joint from the first one, at q = 0.
    key = "fingertip" if i == finger.m - 1 else "joints/origin"
    yield "links/com", "count `com` from the link's own joint, not from its far end", (com + end, end, moment)
    if joint.any():
        yield "links/com", "count `com` from the link's own joint, not from the base", (com - joint, end, moment)
        what = "`fingertip` from the last joint" if key == "fingertip" else "the next joint's `origin` from this joint"
        yield key, f"count {what}, not from the base", (com, end - joint, moment)
    if np.linalg.norm(np.cross(com, end)) > abs(com @ end):
        along = np.linalg.norm(com) * end / np.linalg.norm(end)
        yield "links/com", "give `com` in the frame in which `axis` and `origin` are given", (along, end, moment)


def _like_rod(finger: FingerDescription, i: int, link: Link) -> bool:
    own, other = _distances(finger, i, link)
    return max(own, other) < _MAX_ROD and own + other > _MIN_ROD_SUM


def _about_joint(finger: FingerDescription, i: int, end: np.ndarray) -> bool:
    """Whether the link is a rod if its inertia is about the joint, and has mass beyond both of its ends if not."""
    com, mass = finger.com[i], finger.mass[i]
    moment = _second_moment(finger.inertia[i], mass)
    inner = moment - np.outer(com, com)
    beyond = sum(_distances(finger, i, (com, end, moment))) < _MIN_ROD_SUM
    return bool(beyond and np.linalg.eigvalsh(inner)[0] > 0.0 and _like_rod(finger, i, (com, end, inner)))


def _second_moment(inertia: np.ndarray, mass: float) -> np.ndarray:
    """Mean of r rᵀ, m², over a link's mass, r from the centre of mass."""
    return (0.5 * np.trace(inertia) * np.eye(3) - inertia) / mass


def _distances(finger: FingerDescription, i: int, link: Link) -> tuple[float, float]:
    """Distances of the link's own axis and of the next one from its centre of mass, in standard deviations."""
    com, end, moment = link
    size = max(end @ end, np.trace(moment))
    W = np.linalg.inv(moment + _MIN_THICKNESS**2 * size * np.eye(3))

    def distance(r: np.ndarray, axis: np.ndarray) -> float:
        return float(np.sqrt(max(r @ W @ r - (axis @ W @ r) ** 2 / (axis @ W @ axis), 0.0)))

    return distance(-com, finger.axis[i]), distance(end - com, finger.axis[min(i + 1, finger.m - 1)])
