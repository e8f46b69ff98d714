"""Check that a trial's channels fit its experiment, its finger and SI units."""

from __future__ import annotations

import numpy as np

from jaxfinger.data.checks.values import check_values
from jaxfinger.data.findings import Report
from jaxfinger.data.schema import CHANNELS, DRIVES, MEASURED, MEASURES, NEEDS_JOINT, NEEDS_TENDON
from jaxfinger.data.session import FingerDescription, Trial
from jaxfinger.data.signals.clock import gaps, longest_interval
from jaxfinger.data.signals.motion import HOLD_CUTOFF_HZ, MIN_HOLD, MIN_MOTION, pulled_slowly, still_spans
from jaxfinger.data.signals.quantiles import median, quantile
from jaxfinger.data.signals.sizes import MAX_RATE, STEP_TIME, Sizes
from jaxfinger.data.units import conversion
from jaxfinger.errors import counted, listed

_SEVERAL_PULL = ("VD.2", "VD.3")  # experiments with the tension of several tendons at once
_MOVES_JOINT = ("ID.2", "ID.3-static", "ID.3-dynamic")
_STEPPED = ("ID.3-static", "ID.4", "VD.2")
# Of its median, a tension's travel from the first to the 99th percentile: a motor that keeps a tension holds it to some
# percent, and a tendon that turns a joint round has to overcome the friction of joint and path both ways.
_MAX_STEADY = 0.1
_MAX_UNLIKE = 0.05  # of a joint's travel, by which the angle of another follows it: sensors agree to a few percent


def check_trial(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Report every fault of one trial. `sizes` are those of its session."""
    _attributes(trial, finger, report)
    _time(trial, sizes, report)
    for name in MEASURED:
        if getattr(trial, name) is not None:
            _nan(trial, name, finger, sizes, report)
    _channels(trial, finger, report)
    _motion(trial, finger, sizes, report)
    check_values(trial, finger, sizes, report)
    _holds(trial, report)


def _attributes(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Check that the attributes `joint` and `tendon` fit the experiment and the finger's tables."""
    place = trial.place()
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
    joint = finger.joint(trial.joint)
    if trial.experiment == "ID.4" and joint is not None and not finger.crosses[tendon, joint]:
        message = f"pulls {trial.tendon} at joint {trial.joint}, which it does not cross"
        report.error(place, f"{message}; correct the trial or /finger/tendons/crosses")


def _several_joints(trial: Trial, finger: FingerDescription) -> bool:
    """Whether the trial measures the torque of more than one joint, or, where it measures none, moves more than one."""
    if trial.experiment == "ID.2" or trial.joint_torque is None:
        return sum(bool(span >= still) for span, still in zip(_spans(trial), still_spans(finger), strict=True)) > 1
    return len(trial.motorised(finger)) > 1


def _time(trial: Trial, sizes: Sizes, report: Report) -> None:
    """Check that time increases from 0 in s, without gaps, and often enough to show the session's motions."""
    place, time = trial.place("time"), trial.time
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
    usual = median(steps)
    if abs(time[0]) > longest_interval(steps):
        report.warning(place, f"starts at {time[0]:.6g} s; count from 0 in each trial")
    # In this time a joint passes a tenth of its travel, so that longer intervals show no motion.
    if usual > STEP_TIME * max(sizes.slow_pace, 1.0):
        report.warning(place, f"has a sample every {usual:.3g} s; {conversion('ms')} if that is what it is")
    if usual < 1.0 / MAX_RATE:
        mend = "correct the units of the times, such as days, or ms of times that are in s"
        report.warning(place, f"has a sample every {usual:.3g} s, as no sensor has; {mend}")
    if (lost := gaps(steps)).any():
        said = f"{counted(int(lost.sum()), 'gap')}, the longest {steps.max():.3g} s"
        report.warning(place, f"has {said}; samples were lost, derivatives bridge them")


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
                trial.place(name),
                f"column {column} holds infinite values; write NaN for a column that was not measured",
            )
        elif name == "tendon_excursion" and _slack(trial, bad[:, k], k, sizes):
            report.note(
                trial.place(name), f"column {column} is NaN while the tendon is slack, in {counted(count, 'sample')}"
            )
        else:
            at = trial.time[int(np.argmax(bad[:, k]))]
            report.error(
                trial.place(name),
                f"column {column} is NaN in {count} of {len(bad)} samples, first at {at:.6g} s; cut these samples out "
                "(`span` or `where` in a mapping), or make the whole column NaN if it was not measured",
            )


