"""Files of predictions for a session, in the session's own layout (dataset format, "Predictions")."""

from __future__ import annotations

import os
from collections.abc import Mapping

import h5py
import numpy as np

from jaxfinger.data.check import open_file
from jaxfinger.data.findings import Report
from jaxfinger.data.hdf5 import new_file, write_dataset, write_header
from jaxfinger.data.parse import child, dataset, parse_finger, parse_version
from jaxfinger.data.schema import CHANNELS, TIME
from jaxfinger.data.session import Session
from jaxfinger.errors import UserError

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
            sizes = {"N": len(time), "m": finger.m, "n": finger.n}
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
                wanted = tuple(sizes[axis] if isinstance(axis, str) else axis for axis in CHANNELS[channel].shape)
                if np.shape(value) != wanted:
                    raise UserError(
                        f"{path}: /trials/{name}/{channel}: has shape {np.shape(value)}; it must be {wanted}"
                    )
                write_dataset(group, CHANNELS[channel], value, finger.prismatic)


def read_predictions(path: str | os.PathLike) -> dict[str, dict[str, np.ndarray]]:
    """Read the predicted channels of a file, `{trial: {"time": (N,), channel: array}}`, in SI units.

    >>> import jaxfinger as jf
    >>> session, fit = jf.read("session.h5"), jf.load("fit.json")
    >>> jf.write_predictions("predicted.h5", session, jf.predict(fit, session))
    >>> {name: sorted(channels) for name, channels in jf.read_predictions("predicted.h5").items()}
    {'01-ID3-dynamic-axis': ['joint_torque', 'time']}

    Raises:
        UserError: the first fault of the file.
    """
    report = Report()
    found: dict[str, dict[str, np.ndarray]] = {}
    file = open_file(path, report)
    if file is not None:
        try:
            with file:
                found = _parse(file, report)
        except Exception:  # h5py raises exceptions of many kinds on a damaged file.
            report.error("/", "cannot be read to the end: the file is damaged; predict again")
    if report.fatal is not None:
        raise UserError(f"{path}: {report.fatal.sentence}")
    return found


def _complete(place: str, time: np.ndarray, values: np.ndarray, report: Report) -> None:
    """Report a channel with a column that is NaN in some of its samples: predictions cover all samples or none."""
    bad = ~np.isfinite(values).reshape(len(values), -1)
    for column in bad.T:
        if column.any() and not column.all():
            at = time[int(np.argmax(column))]
            count = f"is NaN in {int(column.sum())} of {len(column)} samples, first at {at:.6g} s"
            report.error(place, f"{count}; predict every sample, or leave the column NaN throughout")
            return


def _parse(file: h5py.File, report: Report) -> dict[str, dict[str, np.ndarray]]:
    finger = parse_finger(file, report) if parse_version(file, report) else None
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
            if value is not None:
                _complete(f"{place}/{channel}", time, value, report)
        found[name] = {"time": time} | {channel: value for channel, value in values.items() if value is not None}
    return found
