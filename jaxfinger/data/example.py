"""Numbers of the example finger that `jaxfinger new` writes, and whether a finger still has them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxfinger.data.session import FingerDescription

# Links of an adult's finger, taken for rods of this radius, give the example's numbers.
RADIUS = 0.007  # m
_LENGTHS = (0.045, 0.028, 0.023)  # m, base to tip
_MASS = 1e4  # kg/m³, over length · radius²: rods of 3200 kg/m³, a little more than aluminium


def link_length(i: int) -> float:
    """Length of link i, m."""
    return _LENGTHS[min(i, len(_LENGTHS) - 1)]


def link_mass(i: int) -> float:
    """Mass of link i, kg."""
    return float(f"{_MASS * link_length(i) * RADIUS**2:.2g}")


def link_middle(i: int) -> float:
    """Distance of link i's centre of mass from its joint, m."""
    return round(link_length(i) / 2, 4)


def is_example(finger: FingerDescription) -> bool:
    """Whether all links of a finger still have the example's masses and centres of mass."""
    masses = [link_mass(i) for i in range(finger.m)]
    centres = [[link_middle(i), 0.0, 0.0] for i in range(finger.m)]
    return bool(np.array_equal(finger.mass, masses) and np.array_equal(finger.com, centres))
