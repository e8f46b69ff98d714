"""A model beside what was measured: points are measured, lines are the model, one colour a joint, tendon or axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from jaxfinger.report.theme import INK, MUTED, axes_or_new, colour, legend_beside, line, look

POINTS = 600  # of a curve over time that a figure shows: more than it has pixels makes a file, no picture


@look()
def over_time(
    time: Float[np.ndarray, " T"],
    names: Sequence[str],
    measured: Float[np.ndarray, "T columns"] | None = None,
    model: Float[np.ndarray, "T columns"] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Columns of a channel over time: what was measured in points, what the model says as lines.

    Args:
        time: s.
        names: of the columns; one that is NaN throughout is left out.
        measured: in the unit of the axis; without a model it is drawn as lines.
        model: in the same unit.
        ax: the axes to draw on; new ones without.
    """
    ax = axes_or_new(ax, 6.4, 2.2)
    thin = slice(None, None, max(len(time) // POINTS, 1))
    handles = []
    for k, name in enumerate(names):
        both = [y[:, k] for y in (measured, model) if y is not None]
        if not any(np.isfinite(y).any() for y in both):
            continue
        handles.append(Line2D([], [], color=colour(k), linestyle=line(k), label=name))
        if measured is not None:
            alone = model is None
            style: dict[str, Any] = (
                {"linestyle": line(k)} if alone else {"linestyle": "", "marker": ".", "markersize": 3.0}
            )
            ax.plot(time[thin], measured[thin, k], color=colour(k), alpha=1.0 if alone else 0.35, **style)
        if model is not None:
            ax.plot(time[thin], model[thin, k], color=colour(k), linestyle=line(k), linewidth=1.0)
    if measured is not None and model is not None:
        handles.append(Line2D([], [], color=INK, linestyle="", marker=".", alpha=0.5, label="measured"))
        handles.append(Line2D([], [], color=INK, label="model"))
    legend_beside(ax, handles)
    return ax


@look()
def missed(
    time: Float[np.ndarray, " T"],
    names: Sequence[str],
    errors: Float[np.ndarray, "T columns"],
    ax: Axes | None = None,
) -> Axes:
    """Measured less model over time, one colour a column; arguments as of `over_time`."""
    ax = axes_or_new(ax, 6.4, 2.2)
    thin = slice(None, None, max(len(time) // POINTS, 1))
    ax.axhline(0.0, color=MUTED, linewidth=0.6)
    for k in range(len(names)):
        if np.isfinite(errors[:, k]).any():
            ax.plot(time[thin], errors[thin, k], ".", color=colour(k), markersize=1.6)
    return ax


@look()
def against_tension(
    tension: Float[np.ndarray, " holds"],
    measured: Float[np.ndarray, "3 holds"],
    model: Float[np.ndarray, "3 holds"],
    ax: Axes | None = None,
) -> Axes:
    """Force at the fingertip against tension, N, hold by hold (paper, Fig. 9): circles are measured, crosses the model.

    Args:
        tension: N, of the pulled tendon in every hold.
        measured: mean force of every hold along x, y and z.
        model: the same as predicted.
        ax: the axes to draw on; new ones without.
    """
    ax = axes_or_new(ax)
    for a, axis in enumerate("xyz"):
        ax.plot(tension, measured[a], "o", color=colour(a), markersize=4, markerfacecolor="none", label=f"f_{axis}")
        ax.plot(tension, model[a], "x", color=colour(a), markersize=4)
    return ax
