"""Figures of a fit: intervals, correlations, and the influence of trials, sensors and CAD on each parameter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from jaxfinger.errors import chosen, require
from jaxfinger.identify import Fit
from jaxfinger.identify.parameters import describe
from jaxfinger.identify.sensitivity import Sensitivity
from jaxfinger.report.numbers import HALF_95, measured
from jaxfinger.report.theme import AFTER, BEFORE, CLEAR, COLOURS, MUTED, axes_or_new, legend_below, look

MAX_SIDE = 0.8  # Side of the largest square in that of its cell, so that neighbours do not touch.
X_LIMIT = 2.1  # Relative to the scale of a row: a value of 1 with a half-width of 1 reaches 2.
INTERVAL_ROWS = 10  # Rows in one panel of a page, which then fits on a phone's screen.
ROW_HEIGHT = 0.36  # Inches that a parameter and its name take.
# Of a figure's width. Longer names are shortened, so that at least half of the width is left for the squares.
MAX_NAME_SHARE = 0.45
# Letters are on average 0.6 of the font's 9 points (`theme.FONT`) wide, which makes 13; one is left for the gap between
# name and value.
CHARACTERS_PER_INCH = 12.0


def interval_size(rows: int, width: float) -> tuple[float, float]:
    """Width and height in inches that `intervals` fills."""
    return width, 0.95 + ROW_HEIGHT * max(rows, 1)


@look()
def intervals(
    fit: Fit, parameters: Sequence[str] | None = None, before: Fit | None = None, ax: Axes | None = None
) -> Axes:
    """Draw parameters with their 95 % intervals, one row each, and return the axes.

    Each row is relative to the larger of the parameter's magnitude and the half-width of its interval, so that it shows
    how well the parameter is known and whether its interval holds zero. The value with its unit stands above the row.

    Args:
        fit: the fit whose estimated parameters are drawn.
        parameters: names to show, in this order; by default all that were estimated.
        before: another fit, whose values of the same parameters are marked.
        ax: the axes to draw on; by default those of a new figure.

    Raises:
        UserError: the fit has estimated no parameter of such a name.
    """
    require(Fit, fit=fit)
    table = {r["name"]: r for r in fit.table()}
    rows = [table[n] for n in chosen(table if parameters is None else parameters, table, "estimated parameter")]
    ax = axes_or_new(ax, *interval_size(len(rows), 4.6))
    old = {} if before is None else {r["name"]: r["value"] for r in before.table()}
    at, width = ax.get_yaxis_transform(), ax.figure.bbox.width / ax.figure.dpi
    for y, row in enumerate(rows):
        value, std = row["value"], row["std"]
        half = HALF_95 * std if std is not None else 0.0
        scale = max(abs(value), half, 1e-300)
        ax.plot(
            [(value - half) / scale, (value + half) / scale], [y, y], color=AFTER, linewidth=2.4, solid_capstyle="butt"
        )
        ax.plot(value / scale, y, "o", color=AFTER, markersize=4)
        if row["name"] in old and abs(old[row["name"]] / scale) < X_LIMIT:
            ax.plot(old[row["name"]] / scale, y, "D", color="none", markeredgecolor=BEFORE, markersize=5)
        text = measured(value, std, row["units"]) if std is not None else "not seen by these trials"
        room = int(width * CHARACTERS_PER_INCH) - len(text)
        ax.text(0.0, y - 0.2, _shortened(row["name"], room), transform=at, va="bottom", ha="left", bbox=CLEAR)
        ax.text(1.0, y - 0.2, text, transform=at, va="bottom", ha="right", bbox=CLEAR)
    ax.axvline(0.0, color=MUTED, linewidth=0.8)
    ax.set(yticks=[], ylim=(len(rows) - 0.5, -0.8), xlim=(-X_LIMIT, X_LIMIT), xticks=[-2, -1, 0, 1, 2])
    ax.set_xlabel("value and interval, relative to the larger")
    ax.grid(axis="y", visible=False)
    ax.spines["left"].set_visible(False)
    if old:
        ax.plot([], [], "o-", color=AFTER, label="this fit")
        ax.plot([], [], "D", color="none", markeredgecolor=BEFORE, label="before")
        legend_below(ax, 2)
    return ax


def _shortened(name: str, room: int) -> str:
    """A parameter's name in at most `room` characters, for which its first word loses its end."""
    first, _, rest = name.partition(" ")
    over = len(name) - room
    return name if over <= 0 else f"{first[: max(len(first) - over - 1, 4)]}… {rest}"


def correlations(fit: Fit) -> tuple[list[str], Float[np.ndarray, "p p"]]:
    """Names of the estimated parameters that the trials determine, and their correlation matrix."""
    seen = [i for i in fit.estimated if np.isfinite(fit.covariance[i, i]) and fit.covariance[i, i] > 0]
    C = fit.covariance[np.ix_(seen, seen)]
    std = np.sqrt(np.diag(C))
    described = describe(fit.model)
    return [described[i].name for i in seen], C / np.outer(std, std)


