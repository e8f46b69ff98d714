"""The paper's figures of a model: moment arms, joint torques and tendon friction, each with measured points."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from jaxfinger.data import Session
from jaxfinger.data.atomic import folder_to_fill
from jaxfinger.identify import Fit
from jaxfinger.report import plots
from jaxfinger.report.curves import curves
from jaxfinger.report.theme import grid, look, save

PANELS_PER_ROW = 3  # A finger has three joints, an arm up to seven.


@look()
def draw_identification(fit: Fit, session: Session, folder: str | Path, overwrite: bool = False) -> list[Path]:
    """Write the figures for which the fit has estimated something; return the paths.

    Raises:
        UserError: a figure exists and `overwrite` is false.
    """
    found = curves(fit, session)
    figures = {}
    if found.moment_arm:
        joints = [j for j in fit.model.finger.joint_names if any(j == joint for _, joint in found.moment_arm)]
        figures["moment-arms"] = _panels(plots.moment_arms, found, joints)
    if found.joints:
        figures["joint-torque"] = _panels(plots.joint_torque, found, list(found.joints))
    if found.tendon_friction:
        figure, ((ax,),) = grid(1, 1, 4.6, 3.2)
        plots.tendon_friction(found, ax)
        figures["tendon-friction"] = figure
    with folder_to_fill(folder) as folder:
        return [save(f, folder / f"{name}.svg", overwrite) for name, f in figures.items()]


def _panels(draw, found, joints: list[str]) -> Figure:
    """A figure with one panel for each joint."""
    rows = -(-len(joints) // PANELS_PER_ROW)
    figure, axes = grid(rows, min(len(joints), PANELS_PER_ROW), 3.4, 3.0)
    panels = [ax for row in axes for ax in row]
    for joint, ax in zip(joints, panels, strict=False):
        draw(found, joint, ax)
    for ax in panels[len(joints) :]:
        ax.set_axis_off()
    return figure
