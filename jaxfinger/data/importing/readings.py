"""Variables of a recording in SI units: scaled, shifted and unwrapped as a mapping says."""

from __future__ import annotations

import numpy as np

from jaxfinger.data.findings import Finding, Report
from jaxfinger.data.importing.mapping import Reading
from jaxfinger.data.importing.recording import Variable
from jaxfinger.data.toml import Place
from jaxfinger.data.units import TO_SI, is_foreign, spelt, unit_name, weight_unit
from jaxfinger.errors import listed

_MIN_VALUES = 30  # of a column: with fewer, values that are lost at random may look regular.
# Intervals of a slower column, as shares of the usual one: a rate that is no whole part of the samples' leaves 1 and 2
# samples, 4/3 of their mean at most. Where a tenth or more of the samples are lost at random, one interval in twenty is
# at least 1.6 of it.
_MAX_LONG = 1.5
_MIN_SLOWER = 1.2  # samples for each value: with fewer, one value in six is blank, as where some are lost.


def converted(values: np.ndarray, spec: Reading, units: str, scale: float, where: Place) -> np.ndarray:
    """Convert a variable to `units` (SI): variable · scale + offset, unwrapped where the mapping says so."""
    own = spec.units or units
    if own not in TO_SI or TO_SI[own].si != units:
        fitting = [name for name, unit in TO_SI.items() if unit.si == units]
        if own == "?":
            where.fail(
                f"has units that are still to be filled in; write one of {listed(fitting)}, and for others, such as "
                "counts, a `scale` too"
            )
        where.fail(f"has units {own!r}; it must be one of {listed(fitting)}, after `scale` and `offset`")
    unwrap = spec.unwrap
    if not isinstance(unwrap, bool):
        values = _unwrapped(values, unwrap)
    si = (values * scale + spec.offset) * TO_SI[own].factor + TO_SI[own].zero
    if unwrap is True:
        if units != "rad":
            where.fail("is no angle, so a whole turn means nothing; write unwrap = the period of the variable")
        si = _unwrapped(si, 2.0 * np.pi)
    return si


def _unwrapped(values: np.ndarray, period: float) -> np.ndarray:
    good = np.isfinite(values)
    out = np.array(values, np.float64)
    out[good] = np.unwrap(out[good], period=period)
    return out


def period(spec: Reading, units: str, scale: float) -> float:
    """Period in `units` (SI) by which a reading is unwrapped; 0 where it is not."""
    if isinstance(spec.unwrap, bool):
        return 2.0 * np.pi if spec.unwrap else 0.0
    return float(spec.unwrap) * abs(scale) * TO_SI[spec.units or units].factor


def is_slower(time: np.ndarray, there: np.ndarray) -> bool:
    """Whether a column with values `there` alone, a mask of the samples at `time`, has a slower clock of its own.

    Its values then come at regular intervals, longer than the samples'. Values that are lost now and then leave mostly
    intervals of one sample, and long ones among them.
    """
    if there.all() or there.sum() < _MIN_VALUES:
        return False
    steps, samples = np.diff(time[there]), np.diff(np.flatnonzero(there))
    long = np.percentile(steps, 95.0)
    regular = steps <= long
    return bool(long < _MAX_LONG * steps[regular].mean() and samples[regular].mean() > _MIN_SLOWER)


def compare_units(
    variable: Variable, spec: Reading, units: str, report: Report, where: Place, derived: bool = False
) -> None:
    """Warn where the recording, or the formula of a derived variable, has other units than the mapping."""
    text = variable.units or ("" if derived else spelt(spec.from_))
    weight = weight_unit(text) if units == "N" else ""
    stated, mapped = unit_name(text) or weight, spec.units or units
    as_it_is = spec.scale in (1.0, -1.0)
    said = ""
    if stated and mapped in TO_SI and stated != mapped and as_it_is and TO_SI[stated] != TO_SI[mapped]:
        states = f"the formula of {spec.from_!r} gives" if derived else "the recording states"
        said = f"{states} {text}, and the mapping reads {mapped}; "
        said += f'write units = "{weight}"' if weight else "correct one of them"
    elif is_foreign(text) and not weight and mapped != "1" and as_it_is:
        said = f"the recording states {text}, and the mapping reads {mapped}"
        said += f"; write `scale`, the {mapped} in one {text}"
    if said and Finding("warning", where.key, said) not in report:  # Trials share columns.
        report.warning(where.key, said)
