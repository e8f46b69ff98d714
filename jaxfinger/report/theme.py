"""Style of all figures and pages: colours for light and dark mode, legends, and figures as SVG.

Colours follow Okabe & Ito (Color Universal Design, 2008), with lightness spread so that they differ under protanopia,
deuteranopia and tritanopia too; `tests/report/test_theme.py` measures these differences and the contrast. Figures are
drawn in the light colours. Inside a page each colour becomes a CSS variable, so that dark mode changes figures too.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from markupsafe import Markup, escape
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import ScaledTranslation

from jaxfinger.data.atomic import atomic_path
from jaxfinger.report.numbers import HALF_95


@dataclass(frozen=True)
class Colour:
    """A colour in light mode and its counterpart in dark mode, as hexadecimal RGB."""

    name: str
    light: str
    dark: str


PALETTE = (
    Colour("blue", "#0067b0", "#2f86d2"),
    Colour("orange", "#d07c00", "#e0902a"),
    Colour("green", "#00805f", "#23b58c"),
    Colour("purple", "#c765a0", "#d06aa8"),
    Colour("olive", "#665c00", "#f4ee8a"),
    Colour("sky", "#4ba3dc", "#a6dcff"),
)
BACKGROUND = Colour("background", "#ffffff", "#15181c")
PANEL = Colour("panel", "#f4f6f8", "#1f242a")
INK_ = Colour("ink", "#1f2328", "#e8eaed")
MUTED_ = Colour("muted", "#57606a", "#a9b1ba")
RULE = Colour("rule", "#d3d8de", "#3a414a")
NOISE_ = Colour("noise", "#b4bac2", "#5b636d")
OPEN_ = Colour("open", "#4a4f58", "#c3c9d1")
WRONG_ = Colour("wrong", "#b3261e", "#ff8a80")  # red, used only for what is wrong
LINK = Colour("link", "#0a58a6", "#7fbdf5")
THEME = (*PALETTE, BACKGROUND, PANEL, INK_, MUTED_, RULE, NOISE_, OPEN_, WRONG_, LINK)

COLOURS = tuple(c.light for c in PALETTE)
INK, MUTED, NOISE, OPEN, WRONG = (c.light for c in (INK_, MUTED_, NOISE_, OPEN_, WRONG_))
BEFORE, AFTER = COLOURS[1], COLOURS[0]
LINES: tuple[Literal["-", "--", "-.", ":"], ...] = ("-", "--", "-.", ":")  # tell curves apart beside colour

CLEAR: dict[str, Any] = {"facecolor": BACKGROUND.light, "edgecolor": "none", "pad": 0.6}  # box behind text on a line
FONT = 9.0  # pt, 12 px on a page
PHONE_WIDTH = 4.0  # Inches: a narrower figure is for a phone.
TICKS, LABEL = 18.0, 14.0  # pt that tick labels and the axis label take below the axes
LOOK: dict[Any, Any] = {
    "font.size": FONT,
    "axes.titlesize": FONT,
    "axes.labelsize": FONT,
    "xtick.labelsize": FONT,
    "ytick.labelsize": FONT,
    "legend.fontsize": FONT,
    "legend.title_fontsize": FONT,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.facecolor": "none",
    "figure.facecolor": BACKGROUND.light,
    "hatch.color": BACKGROUND.light,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": RULE.light,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "svg.hashsalt": "jaxfinger",
    "svg.fonttype": "none",
}


def colour(k: int) -> str:
    """Colour number k of the palette, which repeats; `line` then gives another line style."""
    return COLOURS[k % len(COLOURS)]


def line(k: int) -> Literal["-", "--", "-.", ":"]:
    """Line style of curve number k: one for each round through the palette."""
    return LINES[k // len(COLOURS) % len(LINES)]


@contextmanager
def look() -> Iterator[None]:
    """Context manager and decorator that applies the style to all that is drawn and saved inside."""
    with rc_context(LOOK):
        yield


def grid(rows: int, columns: int, width: float, height: float, **share) -> tuple[Figure, list[list[Axes]]]:
    """A figure of `rows` by `columns` panels, each `width` by `height` inches."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **share)
    return figure, [list(row) for row in axes]


