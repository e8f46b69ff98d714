"""How a finger is mounted: the torque of gravity on its joints, as numbers and in words.

Gravity acts on joint i with the torque aᵢ · Σₖ mₖ (rₖ − pᵢ) × g over the links k from i to the tip. aᵢ is the joint's
axis, pᵢ its place and rₖ a link's centre of mass. On a sliding joint it acts with the force aᵢ · Σₖ mₖ g.

`model.rigid_body.gravity_torque` gives the same by JAX, which `check` does not import.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.session import FingerDescription
from jaxfinger.data.units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from jaxtyping import Float

# Of the largest torque that gravity has in the posture, however the finger is mounted. Mountings are true to some
# degrees, and 3° leave a twentieth.
_NO_TORQUE = 0.05
_NONE = "acts on no joint"
_LEVEL = 5.0  # degrees: a straight finger that points less far up or down is called level.


def reach_of(finger: FingerDescription) -> float:
    """Length, m, of the stretched chain from its first joint to the end of its last link."""
    gyration = np.sqrt(np.trace(finger.inertia[-1]) / 2.0 / finger.mass[-1])
    last = max(np.linalg.norm(finger.fingertip), np.linalg.norm(finger.com[-1]), gyration)
    return float(np.linalg.norm(finger.origin[1:], axis=1).sum() + last)


def weight_of(finger: FingerDescription) -> float:
    """Weight of all links, N, whatever gravity the description has."""
    return STANDARD_GRAVITY * float(finger.mass.sum())


def gravity_levers(finger: FingerDescription, q: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m 3"]:
    """Torque of gravity on each joint at q per unit of the gravity vector: levers · g, N m (N for a sliding joint).

    It is positive where gravity flexes the joint. A motor that holds the joint needs the opposite torque.
    """
    axes, places, coms = _pose(finger, q)
    out, mass, moment = np.empty_like(axes), 0.0, np.zeros_like(axes[:, 0])
    for i in reversed(range(finger.m)):
        mass, moment = mass + finger.mass[i], moment + finger.mass[i] * coms[:, i]
        slides = finger.prismatic[i]
        # a · (r × g) = (a × r) · g
        out[:, i] = mass * axes[:, i] if slides else np.cross(axes[:, i], moment - mass * places[:, i])
    return out


def _pose(finger: FingerDescription, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes, places and centres of mass (N, m, 3) of joints and links, in the base frame."""
    axes, places, coms = np.empty((3, len(q), finger.m, 3))
    turned, place = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    for i in range(finger.m):
        place = place + turned @ finger.origin[i]
        axes[:, i] = turned @ finger.axis[i]
        if finger.prismatic[i]:
            place = place + q[:, i, None] * axes[:, i]
        else:
            turned = turned @ _rotation(finger.axis[i], q[:, i])
        places[:, i], coms[:, i] = place, place + turned @ finger.com[i]
    return axes, places, coms


def _rotation(axis: Float[np.ndarray, "3"], angle: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N 3 3"]:
    """Rodrigues: R = I + sin θ [a]ₓ + (1 − cos θ) [a]ₓ²."""
    cross = np.cross(np.eye(3), axis)  # [a]ₓ r = a × r
    s, c = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + s * cross + (1.0 - c) * cross @ cross


def mounting_in_words(finger: FingerDescription) -> str:
    """Where the straight finger points, and how gravity acts on its joints: one line to compare with the rig."""
    if not finger.gravity.any():
        return "there is no gravity"
    lowest, highest = finger.limits.T
    straight, middle, quarter = (
        _acts(finger, q) for q in (np.zeros(finger.m), (lowest + highest) / 2.0, (3.0 * lowest + highest) / 4.0)
    )
    if (straight, middle) != (_NONE, _NONE):
        return f"{_points(finger)}at q = 0 gravity {straight}; in mid-range it {middle}"
    if quarter != _NONE:  # A pendulum hangs in the middle of its range.
        return f"{_points(finger)}at q = 0 and in mid-range gravity {_NONE}; at a quarter of the range it {quarter}"
    return f"{_points(finger)}gravity {_NONE}: the finger moves in a horizontal plane"


def _points(finger: FingerDescription) -> str:
    """Where the tip lies from the first joint at q = 0; nothing of a chain with sliding joints, or of no length."""
    tip = finger.origin[1:].sum(axis=0) + finger.fingertip
    sizes = float(np.linalg.norm(tip) * np.linalg.norm(finger.gravity))
    if sizes == 0.0 or any(finger.prismatic):
        return ""
    up = float(np.degrees(np.arcsin(np.clip(-tip @ finger.gravity / sizes, -1.0, 1.0))))
    if abs(up) < _LEVEL:
        return "the straight finger points level; "
    where = "up" if up > 0.0 else "down"
    return f"the straight finger points {where if abs(up) > 90.0 - _LEVEL else f'{abs(up):.0f}° {where}'}; "


def _acts(finger: FingerDescription, q: Float[np.ndarray, " m"]) -> str:
    """What gravity does to the joints in a posture: «flexes MCP with 13 N mm and PIP with 2.9 N mm»."""
    levers = gravity_levers(finger, q[None])[0]
    torques, largest = levers @ finger.gravity, np.linalg.norm(levers, axis=1) * np.linalg.norm(finger.gravity)
    acting = np.abs(torques) > _NO_TORQUE * largest
    if not acting.any():
        return _NONE
    said: dict[str, list[str]] = {}
    for i in np.flatnonzero(acting):
        slides, positive = finger.prismatic[i], torques[i] > 0.0
        verb = ("pushes forward" if positive else "pushes back") if slides else "flexes" if positive else "extends"
        unit = "N" if slides else "N m"
        said.setdefault(verb, []).append(f"{finger.joint_names[i]} with {_for_people(abs(torques[i]), unit)}")
    return " and ".join(f"{verb} {', '.join(joints)}" for verb, joints in said.items())


def _for_people(size: float, unit: str) -> str:
    """Size of a force (N) or torque (N m) with its unit; small torques in N mm."""
    return f"{1e3 * size:.3g} N mm" if unit == "N m" and size < 1.0 else f"{size:.3g} {unit}"
