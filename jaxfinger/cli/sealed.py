"""`jaxfinger sealed make | run | close | score | rivals`: the benchmark of the diagnosis on cases with hidden truth."""

from __future__ import annotations

import io
import json
import os
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from jaxfinger.cli.output import console
from jaxfinger.errors import UserError

Folder = Annotated[Path | None, Parameter(name=["--output", "-o"])]
PREDICT = f"{shlex.quote(sys.executable)} -m jaxfinger predict {{fit}} {{session}} -o {{out}}"
REFIT = f"{shlex.quote(sys.executable)} -m jaxfinger fit effects {{session}} --effect {{effects}} -o {{out}}"


def make(
    folder: Path,
    *,
    split: Literal["develop", "fresh", "foreign"] = "develop",
    mix: Literal["natural", "several"] = "natural",
    count: int = 60,
    truth: Path | None = None,
    workers: int | None = None,
    share: str = "1/1",
) -> None:
    """Make sealed cases: FOLDER/case-NNN/{fit,fresh}.h5, and their truth in another tree. Finished cases are left
    alone.

    Args:
        folder: where the cases go.
        split: `develop` to work with; `fresh` has other seeds, and is for a published table only; `foreign` has forms
            and protocols that neither the catalogue nor the other splits have.
        mix: `natural`: mostly one effect, sometimes none, two, or one that the catalogue lacks; `several`: three to
            five effects at once, every other case with a small one beside them that the catalogue lacks.
        count: how many cases; a larger count adds to a smaller one.
        truth: where the truth goes; by default a folder beside it, named FOLDER-truth.
        workers: processes; by default as many as there are cores.
        share: this machine's part of the work, for example 2/8.
    """
    from jaxfinger.data.atomic import folder_to_fill
    from jaxfinger.sealed.cases import make_cases

    if count < 1:
        raise UserError(f"--count {count}: ask for at least one case")
    truth_root = truth or _beside(folder, "truth")
    with folder_to_fill(folder), folder_to_fill(truth_root), _bar("making cases") as progress:
        make_cases(split, count, folder, truth_root, workers or os.cpu_count() or 1, _share(share), progress, mix=mix)
    print(f"{folder}: cases; {truth_root}: truth. Diagnose them with: jaxfinger sealed run {folder}")


def rivals(folder: Path, *, truth: Path | None = None, workers: int | None = None, share: str = "1/1") -> None:
    """Compute the ceiling: which other causes no method could tell from the true one. Written into the truth;
    takes half a minute a case.

    Args:
        folder: the cases.
        truth: what `make` hid; by default FOLDER-truth.
        workers: processes; by default as many as there are cores.
        share: this machine's part of the work, for example 2/8.
    """
    from jaxfinger.sealed.rivals import add_all

    truth_root = truth or _beside(folder, "truth")
    if not any(truth_root.glob("case-*.json")):
        raise UserError(
            f"{truth_root}: no truth of a case here; make the cases first with: jaxfinger sealed make {folder}"
        )
    with _bar("rivals") as progress:
        add_all(truth_root, workers or os.cpu_count() or 1, _share(share), progress)


def run(
    folder: Path,
    *,
    output: Folder = None,
    command: str | None = None,
    withheld: bool = False,
    truth: Path | None = None,
    workers: int | None = None,
    share: str = "1/1",
) -> None:
    """Diagnose every case of FOLDER, each from a lone copy of its fit.h5. Cases that are done are skipped.

    Args:
        folder: the cases.
        output: where each case's gap.json goes; by default a folder beside it, named FOLDER-diagnoses, or
            FOLDER-withheld.
        withheld: diagnose the cases with one effect, with that effect taken out of the catalogue: what is said then?
        truth: what `make` hid, by default FOLDER-truth; read with --withheld only, by this command and not by what
            diagnoses.
        command: another diagnosis than this program's; {fit} and {out} stand for the session and the folder to write.
        workers: cases at a time; by default as many as there are cores.
        share: this machine's part of the work, for example 2/8.
    """
    from jaxfinger.sealed.run import Command, run_cases
    from jaxfinger.sealed.truth import read_truth

    if command and not ("{fit}" in command and "{out}" in command):
        raise UserError(
            f"--command {command!r}: it must hold {{fit}} and {{out}}, as in 'jaxfinger diagnose {{fit}} -o {{out}}'"
        )
    out = output or _beside(folder, "withheld" if withheld else "diagnoses")
    diagnose = Command(command) if command else Diagnosis()
    if withheld:
        truths = [read_truth(f.parent, truth or _beside(folder, "truth")) for f in sorted(folder.glob("*/fit.h5"))]
        diagnose = {t.name: diagnose.without(t.causes[0][0]) for t in truths if t.kind == "listed"}
    with _bar("diagnosing") as progress:
        results = run_cases(folder, out, diagnose, workers or os.cpu_count() or 1, _share(share), progress)
    failed = sorted(name for name, what in results.items() if what == "failed")
    print(
        f"{out}: {len(results) - len(failed)} diagnosed"
        + (f"; failed, see run.json: {', '.join(failed)}" if failed else "")
    )


