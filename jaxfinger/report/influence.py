"""A picture of what holds each parameter: standard deviations that it moves, against trials, sensors and CAD values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxfinger.data.atomic import atomic_path

MOST = 1.0  # standard deviations from which on the colour is full


def draw_influence(
    parameters: Sequence[str],
    shifts: Mapping[str, tuple[Sequence[str], np.ndarray]],
    path: Path,
    overwrite: bool = False,
) -> Path:
    """One column a trial, sensor or value, one row a parameter; the path written.

    Raises:
        UserError: the figure exists and `overwrite` is false.
    """
    columns = [name for names, _ in shifts.values() for name in names]
    values = np.concatenate([v for _, v in shifts.values()]).T
    figure = Figure(figsize=(2.5 + 0.16 * len(columns), 2.0 + 0.14 * len(parameters)), layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    image = ax.imshow(values, cmap="PuOr", vmin=-MOST, vmax=MOST, aspect="auto", interpolation="nearest")
    ax.set_yticks(range(len(parameters)), parameters, fontsize=6)
    ax.set_xticks(range(len(columns)), columns, fontsize=6, rotation=90)
    for edge in np.cumsum([len(names) for names, _ in shifts.values()])[:-1]:
        ax.axvline(edge - 0.5, color="#222222", linewidth=0.8)
    ax.set_title("what holds each parameter: a trial left out, a gain + 1 %, a CAD value + 1 std", fontsize=8)
    figure.colorbar(image, ax=ax, label="standard deviations that it moves", shrink=0.6)
    with atomic_path(path, overwrite) as part:
        figure.savefig(part, format=path.suffix[1:] or "svg", dpi=130)
    return path
