"""The scores as tables for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Group
from rich.table import Table

from .score import Figure, Imitators, Scores

SHARES = (
    "cause",
    "cause, where distinguishable",
    "covered",
    "false alarm",
    "open set",
    "open set, where distinguishable",
    "double, one right",
    "double, both right",
)


def render(scores: Scores) -> Group:
    """One screen: the figures, then where they come from and where it fails."""
    head = Table(title=f"{scores.cases} sealed cases, {scores.failed} failed", title_justify="left")
    for column in ("score", "value", "95 % interval", "cases"):
        head.add_column(column, justify="left" if column == "score" else "right")
    for name, figure in scores.figures.items():
        if figure.count:
            head.add_row(
                name,
                _value(name, figure.value),
                f"{_value(name, figure.low)} … {_value(name, figure.high)}",
                str(figure.count),
            )
    parts = [head]
    for title, split in (
        ("by effect", scores.by_effect),
        ("by severity", scores.by_severity),
        ("by specimen", scores.by_specimen),
    ):
        if split:
            parts.append(_split_table(title, split))
    if scores.confusions:
        table = Table(title="wrong verdicts", title_justify="left")
        for column in ("truth", "answer", "cases"):
            table.add_column(column, overflow="fold")
        for truth, answer, count in scores.confusions[:40]:
            table.add_row(truth, answer, str(count))
        parts.append(table)
    if scores.reliability:
        table = Table(title="reliability", title_justify="left")
        for column in ("said", "came true", "95 % interval", "candidates"):
            table.add_column(column, justify="right")
        for r in scores.reliability:
            table.add_row(
                f"{r['said']:.3f}",
                f"{r['came true']:.3f}",
                f"{r['ci low']:.3f} … {r['ci high']:.3f}",
                f"{r['count']:.0f}",
            )
        parts.append(table)
    return Group(*parts)


def render_imitators(rows: Sequence[Imitators]) -> Table:
    """What is named in place of every effect that was withheld."""
    table = Table(title="withheld from the catalogue", title_justify="left")
    for column in ("effect", "cases", "unexplained, or a set", "no gap", "named instead"):
        table.add_column(column, overflow="fold")
    for r in rows:
        named = "; ".join(f"{a} × {k}" if k > 1 else a for a, k in r.answers)
        share = f"{100 * r.unexplained.value:.0f} % ({100 * r.unexplained.low:.0f} … {100 * r.unexplained.high:.0f})"
        table.add_row(r.effect, str(r.unexplained.count), share, str(r.no_gap), named)
    return table


def _split_table(title: str, split: Mapping[str, Mapping[str, Figure]]) -> Table:
    columns = [c for c in (*SHARES, "probability on the truth") if any(c in figures for figures in split.values())]
    table = Table(title=title, title_justify="left")
    table.add_column("", overflow="fold")
    for column in columns:
        table.add_column(column, justify="right")
    for key, figures in split.items():
        cells = [
            f"{_value(c, figures[c].value)} ({figures[c].count})" if c in figures and figures[c].count else ""
            for c in columns
        ]
        table.add_row(key, *cells)
    return table


def _value(name: str, value: float) -> str:
    if name in SHARES:
        return f"{100 * value:.0f} %"
    if name == "seconds":
        return f"{value:.1f} s"
    return f"{value:.2f}"
