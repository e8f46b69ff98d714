"""Median and quantiles of long columns, several times as fast as NumPy's.

NumPy selects a single order statistic with vector instructions, but several at once, as its own median and quantiles
need them, one by one. Here the larger of two neighbours is the smallest of those above the selected one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


def median(values: Float[np.ndarray, " N"]) -> float:
    """Median of at least one value; NaN where a value is NaN."""
    return quantile(values, 0.5)


def quantile(values: Float[np.ndarray, " N"], share: float) -> float:
    """Value below which this share of at least one value lies, linear between two of them; NaN where a value is NaN."""
    at = share * (len(values) - 1)
    k = int(at)
    selected = np.partition(values, k)  # NaN above all numbers
    low, high = float(selected[k]), float(selected[k + 1 :].min(initial=np.inf))
    return low if at == k and not np.isnan(high) else low + (at - k) * (high - low)
