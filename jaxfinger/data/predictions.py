"""Files of predictions for a session, in the session's own layout (dataset format, "Predictions")."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING

import h5py
import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.hdf5 import new_file, open_file, write_dataset, write_header
from jaxfinger.data.parse import child, dataset, parse_finger, parse_version, text_attribute
from jaxfinger.data.schema import CHANNELS, TIME
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.errors import UserError, listed, require

if TYPE_CHECKING:
    from jaxtyping import Float

Predictions = Mapping[str, Mapping[str, np.ndarray]]  # {trial: {channel: (N, columns)}}, SI units


def write_predictions(
    path: str | os.PathLike, session: Session, predictions: Predictions, overwrite: bool = False
) -> None:
    """Write predicted channels, `{trial: {channel: array}}`, with the session's times, root attributes and finger.

    Shapes and units are those of the measured channels. A trial's channels may include `time`, (N,) in s, where the
    prediction has times of its own.

    >>> import jaxfinger as jf
    >>> session = jf.read("session.h5")
    >>> mine = {trial.name: {"joint_torque": 0.0 * trial.joint_torque} for trial in session}
    >>> jf.write_predictions("simulator.h5", session, mine)

    Raises:
        UserError: the file exists and `overwrite` is false, or a trial, channel or shape does not fit the session.
    """
    require(Session, session=session)
    require(Mapping, predictions=predictions)
    finger = session.finger
    with new_file(path, overwrite) as file:
        write_header(file, session)
        file.attrs["content"] = "predictions"
        trials = file.create_group("trials")
        for name, channels in predictions.items():
            if name not in session.trials:
                raise UserError(f"{path}: /trials/{name}: is predicted but not in the session; predict its trials only")
            trial = session.trials[name]
            time = np.asarray(channels.get("time", trial.time))
            group = trials.create_group(name)
            for key in ("experiment", "joint", "tendon", "complete"):
                if getattr(trial, key) is not None:
                    group.attrs[key] = getattr(trial, key)
            write_dataset(group, TIME, time, finger.prismatic)
            for channel, value in channels.items():
                if channel == "time":
                    continue
                if channel not in CHANNELS:
                    raise UserError(
                        f"{path}: /trials/{name}/{channel}: is no channel; it must be one of {', '.join(CHANNELS)}"
                    )
                _refuse_shape(f"{path}: /trials/{name}/{channel}", channel, value, len(time), session)
                write_dataset(group, CHANNELS[channel], value, finger.prismatic)


def read_predictions(
    path: str | os.PathLike, session: Session | None = None, report: Report | None = None
) -> dict[str, dict[str, np.ndarray]]:
    """Read the predicted channels of a file, `{trial: {"time": (N,), channel: array}}`, in SI units.

    `session` is the one that they were made for. Findings go to `report`.

    >>> import jaxfinger as jf
    >>> session, fit = jf.read("session.h5"), jf.load("fit.json")
    >>> jf.write_predictions("predicted.h5", session, jf.predict(fit, session))
    >>> {name: sorted(channels) for name, channels in jf.read_predictions("predicted.h5").items()}
    {'01-ID3-dynamic-axis': ['joint_torque', 'time']}

    Raises:
        UserError: the first fault of the file, or its joints or tendons are not those of the session.
    """
    report = Report() if report is None else report
    found: dict[str, dict[str, np.ndarray]] = {}
    file = open_file(path, report)
    if file is not None:
        try:
            with file:
                found = _parse(file, session, report)
        except Exception:  # h5py raises exceptions of many kinds on a damaged file.
            report.error("/", "cannot be read to the end: the file is damaged; predict again")
    if report.fatal is not None:
        raise UserError(f"{path}: {report.fatal.sentence}")
    return found


def refuse_misfits(session: Session, predictions: Predictions) -> None:
    """Refuse predictions that do not fit the session's trials; those of other trials are passed over.

    Raises:
        UserError: a channel has another shape than the measured one or is NaN in some of its samples; a trial's times
            do not rise, or do not span the trial.
    """
    for name, channels in predictions.items():
        if name not in session.trials:
            continue
        place, recorded = f"{session.file or 'the session'}: predictions of /trials/{name}", session.trials[name].time
        time = np.asarray(channels.get("time", recorded), float)
        if time.ndim != 1 or not len(time) or not np.all(np.diff(time) > 0):
            raise UserError(f"{place}: have times that do not rise; give one time a sample, in s")
        step = float(np.median(np.diff(recorded))) if len(recorded) > 1 else 0.0
        # A simulator whose own steps start or end between two samples still spans the trial.
        if time[0] > recorded[0] + step or time[-1] < recorded[-1] - step:
            spans = f"from {time[0]:.6g} to {time[-1]:.6g} s of {recorded[0]:.6g} to {recorded[-1]:.6g} s"
            raise UserError(f"{place}: run {spans}; predict the whole trial, in its own time")
        for channel in CHANNELS.keys() & channels.keys():
            _refuse_shape(f"{place}/{channel}", channel, channels[channel], len(time), session)
            if fault := _incomplete(time, np.asarray(channels[channel], float)):
                raise UserError(f"{place}/{channel}: {fault}")


def predicted_at(
    prediction: Mapping[str, np.ndarray], channel: str, trial: Trial, shape: tuple[int, ...]
) -> Float[np.ndarray, "N columns"]:
    """Predicted channel at the trial's times, between samples by straight lines; NaN where there is no prediction."""
    if channel not in prediction:
        return np.full(shape, np.nan)
    columns = np.asarray(prediction[channel], float).T
    return np.stack([np.interp(trial.time, prediction.get("time", trial.time), a) for a in columns], axis=1)


