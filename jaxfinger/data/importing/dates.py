"""Dates and times of day as seconds, as loggers and spreadsheets write them: as text, or packed into one number."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime, timedelta, timezone
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_CLOCK = (
    r"(?:(?P<days>\d+) days? )?(?P<hour>\d{1,2}):(?P<minute>[0-5]\d):(?P<second>[0-5]\d)"
    r"(?:[.,](?P<fraction>\d*)|:(?P<milli>\d{3}))?(?: ?(?P<half>[AP])\.?M\.?)?"
    r"(?: ?(?:Z|UTC|GMT|(?P<zone>[+-]\d\d(?::?\d\d)?)))?"
)
_PACKED_CLOCK = r"(?P<hour>\d\d)(?P<minute>[0-5]\d)(?P<second>[0-5]\d)(?:[.,]?(?P<fraction>\d+))?"
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_FORMS = tuple(
    re.compile(form, re.IGNORECASE)
    for form in (
        _CLOCK,
        r"(?P<minute>\d\d?):(?P<second>[0-5]\d)\.(?P<fraction>\d+)",
        rf"(?P<year>\d{{4}})([-/._])(?P<month>\d\d?)\2(?P<day>\d\d?)(?:,? +|[T_]){_CLOCK}",
        rf"(?P<first>\d\d?)(?P<mark>[-/.])(?P<next>\d\d?)(?P=mark)(?P<year>\d{{4}}|\d\d),? +{_CLOCK}",
        rf"(?P<day>\d\d?)[- ](?P<name>{'|'.join(_MONTHS)})[- ](?P<year>\d{{4}}),? +{_CLOCK}",
        rf"(?P<year>\d{{4}})(?P<month>\d\d)(?P<day>\d\d)[T_ -]{_PACKED_CLOCK}",
    )
)
_EITHER = re.compile(r"(\d\d?)([-/])(\d\d?)\2(?:\d{4}|\d\d),? ")  # day or month first; with dots it is the day
_PACKED = re.compile(r"(\d{14})(\d{3}|[.,]\d*)?")
_DAY = 86400.0  # s
_YEARS = 1970, 2099  # in which a packed date lies; other numbers of 14 digits are none
_MAX_DISORDER = 0.1  # of a clock's steps that run back: late stamps, and midnight
# Usual steps of a packed clock: from one minute to the next its number jumps by more than the first, and its time goes
# on by less than the second.
_MIN_JUMP, _MAX_STEP = 1.5, 5.0


def seconds(cell: str, month_first: bool | None = None) -> float | None:
    """Seconds of a date with a time of day since 1970, of a time of day since midnight; None for any other text.

    Dates such as 01/31/2026 begin with the month or the day; without `month_first`, with the one that makes a date.
    """
    if not cell[:1].isdigit():
        return None
    if month_first is None:
        day_first = seconds(cell, False)
        return seconds(cell, True) if day_first is None else day_first
    found = next((at for form in _FORMS if (at := form.fullmatch(cell))), None)
    if found is None:
        return None
    at = found.groupdict()
    hour, half = int(at.get("hour") or 0), at.get("half")
    if half and not 1 <= hour <= 12:
        return None
    hour = hour % 12 + 12 * (half in ("P", "p")) if half else hour
    digits = at.get("milli") or at["fraction"] or "0"
    fraction = int(digits) / 10.0 ** len(digits)
    if "year" not in at:
        hours = 24.0 * int(at.get("days") or 0) + hour
        return 3600.0 * hours + 60.0 * int(at["minute"]) + int(at["second"]) + fraction
    try:
        whole = datetime(*_date(at, month_first), hour, int(at["minute"]), int(at["second"]), tzinfo=_zone(at))
    except ValueError:
        return None
    return whole.timestamp() + fraction


def _date(at: Mapping[str, str], month_first: bool) -> tuple[int, int, int]:
    """Year, month and day."""
    year = int(at["year"]) + (2000 if len(at["year"]) == 2 else 0)
    if name := at.get("name"):
        return year, _MONTHS.index(name.lower()) + 1, int(at["day"])
    if first := at.get("first"):
        one, other = int(first), int(at["next"])
        return (year, one, other) if month_first and at["mark"] != "." else (year, other, one)
    return year, int(at["month"]), int(at["day"])


def _zone(at: Mapping[str, str]) -> timezone:
    text = at.get("zone")
    if not text:
        return UTC
    minutes = 60 * int(text[1:3]) + int(text[3:].lstrip(":") or 0)
    return timezone(timedelta(minutes=-minutes if text[0] == "-" else minutes))


def month_first(cells: Collection[str]) -> tuple[bool, str]:
    """Whether dates such as 01/02/2026 begin with the month, and one of them where no number above 12 tells.

    Then the order counts by which they lie closer together. Within one day both orders give the same differences.
    """
    dates = {at[0]: (int(at[1]), int(at[3])) for cell in cells if (at := _EITHER.match(cell))}
    if not dates:
        return False, ""
    first, after = (max(pair[k] for pair in dates.values()) for k in (0, 1))
    if max(first, after) > 12:
        return after > 12, ""
    spans = []
    for order in (False, True):
        read = [s for cell in cells if (s := seconds(cell, order)) is not None]
        spans.append(max(read) - min(read) if read else np.inf)
    return spans[1] < spans[0], min(dates).strip(" ,") if spans[0] != spans[1] else ""


def is_packed_date(value: float) -> bool:
    """Whether a number may be a date such as 20260131115959.23, of which float64 keeps the hundredths of a second."""
    year = value // 10**10 if value < 1e15 else value // 10**13
    return _YEARS[0] <= year <= _YEARS[1]


def packed_texts(cells: Sequence[str]) -> Float[np.ndarray, " N"] | None:
    """Seconds since 1970 of texts such as 20260131115959.23, NaN of empty ones; None where any is something else."""
    if not any(map(_PACKED.fullmatch, cells[:2])):  # An empty one may come first.
        return None
    found = [_PACKED.fullmatch(cell) for cell in cells]
    if not any(found) or not all(at or not cell for at, cell in zip(found, cells, strict=True)):
        return None
    there = [at for at in found if at]
    fraction = [float(f"0.{(at[2] or '').lstrip('.,') or 0}") for at in there]
    read = _unpacked(np.array([int(at[1]) for at in there]), np.array(fraction))
    if read is None:
        return None
    out = np.full(len(cells), np.nan)
    out[[bool(at) for at in found]] = read
    return out


def packed(values: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"] | None:
    """Seconds of a clock that packs its digits into a number, as 20260131115959.23 or 115959.23; None of others."""
    good = np.isfinite(values)
    x = values[good]
    if len(x) < 2 or x.min() < 0.0 or x.max() >= 1e17:
        return None
    digits = 1e3 if x.max() >= 1e15 else 1.0  # The last three are ms.
    whole = np.floor(x / digits).astype(np.int64)
    read = _unpacked(whole, (x - whole * digits) / digits)
    if read is None:
        return None
    out = np.full(len(values), np.nan)
    out[good] = read
    return out


def _unpacked(whole: Int[np.ndarray, " N"], fraction: Float[np.ndarray, " N"]) -> np.ndarray | None:
    """Seconds of whole numbers of the form [[yy]yymmdd]hhmmss, and the fractions behind them.

    A date of eight digits shows by itself. Of other numbers the step from one minute to the next must show that they
    are times; before it they are seconds as they stand.
    """
    date, clock = np.divmod(whole, 10**6)
    hour, minute, second = clock // 10**4, clock // 100 % 100, clock % 100
    if (hour > 23).any() or (minute > 59).any() or (second > 59).any():
        return None
    days = _days(date)
    if days is None:
        return None
    of_day = 3600.0 * hour + 60.0 * minute + second + fraction
    read = 86400.0 * days + of_day
    if date.min() >= 10**7:
        return read
    steps, raw = np.diff(read), np.diff(whole + fraction)
    turns, goes_on = ~np.isclose(steps, raw, atol=1e-3), raw > 0.0
    usual = np.median(raw[goes_on & ~turns]) if (goes_on & ~turns).any() else np.inf
    if not turns.any() or np.mean(steps < 0.0) > _MAX_DISORDER:
        return None
    # The numbers jump by 40 or more from minute to minute, and the times go on evenly.
    even = np.median(steps[turns]) < _MAX_STEP * usual < _MAX_STEP * np.median(raw[turns]) / _MIN_JUMP
    return read if even else None


def _days(date: Int[np.ndarray, " N"]) -> np.ndarray | None:
    """Days since 1970 of dates as [yy]yymmdd, 0 of zeros; None where one is no date."""
    days = {}
    for number in np.unique(date).tolist():
        year, month, day = number // 10**4, number // 100 % 100, number % 100
        try:
            then = datetime(year if number >= 10**7 else 2000 + year, month, day, tzinfo=UTC)
        except ValueError:
            if number:
                return None
            days[number] = 0.0
            continue
        if not _YEARS[0] <= then.year <= _YEARS[1]:
            return None
        days[number] = then.timestamp() / 86400.0
    return np.vectorize(days.__getitem__, otypes=[float])(date)


def texts(cells: Collection[str]) -> Float[np.ndarray, " N"] | None:
    """Seconds of texts that are all dates or times of day, NaN of empty ones; None where any is something else."""
    months, _ = month_first(set(cells))
    read = {cell: seconds(cell.strip(), months) for cell in set(cells) if cell.strip()}
    if not read or None in read.values():
        return None
    return past_midnight(np.array([read.get(cell, np.nan) for cell in cells], np.float64))


def past_midnight(times: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Times of day, s, that go on beyond a day where they pass midnight; dates as they are."""
    filled = np.isfinite(times)
    steps = np.diff(times[filled])
    if not len(steps) or np.max(times[filled]) >= _DAY or not (steps < -0.5 * _DAY).any():
        return times
    out = times.copy()
    out[filled] += _DAY * np.concatenate([[0.0], np.cumsum(steps < -0.5 * _DAY)])
    return out
