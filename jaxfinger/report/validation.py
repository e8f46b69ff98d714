"""Traces of the validation experiments: VD.1 and VD.2 as in the paper, and VD.3."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import numpy as np

from jaxfinger.data import Session, Trial
from jaxfinger.experiments import Stack, predict, prepare
from jaxfinger.identify import Fit
from jaxfinger.identify.predictions import model_for, predict_session
from jaxfinger.identify.validate import display, excursion_path
from jaxfinger.model import Model
from jaxfinger.report.theme import COLOURS, grid, look, save

PANELS = 3  # VD.2 trials in one figure


@look()
def draw_validation(
    fit: Fit, session: Session, folder: str | Path, overwrite: bool = False, suffix: str = ".svg"
) -> list[Path]:
    """Write one figure for each validation experiment of the session; the paths written.

    Raises:
        UserError: a figure exists and `overwrite` is false, or the session is of another finger.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    model = model_for(fit, session)
    figures = {}
    if trials := list(session.select("VD.1")):
        figures["vd1"] = _vd1(model, session, trials[0])
    if trials := list(session.select("VD.2")):
        names = [t.name for t in trials[:PANELS]]
        figures["vd2"] = _vd2(model, session, prepare(session, names)["VD.2"])
    if trials := list(session.select("VD.3")):
        figures["vd3"] = _vd3(model, session, trials[0])
    return [save(f, folder / f"{name}{suffix}", overwrite) for name, f in figures.items()]


def _colour(k: int) -> str:
    return COLOURS[k % len(COLOURS)]


def _vd1(model: Model, session: Session, trial: Trial):
    """Paper, Fig. 5: the path by hand, the excursions measured and predicted, and their errors."""
    path = excursion_path(model, trial)
    figure, axes = grid(4, 1, 6.4, 1.6, sharex=True)
    angles, lengths, errors, drifts = (row[0] for row in axes)
    for i, joint in enumerate(session.finger.joint_names):
        angles.plot(trial.time, trial.q[:, i] * display(session, "q", i)[0], color=_colour(i), label=joint)
    for k, tendon in enumerate(session.finger.tendon_names):
        measured = path.measured[:, k] * 1e3
        if np.isfinite(measured).any():
            lengths.plot(path.time, measured, color=_colour(k), label=tendon)
            lengths.plot(path.time, path.direct[:, k] * 1e3, color=_colour(k), linestyle="--", linewidth=0.9)
            errors.plot(path.time, measured - path.direct[:, k] * 1e3, color=_colour(k), linewidth=0.7)
            drifts.plot(path.time, measured - path.integral[:, k] * 1e3, color=_colour(k), linewidth=0.9)
    angles.set(ylabel="q (°)", title=trial.name)
    lengths.set(ylabel="excursion (mm)\ndashed: model")
    errors.set(ylabel="error (mm)\nf(q) − f(q₀)")
    drifts.set(ylabel="error (mm)\n∫ C q̇ dt", xlabel="time (s)")
    for ax in (angles, lengths):
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def _vd2(model: Model, session: Session, stack: Stack):
    """Paper, Fig. 9: force at the fingertip against tension, holds measured and predicted."""
    forces = np.asarray(_predict(model, stack.batch.x, ("fingertip_force",))["fingertip_force"])
    measured, mask = (np.asarray(a["fingertip_force"]) for a in (stack.batch.y, stack.batch.mask))
    figure, (axes,) = grid(1, len(stack.trials), 3.2, 2.8, sharey=True)
    for b, (ax, name) in enumerate(zip(axes, stack.trials, strict=True)):
        tendon = session[name].tendon
        k = session.finger.tendon_names.index(tendon) if tendon else int(np.argmax(np.ptp(stack.batch.x.tension, 2)))
        f = np.asarray(stack.batch.x.tension)[k, b]
        for a, axis in enumerate("xyz"):
            runs = stack.samples_of_holds(b, mask[a, b])
            at = [f[r].mean() for r in runs]
            ax.plot(
                at, [measured[a, b, r].mean() for r in runs], "o", color=_colour(a), markersize=4, label=f"f_{axis}"
            )
            ax.plot(at, [forces[a, b, r].mean() for r in runs], "x", color=_colour(a), markersize=5)
        ax.set(title=name, xlabel=f"tension of {session.finger.tendon_names[k]} (N)")
    axes[0].set_ylabel("force at the fingertip (N)\no measured, × model")
    axes[0].legend(loc="best")
    return figure


def _vd3(model: Model, session: Session, trial: Trial):
    """The whole model: motion simulated forward from the first sample, and the torque it lacks where all slide."""
    channels = predict_session(model, session, [trial.name])[trial.name]
    stack = prepare(session, [trial.name])["VD.3"]
    time, slides = np.asarray(stack.batch.x.time)[0], np.asarray(stack.batch.mask["joint_torque"])[:, 0] > 0
    lacking = np.asarray(_predict(model, stack.batch.x, ("joint_torque",))["joint_torque"])
    figure, axes = grid(3, 1, 6.4, 1.8, sharex=True)
    motion, error, torque = (row[0] for row in axes)
    for i, joint in enumerate(session.finger.joint_names):
        factor = display(session, "q", i)[0]
        motion.plot(trial.time, trial.q[:, i] * factor, color=_colour(i), label=joint)
        motion.plot(trial.time, channels["q"][:, i] * factor, color=_colour(i), linestyle="--", linewidth=0.9)
        error.plot(trial.time, (trial.q[:, i] - channels["q"][:, i]) * factor, color=_colour(i), linewidth=0.9)
        where = np.where(slides[i], lacking[i, 0] * display(session, "joint_torque", i)[0], np.nan)
        torque.plot(time, where, ".", color=_colour(i), markersize=2)
    motion.set(ylabel="q (°)\ndashed: simulated", title=trial.name)
    motion.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    error.set(ylabel="error (°)")
    torque.set(ylabel="torque not\nexplained (N mm)", xlabel="time (s)")
    return figure


_predict = eqx.filter_jit(predict)
