"""Check that a trial's channels fit its experiment, its finger and SI units."""

from __future__ import annotations

import numpy as np

from jaxfinger.data.check_jumps import check_jumps, placeholder
from jaxfinger.data.constant import constant_columns
from jaxfinger.data.findings import Report
from jaxfinger.data.motion import MIN_HOLD, pulled_slowly
from jaxfinger.data.schema import CHANNELS, DRIVES, MEASURED, MEASURES, NEEDS_JOINT, NEEDS_TENDON
from jaxfinger.data.session import FingerDescription, Trial
from jaxfinger.data.sizes import MAX_RATE, NOISE_FACTOR, Sizes
from jaxfinger.data.units import conversion, whole_turns
from jaxfinger.errors import counted, listed

STILL_ANGLE = 0.01  # rad: five times the noise of a 14-bit encoder
_MIN_MOTION = 0.1  # rad: fixtures that hold a joint yield by less.
STILL_DISTANCE = 1e-4  # m, likewise of a prismatic joint: a hundredth of a rad at a radius of 10 mm
MAX_OVERTRAVEL = 0.35  # rad, 20 degrees, that a joint may read beyond its limits, since stated limits are approximate
# Readings below zero, as shares of the highest tension. A good tare is off by a hundredth. A taut tendon is held at a
# fifth or more (`data.sizes`), so a column of the wrong sign reads at least twice MAX_PUSH below zero.
MAX_TARE_ERROR = 0.03
_MAX_TARE = 0.5  # of the highest tension: a tendon that reads more is pulled on purpose.
MAX_PUSH = 0.1
# Of the machine's reach. A moment arm is about a tenth of it, and a joint turns by less than a turn; degrees for rad
# make 57 times as much, which the check of moment arms names, and mm for m a thousand times.
_MAX_EXCURSION = 20.0
_GRAVITY = 9.81  # m/s², for the weight of machines that are described without gravity, too
# Of the weight of all links. Strong tendons of a light finger pull with some hundred times; pulls of a finger with 10 N
# are some ten thousand of it in mN.
_MAX_TENSION = 5000.0
# Of the torque with which the whole machine weighs on an arm as long as its reach. A motor that leads a light joint
# with friction and stiff springs gives up to tens of it; torques in N mm of one that only weighs are some 400 of it.
_MAX_TORQUE = 200.0
_MAX_DEGREES = 400.0  # Angles in degrees are smaller: a turn, with room.
COLD = 200.0  # K, −73 °C: no laboratory is colder, so lower values are in °C.
# A converter's limit is repeated over more samples at once, by this factor, than any value within its range. At the
# turn of a smooth motion the last step of the resolution is held up to five times as long as the one before it.
_CLIPPED, _MIN_CLIPPED = 10, 10
_SEVERAL_PULL = ("VD.2", "VD.3")  # experiments with the tension of several tendons at once
_SLACK = ("ID.3-static", "ID.3-dynamic")  # experiments with slack tendons, whose tensions are not used
_MIN_SAMPLES = 20  # Fewer samples show no typical step.
_MOVES_JOINT = ("ID.2", "ID.3-static", "ID.3-dynamic")
_STEPPED = ("ID.3-static", "ID.4", "VD.2")


