"""What another simulator predicts of a session: which trials and columns, in which steps, and whether it can be so."""

from collections import Counter
from collections.abc import Collection

import numpy as np

from jaxfinger.data import Predictions, Session, Trial
from jaxfinger.data.findings import Report, merged
from jaxfinger.data.predictions import refuse_misfits
from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.sizes import sizes_of
from jaxfinger.errors import UserError, counted, listed
from jaxfinger.experiments import EXPERIMENTS
from jaxfinger.gap.likeness import check_likeness


def check_predictions(session: Session, predictions: Predictions) -> Report:
    """Check what another simulator predicts of a session; findings that trials share are merged.

    Raises:
        UserError: the predictions do not fit the session's trials (`refuse_misfits`), or predict nothing of them that
            is judged.
    """
    refuse_misfits(session, predictions)
    report = Report()
    _report_coverage(session, predictions, report)
    _report_unmeasured(session, predictions, report)
    _report_steps(session, predictions, report)
    check_likeness(session, predictions, report)
    return Report(merged(report))


def refuse_mistaken(session: Session, predictions: Predictions, file: str) -> Report:
    """Check predictions, and refuse those that can only be a mistake; `file` is named in the message.

    Raises:
        UserError: the first error that `check_predictions` finds or raises.
    """
    report = check_predictions(session, predictions)
    if report.fatal is not None:
        raise UserError(f"{file}: {report.fatal.sentence}")
    return report


def _judged(trial: Trial, channels: Collection[str]) -> list[str]:
    """Channels among the predicted ones that a diagnosis of the trial reads."""
    return [c for c in EXPERIMENTS[trial.experiment].channels if c in channels]


def _report_coverage(session: Session, predictions: Predictions, report: Report) -> None:
    """Say which trials count where not all do, and name predicted trials that the session lacks."""
    counts = {t.name for t in session if _judged(t, predictions.get(t.name, {}).keys())}
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


def _report_unmeasured(session: Session, predictions: Predictions, report: Report) -> None:
    """Report channels of a trial of which only columns are predicted that nobody measured."""
    for trial in session:
        for channel in _judged(trial, predictions.get(trial.name, {}).keys()):
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
        if len(time) > 1 and len(trial.time) > 1 and _judged(trial, told.keys()):
            step = float(np.median(np.diff(time)))
            # No step need be shorter than those of the recording.
            if step > max(longest, 1.5 * float(np.median(np.diff(trial.time)))):
                said = f"predictions come every {step:.2g} s, and lines between them hide quicker motion"
                report.warning(
                    f"/trials/{trial.name}", f"{said}; predict at the session's times, or every {longest:.2g} s"
                )