def axes_or_new(ax: Axes | None, width: float = 4.6, height: float = 3.2) -> Axes:
    """The given axes, or those of a new figure of `width` by `height` inches, which needs no display."""
    if ax is not None:
        return ax
    with look():
        return grid(1, 1, width, height)[1][0][0]


def legend_columns(ax: Axes) -> int:
    """Number of a legend's columns: two in a figure for a phone, else three."""
    figure = ax.get_figure(root=True)
    return 2 if figure is not None and figure.get_size_inches()[0] < PHONE_WIDTH else 3


def band(ax: Axes, x, y, std, colour: str, label: str | None = None, **line) -> None:
    """Draw a curve with its 95 % interval as a band; no band where `std` is not finite."""
    ax.plot(x, y, color=colour, label=label, **line)
    half = HALF_95 * np.where(np.isfinite(std), std, np.nan)
    ax.fill_between(x, y - half, y + half, color=colour, alpha=0.22, linewidth=0)


def legend_below(ax: Axes, columns: int = 3, labelled: bool = True, handles: Sequence[Artist] | None = None) -> None:
    """Draw a legend below the axes, where it covers no curve; `labelled` says whether the x axis has a label there."""
    handles = ax.get_legend_handles_labels()[0] if handles is None else handles
    if handles:
        down = ScaledTranslation(0.0, -(TICKS + LABEL * labelled) / 72, ax.figure.dpi_scale_trans)
        ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, 0.0), bbox_transform=ax.transAxes + down,
                  ncols=columns, borderpad=0, borderaxespad=0, handlelength=1.4, columnspacing=1.2)  # fmt: skip


def legend_beside(ax: Axes, handles: Sequence[Artist] | None = None) -> None:
    """Draw a legend to the right of the axes."""
    handles = ax.get_legend_handles_labels()[0] if handles is None else handles
    if handles:
        ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.0, 1.0), borderpad=0, handlelength=1.4)


def save(figure: Figure, path: Path, overwrite: bool) -> Path:
    """Save a figure as SVG or PNG, by the suffix of `path`, and return the path.

    Raises:
        UserError: the file exists and `overwrite` is false.
    """
    with atomic_path(path, overwrite) as part:
        figure.savefig(part, format=path.suffix[1:], dpi=150, metadata={"Date": None} if path.suffix == ".svg" else {})
    return path


def css() -> Markup:
    """The colours as CSS variables, with a media query for dark mode."""
    light = " ".join(f"--{c.name}: {c.light};" for c in THEME)
    dark = " ".join(f"--{c.name}: {c.dark};" for c in THEME)
    return Markup(
        f":root {{ color-scheme: light dark; {light} }}\n@media (prefers-color-scheme: dark) {{ :root {{ {dark} }} }}"
    )


_HEX = re.compile(r"#[0-9a-f]{6}\b")
_VARIABLE = {c.light: f"var(--{c.name})" for c in reversed(THEME)}


def inline(figure: Figure, name: str, label: str) -> Markup:
    """A figure as SVG for a page: text stays text, and the colours are the page's CSS variables.

    `name` is a prefix of the figure's ids, unique in the page; `label` is what a screen reader reads out.
    """
    out = io.StringIO()
    with look(), rc_context({"svg.hashsalt": name}):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue()
    text = _HEX.sub(lambda m: _VARIABLE.get(m[0], m[0]), text[text.index("<svg") :])
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(href="#|url\(#)', rf"\1{name}-", text)
    text = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font: \1 system-ui, sans-serif", text)
    return Markup(text.replace("<svg", f'<svg role="img" aria-label="{escape(label)}"', 1))
