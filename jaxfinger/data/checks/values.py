"""Check that the values of a trial's columns are those of a connected sensor, of plausible size in SI units."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.checks.jumps import check_jumps
from jaxfinger.data.findings import Report
from jaxfinger.data.mounting import reach_of, weight_of
from jaxfinger.data.schema import CHANNELS, DRIVES, measured_columns
from jaxfinger.data.session import FingerDescription, Trial
from jaxfinger.data.signals.motion import MIN_MOTION
from jaxfinger.data.signals.quantiles import median, quantile
from jaxfinger.data.signals.sizes import NOISE_FACTOR, Sizes
from jaxfinger.data.signals.unmeasured import constant_columns, placeholder
from jaxfinger.data.units import MAX_OVERTRAVEL, TO_SI, conversion, limits_of_turns, near_limits, whole_turns
from jaxfinger.errors import counted, listed

if TYPE_CHECKING:
    from jaxtyping import Float

# Readings below zero, as shares of the highest tension. A good tare is off by a hundredth. A taut tendon is held at a
# fifth or more (`data.signals.sizes`), so a column of the wrong sign reads at least twice _MAX_PUSH below zero.
MAX_TARE_ERROR = 0.03
_MAX_TARE = 0.5  # of the highest tension: a tendon that reads more is pulled.
_MAX_PUSH = 0.1
# Of the machine's reach. A moment arm is about a tenth of it, and a joint turns by less than a turn; degrees for rad
# make 57 times as much, which the check of moment arms names, and cm for m a hundred times.
_MAX_EXCURSION = 10.0
# Of the torque with which the whole machine weighs on an arm as long as its reach. A motor that leads a light joint
# with friction and stiff springs gives up to tens of it; torques in N mm of one that only weighs are some 400 of it.
_MAX_TORQUE = 200.0
# Of the weight of all links. Strong tendons of a light finger pull with some hundred times; pulls of a finger with 10 N
# are some ten thousand of it in mN.
_MAX_TENSION = 5000.0
_MAX_DEGREES = 400.0  # Angles in degrees are smaller: a turn, with room.
_COLD = 200.0  # K, −73 °C: no laboratory is colder, so lower values are in °C.
# A converter's limit is repeated over more samples at once, by this factor, than any value within its range. At the
# turn of a smooth motion the last step of the resolution is held up to five times as long as the one before it.
_CLIPPED, _MIN_CLIPPED = 10, 10
_SLACK = ("ID.3-static", "ID.3-dynamic")  # experiments with slack tendons, whose tensions are not used
_MIN_SAMPLES = 20  # Fewer samples show no typical step.


def check_values(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Report columns that no sensor reads so, or that are in other units. `sizes` are those of the session."""
    _constant_columns(trial, finger, report)
    _clipped_columns(trial, finger, report)
    _placeholders(trial, finger, report)
    check_jumps(trial, finger, report)
    _angles(trial, finger, report)
    if trial.tendon_force is not None:
        _tension(trial, finger, sizes, report)
    _temperatures(trial, report)
    _large_for_the_machine(trial, finger, sizes, report)


