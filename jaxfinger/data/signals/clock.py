"""Clocks of recordings: intervals in which samples were lost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.signals.quantiles import median

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

# Usual intervals. Of samples that come at random, as where a sensor sends changes alone, one interval in a million is
# longer: 2⁻²⁰.
_MAX_JITTER = 20.0
# s, for which an operating system that is not real-time may keep a program from reading the next sample. It is the
# computer's, and the same on slow and quick machines.
_MAX_DELAY = 0.02


def longest_interval(steps: Float[np.ndarray, " M"]) -> float:
    """Longest interval, s, that late samples explain, given all intervals of a clock, s: longer ones are gaps."""
    return max(_MAX_JITTER * median(steps), _MAX_DELAY)


def gaps(steps: Float[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """Which intervals of a clock, s, are so long that samples were lost in them."""
    return steps > longest_interval(steps)
