"""Check a session: every fault of it, each in one sentence with its mend."""

from __future__ import annotations

from collections import defaultdict
from datetime import datetime
from itertools import pairwise

import numpy as np

from jaxfinger.data.checks.columns import check_columns
from jaxfinger.data.checks.copies import check_copied_columns, check_copied_trials
from jaxfinger.data.checks.curves import check_curves
from jaxfinger.data.checks.delay import check_delay
from jaxfinger.data.checks.finger import check_finger
from jaxfinger.data.checks.gravity import check_gravity, check_torque_scales
from jaxfinger.data.checks.held import check_held
from jaxfinger.data.checks.paths import check_paths
from jaxfinger.data.checks.pulls import check_pulls
from jaxfinger.data.checks.trial import check_trial
from jaxfinger.data.checks.values import MAX_TARE_ERROR
from jaxfinger.data.checks.work import check_work
from jaxfinger.data.findings import Report
from jaxfinger.data.schema import MEASURED
from jaxfinger.data.session import EXPERIMENT_NAMES, Session
from jaxfinger.data.signals.arms import Excursions
from jaxfinger.data.signals.quantiles import median
from jaxfinger.data.signals.sizes import MAX_SAMPLES, Sizes, sizes_of
from jaxfinger.data.signals.spikes import longest_spike, outlier_mask
from jaxfinger.data.units import conversion
from jaxfinger.errors import counted, listed

# Share of a column's samples from which spikes are a warning instead of a note. Up to this share the mask finds them
# with certainty; motors driven by a coarse encoder reach 0.09.
_MANY_SPIKES = 0.1
# Motions that are slower or quicker than the protocol's by these factors are doubtful. A crane may need 30 times as
# long, a small servo a tenth; ms read as s differ by 1000, minutes read as s by 60.
_MAX_PACE, _MAX_QUICKNESS = 64.0, 16.0
_MAX_OVERLAP = 0.1  # of a trial's length: starts may be rounded, and trials last a little longer than planned.


def check_session(session: Session, report: Report) -> None:
    """Report every fault of a session in memory, except those that `check_samples` finds."""
    # Extreme numbers may overflow; the checks themselves report them.
    with np.errstate(all="ignore"):
        check_finger(session.finger, report)
        sizes = sizes_of(session)
        for trial in session:
            if trial.experiment not in EXPERIMENT_NAMES:
                known = ", ".join(EXPERIMENT_NAMES)
                message = f"has the unknown experiment {trial.experiment!r}; it must be one of {known}"
                report.error(trial.place(), message)
                continue
            check_trial(trial, session.finger, sizes, report)
        _check_tare(session, sizes, report)
    _check_pace(sizes, report)
    _check_order(session, report)
    _check_overlap(session, report)
    _check_motions(session, report)
    check_copied_trials(session, report)
    if session.created:
        _check_created(session.created, report)


def _check_pace(sizes: Sizes, report: Report) -> None:
    """Report motions so slow or so quick that their times are probably in another unit."""
    if sizes.pace > _MAX_PACE:
        said = f"joints move {sizes.pace:.0f} times more slowly than in the protocol; {conversion('ms')}"
        report.warning("/trials", f"{said} if that is what times are in")
    if (quick := min(sizes.pace, sizes.slow_pace)) < 1.0 / _MAX_QUICKNESS:
        said = f"joints move {1.0 / quick:.0f} times more quickly than in the protocol"
        report.warning("/trials", f"{said}; check the units of times, which are to be in s, not in minutes or days")


def _check_tare(session: Session, sizes: Sizes, report: Report) -> None:
    """Note where no tendon is ever slack in ID.4, where all but one may be: the zeros of all may be wrong."""
    lows = [
        np.percentile(f[:: max(1, len(f) // MAX_SAMPLES)], 5.0, axis=0)[session.finger.active]
        for trial in session.select("ID.4")
        if (f := trial.tendon_force) is not None and len(f)
    ]
    low = np.nanmin(lows, initial=np.inf) if lows and np.isfinite(lows).any() else 0.0
    if low > max(MAX_TARE_ERROR * sizes.tension, sizes.slack):
        report.note("/trials", f"no tendon reads less than {low:.3g} N in ID.4; check the tare if one was ever slack")


def _check_order(session: Session, report: Report) -> None:
    without = [trial.name for trial in session if trial.session_start is None]
    if without and len(without) < len(session):
        report.warning(
            "/trials", f"{listed(without)} lack `session_start`, so trials are ordered by name; give it to all or none"
        )


def _check_overlap(session: Session, report: Report) -> None:
    """Report trials that begin before the one before them has ended."""
    spans = sorted((t.session_start, float(t.time[-1]), t.name) for t in session if t.session_start is not None)
    early = [
        (later, earlier)
        for (start, lasts, earlier), (begin, _, later) in pairwise(spans)
        if begin < start + (1.0 - _MAX_OVERLAP) * lasts
    ]
    if early:
        (later, earlier), *more = early
        also = f", and likewise {counted(len(more), 'other trial')}" if more else ""
        message = f"{later} begins before {earlier} has ended{also}; write `session_start` in s, as `time`"
        report.warning("/trials", message)


def _check_motions(session: Session, report: Report) -> None:
    """Report trials that share a `motion` and differ in experiment, joint or tendon."""
    kinds: dict[str, set] = defaultdict(set)
    for trial in session:
        if trial.motion is not None:
            kinds[trial.motion].add((trial.experiment, trial.joint, trial.tendon))
    for motion, found in kinds.items():
        if len(found) > 1:
            report.warning(
                "/trials",
                f"the motion {motion!r} is shared by trials that differ in experiment, joint or tendon; "
                "their differences are not only noise: give each motion its own name",
            )


def _check_created(created: str, report: Report) -> None:
    try:
        zoned = datetime.fromisoformat(created).tzinfo is not None
    except ValueError:
        zoned = False
    if not zoned:
        report.warning("/", f"has `created` {created!r}; write ISO 8601 with time zone, as 2026-01-31T12:00:00+00:00")


def check_samples(session: Session, report: Report) -> None:
    """Report spikes, sensors that stand still, and channels that contradict each other or are late.

    These checks are slow: they go through every sample.
    """
    with np.errstate(all="ignore"):
        check_spikes(session, report)
        if report.fatal is None:
            kinematic = Excursions(session)
            check_work(session, kinematic, report)
            check_columns(session, report)
            check_paths(session, kinematic, report)
            check_copied_columns(session, report)
            check_gravity(session, report)
            check_torque_scales(session, report)
            check_curves(session, report)
            check_held(session, report)
            check_delay(session, report)
            check_pulls(session, report)


def check_spikes(session: Session, report: Report) -> None:
    """Report columns that hold spikes (`outlier_mask`)."""
    for trial in session:
        longest = longest_spike(median(np.diff(trial.time)) if len(trial.time) > 1 else 0.0)
        for name in (name for name in MEASURED if getattr(trial, name) is not None):
            share = float(outlier_mask(getattr(trial, name), longest=longest).mean(axis=0).max(initial=0.0))
            if share > 0.0:
                say = report.warning if share > _MANY_SPIKES else report.note
                say(trial.place(name), f"up to {share:.2%} of a column's samples are spikes; robust fits discount them")
