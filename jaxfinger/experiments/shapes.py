"""Padding to a few common shapes, so that sessions of similar fingers share compiled programs."""

from typing import Literal, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np

from jaxfinger.experiments.prepare import Batch

# Trials in a block, and its least number of samples, which doubles until the longest trial fits. Trials of a session
# recorded for a quick look have up to 128 samples.
TRIALS, SAMPLES = 8, 128
# Samples of a block of a pointwise batch: a minute of slow motion, so that slow and quick experiments share programs.
# With eight trials an array of a block is 64 KiB, which stays in a processor's cache.
PIECE = 1024

Tree = TypeVar("Tree")


class Block(NamedTuple):
    """Part of a batch, in a common shape."""

    trial: int  # number of its first trial in the whole batch
    sample: int  # number of its first sample
    batch: Batch


def padded_size(size: int, least: int) -> int:
    """Smallest of least · (1, 2, 4, 8, …) that is not below `size`."""
    room = least
    while room < size:
        room *= 2
    return room


def blocks(batch: Batch, pointwise: bool = False) -> list[Block]:
    """Split a batch into blocks of TRIALS trials of a common length; padding repeats the last values with mask 0.

    `pointwise`: whether no sample's prediction depends on another sample, so that long trials may be cut, too. A batch
    of starts of simulations is not padded, since every sample added would be one more simulation.
    """
    if batch.x.simulated:
        return [Block(0, 0, batch)]
    B, T = batch.x.time.shape
    length = min(padded_size(T, SAMPLES), PIECE) if pointwise else padded_size(T, SAMPLES)
    ends = (-B % TRIALS, -T % length)
    counting = {c: np.pad(a, [(0, 0), (0, ends[0]), (0, ends[1])]) for c, a in batch.mask.items()}
    wide = padded(batch.x, *ends), padded(batch.y, *ends), counting
    return [
        Block(TRIALS * k, first, Batch(*jax.device_put(jax.tree.map(lambda a, t=first: a[..., t : t + length], part))))
        for k, part in enumerate(split(wide))
        for first in range(0, T, length)
    ]


def in_rows(batch: Batch) -> Batch:
    """The samples of all trials one after the other in TRIALS rows, for predictions that are pointwise in time.

    Rows are of one length; padding repeats the last values with mask 0.
    """
    (B, T), n = batch.x.time.shape, -(-batch.x.time.size // TRIALS)

    def rows(a, mode: Literal["edge", "constant"] = "edge"):
        flat = np.asarray(a).reshape(*np.shape(a)[:-2], B * T)
        fill = np.pad(flat, [(0, 0)] * (flat.ndim - 1) + [(0, TRIALS * n - B * T)], mode)
        return fill.reshape(*flat.shape[:-1], TRIALS, n)

    counting = {c: rows(a, "constant") for c, a in batch.mask.items()}
    return eqx.tree_at(lambda b: b.mask, jax.tree.map(rows, batch), counting)


def padded(tree: Tree, trials: int, samples: int) -> Tree:
    """Pad every array (…, B, T) by so many trials and samples, which repeat the last values."""
    ends = (0, trials), (0, samples)
    return jax.tree.map(lambda a: np.pad(a, [(0, 0)] * (np.ndim(a) - 2) + [*ends], "edge"), tree)


def split(tree: Tree) -> list[Tree]:
    """Split every array (…, B, T) into parts of TRIALS trials."""
    count = jax.tree.leaves(tree)[0].shape[-2]
    return [jax.tree.map(lambda a, b=b: a[..., b : b + TRIALS, :], tree) for b in range(0, count, TRIALS)]
