"""Median and quantiles of long columns, several times as fast as NumPy's.

A sorted sample of the values brackets the order statistic, and what lies within the bracket is selected from alone
(Floyd and Rivest, Communications of the ACM 18 (1975) 165). The larger of two neighbours is the smallest value above
the selected one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


MIN_LENGTH = 2000  # Below it, selecting from all values takes no longer.


def median(values: Float[np.ndarray, " N"]) -> float:
    """Median of at least one value; NaN where a value is NaN."""
    return quantile(values, 0.5)


def quantile(values: Float[np.ndarray, " N"], share: float) -> float:
    """Value below which this share of at least one value lies, linear between two of them; NaN where a value is NaN."""
    rank = share * (len(values) - 1)
    between = rank - int(rank)
    values, k = _near(values, int(rank))
    selected = np.partition(values, k)  # NaN above all numbers
    low, high = float(selected[k]), float(selected[k + 1 :].min(initial=np.inf))
    return low if between == 0.0 and not np.isnan(high) else low + between * (high - low)


def medians(columns: Float[np.ndarray, "N k"]) -> Float[np.ndarray, " k"]:
    """Median of each column."""
    return quantiles(columns, 0.5)


def quantiles(columns: Float[np.ndarray, "N k"], share: float) -> Float[np.ndarray, " k"]:
    """`quantile` of each column."""
    return np.array([quantile(column, share) for column in columns.T])


def _near(values: Float[np.ndarray, " N"], k: int) -> tuple[Float[np.ndarray, " n"], int]:
    """Some values among which are the k-th smallest, the next larger one and every NaN, and the rank of the k-th there.

    The bracket reaches four standard deviations of the sample's rank to either side. Where it misses the k-th, as it
    may where values repeat in step with the sample, all values are returned.
    """
    if len(values) < MIN_LENGTH:
        return values, k
    step = round(len(values) ** (1.0 / 3.0))
    drawn = np.sort(values[::step])
    middle, reach = k // step, 2 * round(len(drawn) ** 0.5)
    low, high = drawn[max(middle - reach, 0)], drawn[min(middle + reach, len(drawn) - 1)]
    below = values < low
    kept = values[~(below | (values > high))]
    rank = k - int(np.count_nonzero(below))
    if not 0 <= rank < len(kept) - 1:
        return values, k
    # Many equal values, as of a slack tendon, are slow to select from.
    return (kept[:2], 0) if low == high and not np.isnan(kept.sum()) else (kept, rank)
