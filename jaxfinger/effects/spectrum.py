"""Spectra of relaxation times.

Polymers and tissue relax over decades of time, nearly in proportion to its logarithm: a spectrum that is constant in
log T between two ends describes them (Fung, Biomechanics, 2nd ed., §7.6). A metal spring with a damper has one time.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects.base import shape

# Midpoints of equal parts of the spectrum, of 0.4 decades where it has two: an exponential is itself a decade wide.
PARTS = np.arange(-2, 3) / 5.0
WIDE = 2.0  # decades. A trial shows hardly more, between its samples and its end.


def width():
    """Declare the width of a spectrum, in decades, as a shape: one time, or many."""
    return shape("1", (0.0, WIDE), moves="not")


def decay(T: Float[Array, ""], decades: Float[Array, ""], dt: Float[Array, "*T"]) -> Float[Array, "k *T"]:
    """exp(−Δt / T_k) of every part of the spectrum about T, s."""
    times = (T * 10.0 ** (decades * PARTS)).reshape(-1, *(1,) * dt.ndim)
    return jnp.exp(-dt[None] / times)


def thinned(shapes: list[dict[str, float]]) -> list[dict[str, float]]:
    """Combinations of shapes to try, with every other time for a spectrum: those beside it overlap with it."""
    times = sorted({s["T"] for s in shapes})[1::2]
    return [s for s in shapes if s["decades"] == 0.0 or s["T"] in times]


def at_rest(drive: Float[Array, "*T"]) -> Float[Array, "k *T"]:
    """State of every part before the first sample."""
    return jnp.zeros((PARTS.size, *drive.shape))
