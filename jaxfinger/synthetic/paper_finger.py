"""The paper's specimen: a planar three-joint finger of Dexmart's design, built to the paper's figures.

Lengths, masses and via points are chosen so that moment arms, torques and losses are those of the paper's Table I and
Figs. 4–9 (`tests/synthetic/test_paper_figures.py`). What the paper does not give has the size of an index finger.
"""

from __future__ import annotations

import numpy as np

from jaxfinger.data import FingerDescription
from jaxfinger.synthetic.routes import Point, PolynomialRoute, WrappedRoute
from jaxfinger.synthetic.specimen import Band, GrowingFriction, Specimen

LENGTHS = np.array([43.0, 27.0, 23.0]) * 1e-3  # m
MASSES = np.array([20.0, 11.0, 6.0]) * 1e-3  # kg, encoder boards and screws included
THICKNESS = 12e-3  # m, of the links, for their inertia
LIMITS = np.deg2rad([[0.0, 90.0], [0.0, 95.0], [0.0, 80.0]])


def _mm(along: float, above: float) -> Point:
    """Return a point in m, given in mm."""
    return along * 1e-3, above * 1e-3


# Flexors pass on the palm's side and lift off their pulley halfway, so that the moment arm rises above its radius.
# Table I gives the ranges of fourth-order polynomials fitted to the strokes of ID.2. The points are chosen so that such
# fits, not the exact moment arms, have these ranges.
T1_MCP = WrappedRoute(_mm(-8.72, 1.07), _mm(4.86, 0.80))  # straight between two eyes: extensor first, then flexor
T1_PIP = WrappedRoute(_mm(-12.69, -1.41), _mm(9.91, -1.09), _mm(0.39, -0.15), 4.34e-3)
T3_MCP = WrappedRoute(_mm(-15.82, -0.51), _mm(12.64, 0.42), _mm(-1.12, -0.73), 5.82e-3)
T4_MCP = WrappedRoute(_mm(-15.82, -0.73), _mm(12.64, 0.24), _mm(-1.28, -0.52), 5.49e-3)
# The extensor wraps heads that are not concentric with the joints, so its moment arm grows as they flex.
T2_MCP = WrappedRoute(_mm(-18.0, 5.0), _mm(16.0, 5.0), _mm(1.60, -0.27), 6.08e-3, dorsal=True)
T2_PIP = WrappedRoute(_mm(-13.0, 4.5), _mm(11.0, 4.5), _mm(-2.09, -0.73), 5.51e-3, dorsal=True, on_distal=True)
T2_DIP = WrappedRoute(_mm(-11.0, 6.0), _mm(9.0, 5.5), _mm(1.99, 1.85), 3.89e-3, dorsal=True)
# The passive tendon is taut where the PIP is flexed much more than the DIP; it then flexes the DIP.
T5_PIP = PolynomialRoute((-4e-3,))
T5_DIP = PolynomialRoute((5e-3,))
T5 = (None, T5_PIP, T5_DIP)

RUBBER_BAND = Band((WrappedRoute(_mm(-12.0, 18.0), _mm(12.0, 18.0)), None, None), stiffness=156.0, stretch=4e-3)
# No active tendon flexes the DIP. A soft spring does, so that the extensor T2 can move it both ways. A spring at the
# PIP keeps the finger stable under given tensions, although bowstringing flexors and gravity destabilise it.
PIP_SPRING = Band((None, PolynomialRoute((5e-3,)), None), stiffness=180.0, stretch=8.3e-3)
DIP_SPRING = Band((None, None, PolynomialRoute((5e-3,))), stiffness=400.0, stretch=7e-3)
PASSIVE_TENDON = Band(T5, stiffness=1500.0, stretch=-3e-3)


def paper_finger(passive_tendon: bool = False) -> Specimen:
    """Return the paper's finger. With `passive_tendon` T5 pulls where it is taut; without, it never pulls."""
    return Specimen(
        name="paper-finger",
        description=_description(),
        routes=((T1_MCP, T1_PIP, None), (T2_MCP, T2_PIP, T2_DIP), (T3_MCP, None, None), (T4_MCP, None, None), T5),
        springs=(RUBBER_BAND, PIP_SPRING, DIP_SPRING, *((PASSIVE_TENDON,) if passive_tendon else ())),
        friction=GrowingFriction((2.5e-3, 1.6e-3, 1.0e-3), (9.88e-3, 1.5e-3, 0.8e-3)),  # 9 N mm at 70° at the MCP
        damping=(6e-5, 3e-5, 1e-5),
        # T3 loses 1.5 N of 4 N and 4 N of 10 N. T1 loses less at low tension and has a steeper slope.
        loss_constant=(-1.2, 0.1, -1.0 / 6.0, -0.1, 0.0),
        loss_proportional=(0.55, 0.20, 2.5 / 6.0, 0.40, 0.0),
    )


def _description() -> FingerDescription:
    com = np.stack([0.5 * LENGTHS, np.zeros(3), np.zeros(3)], axis=1)
    origin = np.zeros((3, 3))
    origin[1:, 0] = LENGTHS[:-1]
    return FingerDescription(
        gravity=np.array([0.0, 0.0, 9.81]),  # palm up: gravity extends the finger
        joint_names=("MCP", "PIP", "DIP"),
        axis=np.tile([0.0, 1.0, 0.0], (3, 1)),
        origin=origin,
        limits=LIMITS,
        mass=MASSES,
        com=com,
        inertia=np.stack([box_inertia(m, length) for m, length in zip(MASSES, LENGTHS, strict=True)]),
        fingertip=np.array([LENGTHS[2], 0.0, -3e-3]),
        tendon_names=("T1", "T2", "T3", "T4", "T5"),
        active=np.array([True, True, True, True, False]),
        crosses=np.array([[1, 1, 0], [1, 1, 1], [1, 0, 0], [1, 0, 0], [0, 1, 1]], dtype=bool),
    )


def box_inertia(mass: float, length: float) -> np.ndarray:
    """Inertia about the centre of mass of a bar along x with a square section, kg m²."""
    across = mass * (length**2 + THICKNESS**2) / 12.0
    return np.diag([mass * THICKNESS**2 / 6.0, across, across])
