"""Numbers as people read them: in a unit of their size, no more digits than their interval holds.

There is one ± in all that is printed or drawn: half of a 95 % interval, 1.96 standard deviations.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

HALF_95 = 1.96  # standard deviations to either end of a 95 % interval
DASH = "–"
_POWERS = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def scaled(size: float, units: str) -> tuple[float, str]:
    """Factor and name of the unit in which an SI quantity of this size is read: 1e3 and «N mm/rad²».

    Angles in degrees; masses in grams; torques of a finger in N mm; else the SI prefix that leaves one to three digits
    before the point. The factor multiplies the SI value.
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
    rounded = float(f"{size:.2g}")  # so that 999.7 µm is 1 mm
    step, prefix = next(((s, p) for s, p in _PREFIXES if rounded >= s), _PREFIXES[-1])
    if prefix in ("k", "M", "G") and units.startswith(("m", "s")):
        step, prefix = 1.0, ""
    return factor / step, prefix + units


def number(value: float | None, digits: int = 3) -> str:
    """A bare number, its whole part written out up to a million; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value:.0f}" if 10**digits - 0.5 <= abs(value) < 1e6 else f"{value:.{digits}g}"


def with_error(value: float, std: float | None) -> str:
    """`value ± half of the 95 % interval`, the half to two digits and the value no finer."""
    if std is None or not math.isfinite(std):
        return f"{value:.4g} ± ?"
    if std == 0:
        return f"{value:.4g}"
    half = HALF_95 * std
    decimals = max(0, 1 - math.floor(math.log10(half)))
    if decimals > 8:
        return f"{value:.4g} ± {half:.2g}"
    return f"{value + 0.0:.{decimals}f} ± {half:.{decimals}f}".replace(f"-{0:.{decimals}f} ", f"{0:.{decimals}f} ")


def quantity(value: float, units: str, digits: int = 2) -> str:
    """An SI quantity to a few digits in a unit of its size: 6.1e-6 m is «6.1 µm»."""
    if not math.isfinite(value):
        return DASH
    factor, unit = scaled(float(f"{value:.{digits}g}"), units)
    return _joined(number(value * factor, digits), unit)


def alike(values: Sequence[float], units: str, digits: int = 2) -> tuple[list[str], str]:
    """SI quantities to a few digits in the one unit that suits the largest, and that unit."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    factor, unit = scaled(float(f"{largest:.{digits}g}"), units)
    return [number(v * factor, digits) for v in values], _joined("", unit).strip()


def measured(value: float, std: float | None, units: str) -> str:
    """An SI quantity with its 95 % interval in a unit of its size: «12.1 ± 0.8 N/mm» where it has one."""
    size = abs(value) if not std or not math.isfinite(std) else max(abs(value), HALF_95 * std)
    factor, unit = scaled(size, units)
    if not std:
        return _joined(number(value * factor), unit)
    return _joined(with_error(value * factor, std * factor), unit)


_UNIT = re.compile(r"(?<=\d) (?=%|[nµmkMG]?(?:m|N|g|s)\b)")


def unbroken(text: str) -> str:
    """With no-break spaces between numbers and their units."""
    return _UNIT.sub("\u00a0", text)


def _joined(text: str, unit: str) -> str:
    return text + unit if unit.startswith("°") else f"{text} {unit}".rstrip()


def percent(share: float) -> str:
    """A share in whole per cent; small ones to one digit, and what is nearly all or nothing as that."""
    value = 100 * share
    if not math.isfinite(value):
        return DASH
    if 0 < value < 1:
        return f"{value:.1g} %" if value >= 0.001 else "under 0.001 %"
    if 99.5 <= value < 100:
        return "over 99 %"
    return f"{value:.0f} %"


def percent_range(low: float, high: float) -> str:
    """A 95 % interval of a share: «35 to 47 %»."""
    return f"{100 * low:.0f} to {100 * high:.0f} %"
