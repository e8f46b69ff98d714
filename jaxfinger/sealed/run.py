"""Run a diagnosis over sealed cases: on many cores, on many machines by shares, and resumed after a stop.

The diagnosis gets a copy of `fit.h5` in an empty folder. It sees neither the fresh trials nor a path to the truth.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import h5py
import numpy as np

from jaxfinger.errors import UserError

from .truth import Cause, Truth, read_diagnosis, read_truth

# Compiled code of a case takes up to 18,000 memory maps. Linux gives a process 65,530.
CASES_PER_PROCESS = 3

Diagnose = Callable[[Path, Path], None]  # (session file, folder to write gap.json into)


@dataclass(frozen=True)
class Command:
    """A shell command line with {fit} and {out}, for example `jaxfinger diagnose {fit} -o {out}`."""

    line: str

    def without(self, effect: str) -> Command:
        """Copy of the command with one effect taken out of the catalogue."""
        return Command(f"{self.line} --without {shlex.quote(effect)}")

    def __call__(self, fit: Path, out: Path) -> None:
        _run([w.format(fit=fit, out=out) for w in shlex.split(self.line)])


def run_case(diagnose: Diagnose, folder: Path, out: Path) -> str:
    """Diagnose one case into `out/<case>` unless it is done. Return "done", "failed" or "skipped".

    `run.json` records the seconds and, of a failure, the error.
    """
    target = out / folder.name
    if (target / "run.json").exists():
        return "skipped"
    record: dict = {"case": folder.name}
    with tempfile.TemporaryDirectory() as sealed:
        fit, result = Path(sealed) / "fit.h5", Path(sealed) / "out"
        shutil.copyfile(folder / "fit.h5", fit)
        begun = time.perf_counter()
        try:
            diagnose(fit, result)
            if not (result / "gap.json").exists():
                raise RuntimeError("the diagnosis wrote no gap.json")
        except Exception as error:  # Any error of the code under test is its result.
            record["error"] = f"{type(error).__name__}: {error}"
        record["seconds"] = time.perf_counter() - begun
        target.mkdir(parents=True, exist_ok=True)
        if result.exists():
            shutil.copytree(result, target, dirs_exist_ok=True)
    part = target / "run.json.part"
    part.write_text(json.dumps(record, indent=1))
    os.replace(part, target / "run.json")
    return "failed" if "error" in record else "done"


@dataclass(frozen=True)
class Predict:
    """Shell command lines: `line` predicts a session by a fit, with {fit}, {session} and {out}; `refit` fits a session
    with the true effects, with {session}, {effects} and {out}. An empty `refit` leaves the best out.
    """

    line: str
    refit: str = ""

    def __call__(self, fit: Path, session: Path, out: Path) -> None:
        _run([w.format(fit=fit, session=session, out=out) for w in shlex.split(self.line)])

    def best(self, session: Path, causes: Sequence[Cause], out: Path) -> None:
        """Fit a session with the true effects into `out`."""
        words = []
        for w in shlex.split(self.refit):
            named = [f"{effect}:{'-'.join(site)}" for effect, site in causes]
            words += named if w == "{effects}" else [w.format(session=session, out=out)]
        _run(words)


def _run(words: list[str]) -> None:
    """Run a command.

    Raises:
        RuntimeError: Its exit status is not zero. The message is the end of what it printed.
    """
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError((done.stderr or done.stdout).strip()[-2000:] or f"exit status {done.returncode}")


def close_case(predict: Predict, folder: Path, diagnosed: Path, truth: Truth) -> str:
    """Predict a case's fresh trials into `diagnosed/fresh.json`, and return "done", "skipped" or "failed".

    Predictions are those of the nominal model (before), with the verdict's effects (after), and with the true effects
    (best, the same as after where the verdict is right). Cases that are done or have no listed effect are skipped. If a
    command fails, `close.log` holds its message.
    """
    from .closure import fresh_rows

    fits = {"before": diagnosed / "nominal.json", "after": diagnosed / "augmented.json"}
    if (diagnosed / "fresh.json").exists() or not all(f.exists() for f in fits.values()):
        return "skipped"
    if not truth.listed:
        return "skipped"
    right = set(read_diagnosis(diagnosed).named) == set(truth.listed)
    with tempfile.TemporaryDirectory() as scratch:
        outs = {name: Path(scratch) / f"{name}.h5" for name in fits}
        try:
            if predict.refit and not right:
                fits["best"] = Path(scratch) / "best.json"
                outs["best"] = Path(scratch) / "best.h5"
                predict.best(folder / "fit.h5", truth.listed, fits["best"])
            for name, fit in fits.items():
                predict(fit, folder / "fresh.h5", outs[name])
        except RuntimeError as error:
            (diagnosed / "close.log").write_text(str(error))
            return "failed"
        if right:
            outs["best"] = outs["after"]
        rows = fresh_rows(folder / "fresh.h5", outs)
    part = diagnosed / "fresh.json.part"
    part.write_text(json.dumps({"rows": rows}, indent=1))
    os.replace(part, diagnosed / "fresh.json")
    return "done"


def close_cases(
    cases: Path,
    out: Path,
    predict: Predict,
    truth_root: Path | None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, str]:
    """Call `close_case` for every diagnosed case, and return its results by case."""
    folders = [f.parent for f in sorted(cases.glob("*/fit.h5")) if (out / f.parent.name / "gap.json").exists()]
    truths = {f.name: read_truth(f, truth_root) for f in folders}
    results: dict[str, str] = {}
    with ThreadPoolExecutor(workers) as pool:
        jobs = {pool.submit(close_case, predict, f, out / f.name, truths[f.name]): f.name for f in folders}
        for job in as_completed(jobs):
            results[jobs[job]] = job.result()
            if progress:
                progress(len(results), len(folders), f"{jobs[job]} {job.result()}")
    return results


def run_cases(
    cases: Path,
    out: Path,
    diagnose: Diagnose | Mapping[str, Diagnose],
    workers: int = 1,
    share: tuple[int, int] = (1, 1),
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, str]:
    """Diagnose the cases of a folder, or share (i, n) of them, and return the results of `run_case` by case.

    `diagnose` may map names of cases to diagnoses; other cases are then left out. Cases with the same crossings of
    tendons and joints run in sequence, so that a process compiles once for them.

    Raises:
        UserError: The folder has no case, or the system ended a process.
    """
    folders = sorted(f.parent for f in cases.glob("*/fit.h5"))
    if not folders:
        raise UserError(
            f"{cases}: no case here; each case is a folder with a fit.h5 (make them with: jaxfinger sealed make)"
        )
    how = diagnose if isinstance(diagnose, Mapping) else {f.name: diagnose for f in folders}
    mine = [f for k, f in enumerate(folders, start=1) if k % share[1] == share[0] % share[1] and f.name in how]
    mine.sort(key=lambda f: (_crossings(f / "fit.h5"), f.name))
    results: dict[str, str] = {}
    commands = all(isinstance(d, Command) for d in how.values())  # A command starts its own process.
    at_once = len(mine) if commands else workers * CASES_PER_PROCESS
    for first in range(0, len(mine), max(1, at_once)):
        # Processes are spawned, since JAX's threads do not survive a fork. They are replaced after some cases, since
        # compiled code stays in memory.
        pool = ThreadPoolExecutor(workers) if commands else ProcessPoolExecutor(workers, get_context("spawn"))
        with pool:
            jobs = {pool.submit(run_case, how[f.name], f, out): f.name for f in mine[first : first + at_once]}
            for job in as_completed(jobs):
                try:
                    results[jobs[job]] = job.result()
                except BrokenProcessPool:
                    raise UserError(
                        f"{cases}: the system ended a process while {jobs[job]} waited for it, as where memory is "
                        "short; run the command again with fewer --workers: it goes on where it was"
                    ) from None
                if progress:
                    progress(len(results), len(mine), f"{jobs[job]} {results[jobs[job]]}")
    return results


def _crossings(fit: Path) -> bytes:
    """Key of the matrix of which tendon crosses which joint; empty where the file has none."""
    try:
        with h5py.File(fit) as file:
            crosses = np.asarray(file["finger/tendons/crosses"])
            return str(crosses.shape).encode() + crosses.tobytes()
    except (OSError, KeyError):
        return b""
