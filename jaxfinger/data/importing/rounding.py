"""Clocks of constant rate whose stamps are rounded: between samples, rounding looks like jitter.

At 300 Hz stamps in whole ms go on by 3, 3 and 4 ms. Their usual interval is then a tenth too short, and where motions
begin and end is told by a sample less or more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.signals.quantiles import median

if TYPE_CHECKING:
    from jaxtyping import Float

_DIGITS = 10.0 ** -np.arange(10)  # s, to which stamps may be rounded, the coarsest first
_MAX_PART = 0.01  # of such a digit that float64 adds to stamps, as to seconds since 1970
_MIN_SAMPLES = 20  # Fewer lie on a line by chance.
_EVEN = 1e-6  # of an interval: stamps that miss a line by less are on it.


def evened(time: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Times of a constant rate where rounding alone takes the stamps, s and increasing, from it; else the stamps.

    Samples may be lost. No time changes by more than the last digit of the stamps.
    """
    if len(time) < _MIN_SAMPLES:
        return time
    since, steps = time - time[0], np.diff(time)
    parts = (np.abs(since / digit - np.round(since / digit)).max() for digit in _DIGITS)
    digit = next((digit for digit, part in zip(_DIGITS, parts, strict=True) if part < _MAX_PART), 0.0)
    usual = steps[steps < 1.5 * median(steps) + digit].mean()
    lossless, lossy = np.ones(len(steps)), np.maximum(np.round(steps / usual), 1.0)
    for samples in (lossless, lossy):
        count = np.concatenate([[0.0], np.cumsum(samples)])
        line = np.polynomial.Polynomial.fit(count, since, 1)(count)
        missed = float(np.ptp(since - line))
        if missed <= (1.0 + _MAX_PART) * digit:
            return time[0] + line if missed > _EVEN * usual else time
    return time
