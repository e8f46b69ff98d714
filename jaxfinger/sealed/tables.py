"""The scores as tables for a terminal or a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Group
from rich.table import Table

from .score import Figure, Imitators, Scores

NOT_PERCENT = (
    "Brier",
    "probability on the truth",
    "set size",
    "closed",
    "closed, of what the true law closes",
    "seconds",
)


def render(scores: Scores) -> Group:
    """Tables of all figures, of their split by effect, severity and specimen, of wrong verdicts and of reliability."""
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
        for column in ("probability", "came true", "95 % interval", "candidates"):
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


def markdown(blocks: Mapping[str, Scores]) -> str:
    """Markdown table with a row for each score and a column for each block of cases: value (95 % interval), count."""
    names = list(dict.fromkeys(n for s in blocks.values() for n, f in s.figures.items() if f.count))
    lines = [f"| | {' | '.join(blocks)} |", "| --- |" + " --- |" * len(blocks)]
    for n in names:
        found = [s.figures.get(n) for s in blocks.values()]
        lines.append(f"| {n} | " + " | ".join(_cell(n, f) if f and f.count else "" for f in found) + " |")
    return "\n".join(lines) + "\n"


def _cell(name: str, f: Figure) -> str:
    return f"{_value(name, f.value)} ({_value(name, f.low)} … {_value(name, f.high)}), {f.count}"


def render_imitators(rows: Sequence[Imitators]) -> Table:
    """Table of what is named in place of each withheld effect."""
    table = Table(title="withheld from the catalogue", title_justify="left")
    for column in ("effect", "cases", "unexplained, or a set", "no gap", "named instead"):
        table.add_column(column, overflow="fold")
    for r in rows:
        named = "; ".join(f"{a} × {k}" if k > 1 else a for a, k in r.answers)
        share = f"{100 * r.unexplained.value:.0f} % ({100 * r.unexplained.low:.0f} … {100 * r.unexplained.high:.0f})"
        table.add_row(r.effect, str(r.unexplained.count), share, str(r.no_gap), named)
    return table


def _split_table(title: str, split: Mapping[str, Mapping[str, Figure]]) -> Table:
    columns = list(dict.fromkeys(name for figures in split.values() for name in figures))
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
    if name == "seconds":
        return f"{value:.1f} s"
    return f"{value:.2f}" if name in NOT_PERCENT else f"{100 * value:.0f} %"
