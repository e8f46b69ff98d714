"""Few distinct shapes, few compilations: sessions of like fingers share what was compiled for the first of them."""

from dataclasses import replace

import jax
import numpy as np

from jaxfinger.experiments.prepare import Batch

TRIALS, SAMPLES = 8, 256  # of the smallest stack that anything is compiled for


def roomy(size: int, least: int) -> int:
    """The first of least · (1, 3/2, 2, 3, 4, 6, 8, …) that holds `size`; `least` is even."""
    double = least
    while double < size:
        double *= 2
    between = 3 * double // 4
    return between if least < between and size <= between else double


def widened(batch: Batch) -> Batch:
    """The batch in a stack of a common shape; what is added holds the last values, and does not count."""
    B, T = batch.x.time.shape
    more = (0, roomy(B, TRIALS) - B), (0, roomy(T, SAMPLES) - T)

    def pad(a, mode):
        return np.pad(np.asarray(a), [(0, 0)] * (a.ndim - 2) + [*more], mode)

    return replace(
        batch,
        x=jax.tree.map(lambda a: pad(a, "edge"), batch.x),
        y={c: pad(a, "constant") for c, a in batch.y.items()},
        mask={c: pad(a, "constant") for c, a in batch.mask.items()},
    )
