"""Seeded specimens of five kinds of finger: their true parameters, and those of their CAD."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxfinger.data import FingerDescription

from .paths import excursion_polynomials

Y, Z = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Layout:
    """Nominal dimensions of one kind of finger. Lengths mm, masses g, angles deg; moment arms mm at q = 0, flexion
    positive.
    """

    joints: tuple[str, ...]
    axis: tuple[tuple[float, float, float], ...]
    length: tuple[float, ...]  # of link i, from joint i to joint i + 1 or the tip
    mass: tuple[float, ...]
    limits: tuple[tuple[float, float], ...]
    rest: tuple[float, ...]  # angles without elastic torque
    stiffness: tuple[float, ...]  # N mm/rad
    arms: dict[str, tuple[float, ...]]  # of the active tendons
    passive: dict[str, tuple[float, ...]]


LAYOUTS = {
    "planar": Layout(
        ("MCP", "PIP", "DIP"),
        (Y, Y, Y),
        (45, 28, 24),
        (21, 11, 6),
        ((-12, 83), (-8, 85), (-8, 80)),
        (0, 20, 70),
        (44, 24, 25),
        {"T1": (2.0, 5.0, 0), "T2": (-7.5, -5.5, -4.8), "T3": (4.0, 0, 0), "T4": (4.5, 0, 0)},
        {"T5": (0, -5.0, 3.5)},
    ),
    "abducting": Layout(
        ("ABD", "MCP", "PIP", "DIP"),
        (Z, Y, Y, Y),
        (12, 44, 27, 23),
        (7, 20, 11, 6),
        ((-22, 22), (-10, 82), (-8, 85), (-8, 80)),
        (0, 0, 20, 70),
        (28, 44, 24, 25),
        {"T1": (0, 2.5, 5.0, 0), "T2": (0, -7.5, -5.5, -4.8), "T3": (5.5, 4.2, 0, 0), "T4": (-5.5, 4.2, 0, 0)},
        {"T5": (0, 0, -5.0, 3.5)},
    ),
    "chain": Layout(
        ("J1", "J2", "J3", "J4", "J5"),
        (Y, Y, Y, Y, Y),
        (34, 28, 24, 20, 16),
        (16, 12, 9, 6, 4),
        ((-15, 80), (-12, 80), (-12, 80), (-10, 75), (-10, 70)),
        (15, 15, 20, 25, 25),
        (40, 36, 32, 28, 26),
        {
            "F1": (5.0, 0, 0, 0, 0),
            "F2": (2.0, 5.0, 0, 0, 0),
            "F3": (1.6, 2.0, 5.0, 0, 0),
            "F4": (1.3, 1.6, 2.0, 4.6, 0),
            "F5": (1.1, 1.3, 1.6, 2.2, 4.0),
            "E": (-7.5, -7.0, -6.2, -5.4, -4.4),
        },
        {},
    ),
    "n-plus-one": Layout(
        ("MCP", "PIP", "DIP"),
        (Y, Y, Y),
        (50, 32, 26),
        (26, 14, 8),
        ((-10, 82), (-10, 85), (-10, 75)),
        (10, 15, 20),
        (34, 26, 20),
        {"A": (3.0, 3.5, 4.2), "B": (3.0, 4.0, 0), "C": (5.0, 0, 0), "D": (-9.5, -6.5, -4.2)},
        {},
    ),
    "human-like": Layout(
        ("MCP-A", "MCP-F", "PIP", "DIP"),
        (Z, Y, Y, Y),
        (9, 40, 25, 20),
        (6, 18, 9, 5),
        ((-20, 20), (-12, 82), (-5, 85), (-5, 70)),
        (0, 5, 25, 25),
        (28, 42, 28, 22),
        {
            "FDP": (1.0, 4.5, 4.5, 3.6),
            "FDS": (-1.0, 5.0, 4.5, 0),
            "EDC": (0.5, -9.5, -5.0, -3.4),
            "RI": (6.0, 1.6, -1.6, -1.0),
            "UI": (-6.0, 1.5, -1.6, -1.0),
            "LU": (3.0, 3.0, -2.2, -1.4),
        },
        {},
    ),
}


@dataclass(frozen=True)
class Specimen:
    """True parameters of a finger in the nominal class. The session contains `cad` in place of the true `finger`.

    excursion: coefficients of q … q⁴ (m/radᵖ); elastic, coulomb: of 1, q, q² (N m); damping: N m s/rad; friction:
    a₀ (N) and a₁ (1) of the active tendons.
    """

    kind: str
    finger: FingerDescription
    cad: FingerDescription
    excursion: Float[np.ndarray, "n m 4"]
    elastic: Float[np.ndarray, "m 3"]
    coulomb: Float[np.ndarray, "m 3"]
    damping: Float[np.ndarray, " m"]
    friction: Float[np.ndarray, "n 2"]
    misfit: float  # m, largest misfit of the polynomials to MuJoCo's paths


def make_specimen(kind: str, rng: np.random.Generator) -> Specimen:
    """Draw a specimen of a kind in `LAYOUTS`, with dimensions and parameters around the layout's."""
    layout = LAYOUTS[kind]
    m = len(layout.joints)
    arms = {**layout.arms, **layout.passive}
    n, active = len(arms), np.array([name in layout.arms for name in arms])
    arm = np.array(list(arms.values())) * 1e-3 * rng.uniform(0.88, 1.12, (n, m))
    truth = _body(layout, arm, active, rng)
    # The eyelets of a flexor approach each other: 2α + q must stay below π.
    alpha = rng.uniform(0.64, 0.72, (n, m))
    excursion, misfit = excursion_polynomials(truth, arm, alpha)
    excursion[~active] = 0.0  # A passive tendon is slack in the nominal model.

    stiffness = np.array(layout.stiffness) * 1e-3 * rng.uniform(0.8, 1.2, m)
    rest = np.deg2rad(layout.rest) + rng.uniform(-0.08, 0.08, m)
    curvature = 0.15 * stiffness * rng.uniform(-1, 1, m)
    elastic = np.stack([-stiffness * rest + curvature * rest**2, stiffness - 2 * curvature * rest, curvature], axis=1)
    base = rng.uniform(1.5e-3, 4.0e-3, m)
    coulomb = np.stack([base, base * rng.uniform(-0.1, 0.35, m), base * rng.uniform(-0.06, 0.12, m)], axis=1)
    friction = np.stack([rng.uniform(0.1, 0.4, n), rng.uniform(0.06, 0.2, n)], axis=1) * active[:, None]
    return Specimen(
        kind, truth, _cad(truth, rng), excursion, elastic, coulomb, rng.uniform(0.5e-4, 2.5e-4, m), friction, misfit
    )


