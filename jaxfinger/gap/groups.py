"""Trials of several experiments that are predicted alike, merged: one program reads a signature off all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.experiments import Stack, roomy
from jaxfinger.model import Model, Motion, contact_map

LENGTH, COUNT = 512, 8  # samples and trials of the smallest stack that is compiled for


@dataclass(frozen=True)
class Group:
    """One channel of the experiments in `first`, whose trials follow one another, padded to a common length."""

    channel: str
    first: dict[str, int]  # first trial of each experiment
    x: Motion
    contact: Array | None  # of the fingertip's force: `contact_map`

    def merged(self, arrays: Mapping[tuple[str, str], np.ndarray]) -> Float[Array, "columns B T"]:
        """Arrays of the experiments and channels, (columns, trials, time), as `x` has its own."""
        return _merged([arrays[e, self.channel] for e in self.first], *self.x.time.shape)


def grouped(stacks: dict[str, Stack], nominal: Model) -> list[Group]:
    """Every channel of the stacks, held joints apart from moving ones."""
    kinds: dict[tuple, list[str]] = {}
    for e, stack in stacks.items():
        for c in stack.experiment.channels:
            held = stack.experiment.held and c != "tendon_excursion"
            kinds.setdefault((c, held), []).append(e)
    return [_group(c, held, {e: stacks[e] for e in experiments}, nominal) for (c, held), experiments in kinds.items()]


def _group(channel: str, held: bool, stacks: dict[str, Stack], nominal: Model) -> Group:
    motions = [replace(s.batch.x, held=held) for s in stacks.values()]
    counts, lengths = zip(*(x.time.shape for x in motions), strict=True)
    B, T = roomy(sum(counts), COUNT), roomy(max(lengths), LENGTH)
    x = jax.tree.map(lambda *parts: _merged(parts, B, T), *motions)
    starts = np.cumsum([0, *counts[:-1]])
    contact = _contact(nominal, x) if channel == "fingertip_force" else None
    return Group(channel, dict(zip(stacks, starts.tolist(), strict=True)), x, contact)


_contact = eqx.filter_jit(contact_map)


def _merged(parts: Sequence, B: int, T: int) -> Float[Array, "*columns B T"]:
    """One after the other along their trials, padded to B trials of T samples by repeating the last."""

    def wide(a, axis, size):
        widths = [(0, 0)] * a.ndim
        widths[axis] = (0, size - a.shape[axis])
        return np.pad(a, widths, mode="edge")

    whole = np.concatenate([wide(np.asarray(a), -1, T) for a in parts], axis=-2)
    return jnp.asarray(wide(whole, -2, B))
