"""What the commands print: tables and JSON on stdout, progress on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from jaxfinger.errors import UserError

Output = Annotated[Path, Parameter(name=["--output", "-o"])]


@contextmanager
def progress(title: str) -> Iterator[Callable[[str], None]]:
    """A line on stderr that says what is being done and since when; one line a step where it is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda message: print(f"{title}: {message}", file=sys.stderr, flush=True)
        return
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title)
        yield lambda message: bar.update(task, description=f"{title}: {message}")


def table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> None:
    """A table whose first `left` columns are text and the rest numbers."""
    out = Table(title=title, title_justify="left", title_style="bold", header_style="", box=None, pad_edge=False)
    for k, name in enumerate(header):
        out.add_column(name, justify="left" if k < left else "right", overflow="fold")
    for row in rows:
        out.add_row(*row)
    console().print(out)
    console().print()


def console() -> Console:
    """Stdout, without colour of its own for numbers; wide where it is no terminal, so that tables stay whole."""
    out = Console(highlight=False)
    return out if out.is_terminal else Console(highlight=False, width=160)


def print_json(content: Any) -> None:
    """JSON for programs: NaN and infinities as null."""
    print(json.dumps(_finite(content), indent=1, ensure_ascii=False))


def _finite(value: Any) -> Any:
    match value:
        case dict():
            return {str(k): _finite(v) for k, v in value.items()}
        case list() | tuple():
            return [_finite(v) for v in value]
        case float() if not math.isfinite(value):
            return None
        case Path():
            return str(value)
    return value


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Before any work: an output file that exists is only replaced when asked."""
    if path.is_dir():
        raise UserError(f"{path}: is a folder; name a file in it")
    if path.exists() and not overwrite:
        raise UserError(f"{path}: exists already and is not overwritten; choose another name, or add --overwrite")
    if not path.parent.is_dir():
        raise UserError(f"{path.parent}: is no folder; make it first")
