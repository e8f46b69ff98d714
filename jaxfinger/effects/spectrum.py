"""Effects that relax over a spectrum of times.

Polymers and tissue relax over decades of time, nearly in proportion to its logarithm: a spectrum that is constant in
log T between two ends describes them (Fung, Biomechanics, 2nd ed., §7.6). A metal spring with a damper has one time.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects.base import CatalogueEffect, shape

# Midpoints of equal parts of the spectrum, of 0.4 decades where it has two: an exponential is itself a decade wide.
PARTS = np.arange(-2, 3) / 5.0
WIDE = 2.0  # decades. A trial shows hardly more, between its samples and its end.


class RelaxingEffect(CatalogueEffect):
    """An effect with a time constant T, or with the mean over a spectrum that is `decades` wide about it.

    A subclass declares T, and its `drive` returns (time, value).
    """

    T: Float[Array, ""]
    decades: Float[Array, ""] = shape(
        "1", (0.0, WIDE), moves="not", says=("one time constant", "times from a decade below T to a decade above")
    )

    @classmethod
    def shapes(cls, finger, site, scales):
        """Combinations of shapes to try, with every other time for a spectrum: those beside it overlap with it."""
        tried = super().shapes(finger, site, scales)
        times = sorted({s["T"] for s in tried})[1::2]
        return [s for s in tried if s["decades"] == 0.0 or s["T"] in times]

    def decay(self, dt: Float[Array, "*T"]) -> Float[Array, "k *T"]:
        """exp(−Δt / T_k) of every part of the spectrum."""
        times = (self.T * 10.0 ** (self.decades * PARTS)).reshape(-1, *(1,) * dt.ndim)
        return jnp.exp(-dt[None] / times)

    def initial_memory(self, drive):
        """Every part at rest."""
        return jnp.zeros((PARTS.size, *drive[1].shape))
