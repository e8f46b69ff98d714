"""Output of the commands: tables and JSON on stdout, progress on stderr."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table
from rich.text import Text

from jaxfinger.errors import UserError
from jaxfinger.jsonable import jsonable
from jaxfinger.progress import Progress, Step

if TYPE_CHECKING:
    from jaxfinger.data import Session
    from jaxfinger.data.findings import Finding

FIGURES = (".svg", ".png")
MAX_WARNINGS = 20  # More would push the results off the screen.
MIN_TIMED = 3.0  # s: people look at the time of work that takes longer.
MIN_DONE = 0.1  # share of the work: before, the elapsed time is no basis for an estimate of the rest.
Output = Annotated[Path, Parameter(name=["--output", "-o"])]


@contextmanager
def progress(title: str) -> Iterator[Progress]:
    """Show progress on stderr: one line that is renewed, or a line a step where stderr is no terminal.

    The context is a function that takes the name of the step that begins. Beside it stand the share done and an
    estimate of the time left. The share comes from the work itself (`Step`), or from the times at which the steps began
    when the same command last ran to its end.
    """
    console, begun = Console(stderr=True), time.monotonic()
    earlier = StepTimes(title)
    if not console.is_terminal:

        def say(message: str) -> None:
            seconds = time.monotonic() - begun
            step = earlier.step(message, seconds)
            about = f" ({_estimate(step, seconds)})" if step else ""
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
                    bar.update(task, total=1.0, completed=step.done, about=_estimate(step, seconds))

            yield tell
    earlier.keep(time.monotonic() - begun)


class StepTimes:
    """Times at which a command's steps began in its last run, as shares of the whole. Stored beside JAX's cache."""

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
            return {}  # The file is missing or damaged. Work goes on without an estimate.

    def step(self, message: str, seconds: float) -> Step | None:
        """Step with the share that is done when it begins; None where that is unknown."""
        self.began.setdefault(str(message), seconds)
        if isinstance(message, Step):
            return message
        return Step(message, self.shares[message]) if message in self.shares else None

    def keep(self, seconds: float) -> None:
        """Store the times of this run, which took `seconds`, if it took long enough for an estimate to be of use."""
        if self.file is None or seconds < MIN_TIMED:
            return
        told = self._all() | {self.title: {m: round(s / seconds, 3) for m, s in self.began.items()}}
        part = self.file.with_suffix(f".{os.getpid()}")
        try:
            part.write_text(json.dumps(told, indent=1), encoding="utf-8")
            os.replace(part, self.file)
        except OSError:
            part.unlink(missing_ok=True)


def _estimate(step: Step, seconds: float) -> str:
    """Share done, and the time left if the rest goes on at the same speed."""
    text = f"{100 * step.done:.0f} %"
    if not MIN_DONE <= step.done < 1.0:
        return text
    left = seconds * (1.0 - step.done) / step.done
    return f"{text}, about {f'{left / 60:.0f} min' if left > 90 else f'{max(left, 1.0):.0f} s'} left"


def plain(text: object) -> str:
    """Text for a terminal, with control characters, which could steer it, replaced by escapes."""
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in str(text))


def print_warnings(findings: Iterable[Finding], file: Path) -> None:
    """Print the checker's warnings on stderr, so that no command silently works on doubtful numbers."""
    from jaxfinger.data.findings import merged

    warnings = merged(finding for finding in findings if finding.severity == "warning" or finding.local)
    for finding in warnings[:MAX_WARNINGS]:
        print(plain(f"{file}: {finding}"), file=sys.stderr)
    if len(warnings) > MAX_WARNINGS:
        print(f"{file}: {len(warnings) - MAX_WARNINGS} more: run `jaxfinger check`", file=sys.stderr)
    sys.stderr.flush()


def read(path: Path) -> Session:
    """Read a session, and print the checker's warnings about it."""
    from jaxfinger.data import read_session
    from jaxfinger.data.checks.session import check_samples
    from jaxfinger.data.findings import Report

    report = Report()
    session = read_session(path, report=report)
    check_samples(session, report)
    print_warnings(report, path)
    return session


def table(title: str, header: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> None:
    """Print a table. Its first `left` columns are text, the others numbers."""
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
    """Console on stdout that does not colour numbers, and is wide where stdout is no terminal, to keep rows whole."""
    out = Console(highlight=False)
    return out if out.is_terminal else Console(highlight=False, width=160)


def print_json(content: Any) -> None:
    """Print JSON for programs, with null for NaN and infinities."""
    print(json.dumps(jsonable(content), indent=1, ensure_ascii=False))


def refuse_output(path: Path, overwrite: bool, *reads: str | Path | None) -> None:
    """Refuse an output file that cannot be written or may not be replaced, before any work is done.

    `reads` are the files that the command reads, or names of shipped ones: it replaces none of them, since each may be
    the only copy.
    """
    from jaxfinger.data.atomic import refuse_existing

    if path.exists() and any(read is not None and Path(read).exists() and path.samefile(read) for read in reads):
        raise UserError(f"{path}: is read by this command and would be lost; choose another name for the output")
    refuse_existing(path, overwrite)
    if not path.parent.is_dir():
        raise UserError(f"{path.parent}: is no folder; make it first")


def refuse_effects(fit: Path) -> None:
    """Refuse a fit whose model has effects, before any work is done."""
    from jaxfinger.fit_content import read_content

    if read_content(fit).get("effects"):
        raise UserError(f"{fit}: its model has effects; give a fit of the nominal model, as `identify` writes it")


def refuse_figure(path: Path, overwrite: bool) -> None:
    """Refuse a picture that is neither .svg nor .png, cannot be written or may not be replaced."""
    if path.suffix not in FIGURES:
        raise UserError(f"{path}: is to be a picture; give a name that ends in {' or '.join(FIGURES)}")
    refuse_output(path, overwrite)