@look()
def correlation(fit: Fit, most: int = 16, ax: Axes | None = None) -> Axes:
    """Draw correlations of the most correlated parameters, and return the axes: area of a square |ρ|, colour its sign.

    Where |ρ| is near 1, the trials determine a combination of the two parameters better than either one.

    Args:
        fit: the fit with its covariance.
        most: largest number of parameters; those whose largest |ρ| with another is largest are drawn.
        ax: the axes to draw on; by default those of a new figure.
    """
    names, R = correlations(fit)
    strongest = np.abs(R - np.diag(np.diag(R))).max(axis=0, initial=0.0)
    chosen = np.sort(np.argsort(-strongest)[:most])
    names, R = [names[i] for i in chosen], R[np.ix_(chosen, chosen)]
    ax = axes_or_new(ax, 2.0 + 0.2 * len(names), 1.0 + 0.2 * len(names))
    numbers = [str(k + 1) for k in range(len(names))]
    room = int(MAX_NAME_SHARE * ax.figure.bbox.width / ax.figure.dpi * CHARACTERS_PER_INCH)
    rows = [f"{_shortened(name, room)}  {k}" for name, k in zip(names, numbers, strict=True)]
    _squares(ax, np.tril(R, -1), rows, numbers, "ρ = 1", "ρ = −1")
    return ax


@look()
def influence(found: Sensitivity | Mapping[str, Sensitivity], fit: Fit, most: int = 16, ax: Axes | None = None) -> Axes:
    """Draw how each row shifts each parameter, and return the axes: area of a square the shift, colour its sign.

    A row is a trial left out, a sensor that reads 1 % more, or a value of CAD that is one standard deviation larger.
    Shifts are in standard deviations of the parameter. Where no other trial determines a parameter, the square is as
    large as the largest.

    Args:
        found: result of `sensitivity`, or one kind of it.
        fit: the fit that it belongs to.
        most: largest number of rows and of columns; those with the largest shifts are drawn.
        ax: the axes to draw on; by default those of a new figure.
    """
    kinds = [found] if isinstance(found, Sensitivity) else list(found.values())
    shifts = np.concatenate([kind.shifts(fit) for kind in kinds])
    rows = [name for kind in kinds for name in kind.names]
    described = describe(fit.model)
    columns = [described[k].name for k in fit.estimated]
    finite = shifts[np.isfinite(shifts)]
    shifts = np.clip(shifts, finite.min(initial=0.0), finite.max(initial=1e-300))
    sizes = np.abs(shifts)
    i, j = (np.sort(np.argsort(-sizes.max(axis=k, initial=0.0), kind="stable")[:most]).astype(int) for k in (1, 0))
    shifts = shifts[np.ix_(i, j)]
    ax = axes_or_new(ax, 2.2 + 0.22 * len(j), 2.0 + 0.22 * len(i))
    largest = float(np.abs(shifts).max(initial=0.0)) or 1.0
    names = [rows[k] for k in i], [columns[k] for k in j]
    _squares(ax, shifts / largest, *names, f"up {largest:.2g} σ", f"down {largest:.2g} σ")
    ax.tick_params(axis="x", labelrotation=90)
    return ax


def _squares(ax: Axes, values, rows: Sequence[str], columns: Sequence[str], up: str, down: str) -> None:
    """Draw values from −1 to 1 as squares whose area is their magnitude."""
    ax.set(xticks=range(len(columns)), yticks=range(len(rows)), xticklabels=columns, yticklabels=rows)
    ax.set(xlim=(-0.6, len(columns) - 0.4), ylim=(len(rows) - 0.4, -0.6))
    ax.xaxis.tick_top()
    ax.spines[["left", "bottom"]].set_visible(False)
    ax.tick_params(length=0)
    signs = ((1, COLOURS[0], up), (-1, COLOURS[1], down))
    legend_below(ax, 2, handles=[Line2D([], [], marker="s", linestyle="", color=c, label=text) for _, c, text in signs])
    if (figure := ax.get_figure(root=True)) is not None:
        figure.draw_without_rendering()  # Names and legend leave the axes less room than the figure has.
    at = ax.get_window_extent().transformed(ax.figure.dpi_scale_trans.inverted())  # inches
    cell = 72.0 * min(at.width / max(len(columns), 1), at.height / max(len(rows), 1))
    size = (MAX_SIDE * cell) ** 2
    for sign, colour, _ in signs:
        i, j = np.nonzero(sign * values > 0.02)
        ax.scatter(j, i, s=size * np.abs(values[i, j]), marker="s", color=colour, linewidths=0)
