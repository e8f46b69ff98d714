"""Padding to a few common shapes, so that sessions of similar fingers share compiled programs."""

from typing import TypeVar

import jax
import numpy as np

from jaxfinger.experiments.prepare import Batch

# Trials in a block, and its least number of samples, which doubles until the longest trial fits. Trials of a session
# recorded for a quick look have up to 128 samples.
TRIALS, SAMPLES = 8, 128

Tree = TypeVar("Tree")


def padded_size(size: int, least: int) -> int:
    """Smallest of least · (1, 2, 4, 8, …) that is not below `size`."""
    room = least
    while room < size:
        room *= 2
    return room


def blocks(batch: Batch) -> list[Batch]:
    """Split a batch into blocks of TRIALS trials of a common length; padding repeats the last values with mask 0.

    A batch of starts of simulations is not padded, since every sample added would be one more simulation.
    """
    if batch.x.simulated:
        return [batch]
    B, T = batch.x.time.shape
    ends = (-B % TRIALS, padded_size(T, SAMPLES) - T)
    counting = {c: np.pad(a, [(0, 0), (0, ends[0]), (0, ends[1])]) for c, a in batch.mask.items()}
    wide = padded(batch.x, *ends), padded(batch.y, *ends), counting
    return [Batch(*jax.device_put(part)) for part in split(wide)]


def padded(tree: Tree, trials: int, samples: int) -> Tree:
    """Pad every array (…, B, T) by so many trials and samples, which repeat the last values."""
    ends = (0, trials), (0, samples)
    return jax.tree.map(lambda a: np.pad(a, [(0, 0)] * (np.ndim(a) - 2) + [*ends], "edge"), tree)


def split(tree: Tree) -> list[Tree]:
    """Split every array (…, B, T) into parts of TRIALS trials."""
    count = jax.tree.leaves(tree)[0].shape[-2]
    return [jax.tree.map(lambda a, b=b: a[..., b : b + TRIALS, :], tree) for b in range(0, count, TRIALS)]
