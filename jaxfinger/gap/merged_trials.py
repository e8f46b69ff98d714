"""Trials of several experiments that share a channel, merged so that one compiled function predicts all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.experiments import SAMPLES, TRIALS, Stack, padded, padded_size, split
from jaxfinger.model import Model, Motion, contact_map


@dataclass(frozen=True)
class MergedTrials:
    """One channel of several experiments: their trials in sequence, padded to a common length, in blocks of TRIALS."""

    channel: str
    held: bool  # whether a fixture holds the joints
    trials: dict[str, range]  # positions of each experiment's trials in the sequence
    x: list[Motion]  # one for each block
    contact: list[Array | None]  # `contact_map` of each block for the fingertip force, None for other channels

    def merged(
        self, arrays: Mapping[tuple[str, str], Float[np.ndarray, "_columns _B _T"]]
    ) -> list[Float[Array, "columns B T"]]:
        """Arrays by experiment and channel, merged into the blocks of `x`."""
        return _merged([arrays[e, self.channel] for e in self.trials])

    def of(self, experiments: Sequence[str]) -> list[int]:
        """Numbers of the blocks that hold trials of these experiments."""
        return sorted({t // TRIALS for e in experiments for t in self.trials[e]})


def merged_trials(stacks: dict[str, Stack], nominal: Model) -> list[MergedTrials]:
    """One group for each way in which a channel of the stacks is predicted (`Experiment.predicted_as`)."""
    kinds: dict[tuple, list[str]] = {}
    for e, stack in stacks.items():
        for c in stack.experiment.channels:
            kinds.setdefault(stack.experiment.predicted_as(c), []).append(e)
    return [
        _merged_trials_of(c, held, {e: stacks[e] for e in experiments}, nominal)
        for (c, held), experiments in kinds.items()
    ]


def _merged_trials_of(channel: str, held: bool, stacks: dict[str, Stack], nominal: Model) -> MergedTrials:
    """The group of one channel from the stacks that have it."""
    motions = [replace(s.batch.x, held=held) for s in stacks.values()]
    x = _merged(motions)
    ends = np.cumsum([0, *(m.time.shape[0] for m in motions)]).tolist()
    trials = {e: range(*ends) for e, ends in zip(stacks, pairwise(ends), strict=True)}
    contact = [_contact(nominal, block) if channel == "fingertip_force" else None for block in x]
    return MergedTrials(channel, held, trials, x, contact)


_contact = quick_jit(contact_map)


def _merged(parts: Sequence) -> list:
    """Arrays (…, B, T) joined along B and split into blocks of TRIALS trials, all padded to one length T."""
    T = padded_size(max(jax.tree.leaves(p)[0].shape[-1] for p in parts), SAMPLES)
    wide = [padded(p, 0, T - jax.tree.leaves(p)[0].shape[-1]) for p in parts]
    whole = jax.tree.map(lambda *a: np.concatenate(a, axis=-2), *wide)
    return jax.device_put(split(padded(whole, -jax.tree.leaves(whole)[0].shape[-2] % TRIALS, 0)))
