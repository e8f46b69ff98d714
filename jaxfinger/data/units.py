"""Units that a mapping may name, with their conversion to SI."""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from typing import NamedTuple

MAX_OVERTRAVEL = 0.35  # rad, 20 degrees, that a joint may read beyond its limits, since stated limits are approximate
STANDARD_GRAVITY = 9.80665  # m s⁻², ISO 80000-4; `scipy.constants` has it too, but its import takes 0.4 s.


class Unit(NamedTuple):
    """Conversion to the SI unit `si`: value · `factor` + `zero`."""

    si: str
    factor: float
    zero: float = 0.0


TO_SI = {
    "rad": Unit("rad", 1.0),
    "mrad": Unit("rad", 1e-3),
    "deg": Unit("rad", math.pi / 180.0),
    "gon": Unit("rad", math.pi / 200.0),
    "turn": Unit("rad", 2.0 * math.pi),
    "m": Unit("m", 1.0),
    "cm": Unit("m", 1e-2),
    "mm": Unit("m", 1e-3),
    "um": Unit("m", 1e-6),
    "N": Unit("N", 1.0),
    "mN": Unit("N", 1e-3),
    "cN": Unit("N", 1e-2),
    "kN": Unit("N", 1e3),
    "gf": Unit("N", 1e-3 * STANDARD_GRAVITY),
    "kgf": Unit("N", STANDARD_GRAVITY),
    "N m": Unit("N m", 1.0),
    "N cm": Unit("N m", 1e-2),
    "N mm": Unit("N m", 1e-3),
    "cN m": Unit("N m", 1e-2),
    "dN m": Unit("N m", 1e-1),
    "mN m": Unit("N m", 1e-3),
    "s": Unit("s", 1.0),
    "ms": Unit("s", 1e-3),
    "us": Unit("s", 1e-6),
    "ns": Unit("s", 1e-9),
    "min": Unit("s", 60.0),
    "h": Unit("s", 3600.0),
    "day": Unit("s", 86400.0),
    "K": Unit("K", 1.0),
    "degC": Unit("K", 1.0, 273.15),
    "1": Unit("1", 1.0),
}
_SPELT = {"°": "deg", "度": "deg", "degrees": "deg", "µm": "um", "µs": "us", "rev": "turn", "sec": "s"}
_SPELT |= {"°c": "degC", "degc": "degC", "celsius": "degC"}
_SPELT |= {"deg": "deg", "rad": "rad", "degree": "deg", "radian": "rad", "radians": "rad"}
_SPELT |= {"turns": "turn", "revs": "turn", "revolution": "turn", "revolutions": "turn"}
_SPELT |= {"cycle": "turn", "cycles": "turn", "umdrehung": "turn", "umdrehungen": "turn"}
_SPELT |= {"gons": "gon", "gradian": "gon", "gradians": "gon"}
_SPELT |= {"second": "s", "seconds": "s", "days": "day", "newton": "N", "newtons": "N"}
_SPELT |= {"meters": "m", "metres": "m", "meter": "m", "millimeters": "mm", "millimetres": "mm", "newton meters": "N m"}
_SPELT |= {"secs": "s", "sek": "s", "sekunden": "s", "minute": "min", "minutes": "min", "hour": "h", "hours": "h"}
_SPELT |= {"millis": "ms", "msec": "ms", "msecs": "ms", "milliseconds": "ms"}
_SPELT |= {"micros": "us", "usec": "us", "usecs": "us", "microseconds": "us", "nsec": "ns", "nanoseconds": "ns"}
_NO_UNITS = "min", "in", "ft"  # at the end of a name: a lowest value, an input, a force-torque sensor
# Words that are a unit in one language and another unit in others.
EITHER = {"grad": "deg in German, gon in other languages"}
# Units of other systems and of raw signals, without capitals and what joins factors: numbers in them are never in SI.
_FOREIGN = {
    "lbf", "lb", "lbs", "ozf", "oz", "g", "kg", "in", "inch", "inches", "ft", "psi", "bar", "pa", "kpa",
    "v", "mv", "mv/v", "a", "ma", "%", "rpm", "count", "counts", "cnt", "tick", "ticks", "pulses", "bit", "bits",
    "lsb", "raw", "kgfcm", "kgcm", "gfcm", "gcm", "ozin", "ozfin", "inoz", "inozf", "lbin", "lbfin", "inlb", "inlbf",
    "lbft", "lbfft", "ftlb", "ftlbf", "danm", "volt", "volts", "millivolts", "amp", "amps", "ampere", "amperes",
    "pounds", "kilograms", "grams",
}  # fmt: skip


def conversion(unit: str) -> str:
    """What to do about numbers that are in `unit` and are read as SI: «convert mm to m (`units = "mm"` in a mapping)».

    A variable that is named by a string alone needs a table for its units; of these only times are common.
    """
    spelt = f'units = "{unit}"'
    si = TO_SI[unit].si
    return f"convert {unit} to {si} (`{f'time = {{ from = …, {spelt} }}' if si == 's' else spelt}` in a mapping)"


