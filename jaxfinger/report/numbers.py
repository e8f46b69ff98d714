"""Numbers as text: in a unit that suits their size, and with no more digits than their interval supports.

In all that is printed or drawn ± means half of a 95 % interval, 1.96 standard deviations.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from jaxfinger.data.signals.noise import HALF_95

# χ² per row above which the model or its noise is taken to be wrong: residuals of 1.22 times the noise.
MAX_CHI2 = 1.5
DASH = "–"
_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def scaled(size: float, units: str) -> tuple[float, str]:
    """Factor from SI, and name, of the unit in which people read a quantity of this size: 1e3 and «N mm/rad²».

    Angles have degrees, masses grams, torques between 1e-6 and 1 N m have N mm; others have the SI prefix that leaves
    one to three digits before the point. The SI value times the factor is the value in that unit.
    """
    factor, unit = _scaled(abs(size), units)
    return factor, unit.replace("^", "").translate(_POWERS) if "^" in unit or "m2" in unit else unit


def _scaled(size: float, units: str) -> tuple[float, str]:
    base, slash, per = units.partition("/")
    if base in ("1", "") and not slash:
        return 1.0, ""
    if base == "rad" and not per.startswith("m"):
        return 180 / math.pi, "°" + slash + per
    if base == "kg" or base.startswith("kg "):
        return _prefixed(size * 1e3, "g" + base[2:] + slash + per, 1e3)
    if (base == "N m" or base.startswith("N m ")) and 1e-6 < size < 1.0:
        return 1e3, "N mm" + base[3:] + slash + per
    if base.split(" ")[0] in ("N", "m", "s") and not base.startswith("m2"):
        return _prefixed(size, units, 1.0)
    return 1.0, units


def _prefixed(size: float, units: str, factor: float) -> tuple[float, str]:
    if not (size > 0 and math.isfinite(size)):
        return factor, units
    rounded = float(f"{size:.2g}")  # 999.7 µm must become 1 mm.
    step, prefix = next(((s, p) for s, p in _PREFIXES if rounded >= s), _PREFIXES[-1])
    if prefix in ("k", "M", "G") and units.startswith(("m", "s")):
        step, prefix = 1.0, ""
    return factor / step, prefix + units


def number(value: float | None, digits: int = 3) -> str:
    """A number without a unit, with so many significant digits; integers below a million are written out.

    None and non-finite numbers give a dash.
    """
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.0f}" if 10**digits - 0.5 <= abs(value) < 1e6 else f"{value:.{digits}g}"


def with_error(value: float, std: float | None) -> str:
    """`value ± half of the 95 % interval`, with two digits of the half and as many decimals of the value."""
    if std is None or not math.isfinite(std):
        return f"{value:.4g} ± ?"
    if std == 0:
        return f"{value + 0.0:.4g}"
    half = HALF_95 * std
    decimals = max(0, 1 - math.floor(math.log10(half)))
    if decimals > 8:
        return f"{value:.4g} ± {half:.2g}"
    return f"{_fixed(value, decimals)} ± {half:.{decimals}f}"


def reach(high: float, low: float, std: float | None) -> str:
    """`largest; smallest ± half of the 95 % interval` of a curve, in the digits of `with_error`."""
    smallest = with_error(low, std)
    value, known, half = smallest.partition(" ± ")
    if not known or half == "?" or "e" in value:
        return f"{high + 0.0:.4g}; {smallest}"
    return f"{_fixed(high, len(value.partition('.')[2]))}; {smallest}"


def extremes(high: float, low: float, digits: int = 3) -> str:
    """`largest; smallest` of a curve without an interval, with so many significant digits of the larger size."""
    size = max(abs(high), abs(low))
    decimals = max(0, digits - 1 - math.floor(math.log10(size))) if 0.0 < size < math.inf else 0
    return f"{_fixed(high, decimals)}; {_fixed(low, decimals)}"


def _fixed(value: float, decimals: int) -> str:
    """The number with so many decimals, and zero without a sign."""
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not text.strip("-0.") else text


def quantity(value: float, units: str) -> str:
    """An SI quantity in the unit of `scaled`, with two digits: 6.1e-6 m gives «6.1 µm»."""
    if not math.isfinite(value):
        return DASH
    factor, unit = scaled(float(f"{value:.2g}"), units)
    return _joined(number(value * factor, 2), unit)


def alike(values: Sequence[float], units: str) -> tuple[list[str], str]:
    """SI quantities as numbers of two digits in the unit that suits the largest, and the name of that unit."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    factor, unit = scaled(float(f"{largest:.2g}"), units)
    return [number(v * factor, 2) for v in values], _joined("", unit).strip()


def measured(value: float, std: float | None, units: str) -> str:
    """An SI quantity in the unit of `scaled`, with its 95 % interval if it has one: «12.1 ± 0.8 N/mm»."""
    size = abs(value) if not std or not math.isfinite(std) else max(abs(value), HALF_95 * std)
    factor, unit = scaled(size, units)
    if not std:
        return _joined(number(value * factor), unit)
    return _joined(with_error(value * factor, std * factor), unit)


_UNIT = re.compile(r"(?<=\d) (?=%|[nµmkMG]?(?:m|N|g|s)\b)")


def unbroken(text: str) -> str:
    """Put no-break spaces between numbers and their units."""
    return _UNIT.sub("\u00a0", text)


def _joined(text: str, unit: str) -> str:
    return text + unit if unit.startswith("°") else f"{text} {unit}".rstrip()


def percent(share: float) -> str:
    """A share in whole per cent; below 1 % with one digit, and from 99.5 % short of 100 % as «over 99 %»."""
    value = 100 * share
    if not math.isfinite(value):
        return DASH
    if 0 < value < 1:
        return f"{value:.1g} %" if value >= 0.001 else "under 0.001 %"
    if 99.5 <= value < 100:
        return "over 99 %"
    return f"{round(value)} %"  # An integer has no minus zero.


def chance(probability: float) -> str:
    """A probability as `percent` says it, but for one that is rounded to certainty, as no probability is."""
    return "over 99 %" if probability >= 0.995 else percent(probability)


def percent_range(low: float, high: float) -> str:
    """An interval of shares: «35 to 47 %», and one number where both ends round to it: «over 99 %»."""
    whole = round(100 * low), round(100 * high)
    return percent(low) if whole[0] == whole[1] else f"{whole[0]} to {whole[1]} %"
