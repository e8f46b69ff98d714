"""The paper's figures of a model: moment arms, torque of the joints, tendon friction, each with what was measured."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import numpy as np

from jaxfinger.data import Session
from jaxfinger.experiments import predict, prepare
from jaxfinger.identify import Fit
from jaxfinger.model import Model, TendonFriction, rigid_body
from jaxfinger.report.canvas import COLOURS, band, grid, look, save
from jaxfinger.report.curves import Curves, curves

SHORT_ARM = 1e-3  # m: a shorter moment arm says nothing of the tension behind a torque


@look()
def draw_identification(
    fit: Fit, session: Session, folder: str | Path, overwrite: bool = False, suffix: str = ".svg"
) -> list[Path]:
    """Write the figures that the fit has something to show for; the paths written.

    Raises:
        UserError: a figure exists and `overwrite` is false.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    found = curves(fit)
    stacks = prepare(session, [t.name for t in session if t.experiment in ("ID.3-static", "ID.4")])
    figures = {}
    if found.moment_arm:
        figures["moment-arms"] = _moment_arms(fit, found)
    if found.joints:
        figures["joint-torque"] = _joint_torque(fit, found, stacks.get("ID.3-static"))
    if found.tendon_friction:
        figures["tendon-friction"] = _tendon_friction(fit, found, session, stacks.get("ID.4"))
    return [save(f, folder / f"{name}{suffix}", overwrite) for name, f in figures.items()]


def _moment_arms(fit: Fit, found: Curves):
    """Paper, Fig. 4: one panel a joint, one curve a tendon, flexion positive."""
    finger = fit.model.finger
    joints = [j for j in finger.joint_names if any(j == joint for _, joint in found.moment_arm)]
    figure, (axes,) = grid(1, len(joints), 3.0, 2.6, sharey=True)
    for ax, joint in zip(axes, joints, strict=True):
        for k, tendon in enumerate(finger.tendon_names):
            if (tendon, joint) in found.moment_arm:
                c = found.moment_arm[tendon, joint]
                band(ax, c.x, c.y, c.std, COLOURS[k % len(COLOURS)], tendon)
        ax.axhline(0, color="#888888", linewidth=0.6)
        ax.set(title=joint, xlabel="joint angle (°)")
        ax.legend(loc="best", ncols=2)
    axes[0].set_ylabel("moment arm (mm)")
    return figure


def _joint_torque(fit: Fit, found: Curves, stack):
    """Paper, Fig. 6: elastic torque as the mean of the two directions, friction as half their difference."""
    names = fit.model.finger.joint_names
    figure, (axes,) = grid(1, len(found.joints), 3.2, 2.8)
    points = {} if stack is None else _holds(fit.model, stack)
    for ax, (joint, c) in zip(axes, found.joints.items(), strict=True):
        scale = 1.0 if c.prismatic else 1e3
        degrees = 1e3 if c.prismatic else 180 / np.pi
        band(ax, c.elastic.x, c.elastic.y, c.elastic.std, COLOURS[2], "elastic τₖ")
        for sign, label in ((1, "τₖ ± friction τ_f"), (-1, None)):
            std = np.hypot(c.elastic.std, c.friction.std)
            band(ax, c.elastic.x, c.elastic.y + sign * c.friction.y, std, COLOURS[0], label, linestyle="--")
        for way, marker, label in ((1, "^", "held, flexing"), (-1, "v", "held, extending")):
            rows = [p for p in points.get(names.index(joint), []) if p[3] == way]
            if rows:
                q, h, spread, _ = np.array(rows).T
                ax.errorbar(
                    q * degrees, h * scale, spread * scale, fmt=marker, color="#444444", markersize=3.5,
                    elinewidth=0.7, label=label,
                )  # fmt: skip
        ax.set(title=joint, xlabel="position (mm)" if c.prismatic else "joint angle (°)")
        ax.set_ylabel("resisting force (N)" if c.prismatic else "resisting torque (N mm)")
    axes[0].legend(loc="best")
    return figure


def _holds(model: Model, stack) -> dict[int, list[tuple[float, float, float, float]]]:
    """By joint: angle, τ_ext − G and its spread, direction of approach, of every hold."""
    x, y, mask = stack.batch.x, np.asarray(stack.batch.y["joint_torque"]), np.asarray(stack.batch.mask["joint_torque"])
    h = y - np.asarray(rigid_body.gravity_torque(model.finger, x.q))
    q, way = np.asarray(x.q), np.asarray(x.joint_direction)
    points: dict[int, list] = {}
    for i, b in np.ndindex(y.shape[:2]):
        for run in stack.samples_of_holds(b, mask[i, b]):
            row = (q[i, b, run].mean(), h[i, b, run].mean(), h[i, b, run].std(), np.sign(way[i, b, run].mean()))
            points.setdefault(i, []).append(row)
    return points


def _tendon_friction(fit: Fit, found: Curves, session: Session, stack):
    """Paper, Fig. 8: tension lost on the way against tension at the actuator, while it rises."""
    figure, ((ax,),) = grid(1, 1, 4.6, 3.2)
    points = {} if stack is None else _losses(fit.model, session, stack)
    for k, tendon in enumerate(fit.model.finger.tendon_names):
        if tendon in found.tendon_friction:
            c, colour = found.tendon_friction[tendon], COLOURS[k % len(COLOURS)]
            band(ax, c.x, c.y, c.std, colour, tendon)
            if tendon in points:
                ax.plot(*np.array(points[tendon]).T, "o", color=colour, markersize=3, alpha=0.6, markeredgewidth=0)
    ax.set(xlabel="tension at the actuator (N)", ylabel="tension lost (N)", xlim=(0, None), ylim=(0, None))
    ax.legend(loc="upper left", title="line: fit, dots: holds")
    return figure


def _losses(model: Model, session: Session, stack) -> dict[str, list[tuple[float, float]]]:
    """By tendon: tension and loss at every hold of rising tension, from the torque at the held joint, eq. (1)."""
    frictionless = eqx.tree_at(lambda m: m.tendon_friction, model, TendonFriction.zeros(model.finger.n))
    x = stack.batch.x
    y, mask = np.asarray(stack.batch.y["joint_torque"]), np.asarray(stack.batch.mask["joint_torque"])
    without = np.asarray(_torque(frictionless, x))
    C = np.asarray(model.moment_arm.coupling(x.q))
    points: dict[str, list] = {}
    for b, name in enumerate(stack.trials):
        trial = session[name]
        if trial.tendon is None or trial.joint is None:
            continue
        k, i = session.finger.tendon_names.index(trial.tendon), session.finger.joint_names.index(trial.joint)
        f = np.asarray(x.tension)[k, b]
        highest = 0.0
        for run in stack.samples_of_holds(b, mask[i, b]):
            arm = C[k, i, b, run].mean()
            if f[run].mean() > highest + 0.1 and abs(arm) > SHORT_ARM:
                lost = (y[i, b, run] - without[i, b, run]).mean() / arm
                points.setdefault(trial.tendon, []).append((f[run].mean(), lost))
            highest = max(highest, f[run].mean())
    return points


@eqx.filter_jit
def _torque(model: Model, x):
    return predict(model, x, ("joint_torque",))["joint_torque"]
