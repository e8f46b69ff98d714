"""Figures of a diagnosis: the budget of the gap, how far it closes, and the trial that the model misses most."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch

from jaxfinger.errors import require
from jaxfinger.gap.result import ChannelBudget, Closure, Diagnosis
from jaxfinger.report.names import cause_name, channel_name
from jaxfinger.report.numbers import alike, quantity
from jaxfinger.report.theme import (
    AFTER,
    BEFORE,
    CLEAR,
    INK,
    MUTED,
    NOISE,
    OPEN,
    WRONG,
    axes_or_new,
    colour,
    legend_below,
    legend_columns,
    look,
)
from jaxfinger.report.traces import Trace

MAX_BARS = 12  # Bars in one picture, which then fits on a screen.
ROW_HEIGHT = 0.42  # Inches that a bar and its label take.
HATCH = "////"  # marks the unexplained part beside its colour
MIN_SEGMENT = 0.004  # Share of a bar: a smaller segment is narrower than two pixels.


def rows_of(d: Diagnosis, most: int = MAX_BARS) -> list[ChannelBudget]:
    """The `most` columns with the largest gaps relative to their noise, largest first."""
    return sorted(d.channels, key=lambda x: -x.gap / max(x.noise, 1e-300))[:most]


def segments(x: ChannelBudget) -> tuple[float, list[float], float, float]:
    """Segments of a column's bar, as shares of its mean square: noise, causes, several together, unexplained.

    The shares of the causes need not sum to what all close. If they sum to less, the rest is closed by several causes
    together; with one cause, held-out trials show no more than its share, and the rest counts as noise. If they sum to
    more, they are scaled down in proportion.
    """
    noise = x.noise**2 / max(x.noise**2 + x.gap**2, 1e-300)
    causes, left = [max(s, 0.0) for s in x.by_cause], min(max(x.unexplained, 0.0), 1.0)
    room = 1.0 - left
    over = max(sum(causes) / room, 1.0) if room > 0 else math.inf
    causes = [(s / over) * (1.0 - noise) for s in causes]
    together, left = max(room * (1.0 - noise) - sum(causes), 0.0), left * (1.0 - noise)
    if len(causes) < 2:  # What one cause neither closes nor leaves is no gap on held-out trials.
        noise, together = noise + together, 0.0
    return noise, causes, together, left


def budget_size(d: Diagnosis, width: float) -> tuple[float, float]:
    """Width and height in inches that `budget` fills."""
    entries = len(d.budget) + 3
    lines = entries if width < 5 else -(-entries // 2)
    return width, 0.45 + ROW_HEIGHT * max(len(rows_of(d)), 1) + 0.19 * lines


@look()
def budget(d: Diagnosis, ax: Axes | None = None) -> Axes:
    """Draw the budget of the gap, one bar for each column with a gap, and return the axes.

    The length of a bar is the mean square of the nominal model's residual. Noise comes first, then a colour for each
    cause, then the unexplained part, hatched. Beside the column's name stands the gap in physical units.

    Args:
        d: the diagnosis.
        ax: the axes to draw on; by default those of a new figure.
    """
    require(Diagnosis, d=d)
    ax = axes_or_new(ax, *budget_size(d, 6.4))
    rows = rows_of(d)
    for y, x in enumerate(rows):
        noise, causes, together, left = segments(x)
        parts = [(noise, NOISE, None), *((s, colour(i), None) for i, s in enumerate(causes))]
        parts += [(together, MUTED, None), (left, OPEN, HATCH)]
        start = 0.0
        for share, fill, hatch in parts:
            if share > MIN_SEGMENT:
                ax.barh(y, share, left=start, height=0.42, color=fill, hatch=hatch, edgecolor="none", linewidth=0)
            start += share
        name = f"{x.experiment} · {channel_name(x.channel)} {x.column}"
        ax.text(0.0, y - 0.34, name, va="bottom", ha="left")
        ax.text(1.0, y - 0.34, quantity(x.gap, x.units), va="bottom", ha="right")
    seen = [segments(x) for x in rows]
    handles = [Patch(color=NOISE, label="noise")]
    handles += [Patch(color=colour(i), label=cause_name(cause)) for i, cause in enumerate(d.budget)]
    if any(s[2] > MIN_SEGMENT for s in seen):
        handles.append(Patch(color=MUTED, label="several together"))
    if any(s[3] > MIN_SEGMENT for s in seen):
        handles.append(Patch(facecolor=OPEN, hatch=HATCH, linewidth=0, label="unexplained"))
    ax.set(yticks=[], xlim=(0, 1), ylim=(max(len(rows), 1) - 0.6, -0.95))
    ax.set_xticks([0, 0.25, 0.5, 0.75, 1], ["0", "25 %", "50 %", "75 %", "100 %"])
    ax.spines["left"].set_visible(False)
    ax.grid(axis="y", visible=False)
    legend_below(ax, legend_columns(ax) - 1, labelled=False, handles=handles)
    return ax


def closure_size(lines: Sequence[Closure], width: float) -> tuple[float, float]:
    """Width and height in inches that `closure` fills."""
    return width, 1.05 + ROW_HEIGHT * max(len(shown(lines)), 1)


def shown(lines: Sequence[Closure]) -> list[Closure]:
    """Lines that are drawn: those whose noise is known and whose simulation did not diverge."""
    return [x for x in lines if x.noise > 0 and not x.diverged]


@look()
def closure(of: Diagnosis | Sequence[Closure], ax: Axes | None = None) -> Axes:
    """Draw how far each channel closes on held-out trials, and return the axes.

    Values are rms relative to the noise, before and after, on a logarithmic axis. Channels that stay open are red.

    Args:
        of: the diagnosis, or some of its `closures`.
        ax: the axes to draw on; by default those of a new figure.
    """
    rows = shown(of.closures if isinstance(of, Diagnosis) else of)
    changed = any(x.before != x.after for x in rows)
    ax = axes_or_new(ax, *closure_size(rows, 5.0))
    for y, x in enumerate(rows):
        before, after = x.before / x.noise, x.after / x.noise
        stays = x.stays_open
        ax.plot([before, after], [y, y], color=MUTED, linewidth=1.2, zorder=1)
        if changed:
            ax.plot(before, y, "o", color="none", markeredgecolor=BEFORE, markeredgewidth=1.6, markersize=6)
        ax.plot(after, y, "s" if stays else "o", color=WRONG if stays else AFTER, markersize=5)
        name = f"{x.experiment} · {channel_name(x.channel)}"
        at = ax.get_yaxis_transform()
        ax.text(0.0, y - 0.22, name, transform=at, va="bottom", ha="left", bbox=CLEAR)
        (old, new), unit = alike((x.before, x.after), x.units)
        text = f"{old} → {new} {unit}" if changed else f"{old} {unit}"
        ax.text(1.0, y - 0.22, text, transform=at, va="bottom", ha="right", bbox=CLEAR)
    ratios = [r for x in rows for r in (x.before / x.noise, x.after / x.noise) if r > 0]
    low, high = min([0.6, *(0.8 * r for r in ratios)]), max([3.0, *(1.3 * r for r in ratios)])
    steps = (1, 2, 5) if high < 30 * low else (1,)
    ticks = [t for k in range(-3, 9) for t in (s * 10.0**k for s in steps) if low <= t <= high]
    ax.axvline(1.0, color=INK, linewidth=0.9, linestyle="--", label="noise")
    ax.set(yticks=[], xscale="log", xlim=(low, high), ylim=(max(len(rows), 1) - 0.5, -0.75), xlabel="rms / noise")
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.set_xticks([], minor=True)
    ax.grid(axis="y", visible=False)
    ax.spines["left"].set_visible(False)
    if changed:
        ax.plot([], [], "o", color="none", markeredgecolor=BEFORE, markeredgewidth=1.6, label="before")
    ax.plot([], [], "o", color=AFTER, label="after" if changed else "the model")
    if any(x.stays_open for x in rows):
        ax.plot([], [], "s", color=WRONG, label="stays open")
    legend_below(ax, 2)
    return ax


@look()
def signal(trace: Trace, ax: Axes | None = None) -> Axes:
    """Draw one column of one trial over time: dots are measured, lines are the model before and after."""
    ax = axes_or_new(ax, 6.4, 2.2)
    ax.plot(trace.time, trace.measured, ".", color=INK, markersize=2.0, label="measured")
    for predicted, colour_, style, label in _models(trace):
        ax.plot(trace.time, predicted, style, color=colour_, linewidth=1.1, label=label)
    ax.set_title(f"{trace.name} ({trace.units})")
    legend_below(ax, legend_columns(ax), labelled=False)
    return ax


@look()
def residuals(trace: Trace, ax: Axes | None = None) -> Axes:
    """Draw measured less model over time, before and after, with the 95 % interval of the noise about zero."""
    ax = axes_or_new(ax, 6.4, 2.2)
    ax.axhspan(-trace.half, trace.half, color=NOISE, alpha=0.5, linewidth=0, label="noise, 95 %")
    for predicted, colour_, _, label in _models(trace):
        ax.plot(trace.time, trace.measured - predicted, ".", color=colour_, markersize=2.4, label=label)
    ax.set(title=f"measured less model ({trace.units})", xlabel="time (s)")
    legend_below(ax, legend_columns(ax))
    return ax


def _models(trace: Trace) -> list[tuple[np.ndarray, str, str, str]]:
    """Prediction, colour, line style and label of the model before and, if it differs, after."""
    both = [(trace.before, BEFORE, "--", "model before")]
    return [*both, (trace.after, AFTER, "-", "model after")] if trace.changed else both
