"""What the commands print: tables and JSON on stdout, progress on stderr."""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxfinger.errors import UserError
from jaxfinger.progress import Step

if TYPE_CHECKING:
    from jaxfinger.data import Session
    from jaxfinger.data.findings import Finding

FIGURES = (".svg", ".png")
MOST_REMARKS = 20  # what a person reads before the results scroll away
Output = Annotated[Path, Parameter(name=["--output", "-o"])]


@contextmanager
def progress(title: str) -> Iterator[Callable[[str], None]]:
    """What is being done, on stderr: a line that renews itself, or one line a step where it is no terminal.

    Beside it stand the share done and about how long the rest takes: as the work says itself (`Step`), or by when each
    step began the last time that the same command came to its end.
    """
    console, begun = Console(stderr=True), time.monotonic()
    earlier = Earlier(title)
    if not console.is_terminal:

        def say(message: str) -> None:
            seconds = time.monotonic() - begun
            step = earlier.step(message, seconds)
            about = f" ({_so_far(step, seconds)})" if step else ""
            print(plain(f"{title}: {message}{about}"), file=sys.stderr, flush=True)

        yield say
    else:
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        said, about = TextColumn("{task.description}", markup=False), TextColumn("{task.fields[about]}")
        columns = (SpinnerColumn(), said, BarColumn(20), about, TimeElapsedColumn())
        with Progress(*columns, console=console, transient=True) as bar:
            task = bar.add_task(title, total=None, about="")

            def tell(message: str) -> None:
                seconds = time.monotonic() - begun
                bar.update(task, description=plain(f"{title}: {message}"))
                if step := earlier.step(message, seconds):
                    bar.update(task, total=1.0, completed=step.done, about=_so_far(step, seconds))

            yield tell
    earlier.keep(time.monotonic() - begun)


class Earlier:
    """When each step of a command began the last time, as a share of the whole; kept beside the compiled programs."""

    def __init__(self, title: str):
        folder = os.environ.get("JAX_COMPILATION_CACHE_DIR")
        self.file = Path(folder, "progress.json") if folder else None
        self.title, self.began = title, {}
        self.shares: dict[str, float] = self._all().get(title, {})

    def _all(self) -> dict:
        try:
            found = json.loads(self.file.read_text(encoding="utf-8")) if self.file else {}
            return {t: {str(k): float(v) for k, v in shares.items()} for t, shares in found.items()}
        except (OSError, ValueError, AttributeError, TypeError):
            return {}  # none yet, or none that can be read: an estimate is no reason to stop

    def step(self, message: str, seconds: float) -> Step | None:
        """The message with the share that is done, where it is known."""
        self.began.setdefault(str(message), seconds)
        if isinstance(message, Step):
            return message
        return Step(message, self.shares[message]) if message in self.shares else None

    def keep(self, seconds: float) -> None:
        """For the next time, of work that took long."""
        if self.file is None or seconds < LONG:
            return
        told = self._all() | {self.title: {m: round(s / seconds, 3) for m, s in self.began.items()}}
        part = self.file.with_suffix(f".{os.getpid()}")
        try:
            part.write_text(json.dumps(told, indent=1), encoding="utf-8")
            os.replace(part, self.file)
        except OSError:
            part.unlink(missing_ok=True)


LONG = 3.0  # s of work from which on people look at the time
EARLY = 0.1  # share done before which the time so far says nothing of the time that is left


def _so_far(step: Step, seconds: float) -> str:
    """Share done, and about how long the rest takes if it goes on as so far."""
    text = f"{100 * step.done:.0f} %"
    if not EARLY <= step.done < 1.0:
        return text
    left = seconds * (1.0 - step.done) / step.done
    return f"{text}, about {f'{left / 60:.0f} min' if left > 90 else f'{max(left, 1.0):.0f} s'} left"


def plain(text: object) -> str:
    """Text for a terminal: control characters, which would steer it, as their escapes."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in str(text))


def remark(findings: Iterable[Finding], file: Path) -> None:
    """What the checker warns of, on stderr, so that no command works on doubtful numbers without a word."""
    from jaxfinger.data.findings import together

    warnings = together(finding for finding in findings if finding.severity == "warning" or finding.local)
    for finding in warnings[:MOST_REMARKS]:
        print(plain(f"{file}: {finding}"), file=sys.stderr)
    if len(warnings) > MOST_REMARKS:
        print(f"{file}: {len(warnings) - MOST_REMARKS} more: run `jaxfinger check`", file=sys.stderr)
    sys.stderr.flush()


def read(path: Path) -> Session:
    """The session in a file, once what the checker warns of is said."""
    from jaxfinger.data import read_session
    from jaxfinger.data.check import examine
    from jaxfinger.data.findings import Report

    report = Report()
    session = read_session(path, report=report)
    examine(session, report)
    remark(report, path)
    return session


def table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> None:
    """A table whose first `left` columns are text and the rest numbers."""
    out = Table(
        title=Text(plain(title)), title_justify="left", title_style="bold", header_style="", box=None, pad_edge=False
    )
    for k, name in enumerate(header):
        out.add_column(Text(plain(name)), justify="left" if k < left else "right", overflow="fold")
    for row in rows:
        out.add_row(*(Text(plain(cell)) for cell in row))
    console().print(out)
    console().print()


def console() -> Console:
    """Stdout, without colour of its own for numbers; wide where it is no terminal, so that tables stay whole."""
    out = Console(highlight=False)
    return out if out.is_terminal else Console(highlight=False, width=160)


def print_json(content: Any) -> None:
    """JSON for programs: NaN and infinities as null."""
    print(json.dumps(without_infinities(content), indent=1, ensure_ascii=False))


def without_infinities(value: Any) -> Any:
    """For JSON, which has no infinity and no NaN: null."""
    match value:
        case dict():
            return {str(k): without_infinities(v) for k, v in value.items()}
        case list() | tuple():
            return [without_infinities(v) for v in value]
        case float() if not math.isfinite(value):
            return None
        case Path():
            return str(value)
    return value


def refuse_output(path: Path, overwrite: bool) -> None:
    """Before any work: what will be written can be, and replaces nothing unasked."""
    from jaxfinger.data.atomic import refuse_existing

    refuse_existing(path, overwrite)
    if not path.parent.is_dir():
        raise UserError(f"{path.parent}: is no folder; make it first")


def refuse_figure(path: Path, overwrite: bool) -> None:
    """The same for a picture, whose kind its name says."""
    if path.suffix not in FIGURES:
        raise UserError(f"{path}: is to be a picture; give a name that ends in {' or '.join(FIGURES)}")
    refuse_output(path, overwrite)
