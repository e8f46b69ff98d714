"""Figures of the validation experiments: VD.1 and VD.2 as in the paper, and VD.3."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from jaxfinger.data import Session, Trial
from jaxfinger.data.atomic import folder_to_fill
from jaxfinger.data.signals.sizes import sizes_of
from jaxfinger.experiments import Stack, predict_compiled, prepare
from jaxfinger.identify import Fit
from jaxfinger.identify.excursion_path import excursion_path
from jaxfinger.identify.predictions import model_for, predict_session
from jaxfinger.identify.validate import display
from jaxfinger.model import Model
from jaxfinger.report import plots
from jaxfinger.report.theme import grid, legend_beside, look, save

MAX_PANELS = 3  # VD.2 trials in one figure, which then fits across a page


@look()
def draw_validation(fit: Fit, session: Session, folder: str | Path, overwrite: bool = False) -> list[Path]:
    """Write one figure for each validation experiment of the session; return the paths.

    Raises:
        UserError: a figure exists and `overwrite` is false, or the session is of another finger.
    """
    model = model_for(fit, session)
    figures = {}
    if trials := list(session.select("VD.1")):
        figures["vd1"] = _vd1(model, session, trials[0])
    if trials := list(session.select("VD.2")):
        names = [t.name for t in trials[:MAX_PANELS]]
        figures["vd2"] = _vd2(model, session, prepare(session, names)["VD.2"])
    if trials := list(session.select("VD.3")):
        figures["vd3"] = _vd3(model, session, trials[0])
    with folder_to_fill(folder) as folder:
        return [save(f, folder / f"{name}.svg", overwrite) for name, f in figures.items()]


def _vd1(model: Model, session: Session, trial: Trial) -> Figure:
    """Angles, excursions measured and predicted, and their errors by f(q) and by ∫ C q̇ dt (paper, Fig. 5)."""
    path = excursion_path(model, trial, sizes_of(session).slow_pace)
    joints, tendons = session.finger.joint_names, session.finger.tendon_names
    turn = np.array([display(session, "q", i)[0] for i in range(len(joints))])
    figure, axes = grid(4, 1, 6.4, 1.7, sharex=True)
    angles, lengths, errors, drifts = (row[0] for row in axes)
    plots.over_time(trial.time, joints, trial.q * turn, ax=angles)
    seen = np.where(np.isfinite(path.measured).any(axis=0), 1e3, np.nan)
    plots.over_time(path.time, tendons, path.measured * seen, path.direct * seen, ax=lengths)
    plots.missed(path.time, tendons, (path.measured - path.direct) * 1e3, ax=errors)
    plots.missed(path.time, tendons, (path.measured - path.integral) * 1e3, ax=drifts)
    angles.set(ylabel=f"q ({_unit(session, 'q')})", title=trial.name)
    lengths.set(ylabel="excursion (mm)")
    errors.set(ylabel="missed by\nf(q) − f(q₀) (mm)")
    drifts.set(ylabel="missed by\n∫ C q̇ dt (mm)", xlabel="time (s)")
    return figure


def _vd2(model: Model, session: Session, stack: Stack) -> Figure:
    """Fingertip force against tension, measured and predicted, hold by hold (paper, Fig. 9)."""
    forces = np.asarray(predict_compiled(model, stack.batch.x, ("fingertip_force",))["fingertip_force"])
    measured, mask = (np.asarray(a["fingertip_force"]) for a in (stack.batch.y, stack.batch.mask))
    figure, (axes,) = grid(1, len(stack.trials), 3.2, 2.8, sharey=True)
    for b, (ax, name) in enumerate(zip(axes, stack.trials, strict=True)):
        tendon = session[name].tendon
        k = session.finger.tendon_names.index(tendon) if tendon else int(np.argmax(np.ptp(stack.batch.x.tension, 2)))
        runs = stack.samples_of_holds(b, mask[:, b].max(axis=0))
        at = np.array([np.asarray(stack.batch.x.tension)[k, b, r].mean() for r in runs])
        observed, predicted = (
            np.array([[y[a, b, r].mean() for r in runs] for a in range(3)]) for y in (measured, forces)
        )
        plots.against_tension(at, observed, predicted, ax)
        ax.set(title=name, xlabel=f"tension of {session.finger.tendon_names[k]} (N)")
    axes[0].set_ylabel("force at the fingertip (N)\n○ measured, × model")
    legend_beside(axes[-1])
    return figure


def _vd3(model: Model, session: Session, trial: Trial) -> Figure:
    """Motion simulated forward from the first sample, its error, and the torque that the model lacks.

    The torque is shown where all joints and tendons slide, since friction is not known elsewhere.
    """
    simulated = predict_session(model, session, [trial.name])[trial.name]["q"]
    stack = prepare(session, [trial.name])["VD.3"]
    time, slides = np.asarray(stack.batch.x.time)[0], np.asarray(stack.batch.mask["joint_torque"])[:, 0] > 0
    lacking = np.asarray(predict_compiled(model, stack.batch.x, ("joint_torque",))["joint_torque"])[:, 0]
    joints = session.finger.joint_names
    turn, torque = (np.array([display(session, c, i)[0] for i in range(len(joints))]) for c in ("q", "joint_torque"))
    figure, axes = grid(3, 1, 6.4, 1.8, sharex=True)
    motion, error, lacks = (row[0] for row in axes)
    plots.over_time(trial.time, joints, trial.q * turn, simulated * turn, motion)
    plots.missed(trial.time, joints, (trial.q - simulated) * turn, error)
    plots.missed(time, joints, np.where(slides, lacking, np.nan).T * torque, lacks)
    motion.set(ylabel=f"q ({_unit(session, 'q')})", title=trial.name)
    error.set(ylabel=f"missed ({_unit(session, 'q')})")
    lacks.set(ylabel=f"torque that the\nmodel lacks ({_unit(session, 'joint_torque')})", xlabel="time (s)")
    return figure


def _unit(session: Session, channel: str) -> str:
    """Unit in which people read a channel's first column."""
    return display(session, channel, 0)[1].replace("degrees", "°")
