"""Order of a clock's stamps: where they begin again, are coarser than the samples, or run back."""

from __future__ import annotations

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.toml import Place
from jaxfinger.errors import counted

# A stamp that is late is so by less than this, in s and in samples, since loggers write more often; and one that runs
# back between two longer runs of samples begins another recording, or wraps.
_MAX_LATE, _MAX_LATE_SAMPLES = 1.0, 10
_HOUR = 3600.0  # s
# Coarse stamps repeat regularly: as many samples to each, within one or a fifth, with room for jitter. Fewer repeated
# stamps may be samples that were logged twice, and fewer stamps show no regularity.
_MIN_REPEATED, _MIN_STAMPS, _MIN_REGULAR, _MAX_UNEVEN = 0.1, 10, 0.9, 0.2


def restarts(time: np.ndarray) -> np.ndarray:
    """Indices of the samples after which a clock, s, begins again or wraps: it runs back further than late stamps do,
    and runs on from there."""
    steps = np.diff(time)
    back = np.flatnonzero(steps < 0.0)
    if not len(back):
        return back
    late = max(_MAX_LATE, _MAX_LATE_SAMPLES * float(np.nanmedian(np.abs(steps))))
    runs = np.diff(np.concatenate([[-1], back, [len(time) - 1]]))
    return back[(steps[back] < -late) & (np.minimum(runs[:-1], runs[1:]) > _MAX_LATE_SAMPLES)]


def coarse_rate(time: np.ndarray) -> tuple[float, float] | None:
    """Step, s, of stamps that are coarser than the samples, and the samples' rate, Hz; None where they are not.

    Each coarse stamp is regularly that of several samples, since its last digits are cut.
    """
    stamps, counts = np.unique(time, return_counts=True)
    if (np.diff(time) < 0.0).any() or len(time) < (1.0 + _MIN_REPEATED) * len(stamps) or len(stamps) < _MIN_STAMPS:
        return None
    steps, counts = np.diff(stamps), counts[1:-1]  # The recording may begin and end within a stamp.
    step, shared = float(np.median(steps)), float(counts.mean())
    regular = (np.abs(counts - shared) <= max(1.0, _MAX_UNEVEN * shared)).mean() > _MIN_REGULAR and np.ptp(
        steps
    ) < 0.5 * step
    return (step, shared / step) if regular else None


def increasing_order(time: np.ndarray, name: str, sort: bool, choice: str, where: Place, report: Report) -> np.ndarray:
    """Indices that put times into increasing order, without repeated ones. `choice` says how to read one part of them.

    Raises:
        UserError: the times begin again, or do not increase and `sort` is false.
    """
    late = np.diff(time) <= 0.0
    if not late.any():
        return np.arange(len(time))
    begins = restarts(time)
    if len(begins):
        far = f"runs back by {time[begins[0]] - time[begins[0] + 1]:.4g} s after sample {begins[0]}"
        far += f", and at {counted(len(begins), 'place')} in all" if len(begins) > 1 else ""
        wraps_after = time[begins[0]] - time[begins[0] + 1] + float(np.median(np.diff(time)))
        if abs(wraps_after - _HOUR) < _MAX_LATE:
            where.fail(
                f"the clock {name} {far}, as clocks do when summer time ends: add the hour by its period in its own "
                f"units, of s as time = {{ from = …, unwrap = {_HOUR:.0f} }}; if it begins again there, {choice}"
            )
        where.fail(
            f"the clock {name} {far}: it begins again or wraps, and sorting would mix different times; {choice}, or "
            f"unwrap a clock that wraps after {wraps_after:.6g} s by its period in its own units, as "
            "time = { from = …, unwrap = 4294967296 }"
        )
    at, back, twice = int(np.argmax(late)), int((np.diff(time) < 0.0).sum()), int((np.diff(np.sort(time)) == 0.0).sum())
    if not sort:
        count = f"does not increase at {int(late.sum())} of {len(time)} samples, first after sample {at}"
        mend = "the samples must be sorted by their time"
        mend += f", without the {counted(twice, 'sample')} at repeated stamps" if twice else ""
        if twice > 0.5 * len(time):
            where.fail(f"the clock {name} {count}: its stamps are too coarse; write rate_hz in place of `time`")
        where.fail(f"the clock {name} {count}: {mend}; have import do so by `sort = true` in the trial")
    order = np.argsort(time, kind="stable")
    first = np.concatenate([[True], np.diff(time[order]) > 0.0])
    left = f"{counted(back, 'stamp')} ran back, and {counted(twice, 'sample')} at repeated stamps left out"
    report.warning(where.key, f"the clock {name} was sorted, {left}")
    return order[first]
