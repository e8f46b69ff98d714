"""Figures of a model's curves: each function draws one panel and returns its axes."""

from __future__ import annotations

from matplotlib.axes import Axes

from jaxfinger.errors import chosen, require
from jaxfinger.identify import Fit
from jaxfinger.report.curves import Curves, JointCurves, curves
from jaxfinger.report.measured import Points
from jaxfinger.report.theme import (
    COLOURS,
    INK,
    MUTED,
    axes_or_new,
    band,
    colour,
    legend_below,
    legend_columns,
    line,
    look,
)


def _curves(of: Fit | Curves) -> Curves:
    require((Fit, Curves), of=of)
    return of if isinstance(of, Curves) else curves(of)


def _measured(ax: Axes) -> None:
    """Add an entry for measured points to the legend."""
    ax.plot([], [], "o", color=INK, markersize=3.2, markeredgewidth=0, label="measured")


def _points(ax: Axes, points: Points, colour: str, marker: str = "o", label: str | None = None) -> None:
    ax.plot(points.x, points.y, marker, color=colour, markersize=3.2, markeredgewidth=0, alpha=0.75, label=label)


@look()
def moment_arms(of: Fit | Curves, joint: str, ax: Axes | None = None) -> Axes:
    """Draw moment arms about one joint against its angle, mm, flexion positive, and return the axes (paper, Fig. 4).

    Lines and bands are the fit and its 95 % interval. Points are slopes of the measured excursion, if `curves` was
    given a session.

    Args:
        of: a fit, or its `curves`, which are then computed once for many panels.
        joint: name of the joint.
        ax: the axes to draw on; by default those of a new figure.

    Raises:
        UserError: the fit has estimated no moment arm about this joint.
    """
    found = _curves(of)
    chosen(joint, dict.fromkeys(j for _, j in found.moment_arm), "moment arm about joint")
    ax = axes_or_new(ax)
    tendons = list(dict.fromkeys(t for t, _ in found.moment_arm))
    for k, tendon in enumerate(tendons):
        if (tendon, joint) in found.moment_arm:
            c = found.moment_arm[tendon, joint]
            band(ax, c.x, c.y, c.std, colour(k), tendon, linestyle=line(k))
            if (tendon, joint) in found.arm_points:
                _points(ax, found.arm_points[tendon, joint], colour(k))
    if any(j == joint for _, j in found.arm_points):
        _measured(ax)
    ax.axhline(0, color=MUTED, linewidth=0.6)
    slides = joint in found.joints and found.joints[joint].prismatic
    ax.set(title=joint, xlabel="position (mm)" if slides else "joint angle (°)")
    ax.set_ylabel("moment arm" if slides else "moment arm (mm)")
    legend_below(ax, 3 if legend_columns(ax) < 3 else 5)
    return ax


@look()
def joint_torque(of: Fit | Curves, joint: str, ax: Axes | None = None) -> Axes:
    """Draw the resisting torque of one joint against its angle, N mm, and return the axes (paper, Fig. 6).

    Lines are the elastic torque, and its sum with friction in either direction of a slow motion. Points are holds, with
    a marker for the direction in which they were reached. Arguments as in `moment_arms`.

    Raises:
        UserError: the fit has estimated no torque of this joint.
    """
    found = _curves(of).joints
    chosen(joint, found, "torque of joint")
    c: JointCurves = found[joint]
    ax = axes_or_new(ax)
    band(ax, c.elastic.x, c.elastic.y, c.elastic.std, COLOURS[0], "elastic")
    for both, label in ((c.forwards, "with friction"), (c.backwards, None)):
        band(ax, both.x, both.y, both.std, COLOURS[1], label, linestyle="--")
    for points, marker, label in ((c.flexing, "^", "held, flexing"), (c.extending, "v", "held, extending")):
        if points is not None:
            _points(ax, points, INK, marker, label)
    ax.set(title=joint, xlabel="position (mm)" if c.prismatic else "joint angle (°)")
    ax.set_ylabel("resisting force (N)" if c.prismatic else "resisting torque (N mm)")
    legend_below(ax, 2)
    return ax


@look()
def tendon_friction(of: Fit | Curves, ax: Axes | None = None) -> Axes:
    """Draw tension lost to friction against rising tension at the actuator, N, and return the axes (paper, Fig. 8).

    Points are holds of ID.4. Arguments as in `moment_arms`.
    """
    found, ax = _curves(of), axes_or_new(ax)
    for k, (tendon, c) in enumerate(found.tendon_friction.items()):
        band(ax, c.x, c.y, c.std, colour(k), tendon, linestyle=line(k))
        if tendon in found.loss_points:
            _points(ax, found.loss_points[tendon], colour(k))
    if found.loss_points:
        _measured(ax)
    ax.set(xlabel="tension at the actuator (N)", ylabel="tension lost (N)", xlim=(0, None), ylim=(0, None))
    legend_below(ax, 3 if legend_columns(ax) < 3 else 5)
    return ax