@dataclass(frozen=True)
class Diagnosis:
    """`jaxfinger diagnose` without output, in this process, so that compiled functions serve the cases that follow."""

    left_out: tuple[str, ...] = ()

    def without(self, effect: str) -> Diagnosis:
        """Diagnosis with one effect taken out of the catalogue."""
        return Diagnosis((effect,))

    def __call__(self, fit: Path, out: Path) -> None:
        from jaxfinger.cli.diagnose import diagnose

        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            diagnose(fit, output=out, without=list(self.left_out))


def close(
    folder: Path,
    *,
    diagnoses: Path | None = None,
    truth: Path | None = None,
    command: str = PREDICT,
    refit: str = REFIT,
    workers: int | None = None,
) -> None:
    """Predict the fresh trials of every diagnosed case with a known effect before and after, and by a refit with the
    true effects, for the score of how far the gap closes.

    Args:
        folder: the cases.
        diagnoses: what `run` wrote; by default FOLDER-diagnoses.
        truth: what `make` hid; by default FOLDER-truth, or truth.json beside each fit.h5.
        command: what predicts; {fit}, {session} and {out} stand for the fit, the fresh trials and the file to write.
        refit: what fits with the true effects; {session}, {effects} and {out} stand for the session that was
            diagnosed, the effects as effect:site, and the fit to write. An empty one for none.
        workers: cases at a time; by default as many as there are cores.
    """
    from jaxfinger.sealed.run import Predict, close_cases

    out = diagnoses or _beside(folder, "diagnoses")
    if not out.is_dir():
        raise UserError(f"{out}: no diagnoses here; run them first with: jaxfinger sealed run {folder}")
    truths = truth or _beside(folder, "truth")
    with _bar("closing") as progress:
        results = close_cases(folder, out, Predict(command, refit), truths, workers or os.cpu_count() or 1, progress)
    failed = sorted(name for name, what in results.items() if what == "failed")
    print(f"{out}: {len(results)} cases" + (f"; failed, see close.log: {', '.join(failed)}" if failed else ""))


def score(folder: Path, *, diagnoses: Path | None = None, truth: Path | None = None, output: Folder = None) -> None:
    """Print every score of the diagnosis on FOLDER's cases, with intervals, confusions and reliability; and what stands
    in for effects that were withheld, where `run --withheld` has been.

    Args:
        folder: the cases.
        diagnoses: what `run` wrote; by default FOLDER-diagnoses.
        truth: what `make` hid; by default FOLDER-truth, or truth.json beside each fit.h5.
        output: a folder for scores.json, table.md and reliability.svg.
    """
    from jaxfinger.data.atomic import folder_to_fill
    from jaxfinger.sealed.figures import reliability_diagram
    from jaxfinger.sealed.score import imitators, score_folder
    from jaxfinger.sealed.tables import markdown, render, render_imitators

    results = diagnoses or _beside(folder, "diagnoses")
    if not results.is_dir():
        raise UserError(f"{results}: no diagnoses here; run them first with: jaxfinger sealed run {folder}")
    scores = score_folder(folder, results, truth or _beside(folder, "truth"))
    if not scores.cases:
        raise UserError(
            f"{results}: holds no diagnosis of a case in {folder}; run them first with: jaxfinger sealed run {folder}"
        )
    console().print(render(scores))
    stand_ins = imitators(folder, _beside(folder, "withheld"), truth or _beside(folder, "truth"))
    if stand_ins:
        console().print(render_imitators(stand_ins))
    if output:
        both = scores.to_json() | {"withheld": [asdict(r) for r in stand_ins]}
        with folder_to_fill(output):
            (output / "scores.json").write_text(json.dumps(both, indent=1))
            (output / "table.md").write_text(markdown({folder.name: scores}))
            reliability_diagram(scores.reliability, output / "reliability.svg")
        print(f"{output}: scores.json, table.md, reliability.svg")


def _beside(folder: Path, what: str) -> Path:
    return folder.with_name(f"{folder.name}-{what}")


def _share(text: str) -> tuple[int, int]:
    """Numbers i and n of a share `i/n`."""
    try:
        i, n = (int(x) for x in text.split("/"))
    except ValueError:
        raise UserError(f"--share {text}: say it as i/n, for example 2/8") from None
    if not 1 <= i <= n:
        raise UserError(f"--share {text}: i runs from 1 to n")
    return i, n


@contextmanager
def _bar(title: str) -> Iterator[Callable[[int, int, str], None]]:
    """Show a progress bar. The context is a function that takes the numbers done and in total, and a description."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn(title),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, what: bar.update(task, completed=done, total=total, description=what)
