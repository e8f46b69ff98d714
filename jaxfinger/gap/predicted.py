"""What another simulator predicts of a session: which trials and columns, in which steps, and whether it can be so."""

from collections import Counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfinger.data import Predictions, Session, Trial
from jaxfinger.data.findings import Finding, Report, merged
from jaxfinger.data.predictions import predicted_at, refuse_misfits
from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.signals.sizes import sizes_of
from jaxfinger.errors import UserError, counted, listed
from jaxfinger.experiments import EXPERIMENTS
from jaxfinger.gap.comparison import compare
from jaxfinger.gap.likeness import check_likeness

# Share of a column's range: changes below it are rounding of a computation.
MAX_ROUNDING = 1e-9
# Values that a rounded column has at least: few values are multiples of some step by chance.
MIN_VALUES = 6
# Of median steps, predictions over recording. Up to it clocks may jitter; beyond, samples are lacking.
MAX_STEP_RATIO = 1.5
MAX_ODD = 0.01  # of a step, by which rounded values are off: written digits are exact but for rounding


def check_predictions(session: Session, predictions: Predictions) -> Report:
    """Check what another simulator predicts of a session; findings that trials share are merged.

    Raises:
        UserError: the predictions do not fit the session's trials (`refuse_misfits`), or predict nothing of them that
            is judged.
    """
    refuse_misfits(session, predictions)
    report = Report()
    _report_coverage(session, predictions, report)
    _report_other_motion(session, predictions, report)
    _report_unmeasured(session, predictions, report)
    _report_steps(session, predictions, report)
    _report_digits(session, predictions, report)
    check_likeness(session, predictions, report)
    return Report(merged(report))


class CheckedPredictions(NamedTuple):
    """Predictions of a session that may be right, with what is doubtful about them."""

    values: Predictions
    doubts: tuple[Finding, ...]


def checked(session: Session, predictions: Predictions, file: str) -> CheckedPredictions:
    """Check predictions, and refuse those that can only be a mistake; `file` is named in the message.

    Raises:
        UserError: the first error that `check_predictions` finds or raises.
    """
    report = check_predictions(session, predictions)
    if report.fatal is not None:
        raise UserError(f"{file}: {report.fatal.sentence}")
    return CheckedPredictions(predictions, tuple(report))


def _judged(trial: Trial, predictions: Predictions) -> list[str]:
    """Channels of a trial that are predicted, at least in one column, and read by a diagnosis."""
    told = predictions.get(trial.name, {})
    return [c for c in EXPERIMENTS[trial.experiment].channels if c in told and np.isfinite(told[c]).any()]


def _report_coverage(session: Session, predictions: Predictions, report: Report) -> None:
    """Say which trials count where not all do, and name predicted trials that the session lacks."""
    counts = {t.name for t in session if _judged(t, predictions)}
    if not counts:
        named = next((t for t in session if t.name in predictions), None)
        mend = "predict its trials under their own names"
        if named is not None:
            wanted = " or ".join(EXPERIMENTS[named.experiment].channels)
            mend = f"of {named.name} ({named.experiment}) predict {wanted}"
        raise UserError(f"{session.file or 'the session'}: none of its trials is in the predictions; {mend}")
    if strangers := [name for name in predictions if name not in session.trials]:
        said = f"predictions of {counted(len(strangers), 'trial')} that the session lacks ({listed(strangers, 3)})"
        report.warning("/", f"{said} are passed over; give trials the session's names")
    if len(counts) < len(session):
        recorded, predicted = (Counter(t.experiment for t in s) for s in (session, session.with_trials(counts)))
        parts = [f"{predicted[e]} of {n} {e}" for e, n in recorded.items() if predicted[e]]
        said = f"{len(counts)} of {len(session)} trials are predicted ({', '.join(parts)})"
        report.note("/", f"{said}; the diagnosis rests on these alone")