def _body(
    layout: Layout, arm: Float[np.ndarray, "n m"], active: np.ndarray, rng: np.random.Generator
) -> FingerDescription:
    """Draw the true rigid body: links are rods of about 9 mm radius."""
    m = len(layout.joints)
    length = np.array(layout.length) * 1e-3 * rng.uniform(0.92, 1.08, m)
    mass = np.array(layout.mass) * 1e-3 * rng.uniform(0.85, 1.15, m)
    com = np.stack([length * rng.uniform(0.42, 0.55, m), rng.normal(0, 3e-4, m), rng.normal(0, 5e-4, m)], axis=1)
    inertia = np.zeros((m, 3, 3))
    for i in range(m):
        radius = 9e-3 * rng.uniform(0.8, 1.1)
        across = mass[i] * (3 * radius**2 + length[i] ** 2) / 12
        tilt = _rotation(rng.normal(0, 0.04, 3))
        inertia[i] = tilt @ np.diag([mass[i] * radius**2 / 2, across, across * 1.02]) @ tilt.T
    hang = rng.uniform(-0.9, 0.9)  # rad about y, from hanging straight down
    return FingerDescription(
        gravity=9.81 * np.array([np.cos(hang), 0.0, np.sin(hang)]),
        joint_names=layout.joints,
        axis=np.array(layout.axis),
        origin=np.concatenate([np.zeros((1, 3)), np.stack([length[:-1], 0 * length[1:], 0 * length[1:]], axis=1)]),
        limits=np.deg2rad(layout.limits),
        mass=mass,
        com=com,
        inertia=inertia,
        fingertip=np.array([0.9 * length[-1], 0.0, -2e-3]),
        tendon_names=(*layout.arms, *layout.passive),
        active=active,
        crosses=arm != 0,
        mass_std=mass * 0.015,
        com_std=np.tile([3e-4, 2e-4, 2e-4], (m, 1)),
    )


def _cad(truth: FingerDescription, rng: np.random.Generator) -> FingerDescription:
    """Draw the description by CAD and scale: off by about one standard deviation, inertia scaled with mass."""
    assert truth.mass_std is not None
    assert truth.com_std is not None
    mass = truth.mass + truth.mass_std * rng.normal(size=truth.m)
    return replace(
        truth,
        mass=mass,
        com=truth.com + truth.com_std * rng.normal(size=(truth.m, 3)),
        inertia=truth.inertia * (mass / truth.mass)[:, None, None],
    )


def _rotation(vector: Float[np.ndarray, " xyz"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix by |vector| about its direction (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
