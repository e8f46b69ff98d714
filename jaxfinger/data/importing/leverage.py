"""Units of tensions, excursions and torques by the moment arms that they mean, where names and sizes leave them open.

A tendon with moment arm r moves by r dq while its joint turns by dq, and gives the torque r df at a joint that is held.
Of the units that people use, the arms of a finger often fit one alone; where they fit two, the unit stays open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxfinger.data.importing.names import Owners
from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.importing.survey import GEARED, ColumnSurvey, agreed, columns_of, values_of, weight_on_reach
from jaxfinger.data.importing.turning import by_speeds
from jaxfinger.data.session import FingerDescription
from jaxfinger.data.units import STANDARD_GRAVITY, TO_SI, spelt, spelt_unit

# Range of a finger's largest moment arm, m, with room for a child's and for a large robot's. Where the arms are known,
# as shares of the largest: routed tendons lose up to two thirds of their tension on the way to the joint.
_ARMS = 1.5e-3, 60e-3
_OF_KNOWN = {"tendon_excursion": (0.5, 1.5), "tendon_force": (0.25, 1.5), "joint_torque": (0.25, 1.5)}
# Units of logs for each channel, with their SI factors, and those that are taken. The others only keep these from being
# taken, since turns of a spool and volts of a load cell may be of the same size.
_UNITS = {
    "tendon_excursion": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254},
    "tendon_force": {
        "N": 1.0,
        "lbf": 0.45359237 * STANDARD_GRAVITY,
        "mN": 1e-3,
        "gf": 1e-3 * STANDARD_GRAVITY,
        "kgf": STANDARD_GRAVITY,
    },
    "joint_torque": {"N m": 1.0, "N cm": 1e-2, "N mm": 1e-3, "kgf cm": 1e-2 * STANDARD_GRAVITY},
}
_TAKEN = "m", "mm", "N", "N m", "N mm"
_MIN_TURN, _MAX_YIELD = 0.2, 0.05  # rad: a joint that turns, and one that is held
_MIN_SHARE = 0.2  # of the largest change among tensions: smaller ones do not tell an arm
_MIN_EXPLAINED = 0.9  # of a column's variance: with less, something else than a lever moves it
_MIN_SAMPLES = 30
_MAX_RATIO = 200.0  # of travels in one unit; between m and mm it is a thousand
_MIN_SINGULAR = 0.1  # of the largest singular value: joints that only turn together share their arms


def surveyed(recordings: Sequence[Recording], finger: FingerDescription | None) -> list[list[ColumnSurvey]]:
    """Surveys of the columns of each of some recordings of one finger, where it is known."""
    names = (finger.joint_names, finger.tendon_names) if finger is not None else ()
    weight = weight_on_reach(finger)
    seen = [by_speeds(r, columns_of(r, recordings, *names, weight=weight)) for r in recordings]
    seen = _agreed(recordings, seen, Owners(*names or ((), ())), weight)
    seen = [_angles(r, columns, finger) for r, columns in zip(recordings, seen, strict=True)]
    return by_arms(recordings, seen, finger)


def _agreed(
    recordings: Sequence[Recording], seen: Sequence[Sequence[ColumnSurvey]], owners: Owners, weight: float
) -> list[list[ColumnSurvey]]:
    """Surveys with one guess for the columns of one quantity in all recordings, as torques of one joint in each."""
    rows = [(r, s) for r, columns in zip(recordings, seen, strict=True) for s in columns]
    sizes = {
        i: float(np.nanmax(np.abs(values_of(r, s))))
        for i, (r, s) in enumerate(rows)
        if s.meaning in _UNITS and _is_open(s, s.meaning)
    }
    told = iter(agreed([s for _, s in rows], sizes, owners, weight))
    return [[next(told) for _ in columns] for columns in seen]


def by_arms(
    recordings: Sequence[Recording], seen: Sequence[Sequence[ColumnSurvey]], finger: FingerDescription | None
) -> list[list[ColumnSurvey]]:
    """Surveys of the columns of some recordings of one finger, with the units that its moment arms tell.

    They tell those of columns for which neither the recording nor a name states one, and of a channel's columns alike;
    but travels that are hundreds of times smaller than others may be in another unit, and stay open. A guess from sizes
    is dropped where it contradicts them, and stays where nothing moves that tells an arm.
    """
    surveys = [list(columns) for columns in seen]
    for channel, units in _UNITS.items():
        low, high = _arms(finger, channel)
        slopes = [x for pair in zip(recordings, surveys, strict=True) for x in _slopes(*pair, channel)]
        if not slopes:
            continue
        power = -1.0 if channel == "tendon_force" else 1.0
        fitting = [unit for unit, factor in units.items() if low < max(slopes) * factor**power < high]
        unit = fitting[0] if len(fitting) == 1 and fitting[0] in _TAKEN else ""
        open_ = [s for columns in surveys for s in columns if _is_open(s, channel)]
        least = max(s.high - s.low for s in open_) / _MAX_RATIO if channel == "tendon_excursion" else 0.0
        told = {s: replace(s, units=unit if s.high - s.low >= least else "") for s in open_}
        surveys = [[told.get(s, s) for s in columns] for columns in surveys]
    return surveys


def _angles(recording: Recording, seen: Sequence[ColumnSurvey], finger: FingerDescription | None) -> list[ColumnSurvey]:
    """Surveys of a recording whose angles, taken for rad by their size, are left open where moment arms contradict it.

    The arms are those that travels in a known unit show. Angles of a motor before its gear make other ones.
    """
    guessed = [s for s in seen if s.units == "rad" and _is_open(s, "q")]
    travels = [s for s in seen if s.meaning == "tendon_excursion" and (s.stated or spelt_unit(s.name)) and s.units]
    turns = [q for s in guessed if _span(q := values_of(recording, s)) > _MIN_TURN]
    lengths = [values_of(recording, s) * TO_SI[s.units].factor for s in travels]
    slopes = [_largest_slope(x, [q for q in turns if len(q) == len(x)]) for x in lengths]
    arm, (low, high) = max(slopes, default=0.0), _arms(finger, "tendon_excursion")
    if not arm or low < arm < high:
        return list(seen)
    doubt = (
        f"in rad it would make a moment arm of {1e3 * arm:.3g} mm, not {1e3 * low:.3g} to {1e3 * high:.3g}: {GEARED}"
    )
    return [replace(s, units="", doubt=doubt) if s in guessed else s for s in seen]


def _arms(finger: FingerDescription | None, channel: str) -> tuple[float, float]:
    """Range in which the largest moment arm lies that a channel shows, m."""
    if finger is None or finger.excursion is None or np.isnan(finger.excursion).all():
        return _ARMS
    q = np.linspace(finger.limits[:, 0], finger.limits[:, 1], 9)[:, :, None]
    power = np.arange(finger.excursion.shape[2])
    arms = np.einsum("kip,sip->ski", np.nan_to_num(finger.excursion) * (power + 1.0), q**power)
    largest = float(np.abs(arms).max())
    return (_OF_KNOWN[channel][0] * largest, _OF_KNOWN[channel][1] * largest) if largest else _ARMS


def _slopes(recording: Recording, seen: Sequence[ColumnSurvey], channel: str) -> list[float]:
    """Slopes that are a moment arm but for the units of a channel whose units are open: of travel by angle, or of
    torque by tension."""
    angles = [s for s in seen if s.meaning == "q" and s.units and TO_SI[s.units].si == "rad" and s.samples > 1]
    turns = [values_of(recording, s) * TO_SI[s.units].factor for s in angles]
    open_ = [values_of(recording, s) for s in seen if _is_open(s, channel)]
    known = {"tendon_force": "joint_torque", "joint_torque": "tendon_force"}.get(channel, "")
    stated = [
        values_of(recording, s) * TO_SI[s.units].factor for s in seen if s.meaning == known and s.stated and s.units
    ]
    if channel == "tendon_excursion":
        by, felt = [q for q in turns if _span(q) > _MIN_TURN], open_
    elif not turns or max(_span(q) for q in turns) > _MAX_YIELD:
        return []
    else:
        by, felt = (open_, stated) if channel == "tendon_force" else (stated, open_)
        by = [f for f in by if _span(f) > _MIN_SHARE * max(map(_span, by))]
    slopes = (_largest_slope(x, [f for f in by if len(f) == len(x)]) for x in felt)
    return [slope for slope in slopes if slope]


def _is_open(seen: ColumnSurvey, channel: str) -> bool:
    """Whether a column is of a channel, and neither its recording nor its name says anything of its unit."""
    said = seen.stated or seen.foreign or seen.whole or spelt(seen.name)
    return seen.meaning == channel and not said and seen.missing < seen.samples


def _span(x: Float[np.ndarray, " N"]) -> float:
    """Range of the finite values, but for the outermost hundredths."""
    x = x[np.isfinite(x)]
    return float(np.ptp(np.quantile(x, (0.01, 0.99)))) if len(x) else 0.0


def _largest_slope(x: Float[np.ndarray, " N"], by: Sequence[Float[np.ndarray, " N"]]) -> float:
    """Largest slope of a column by some others; 0 where these do not explain it."""
    table = np.column_stack([x, *by])
    table = table[np.isfinite(table).all(axis=1)]
    if not by or len(table) < _MIN_SAMPLES:
        return 0.0
    table = table - table.mean(axis=0)
    slopes = np.linalg.lstsq(table[:, 1:], table[:, 0], rcond=_MIN_SINGULAR)[0]
    left, whole = np.sum((table[:, 0] - table[:, 1:] @ slopes) ** 2), np.sum(table[:, 0] ** 2)
    return float(np.abs(slopes).max()) if left < (1.0 - _MIN_EXPLAINED) * whole else 0.0