def without_units(name: str) -> str:
    """A column's name without the units that end it, in brackets as `q [rad]` or behind a stroke as `q/rad`."""
    return (_behind_a_stroke(name) or [re.sub(r"\s*[\[(][^\[\]()]*[\])]\s*$", "", name).strip("/ ")])[0]


def stated_units(name: str) -> str:
    """Units that end a column's name, as it spells them; empty where none do."""
    in_brackets = re.search(r"[\[(]([^\[\]()]*)[\])]\s*$", name)
    return in_brackets[1].strip() if in_brackets else (*_behind_a_stroke(name), "", "")[1]


def spelt(name: str) -> str:
    """Unit that ends a name such as `stamp_ms`, `force_kg` or `torque_N_mm`, as it is spelt there; empty without one.

    Of single letters N is taken for one, but not of counts, and the g of a force. Words with another meaning there are
    not.
    """
    *before, last = re.split(r"[\s_./]+", name.strip())
    pair = f"{before[-1]} {last}" if len(before) > 1 else ""
    if is_foreign(pair) or (unit_name(pair) and TO_SI[unit_name(pair)].si == "N m"):
        return pair
    of_force = last == "g" and re.match(r"f(_|orce)|load|tension", name.lower()) is not None
    newtons = last == "N" and re.search(r"sample|count|num|index|id$", "_".join(before).lower()) is None
    known = (len(last) > 1 and last not in _NO_UNITS and (unit_name(last) or is_foreign(last))) or of_force or newtons
    return last if before and known else ""


def spelt_unit(name: str) -> str:
    """Unit that ends a name, as a mapping has it; empty where no mapping converts it."""
    return unit_name(spelt(name))


def _behind_a_stroke(name: str) -> tuple[str, ...]:
    """Quantity and unit of a name such as `q/rad`; nothing of other names, as of the path of a topic."""
    quantity, _, unit = (part.strip() for part in name.partition("/"))
    return (quantity, unit) if quantity and unit_name(unit) else ()


def weight_unit(stated: str) -> str:
    """Unit of force where a file states g or kg of a force; empty where it states another."""
    return {"g": "gf", "kg": "kgf"}.get(stated.strip(), "")


def is_foreign(stated: str) -> bool:
    """Whether a file states a unit that no mapping converts, such as lbf, V or counts."""
    return re.sub(r"[\s·*.-]", "", stated).lower() in _FOREIGN and not unit_name(stated)


def is_unknown(stated: str) -> bool:
    """Whether a file states a word in place of a unit that is none of the known ones, such as `grad`."""
    known = unit_name(stated) or is_foreign(stated) or is_ratio(stated)
    return not known and re.search(r"[^\W\d_]", stated) is not None


def is_ratio(stated: str) -> bool:
    """Whether a file states a unit of one quantity by another, such as rad/s or N m/A, which no channel has."""
    parts = re.sub(r"(\^|\*\*)?[2²]$", "", stated.strip()).split("/")
    return len(parts) > 1 and not is_foreign(stated) and all(unit_name(x) or is_foreign(x) for x in parts)


def unit_name(stated: str) -> str:
    """Name in `TO_SI` of a unit as a file spells it; empty where it is not listed there."""
    plain = re.sub(r"[·*.-]", " ", stated.strip()).replace("µ", "u")
    plain = _SPELT.get(plain.lower(), plain)
    joined = {name.replace(" ", ""): name for name in TO_SI if name != "1"}
    return joined.get(plain.replace(" ", ""), "")


def whole_turns(x: float, period: float, limits: Collection[float]) -> float:
    """Sum of whole periods that brings `x` nearest to the middle of the limits."""
    return round((sum(limits) / len(limits) - x) / period) * period


def near_limits(low: float, high: float, limits: Collection[float]) -> bool:
    """Whether an angle that runs from `low` to `high` rad stays near the joint's limits."""
    return bool(min(limits) - MAX_OVERTRAVEL <= low and high <= max(limits) + MAX_OVERTRAVEL)


def limits_of_turns(low: float, high: float) -> str:
    """The limits, as the finger's file has them, of a joint that turns on from `low` to `high` rad."""
    first, last = 360.0 * math.floor(low / (2.0 * math.pi)), 360.0 * math.ceil(high / (2.0 * math.pi))
    return f"`limits_deg = [{first:.0f}, {last:.0f}]` in the finger's file"


def beyond_a_turn(limits: Collection[float]) -> bool:
    """Whether the limits of a joint, rad, leave it more than a turn to one side. Limits of one turn may be rounded."""
    return bool(max(map(abs, limits)) > 2.0 * math.pi + 0.1)
