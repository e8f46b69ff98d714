"""Figures of measurement and model: one colour for each joint, tendon or axis."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from jaxfinger.report.theme import INK, MUTED, axes_or_new, colour, legend_beside, line, look

MAX_POINTS = 600  # Points of a curve over time: about the pixels across a figure. More only make its file larger.


@look()
def over_time(
    time: Float[np.ndarray, " T"],
    names: Sequence[str],
    measured: Float[np.ndarray, "T columns"] | None = None,
    model: Float[np.ndarray, "T columns"] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw columns of a channel over time, measured as points and predicted as lines, and return the axes.

    Args:
        time: s.
        names: names of the columns; a column that is NaN throughout is left out.
        measured: in the unit of the axis; without `model` it is drawn as lines.
        model: in the same unit.
        ax: the axes to draw on; by default those of a new figure.
    """
    ax = axes_or_new(ax, 6.4, 2.2)
    thin = slice(None, None, max(len(time) // MAX_POINTS, 1))
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
    """Draw measured less predicted over time, one colour for each column, and return the axes.

    Arguments as in `over_time`; `errors` in the unit of the axis.
    """
    ax = axes_or_new(ax, 6.4, 2.2)
    thin = slice(None, None, max(len(time) // MAX_POINTS, 1))
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
    """Draw the fingertip force against tension, hold by hold, and return the axes (paper, Fig. 9).

    Circles are measured, crosses are predicted.

    Args:
        tension: of the pulled tendon in each hold, N.
        measured: mean force of each hold along x, y and z, N.
        model: the same as predicted.
        ax: the axes to draw on; by default those of a new figure.
    """
    ax = axes_or_new(ax)
    for a, axis in enumerate("xyz"):
        ax.plot(tension, measured[a], "o", color=colour(a), markersize=4, markerfacecolor="none", label=f"f_{axis}")
        ax.plot(tension, model[a], "x", color=colour(a), markersize=4)
    return ax