def check_trial(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Report every fault of one trial. `sizes` are those of its session."""
    _attributes(trial, finger, report)
    _time(trial, report)
    for name in MEASURED:
        if getattr(trial, name) is not None:
            _nan(trial, name, finger, sizes, report)
    _channels(trial, finger, report)
    _motion(trial, finger, sizes, report)
    _constant_columns(trial, finger, report)
    _clipped_columns(trial, finger, report)
    _placeholders(trial, finger, report)
    check_jumps(trial, finger, _still_spans(finger), report)
    _magnitudes(trial, finger, sizes, report)
    _holds(trial, report)


def _place(trial: Trial, channel: str = "") -> str:
    return f"/trials/{trial.name}/{channel}".rstrip("/")


def _attributes(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Check that the attributes `joint` and `tendon` fit the experiment and the finger's tables."""
    place = _place(trial)
    for kind, value, names, needed in (
        ("joint", trial.joint, finger.joint_names, trial.experiment in NEEDS_JOINT),
        ("tendon", trial.tendon, finger.tendon_names, trial.experiment in NEEDS_TENDON),
    ):
        if value is None and needed and not (kind == "joint" and _several_joints(trial, finger)):
            report.error(
                place, f"is {trial.experiment} and has no attribute `{kind}`; write which one of {listed(names)}"
            )
        elif value is not None and value not in names:
            report.error(
                place, f"names the {kind} {value!r}, which the finger has not; it must be one of {listed(names)}"
            )
    if trial.tendon not in finger.tendon_names or trial.experiment not in NEEDS_TENDON:
        return
    tendon = finger.tendon_names.index(trial.tendon)
    if not finger.active[tendon]:
        report.error(
            place, f"pulls tendon {trial.tendon}, which is passive; correct the trial or /finger/tendons/active"
        )
    joint = _index(finger.joint_names, trial.joint)
    if trial.experiment == "ID.4" and joint is not None and not finger.crosses[tendon, joint]:
        message = f"pulls {trial.tendon} at joint {trial.joint}, which it does not cross"
        report.error(place, f"{message}; correct the trial or /finger/tendons/crosses")


def _several_joints(trial: Trial, finger: FingerDescription) -> bool:
    """Whether the trial moves, or measures the torque of, more than one joint."""
    if trial.experiment == "ID.2":
        return sum(bool(span >= still) for span, still in zip(_spans(trial), _still_spans(finger), strict=True)) > 1
    return len(trial.motorised(finger)) > 1


def _index(names: tuple[str, ...], name: str | None) -> int | None:
    return names.index(name) if name in names else None


def _time(trial: Trial, report: Report) -> None:
    """Check that time increases from 0 in s, without gaps."""
    place, time = _place(trial, "time"), trial.time
    if not np.isfinite(time).all():
        report.error(
            place, f"is not finite at sample {int(np.argmin(np.isfinite(time)))}; write seconds from the trial's start"
        )
        return
    if len(time) < 2:
        report.warning(place, "holds a single sample, from which no motion can be seen; record the trial again")
        return
    steps = np.diff(time)
    if steps.min() <= 0.0:
        at = int(np.argmax(steps <= 0.0))
        what = "runs backwards" if (steps < 0.0).any() else "repeats"
        count = int((steps <= 0.0).sum())
        report.error(
            place, f"{what} after sample {at} ({time[at]:.6g} s), at {count} of {len(time)}; sort or drop these samples"
        )
        return
    usual = float(np.median(steps))
    if abs(time[0]) > max(10.0 * usual, 0.01):
        report.warning(place, f"starts at {time[0]:.6g} s; count from 0 in each trial")
    if usual > 0.2:
        report.warning(place, f"has a sample every {usual:.3g} s; {conversion('ms')} if that is what it is")
    if usual < 1.0 / MAX_RATE:
        report.warning(place, f"has a sample every {usual:.3g} s; convert times to s, such as days or hours")
    gaps = steps > max(20.0 * usual, 0.02)
    if gaps.any():
        lost = f"{counted(int(gaps.sum()), 'gap')}, the longest {steps.max():.3g} s"
        report.warning(place, f"has {lost}; samples were lost, derivatives bridge them")


def _nan(trial: Trial, name: str, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Check NaN: a whole column means «not measured»; within a column only a slack tendon's excursion may be NaN."""
    values = getattr(trial, name)
    bad = ~np.isfinite(values)
    if not bad.any():
        return
    for k, column in enumerate(CHANNELS[name].columns(finger)):
        count = int(bad[:, k].sum())
        if count == 0 or np.isnan(values[:, k]).all():
            continue
        if np.isinf(values[:, k]).any():
            report.error(
                _place(trial, name),
                f"column {column} holds infinite values; write NaN for a column that was not measured",
            )
        elif name == "tendon_excursion" and _slack(trial, bad[:, k], k, sizes):
            report.note(
                _place(trial, name), f"column {column} is NaN while the tendon is slack, in {counted(count, 'sample')}"
            )
        else:
            at = trial.time[int(np.argmax(bad[:, k]))]
            report.error(
                _place(trial, name),
                f"column {column} is NaN in {count} of {len(bad)} samples, first at {at:.6g} s; cut these samples out "
                "(`span` in a mapping), or make the whole column NaN if it was not measured",
            )


def _slack(trial: Trial, where: np.ndarray, tendon: int, sizes: Sizes) -> bool:
    return trial.tendon_force is not None and bool(np.all(trial.tendon_force[where, tendon] < sizes.slack))


def _channels(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Check that the channels that the experiment drives and measures are there."""
    what = trial.experiment
    for name in DRIVES.get(what, ()):
        if getattr(trial, name) is None:
            report.error(_place(trial, name), f"is missing, and {what} cannot be read without it; write this channel")
        elif what == "ID.4" and np.isnan(_pulled(trial, finger)).all():
            message = f"column {trial.tendon}, the tendon that is pulled, is NaN; write its tension"
            report.error(_place(trial, name), message)
    for name in MEASURES[what]:
        values = getattr(trial, name)
        lost = f", and it is what {what} measures: nothing can be identified from this trial; write this channel"
        joint = _index(finger.joint_names, trial.joint)
        if values is None:
            report.error(_place(trial, name), f"is missing{lost}", local=True)
        elif np.isnan(values).all():
            report.error(_place(trial, name), f"is NaN throughout{lost}", local=True)
        elif name == "joint_torque" and joint is not None and np.isnan(values[:, joint]).all():
            report.error(_place(trial, name), f"column {trial.joint} is NaN throughout{lost}", local=True)
    if what in _SEVERAL_PULL and trial.tendon_force is not None:
        for name, active, x in zip(finger.tendon_names, finger.active, trial.tendon_force.T, strict=True):
            if active and np.isnan(x).all():
                message = f"column {name} is not measured (NaN), and the tendon is taken for slack; write its tension"
                report.warning(_place(trial, "tendon_force"), message)
    for k, joint in enumerate(finger.joint_names):
        if np.isnan(trial.q[:, k]).all():
            say = report.error if joint == trial.joint else report.warning
            say(
                _place(trial, "q"), f"column {joint} is not measured (NaN), and no torque is known without it; write it"
            )


def _pulled(trial: Trial, finger: FingerDescription) -> np.ndarray:
    """Tension, N, of the tendon that the trial pulls; empty where there is none."""
    tendon = _index(finger.tendon_names, trial.tendon)
    return np.zeros(0) if trial.tendon_force is None or tendon is None else trial.tendon_force[:, tendon]


def _span(values: np.ndarray) -> float:
    """Travel of a column, from its first to its 99th percentile; NaN where a sample is not finite."""
    if len(values) == 0 or not np.isfinite(values).all():
        return np.nan
    low, high = np.percentile(values, [1.0, 99.0])
    return float(high - low)


def _spans(trial: Trial) -> np.ndarray:
    return np.array([_span(column) for column in trial.q.T])


def _still_spans(finger: FingerDescription) -> np.ndarray:
    """Travel (m,) of each joint, rad or m, below which it stands still."""
    return np.where(finger.prismatic, STILL_DISTANCE, STILL_ANGLE)


def _motion(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Check that the joints and tendons that the experiment moves do move, and that those it holds stand still."""
    spans, still = _spans(trial), _still_spans(finger)
    say = report.error if trial.complete else report.warning
    place = _place(trial, "q")
    moved = _index(finger.joint_names, trial.joint) if trial.experiment in _MOVES_JOINT else None
    if moved is not None and spans[moved] < still[moved]:
        message = f"joint {trial.joint} never moves (it spans {spans[moved]:.2g}), though {trial.experiment} moves it"
        say(place, f"{message}; correct the attribute `joint`, or record the trial again")
    elif (
        trial.experiment in ("VD.1", "VD.3") or (trial.joint is None and trial.experiment in _MOVES_JOINT)
    ) and np.all(spans < still):
        say(place, f"no joint moves, though {trial.experiment} moves them; record it again")
    held = [
        (name, span)
        for name, span, slides in zip(finger.joint_names, spans, finger.prismatic, strict=True)
        if not slides
        and span > _MIN_MOTION
        and (trial.experiment in ("ID.4", "VD.2") or (trial.experiment == "ID.2" and trial.joint not in (None, name)))
    ]
    for name, span in held:
        report.warning(
            place, f"joint {name} moves by {span:.2g} rad though {trial.experiment} holds it; check the fixture"
        )
    if trial.experiment in NEEDS_TENDON and _span(_pulled(trial, finger)) < sizes.travel:
        message = f"tendon {trial.tendon} is never pulled; check the attribute `tendon`"
        report.warning(_place(trial, "tendon_force"), message)
    elif trial.experiment in NEEDS_TENDON and not pulled_slowly(trial, _pulled(trial, finger), sizes):
        slowly = f"holds of {MIN_HOLD * sizes.slow_pace:g} s nor in ramps of {sizes.slow_pace:g} s"
        message = f"tendon {trial.tendon} is pulled neither in {slowly}"
        report.warning(_place(trial, "tendon_force"), f"{message}: nothing of the trial is judged; pull it slower")


def _constant_columns(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report measured columns that never change: such a column is not connected."""
    for name, still in constant_columns(trial, finger).items():
        for k in np.flatnonzero(still):
            value = getattr(trial, name)[0, k] + 0.0  # −0 becomes 0.
            report.warning(
                _place(trial, name),
                f"column {CHANNELS[name].columns(finger)[k]} is {value:.4g} at every sample, as no sensor is; check "
                "its cable and its column, or leave it out",
            )


def _clipped_columns(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report forces and torques that stay at their highest or lowest value longer than at any other.

    Zero is no limit of a converter: a tendon sensor may read zero while its tendon is slack.
    """
    for name in ("tendon_force", "joint_torque", "fingertip_force"):
        values = getattr(trial, name)
        for column, x in zip(CHANNELS[name].columns(finger), [] if values is None else values.T, strict=False):
            if len(x) < _MIN_SAMPLES or not np.isfinite(x).all() or np.ptp(x) == 0.0 or placeholder(x) is not None:
                continue
            starts = np.flatnonzero(np.diff(x, prepend=np.nan) != 0.0)
            runs, held = np.diff(np.append(starts, len(x))), x[starts]
            limits = [limit for limit in (x.min(), x.max()) if limit != 0.0]
            within = int(runs[~np.isin(held, limits)].max(initial=1))
            for limit in limits:
                if runs[held == limit].max() > max(_CLIPPED * within, _MIN_CLIPPED):
                    count = counted(int((x == limit).sum()), "sample")
                    message = f"column {column} is clipped: it stays at {limit:.4g}, an end of its range, in {count}"
                    report.warning(
                        _place(trial, name), f"{message}; record it with a wider range, or cut these samples out"
                    )


def _placeholders(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report values that stand for a missing one, such as 9999: repeated exactly, and far from all others."""
    for name in MEASURED:
        values = getattr(trial, name)
        for column, x in zip(CHANNELS[name].columns(finger), [] if values is None else values.T, strict=False):
            found = placeholder(x)
            if found is not None:
                at, count = trial.time[int(np.argmax(x == found))], counted(int((x == found).sum()), "sample")
                report.warning(
                    _place(trial, name),
                    f"column {column} is {found:.6g} in {count}, first at {at:.6g} s, far from all others, as where a "
                    "number stands for a missing value; cut these samples out (`where` in a mapping)",
                )


def _magnitudes(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Check that values have plausible sizes in SI units, and tensions the right sign."""
    turning = ~np.array(finger.prismatic)
    for k, name in enumerate(finger.joint_names):
        if not turning[k] or not np.isfinite(trial.q[:, k]).all():
            continue
        low, high = np.percentile(trial.q[:, k], [1.0, 99.0])
        lower, upper = finger.limits[k]
        where = f"column {name} runs from {low:.3g} to {high:.3g} rad"
        outside = low < lower - MAX_OVERTRAVEL or high > upper + MAX_OVERTRAVEL
        turn = whole_turns(0.5 * (low + high), 2.0 * np.pi, finger.limits[k])
        fits = low + turn >= lower - MAX_OVERTRAVEL and high + turn <= upper + MAX_OVERTRAVEL
        degrees, unwrap = conversion("deg"), "take a whole turn off (`unwrap = true` in a mapping)"
        # Degrees of a joint that moves would exceed its limits by more than a turn.
        if outside and fits and abs(turn) < 4.0 * np.pi and high - low > _MIN_MOTION:
            say = report.error if max(-low, high) > 2.0 * np.pi else report.warning
            say(_place(trial, "q"), f"{where}, a turn beside its limits {lower:.3g} to {upper:.3g}; {unwrap}")
        elif max(-low, high) > 2.0 * np.pi:
            mend = degrees if max(-low, high) < _MAX_DEGREES else "convert counts to rad (`scale` in a mapping)"
            mend += f", or {unwrap}" if fits and abs(turn) < 4.0 * np.pi else ""
            report.error(_place(trial, "q"), f"{where}, more than a turn; {mend}")
        elif outside:
            message = f"{where}, far outside its limits {lower:.3g} to {upper:.3g}; correct one or the other"
            report.warning(_place(trial, "q"), message)
    if trial.tendon_force is not None:
        _tension(trial, finger, sizes, report)
    if trial.temperature is not None:
        for name, x in zip(trial.temperature_names, trial.temperature.T, strict=True):
            if np.nanmax(x, initial=-np.inf) < COLD:
                report.warning(
                    _place(trial, "temperature"),
                    f'column {name} stays below {COLD:g} K; add 273.15 if it is in °C (`units = "degC"` in a mapping)',
                )
    if not turning.all():
        return
    reach = _reach(finger)
    for name, most, unit in (
        ("tendon_excursion", _MAX_EXCURSION * reach, "mm"),
        ("joint_torque", _MAX_TORQUE * _GRAVITY * float(finger.mass.sum()) * reach, "N mm"),
    ):
        values = getattr(trial, name)
        if values is None or most == 0.0:
            continue
        for column, x in zip(CHANNELS[name].columns(finger), values.T, strict=True):
            if np.isfinite(x).all() and (size := float(np.percentile(np.abs(x), 90.0))) > most:
                report.error(
                    _place(trial, name),
                    f"column {column} is of size {size:.3g}, too large for the lengths and masses of this machine; "
                    f"{conversion(unit)}",
                )


def _reach(finger: FingerDescription) -> float:
    """Length, m, of the stretched chain from its first joint to the end of its last link."""
    gyration = np.sqrt(np.trace(finger.inertia[-1]) / 2.0 / finger.mass[-1])
    last = max(np.linalg.norm(finger.fingertip), np.linalg.norm(finger.com[-1]), gyration)
    return float(np.linalg.norm(finger.origin[1:], axis=1).sum() + last)


def _tension(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Check that tensions are positive but for noise and tare, about zero where tendons are slack, and not in mN."""
    assert trial.tendon_force is not None
    place, tare = _place(trial, "tendon_force"), max(MAX_TARE_ERROR * sizes.tension, sizes.slack)
    unslack, slack = {}, []  # tendons with a tension where they are to be slack, and without one where to be taut
    for name, active, x in zip(finger.tendon_names, finger.active, trial.tendon_force.T, strict=True):
        if not np.isfinite(x).all():
            continue
        if not active:
            report.note(place, f"column {name} is measured though the tendon is passive; it is ignored")
            continue
        low = float(np.percentile(x, 5.0))
        if low < -max(MAX_PUSH * sizes.tension, sizes.slack) and trial.experiment not in _SLACK:
            report.error(place, f"column {name} falls to {low:.3g} N, and a tendon cannot push; check sign and tare")
        elif low < -tare:
            report.warning(place, f"column {name} falls to {low:.3g} N, below zero by more than noise; check the tare")
        elif trial.experiment in _SLACK and tare < low < _MAX_TARE * sizes.tension:
            unslack[name] = low
        elif trial.experiment == "ID.2" and np.median(x) <= NOISE_FACTOR * sizes.noise:
            slack.append(name)
        if np.percentile(x, 95.0) > (most := _MAX_TENSION * _GRAVITY * float(finger.mass.sum())):
            said = f"column {name} exceeds {_MAX_TENSION:.0f} times the weight of all links, {most:.2g} N"
            report.warning(place, f"{said}; {conversion('mN')} if that is what it is")
    if slack and trial.tendon_excursion is not None:
        said = f"shows no tension in {listed(slack)}, though ID.2 needs taut tendons to follow the joint"
        report.warning(place, f"{said}; check the columns, or record the trial again with tension")
    if unslack:
        said = f"stays above {min(unslack.values()):.3g} N in {listed(list(unslack))}"
        said = f"{said}, though {trial.experiment} leaves tendons slack"
        report.warning(place, f"{said}; check the tare, or let the tendons go")


def _holds(trial: Trial, report: Report) -> None:
    """Check that the channel `hold` marks holds, each with an index of its own."""
    if trial.hold is None:
        return
    place = _place(trial, "hold")
    starts = np.flatnonzero(np.diff(trial.hold, prepend=-2))
    runs = trial.hold[starts]
    runs = runs[runs >= 0]
    if len(runs) == 0 and trial.experiment in _STEPPED:
        report.warning(place, "marks no hold; leave the channel out to have holds derived from stillness")
    elif len(np.unique(runs)) < len(runs):
        index = int(next(i for i in runs if (runs == i).sum() > 1))
        report.warning(place, f"hold {index} is interrupted and comes back; give each hold its own index")
