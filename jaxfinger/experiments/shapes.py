"""Few distinct shapes, few compilations: sessions of like fingers share what was compiled for the first of them."""

from typing import TypeVar

import jax
import numpy as np

from jaxfinger.experiments.prepare import Batch

# Of a block; samples are doubled until the longest trial fits. A quick look's trials have up to 128.
TRIALS, SAMPLES = 8, 128

Tree = TypeVar("Tree")


def roomy(size: int, least: int) -> int:
    """The first of least · (1, 2, 4, 8, …) that holds `size`."""
    room = least
    while room < size:
        room *= 2
    return room


def blocks(batch: Batch) -> list[Batch]:
    """The batch in stacks of TRIALS trials of a common length; what is added holds the last values, and counts not.
    A batch that simulations start from stays as it is: every sample added would be one more simulation.
    """
    if batch.x.simulated:
        return [batch]
    B, T = batch.x.time.shape
    ends = (-B % TRIALS, roomy(T, SAMPLES) - T)
    counting = {c: np.pad(a, [(0, 0), (0, ends[0]), (0, ends[1])]) for c, a in batch.mask.items()}
    wide = padded(batch.x, *ends), padded(batch.y, *ends), counting
    return [Batch(*jax.device_put(part)) for part in split(wide)]


def padded(tree: Tree, trials: int, samples: int) -> Tree:
    """Every array, (…, B, T), with so many more trials and samples that hold the last values."""
    ends = (0, trials), (0, samples)
    return jax.tree.map(lambda a: np.pad(a, [(0, 0)] * (np.ndim(a) - 2) + [*ends], "edge"), tree)


def split(tree: Tree) -> list[Tree]:
    """Every array, (…, B, T), in parts of TRIALS trials."""
    count = jax.tree.leaves(tree)[0].shape[-2]
    return [jax.tree.map(lambda a, b=b: a[..., b : b + TRIALS, :], tree) for b in range(0, count, TRIALS)]