def _report_other_motion(session: Session, predictions: Predictions, report: Report) -> None:
    """Report angles that a simulator read and that are not the session's; those of VD.3 it may have predicted."""
    for trial in session:
        told = predictions.get(trial.name, {})
        if "q" in told and trial.experiment != "VD.3":
            angles = compare(trial.name, "q", trial.q, predicted_at(told, "q", trial, trial.q.shape))
            if other := [
                name for name, unlike in zip(session.finger.joint_names, angles.unlike, strict=True) if unlike
            ]:
                said = f"predictions were made for another motion of {listed(other)} than the session's"
                report.error(
                    f"/trials/{trial.name}/q", f"{said}; predict this session, at its own angles and in their units"
                )


def _report_unmeasured(session: Session, predictions: Predictions, report: Report) -> None:
    """Report channels of a trial of which only columns are predicted that nobody measured."""
    for trial in session:
        for channel in _judged(trial, predictions):
            values = getattr(trial, channel)
            if values is None:
                continue
            names = CHANNELS[channel].columns(session.finger)
            measured, told = (np.isfinite(x).any(axis=0) for x in (values, predictions[trial.name][channel]))
            if measured.any() and told.any() and not (measured & told).any():
                there, wanted = (listed([names[k] for k in np.flatnonzero(x)]) for x in (told, measured))
                said = f"predictions are of {there} alone, and {wanted} was measured"
                report.warning(f"/trials/{trial.name}/{channel}", f"{said}; predict {wanted}")


def _report_steps(session: Session, predictions: Predictions, report: Report) -> None:
    """Report predictions in steps longer than the averages that a diagnosis reads."""
    sizes = sizes_of(session)
    for trial in session:
        told = predictions.get(trial.name, {})
        time = np.asarray(told.get("time", ()))
        experiment = EXPERIMENTS[trial.experiment]
        longest = (sizes.pace if experiment.kind == "driven" else sizes.slow_pace) / experiment.rate
        if len(time) > 1 and len(trial.time) > 1 and _judged(trial, predictions):
            step = float(np.median(np.diff(time)))
            # No step need be shorter than those of the recording.
            if step > max(longest, MAX_STEP_RATIO * float(np.median(np.diff(trial.time)))):
                said = f"predictions come every {step:.2g} s, and lines between them hide quicker motion"
                report.warning(
                    f"/trials/{trial.name}", f"{said}; predict at the session's times, or every {longest:.2g} s"
                )


def _report_digits(session: Session, predictions: Predictions, report: Report) -> None:
    """Report predictions that were rounded to steps longer than the sensor's noise, which look like a gap."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for trial in session:
        for channel in _judged(trial, predictions):
            measured = getattr(trial, channel)
            if measured is not None and len(trial.time) > 2:
                # Second differences of white noise have six times its variance.
                noise = np.sqrt(np.mean(np.diff(measured, 2, axis=0) ** 2, axis=0) / 6.0)
                steps = np.array([_step(x) for x in np.asarray(predictions[trial.name][channel]).T])
                names = CHANNELS[channel].columns(session.finger)
                if coarse := {names[k]: float(steps[k]) for k in np.flatnonzero(steps > noise)}:
                    found.setdefault(channel, {})[trial.name] = coarse
    for channel, trials in found.items():
        steps = {name: step for coarse in trials.values() for name, step in coarse.items()}
        said = (
            f"predictions of {listed(list(steps))} come in steps of {max(steps.values()):.2g} {CHANNELS[channel].units}"
        )
        for name in trials:
            report.warning(f"/trials/{name}/{channel}", f"{said}, longer than the sensor's noise; write more digits")


def _step(x: Float[np.ndarray, " N"]) -> float:
    """The step of which all changes of x are multiples; zero where there is none, or where few values could be."""
    values = np.unique(x[np.isfinite(x)])
    steps = np.diff(values)
    steps = steps[steps > MAX_ROUNDING * np.ptp(values)] if len(values) > 1 else steps
    if len(values) < MIN_VALUES or not len(steps):
        return 0.0
    multiples = (values - values[0]) / steps.min()
    return float(steps.min()) if np.abs(multiples - np.round(multiples)).max() < MAX_ODD else 0.0
