"""Reliability diagram of the probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def reliability_diagram(rows: Sequence[dict[str, float]], file: Path) -> Path:
    """Draw how often causes came true against the probability given, with 95 % intervals, and return the file.

    `rows`: those of `score.reliability`. The file's suffix (.svg, .png) sets the format.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 4.2), layout="constrained")
    ax = figure.subplots()
    ax.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="calibrated")
    given = [r["said"] for r in rows]
    came = [r["came true"] for r in rows]
    spread = [
        [max(c - r["ci low"], 0) for c, r in zip(came, rows, strict=True)],
        [max(r["ci high"] - c, 0) for c, r in zip(came, rows, strict=True)],
    ]
    ax.errorbar(given, came, yerr=spread, fmt="o", capsize=3, color="tab:blue")
    for x, y, r in zip(given, came, rows, strict=True):
        ax.annotate(f"{r['count']:.0f}", (x, y), xytext=(6, -10), textcoords="offset points", fontsize=8, color="0.4")
    ax.set(xlabel="probability given", ylabel="share that came true", xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    ax.legend(frameon=False, loc="upper left")
    figure.savefig(file)
    return file
