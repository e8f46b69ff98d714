"""Random fingers: 1 to 7 joints, planar, with abduction or with tilted axes, and two layouts of tendons.

Lengths, masses, moment arms, springs and friction are drawn around those of the paper's finger.
"""

from __future__ import annotations

import numpy as np

from jaxfinger.data import FingerDescription
from jaxfinger.synthetic.paper_finger import box_inertia
from jaxfinger.synthetic.routes import Route, WrappedRoute
from jaxfinger.synthetic.specimen import GrowingFriction, PolynomialSpring, Routes, Specimen

ABDUCTION = np.deg2rad(20.0)  # range of abduction to either side, as of a human MCP joint


def random_finger(seed: int, m: int = 3, layout: str = "planar", tendons: str = "antagonists") -> Specimen:
    """Return a random specimen of m joints.

    `layout` is `planar` (all joints flex about y), `abduction` (the first joint turns about z, at the place of the
    second) or `spatial` (axes tilted at random). `tendons` is `antagonists` (a flexor and an extensor per joint, which
    also cross the joint before it) or `fewest` (m flexors and one extensor along the whole finger).
    """
    rng = np.random.default_rng([seed, m])
    description = _description(rng, m, layout, tendons)
    flexors = _flexors(m, tendons)
    return Specimen(
        name=f"random-finger-{seed}",
        description=description,
        routes=tuple(_routes(rng, row, flexor) for row, flexor in zip(description.crosses, flexors, strict=True)),
        springs=(_springs(rng, m),),
        friction=GrowingFriction(tuple(rng.uniform(1e-3, 3e-3, m)), tuple(rng.uniform(0.5e-3, 5e-3, m))),
        damping=tuple(rng.uniform(1e-5, 1e-4, m)),
        loss_constant=tuple(rng.uniform(0.0, 0.2, description.n)),
        loss_proportional=tuple(rng.uniform(0.1, 0.35, description.n)),
    )


def _description(rng: np.random.Generator, m: int, layout: str, tendons: str) -> FingerDescription:
    abducts = layout == "abduction" and m > 1
    lengths = np.linspace(45e-3, 22e-3, m) * rng.uniform(0.9, 1.1, m)
    axis = np.tile([0.0, 1.0, 0.0], (m, 1))
    limits = np.stack([np.zeros(m), np.deg2rad(rng.uniform(70.0, 95.0, m))], axis=1)
    if layout == "spatial":
        axis = axis + rng.uniform(-0.4, 0.4, (m, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    if abducts:
        lengths[0], axis[0], limits[0] = 0.0, [0.0, 0.0, 1.0], [-ABDUCTION, ABDUCTION]
    mass = 0.4 * np.maximum(lengths, 6e-3) * rng.uniform(0.9, 1.1, m)  # kg: 0.4 kg/m
    origin = np.zeros((m, 3))
    origin[1:, 0] = lengths[:-1]
    com = np.stack([0.5 * lengths, *rng.uniform(-1e-3, 1e-3, (2, m))], axis=1)
    gravity = rng.standard_normal(3)
    crosses = _crossings(m, tendons)
    names = ["ABD", *(f"J{i}" for i in range(1, m))] if abducts else [f"J{i + 1}" for i in range(m)]
    return FingerDescription(
        gravity=9.81 * gravity / np.linalg.norm(gravity),
        joint_names=tuple(names),
        axis=axis,
        origin=origin,
        limits=limits,
        mass=mass,
        com=com,
        inertia=np.stack([box_inertia(*bar) for bar in zip(mass, lengths, strict=True)]),
        fingertip=np.array([lengths[-1], 0.0, -2e-3]),
        tendon_names=tuple(f"T{k + 1}" for k in range(len(crosses))),
        active=np.ones(len(crosses), dtype=bool),
        crosses=crosses,
    )


def _crossings(m: int, tendons: str) -> np.ndarray:
    """Which joints each tendon crosses, (n, m)."""
    pairs = np.array([[i - 1 <= j <= i for j in range(m)] for i in range(m)])
    return np.repeat(pairs, 2, axis=0) if tendons == "antagonists" else np.vstack([pairs, np.ones(m, dtype=bool)])


def _flexors(m: int, tendons: str) -> list[bool]:
    """Whether each tendon is a flexor."""
    return [True, False] * m if tendons == "antagonists" else [True] * m + [False]


def _routes(rng: np.random.Generator, crosses: np.ndarray, flexor: bool) -> Routes:
    """Routes of one tendon. A flexor passes nearer to the axis at the joints before its last one."""
    last = np.flatnonzero(crosses)[-1]
    return tuple(
        _route(rng, flexor, 1.0 if i == last or not flexor else 0.4) if crossed else None
        for i, crossed in enumerate(crosses)
    )


def _route(rng: np.random.Generator, flexor: bool, scale: float) -> Route:
    """Route of random size like the paper's T3 (lifts off its pulley) or T2 (wraps an eccentric head)."""
    radius, x, z = scale * rng.uniform(4.5e-3, 6.5e-3), *(scale * rng.uniform(-1e-3, 1e-3, 2))
    proximal, distal = scale * rng.uniform(12e-3, 18e-3, 2)
    height = scale * rng.uniform(-0.8e-3, 0.2e-3) if flexor else radius
    return WrappedRoute(
        (-proximal, height), (distal, height), (x, z), radius, dorsal=not flexor, on_distal=bool(rng.integers(2))
    )


def _springs(rng: np.random.Generator, m: int) -> PolynomialSpring:
    """Soft springs about a rest angle within each joint's range. Their q³ term is beyond the nominal model's degree."""
    stiffness, rest = rng.uniform(0.02, 0.04, m), rng.uniform(0.2, 0.8, m)
    return PolynomialSpring(tuple((-k * r, k, 0.0, 0.2 * k) for k, r in zip(stiffness, rest, strict=True)))