def _refuse_shape(place: str, channel: str, value: np.ndarray, samples: int, session: Session) -> None:
    """Refuse a channel that has not the shape of the measured one; UserError names the shape that it must have."""
    sizes = {"N": samples, "m": session.finger.m, "n": session.finger.n}
    wanted = tuple(sizes[axis] if isinstance(axis, str) else axis for axis in CHANNELS[channel].shape)
    if np.shape(value) != wanted:
        raise UserError(f"{place}: has shape {np.shape(value)}; it must be {wanted}")


def _incomplete(time: np.ndarray, values: np.ndarray) -> str:
    """Say in which samples a column is infinite, or NaN while it is not in others; empty where it is neither."""
    columns = values.reshape(len(values), -1)
    for infinite, bad in ((True, np.isinf(columns)), (False, np.isnan(columns))):
        for column in bad.T:
            if column.any() and (infinite or not column.all()):
                at = time[int(np.argmax(column))]
                count = f"{int(column.sum())} of {len(column)} samples, first at {at:.6g} s"
                said = f"is {'infinite' if infinite else 'NaN'} in {count}"
                return f"{said}; predict every sample, or leave the column NaN throughout"
    return ""


def _report_other_names(finger: FingerDescription, of_session: FingerDescription, report: Report) -> None:
    """Report joints or tendons that are not those of the session, in its order."""
    for what in ("joint", "tendon"):
        told, wanted = (getattr(f, f"{what}_names") for f in (finger, of_session))
        if told != wanted:
            said = f"names {listed(told)} where the session has {listed(wanted)}"
            report.error(f"/finger/{what}s/name", f"{said}; give the columns of the session's {what}s, in its order")


def _parse(file: h5py.File, session: Session | None, report: Report) -> dict[str, dict[str, np.ndarray]]:
    finger = parse_finger(file, report) if parse_version(file, report) else None
    if finger is not None and session is not None:
        _report_other_names(finger, session.finger, report)
    if text_attribute(file, "content", "/", Report()) != "predictions":
        said = "has no attribute `content` that says `predictions`, and may hold recordings"
        report.warning("/", f"{said}; write it if these are predictions")
    trials = child(file, "trials", "/trials", report, h5py.Group) if finger is not None else None
    if finger is None or trials is None:
        return {}
    found = {}
    for name in trials:
        place = f"/trials/{name}"
        group = child(trials, name, place, report, h5py.Group)
        if group is None or (time := dataset(group, TIME, place, {}, finger.prismatic, report)) is None:
            continue
        sizes = {"N": len(time), "m": finger.m, "n": finger.n}
        values = {
            c: dataset(group, e, place, sizes, finger.prismatic, report) for c, e in CHANNELS.items() if c in group
        }
        for channel, value in values.items():
            if value is not None and (fault := _incomplete(time, value)):
                report.error(f"{place}/{channel}", fault)
        found[name] = {"time": time} | {channel: value for channel, value in values.items() if value is not None}
    return found
