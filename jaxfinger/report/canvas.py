"""Figures without a display: one look for all of them, written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from jaxfinger.data.atomic import atomic_path

COLOURS = ("#1f5fbf", "#2a8f4f", "#c8342b", "#222222", "#d98a00", "#7b4fb0", "#00908f", "#8c564b")
LOOK: dict[Any, Any] = {
    "font.size": 8.5,
    "axes.titlesize": 9.0,
    "legend.fontsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    "svg.hashsalt": "jaxfinger",
    "svg.fonttype": "none",
}


@contextmanager
def look() -> Iterator[None]:
    """The style of all that is drawn and saved inside a `with` (or by a function so decorated)."""
    with rc_context(LOOK):
        yield


def grid(rows: int, columns: int, width: float, height: float, **share) -> tuple[Figure, list[list[Axes]]]:
    """A figure of `rows` by `columns` panels, each `width` by `height` inches."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **share)
    return figure, [list(row) for row in axes]


def band(ax: Axes, x, y, std, colour: str, label: str | None = None, **line) -> None:
    """A curve with its 95 % band."""
    ax.plot(x, y, color=colour, label=label, **line)
    ax.fill_between(x, y - 1.96 * std, y + 1.96 * std, color=colour, alpha=0.2, linewidth=0)


def save(figure: Figure, path: Path, overwrite: bool) -> Path:
    """By the suffix: .svg or .png."""
    with atomic_path(path, overwrite) as part:
        figure.savefig(part, format=path.suffix[1:], dpi=130, metadata={"Date": None} if path.suffix == ".svg" else {})
    return path