def _slack(trial: Trial, where: np.ndarray, tendon: int, sizes: Sizes) -> bool:
    return trial.tendon_force is not None and bool(np.all(trial.tendon_force[where, tendon] < sizes.slack))


def _channels(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Check that the channels that the experiment drives and measures are there."""
    what = trial.experiment
    for name in DRIVES.get(what, ()):
        if getattr(trial, name) is None:
            report.error(trial.place(name), f"is missing, and {what} cannot be read without it; write this channel")
        elif what == "ID.4" and np.isnan(_pulled(trial, finger)).all():
            message = f"column {trial.tendon}, the tendon that is pulled, is NaN; write its tension"
            report.error(trial.place(name), message)
    for name in MEASURES[what]:
        values = getattr(trial, name)
        lost = f", and it is what {what} measures: nothing can be identified from this trial; write this channel"
        joint = finger.joint(trial.joint)
        if values is None:
            report.error(trial.place(name), f"is missing{lost}", local=True)
        elif np.isnan(values).all():
            report.error(trial.place(name), f"is NaN throughout{lost}", local=True)
        elif name == "joint_torque" and joint is not None and np.isnan(values[:, joint]).all():
            report.error(trial.place(name), f"column {trial.joint} is NaN throughout{lost}", local=True)
    if what in _SEVERAL_PULL and trial.tendon_force is not None:
        for name, active, x in zip(finger.tendon_names, finger.active, trial.tendon_force.T, strict=True):
            if active and np.isnan(x).all():
                message = f"column {name} is not measured (NaN), and the tendon is taken for slack; write its tension"
                report.warning(trial.place("tendon_force"), message)
    for k, joint in enumerate(finger.joint_names):
        if np.isnan(trial.q[:, k]).all():
            say = report.error if joint == trial.joint else report.warning
            say(trial.place("q"), f"column {joint} is not measured (NaN), and no torque is known without it; write it")


def _pulled(trial: Trial, finger: FingerDescription) -> np.ndarray:
    """Tension, N, of the tendon that the trial pulls; empty where there is none."""
    tendon = finger.tendon(trial.tendon)
    return np.zeros(0) if trial.tendon_force is None or tendon is None else trial.tendon_force[:, tendon]


def _all_steady(trial: Trial, finger: FingerDescription) -> bool:
    """Whether all tensions that are measured are kept constant; false where none is, or all are slack."""
    tension = np.zeros((0, finger.n)) if trial.tendon_force is None else trial.tendon_force[:, finger.active]
    measured = [x for x in tension.T if np.isfinite(x).any()]
    return bool(measured) and all(_span(x) < _MAX_STEADY * median(x) for x in measured)


def _span(values: np.ndarray) -> float:
    """Travel of a column, from its first to its 99th percentile; NaN where a sample is not finite."""
    if len(values) == 0 or not np.isfinite(values).all():
        return np.nan
    return quantile(values, 0.99) - quantile(values, 0.01)


def _spans(trial: Trial) -> np.ndarray:
    return np.array([_span(column) for column in trial.q.T])


def _followers(q: np.ndarray, moved: int, finger: FingerDescription) -> list[str]:
    """Names of the joints behind the `moved` one whose angles (N, m) are its own but for a constant."""
    x, turns = q[:, moved], not finger.prismatic[moved]
    return [
        name
        for k, name in enumerate(finger.joint_names)
        if k > moved and turns and not finger.prismatic[k] and _span(q[:, k] - x) < _MAX_UNLIKE * _span(x)
    ]


def _motion(trial: Trial, finger: FingerDescription, sizes: Sizes, report: Report) -> None:
    """Check that the joints and tendons that the experiment moves do move, and that those it holds stand still."""
    spans, still = _spans(trial), still_spans(finger)
    say = report.error if trial.complete else report.warning
    place = trial.place("q")
    moved = finger.joint(trial.joint) if trial.experiment in _MOVES_JOINT else None
    if moved is not None and spans[moved] < still[moved]:
        message = f"joint {trial.joint} never moves (it spans {spans[moved]:.2g}), though {trial.experiment} moves it"
        say(place, f"{message}; check its column, correct the attribute `joint`, or record the trial again")
    elif (
        trial.experiment in ("VD.1", "VD.3") or (trial.joint is None and trial.experiment in _MOVES_JOINT)
    ) and np.all(spans < still):
        say(place, f"no joint moves, though {trial.experiment} moves them; record it again")
    if trial.experiment == "VD.3" and (spans > still).any() and _all_steady(trial, finger):
        message = "no tension changes by a tenth of its size while joints move, as where they are moved by hand"
        report.warning(
            trial.place("tendon_force"),
            f"{message}, and in VD.3 tendons drive the finger; check these columns, or make the trial a VD.1, or an "
            "ID.2 if one joint moves alone",
        )
    held = [
        (name, span)
        for name, span, slides in zip(finger.joint_names, spans, finger.prismatic, strict=True)
        if not slides
        and span > MIN_MOTION
        and (trial.experiment in ("ID.4", "VD.2") or (trial.experiment == "ID.2" and trial.joint not in (None, name)))
    ]
    followers = [] if moved is None or spans[moved] < MIN_MOTION else _followers(trial.q, moved, finger)
    for name in followers:
        report.warning(
            place,
            f"joint {name} turns as far as {trial.joint} at every sample, as an angle against the base does; map their "
            "difference, each joint's angle against the link before it, or check whether the joints are coupled",
        )
    for name, span in held:
        if name not in followers:
            report.warning(
                place, f"joint {name} moves by {span:.2g} rad though {trial.experiment} holds it; check the fixture"
            )
    if trial.experiment in NEEDS_TENDON and _span(_pulled(trial, finger)) < sizes.travel:
        message = f"tendon {trial.tendon} is never pulled; check its column, and the attribute `tendon`"
        report.warning(trial.place("tendon_force"), message)
    elif trial.experiment in NEEDS_TENDON and not pulled_slowly(trial, _pulled(trial, finger), sizes):
        shortest = (MIN_HOLD + 2.0 / HOLD_CUTOFF_HZ) * sizes.slow_pace  # with both ends, which the filter blurs
        slowly = f"in two holds of {shortest:.2g} s nor in ramps of {sizes.slow_pace:g} s"
        message = f"tendon {trial.tendon} is pulled neither {slowly}: next to nothing of the trial is judged"
        report.warning(trial.place("tendon_force"), f"{message}; pull it slower, or map the channel `hold`")


def _holds(trial: Trial, report: Report) -> None:
    """Check that the channel `hold` marks holds, each with an index of its own."""
    if trial.hold is None:
        return
    place = trial.place("hold")
    starts = np.flatnonzero(np.diff(trial.hold, prepend=-2))
    runs = trial.hold[starts]
    runs = runs[runs >= 0]
    if len(runs) == 0 and trial.experiment in _STEPPED:
        report.warning(place, "marks no hold; leave the channel out to have holds derived from stillness")
    elif len(np.unique(runs)) < len(runs):
        index = int(next(i for i in runs if (runs == i).sum() > 1))
        report.warning(place, f"hold {index} is interrupted and comes back; give each hold its own index")