def _constant_columns(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report measured columns that never change: such a column is not connected."""
    for channel, still in constant_columns(trial, finger).items():
        names, of_value = CHANNELS[channel].columns(finger), defaultdict(list)
        for k in np.flatnonzero(still):
            of_value[getattr(trial, channel)[0, k] + 0.0].append(names[k])  # −0 becomes 0.
        for value, alike in of_value.items():
            columns, are, them = ("column", "is", "it") if len(alike) == 1 else ("columns", "are", "them")
            needed = channel in ("q", *DRIVES.get(trial.experiment, ()))
            mend = "record the trial again" if needed else f"leave {them} out"
            report.warning(
                trial.place(channel),
                f"{columns} {listed(alike)} {are} {value:.4g} at every sample, as no sensor is; check cable and "
                f"column, or {mend}",
            )


def _clipped_columns(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report forces and torques that stay at their highest or lowest value longer than at any other.

    Zero is no limit of a converter: a tendon sensor may read zero while its tendon is slack.
    """
    for channel, name, x in measured_columns(trial, finger, ("tendon_force", "joint_torque", "fingertip_force")):
        if len(x) < _MIN_SAMPLES or not np.isfinite(x).all() or np.ptp(x) == 0.0 or placeholder(x) is not None:
            continue
        starts = np.flatnonzero(np.diff(x, prepend=np.nan) != 0.0)
        runs, held = np.diff(np.append(starts, len(x))), x[starts]
        limits = [limit for limit in (x.min(), x.max()) if limit != 0.0]
        within = int(runs[~np.isin(held, limits)].max(initial=1))
        for limit in limits:
            if runs[held == limit].max() > max(_CLIPPED * within, _MIN_CLIPPED):
                count = counted(int((x == limit).sum()), "sample")
                message = f"column {name} is clipped: it stays at {limit:.4g}, an end of its range, in {count}"
                report.warning(
                    trial.place(channel), f"{message}; record it with a wider range, or cut these samples out"
                )


def _placeholders(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report values that stand for a missing one, such as 9999: repeated exactly, and far from all others."""
    for channel, name, x in measured_columns(trial, finger):
        found = placeholder(x)
        if found is not None:
            at, count = trial.time[int(np.argmax(x == found))], counted(int((x == found).sum()), "sample")
            report.warning(
                trial.place(channel),
                f"column {name} is {found:.6g} in {count}, first at {at:.6g} s, far from all others, as where a "
                "number stands for a missing value; cut these samples out (`where` in a mapping)",
            )


def _angles(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Check that revolute joints stay near their limits, and are in rad if these leave them no more than a turn."""
    place = trial.place("q")
    columns = zip(finger.joint_names, trial.q.T, finger.limits, finger.prismatic, strict=True)
    for name, q, limits, slides in columns:
        if slides or not np.isfinite(q).all() or near_limits(q.min(), q.max(), limits):
            continue
        missing = placeholder(q)
        measured = q if missing is None else q[q != missing]
        low, high = quantile(measured, 0.01), quantile(measured, 0.99)
        where = f"column {name} runs from {low:.3g} to {high:.3g} rad"
        its_limits = f"its limits {limits[0]:.3g} to {limits[1]:.3g}"
        outside = not near_limits(low, high, limits)
        turn = whole_turns(0.5 * (low + high), 2.0 * np.pi, limits)
        fits = near_limits(low + turn, high + turn, limits)
        unwrap = "take a whole turn off (`unwrap = true` in a mapping)"
        # Degrees of a joint that moves would exceed its limits by more than a turn.
        if outside and fits and abs(turn) < 4.0 * np.pi and high - low > MIN_MOTION:
            say = report.error if max(-low, high) > 2.0 * np.pi else report.warning
            say(place, f"{where}, a turn beside {its_limits}; {unwrap}")
        elif outside and max(-low, high) > 2.0 * np.pi:
            mend = _mend_of_turns(q, low, high, limits)
            mend += f", or {unwrap}" if fits and abs(turn) < 4.0 * np.pi else ""
            report.error(place, f"{where}, more than a turn; {mend}")
        elif outside:
            message = f"{where}, far outside {its_limits}; "
            # The angle between two links is half a turn where they are straight, and falls as the joint flexes.
            between = near_limits(np.pi - high, np.pi - low, limits)
            straight = "if it is 180 degrees where the finger is straight, write scale = -1.0 and offset = 180.0 (deg)"
            message += f"{straight}, or else correct its zero or the limits" if between else "correct one or the other"
            report.warning(place, message)


def _mend_of_turns(q: Float[np.ndarray, " N"], low: float, high: float, limits: Float[np.ndarray, "2"]) -> str:
    """What to do about an angle that runs from `low` to `high` rad, more than a turn, which its limits forbid.

    1. It is in counts, if it has whole numbers beyond 400, and otherwise in degrees if it has whole numbers.
    2. It is in degrees, if these lie within limits of less than a turn.
    3. Else the joint may also turn on and on.
    """
    other = conversion("deg") if max(-low, high) < _MAX_DEGREES else "convert counts to rad (`scale` in a mapping)"
    fits = near_limits(np.radians(low), np.radians(high), limits) and np.ptp(limits) < 2.0 * np.pi - MAX_OVERTRAVEL
    if fits or np.all(q == np.round(q)):
        return other
    return f"{other}, or, if the joint turns on, write {limits_of_turns(low, high)}"


def _temperatures(trial: Trial, report: Report) -> None:
    """Check that temperatures are in K."""
    if trial.temperature is None:
        return
    for name, x in zip(trial.temperature_names, trial.temperature.T, strict=True):
        if np.nanmax(x, initial=-np.inf) < _COLD:
            report.warning(
                trial.place("temperature"),
                f'column {name} stays below {_COLD:g} K; add 273.15 if it is in °C (`units = "degC"` in a mapping)',
            )


def _large_for_the_machine(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Check that excursions and torques are in m and N m: their sizes fit the machine's lengths and masses.

    A torque may also be that of a tendon, of which no arm is longer than the machine.
    """
    if any(finger.prismatic):
        return
    reach = reach_of(finger)
    for channel, most, unit, larger in (
        ("tendon_excursion", _MAX_EXCURSION * reach, "mm", "cm"),
        ("joint_torque", max(_MAX_TORQUE * weight_of(finger), sizes.tension) * reach, "N mm", "N cm"),
    ):
        for _, name, x in measured_columns(trial, finger, (channel,)) if most != 0.0 else ():
            if np.isfinite(x).all() and (size := quantile(np.abs(x), 0.9)) > most:
                other = f", or {conversion(larger)}" if TO_SI[larger].factor * size < most else ""
                report.error(
                    trial.place(channel),
                    f"column {name} is of size {size:.3g}, too large for the lengths and masses of this machine; "
                    f"{conversion(unit)}{other}",
                )


def _tension(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Check that tensions are positive but for noise and tare, about zero where tendons are slack, and not in mN."""
    assert trial.tendon_force is not None
    place, tare = trial.place("tendon_force"), max(MAX_TARE_ERROR * sizes.tension, sizes.slack)
    unslack, pulled = {}, {}  # tensions of tendons that are to be slack: read throughout, and pulled
    slack = []  # tendons without tension where they are to be taut
    for name, active, x in zip(finger.tendon_names, finger.active, trial.tendon_force.T, strict=True):
        if not np.isfinite(x).all():
            continue
        if not active:
            report.note(place, f"column {name} is measured though the tendon is passive; it is ignored")
            continue
        low, high = quantile(x, 0.05), quantile(x, 0.95)
        if low < -max(_MAX_PUSH * sizes.tension, sizes.slack) and trial.experiment not in _SLACK:
            report.error(place, f"column {name} falls to {low:.3g} N, and a tendon cannot push; check sign and tare")
        elif trial.experiment in _SLACK and high > tare:
            # The tare shifts all readings alike, and by less than a pull.
            of_tare = high - low < tare and low < _MAX_TARE * sizes.tension
            (unslack if of_tare else pulled)[name] = low if of_tare else high
        elif low < -tare:
            report.warning(place, f"column {name} falls to {low:.3g} N, below zero by more than noise; check the tare")
        elif trial.experiment == "ID.2" and median(x) <= NOISE_FACTOR * sizes.noise:
            slack.append(name)
        if high > _MAX_TENSION * weight_of(finger):
            said = f"column {name} exceeds {_MAX_TENSION:.0f} times the weight of all links"
            report.warning(place, f"{said}; {conversion('mN')} if that is what it is")
    if slack and trial.tendon_excursion is not None:
        said = f"shows no tension in {listed(slack)}, though ID.2 needs taut tendons to follow the joint"
        report.warning(place, f"{said}; check the columns, or record the trial again with tension")
    if unslack:
        said = f"stays above {min(unslack.values()):.3g} N in {listed(list(unslack))}"
        said = f"{said}, though {trial.experiment} leaves tendons slack"
        report.warning(place, f"{said}; check the tare, or let the tendons go")
    if pulled:
        said = f"reaches {max(pulled.values()):.3g} N in {listed(list(pulled))}, though {trial.experiment} leaves"
        said = f"{said} tendons slack, and what they pull is taken for a torque of the joints"
        report.warning(place, f"{said}; let them go, and record the trial again")
