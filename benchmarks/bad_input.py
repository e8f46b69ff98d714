"""Bad input: mistakes of unit, sign and column that pass without a warning, and damaged files.

    python benchmarks/bad_input.py mistakes SESSION.h5 … [--sound SESSION.h5 …]
    python benchmarks/bad_input.py mutations [--count N]

`mistakes` makes every mistake of a mapping in a sound session, and counts those that the checker does not warn of.
Sound files must have no warning. `mutations` mutates mappings, recordings and sessions, and counts tracebacks, crashes,
hangs and files that should not have been written.
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np
import scipy.io

from jaxfinger.cli import main as main_of_jaxfinger
from jaxfinger.data import Session, Trial, check_file, read_session, write_session
from jaxfinger.data.checks.session import check_samples, check_session
from jaxfinger.data.findings import Report

ROOT = Path(__file__).parents[1]
Mistake = Callable[[Trial], Trial]

# Units that a mapping may confuse with SI, and the factors by which values then come out too large.
UNITS = {
    "time": {"ms": 1e3, "us": 1e6, "ns": 1e9, "s taken for ms": 1e-3, "min": 1 / 60},
    "q": {"deg": 57.29578, "turn": 0.1591549, "mrad": 1e3, "rad taken for deg": 0.01745329, "motor of gear 10": 10},
    "tendon_force": {"mN": 1e3, "kN": 1e-3, "g": 101.97, "kg": 0.10197, "lbf": 0.22481, "V of 10 N/V": 0.1},
    "tendon_excursion": {"mm": 1e3, "cm": 1e2, "um": 1e6, "inch": 39.370, "m for mm": 1e-3, "m for cm": 0.01},
    "joint_torque": {"N mm": 1e3, "N cm": 1e2, "kg cm": 10.197, "lbf inch": 8.8507, "N m taken for N mm": 1e-3,
                     "V of 0.1 N m/V": 10},
    "fingertip_force": {"mN": 1e3, "kN": 1e-3, "g": 101.97, "kg": 0.10197, "lbf": 0.22481, "V of 10 N/V": 0.1},
}  # fmt: skip


def mistakes(session: Session) -> Iterator[tuple[str, Mistake]]:
    """Yield the mistakes that a mapping can make with the channels of a session, by name."""
    m, n = session.finger.m, session.finger.n
    active = np.flatnonzero(session.finger.active)
    for channel, units in UNITS.items():
        for name, factor in units.items():
            yield f"{channel} in {name}", _changed(channel, lambda x, f=factor: x * f)
    negated = {
        "q": range(m),
        "joint_torque": range(m),
        "tendon_excursion": active[:2],
        "tendon_force": active[:1],
        "fingertip_force": (0, 2),
    }
    for channel, columns in negated.items():
        for k in columns:
            yield f"{channel} {k} negated", _changed(channel, lambda x, k=k: x * _minus(x, k))
        yield f"{channel} negated", _changed(channel, lambda x: -x)
    swaps = {
        "q": ((0, 1), (m - 2, m - 1)),
        "joint_torque": ((0, 1), (m - 2, m - 1)),
        "tendon_excursion": (active[:2],),
        "tendon_force": (active[:2],),
        "fingertip_force": ((0, 2), (0, 1)),
    }
    for channel, (a, b) in ((channel, pair) for channel, pairs in swaps.items() for pair in pairs):
        yield f"{channel} {a} and {b} exchanged", _changed(channel, lambda x, a=a, b=b: _exchanged(x, a, b))
    yield (
        "tendon_force and tendon_excursion exchanged",
        lambda t: replace(t, tendon_force=t.tendon_excursion, tendon_excursion=t.tendon_force),
    )
    yield "every excursion is the first's", _changed("tendon_excursion", lambda x: np.repeat(x[:, :1], n, axis=1))
    yield "q is the speed", lambda t: replace(t, q=np.gradient(t.q, t.time, axis=0))
    yield "q is the time", lambda t: replace(t, q=np.repeat(t.time[:, None], m, axis=1))
    yield "joint_torque is zero", _changed("joint_torque", lambda x: 0 * x)
    yield "tendon_excursion is zero", _changed("tendon_excursion", lambda x: 0 * x)


def _minus(x: np.ndarray, k: int) -> np.ndarray:
    return np.where(np.arange(x.shape[1]) == k, -1, 1)


def _changed(channel: str, change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    def make(trial: Trial) -> Trial:
        values = getattr(trial, channel)
        return trial if values is None else replace(trial, **{channel: change(values)})

    return make


def _exchanged(x: np.ndarray, a: int, b: int) -> np.ndarray:
    out = x.copy()
    out[:, [a, b]] = x[:, [b, a]]
    return out


def findings(session: Session) -> Report:
    """Findings of the checker on a session in memory."""
    report = Report()
    check_session(session, report)
    check_samples(session, report)
    return report


def complaints(session: Session) -> set[str]:
    """Errors and warnings of the checker on a session."""
    return {str(f) for f in findings(session) if f.severity != "note"}


def run_mistakes(paths: list[str], sound: list[str]) -> None:
    """Print the mistakes that pass without a warning, and the warnings on sound files."""
    for path in paths:
        session = read_session(path)
        before, silent, count = complaints(session), [], 0
        for name, mistake in mistakes(session):
            wrong = replace(session, trials={t.name: mistake(t) for t in session})
            if all(wrong[t.name] is t for t in session):
                continue  # The session has no such channel.
            count += 1
            if complaints(wrong) <= before:
                silent.append(name)
        print(f"{path}: {len(silent)} of {count} mistakes pass without a warning: {'; '.join(silent)}")
    warnings = {path: complaints(read_session(path)) for path in (*paths, *sound)}
    print(f"{sum(map(len, warnings.values()))} warnings on {len(warnings)} sound files")
    for path, texts in warnings.items():
        for text in sorted(texts):
            print(f"  {path}: {text}")


# Values that a mutation puts in the place of another.
VALUES = (
    "3",
    "-1",
    "0",
    "1e308",
    "nan",
    "true",
    '"text"',
    '""',
    "[]",
    "[1, 2]",
    "{}",
    "[[1]]",
    "2024-03-01",
    '"t"',
    '"../x"',
)
HANG_TIME = 20.0  # s of processor time after which a command counts as hung


def mutated_text(text: str, rng: np.random.Generator) -> str:
    """Mutate a mapping as a slip of the hand does: change a value, a line, a key or a character."""
    lines = text.splitlines()
    k = int(rng.integers(len(lines)))
    line = lines[k]
    match rng.integers(7):
        case 0:
            del lines[k]
        case 1:
            lines.insert(int(rng.integers(len(lines))), line)
        case 2 | 3:
            key, equals, _ = line.partition(" = ")
            lines[k] = f"{key} = {rng.choice(VALUES)}" if equals else line
        case 4:
            words = list(re.finditer(r'"[^"]*"|[\w.]+', line))
            if words:
                word = words[int(rng.integers(len(words)))]
                lines[k] = line[: word.start()] + str(rng.choice(VALUES)) + line[word.end() :]
        case 5:
            at = int(rng.integers(len(line) + 1))
            lines[k] = line[:at] + chr(rng.integers(32, 127)) + line[at + int(rng.integers(2)) :]
        case _:
            other = int(rng.integers(len(lines)))
            lines[k], lines[other] = lines[other], lines[k]
    return "\n".join(lines)


def mutated_bytes(raw: bytes, rng: np.random.Generator) -> bytes:
    """Mutate a file as a fault of memory, disk or editor does: change, remove or double bytes, or cut off its end.

    Half of the files keep all bytes in their places, since a binary file with moved bytes hardly ever opens.
    """
    out = bytearray(raw)
    kinds = 3 if rng.integers(2) else 6
    for _ in range(int(rng.integers(1, 9))):
        at, size = int(rng.integers(len(out))), int(rng.integers(1, 17))
        match rng.integers(kinds):
            case 0 | 1:
                out[at] = int(rng.integers(256))
            case 2:
                out[at : at + size] = rng.bytes(size)
            case 3:
                del out[at : at + size]
            case 4:
                out[at:at] = out[at : at + size]
            case _:
                if rng.integers(8) == 0:
                    del out[at:]
        if not out:
            break
    return bytes(out)


def mutated_table(raw: bytes, rng: np.random.Generator) -> bytes:
    """Mutate a cell, a line or the separators of a CSV."""
    lines = raw.decode().splitlines()
    k = int(rng.choice([0, 1, int(rng.integers(len(lines)))]))
    cells = lines[k].split(",")
    at = int(rng.integers(len(cells)))
    match rng.integers(6):
        case 0:
            cells[at] = str(rng.choice(["", "x", "1,5", "1e999", "nan", '"', "#", "True", "1_000", "\x00", "é"]))
        case 1:
            cells.insert(at, cells[at])
        case 2:
            del cells[at]
        case 3:
            lines.insert(int(rng.integers(len(lines))), lines[k])
        case 4:
            lines = [line.replace(",", str(rng.choice([";", "\t", " ", "|", ", "]))) for line in lines]
            return "\n".join(lines).encode(str(rng.choice(["utf-8", "utf-16", "utf-8-sig"])))
        case _:
            return mutated_bytes(raw, rng)
    lines[k] = ",".join(cells)
    return "\n".join(lines).encode()


def mutate_structure(path: Path, rng: np.random.Generator) -> None:
    """Remove an object of an HDF5 file, change its shape, type or place, or change an attribute."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = str(rng.choice(names))
        item = file[name]
        values = (np.nan, -1, 3, "text", "", b"\xff\xfe", [1.0, 2.0], True, 1e308, np.zeros((2, 2)), h5py.Empty("f8"))
        value = values[int(rng.integers(len(values)))]
        if item.attrs and rng.integers(2):
            key = str(rng.choice(list(item.attrs)))
            if rng.integers(3):
                item.attrs[key] = value
            else:
                del item.attrs[key]
            return
        match rng.integers(7):
            case 0:
                del file[name]
            case 1:
                del file[name]
                file[name] = value
            case 2:
                del file[name]
                file.create_group(name)
            case 3:
                file[str(rng.choice(names)) + "/" + "x" if isinstance(item, h5py.Group) else name + "2"] = value
            case 4:
                del file[name]
                file[name] = h5py.SoftLink(str(rng.choice(["/nowhere", "/", "/trials", f"/{name}"])))
            case 5 if isinstance(item, h5py.Dataset):
                x, attributes = item[()], dict(item.attrs)
                del file[name]
                changes = (
                    np.transpose,
                    np.ravel,
                    lambda x: x[:0],
                    lambda x: x[:-1],
                    lambda x: x[::-1],
                    lambda x: x[None],
                )
                file[name] = changes[int(rng.integers(len(changes)))](np.atleast_1d(x))
                file[name].attrs.update(attributes)
            case _ if isinstance(item, h5py.Dataset) and item.dtype.kind == "f":
                x, attributes = item[()], dict(item.attrs)
                del file[name]
                x = (
                    np.array(x, str(rng.choice(["f2", "f4", "i1", "u8", "c16", "S8"])))
                    if rng.integers(2)
                    else x * rng.choice([np.nan, np.inf, -1.0, 0.0, 1e300, 1e-300])
                )
                file[name] = x
                file[name].attrs.update(attributes)


@dataclass
class Counts:
    """Counts of what happened to the mutated inputs of one kind."""

    tried: int = 0
    taken: int = 0
    refused: int = 0
    tracebacks: list[str] = field(default_factory=list)
    crashes: int = 0
    hangs: int = 0
    written: int = 0  # files of a command that failed, or that `check` refuses


def outcome(command: Callable[[], None], out: Path | None) -> str:
    """Run a command in a child process. Return its exit code, a traceback's last line, "hang", "crash" or "written"."""
    read, write = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        child = os.fork()
    if child == 0:
        os.close(read)
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, HANG_TIME)
        result = "0"
        try:
            command()
        except SystemExit as end:
            result = str(end.code or 0)
        except BaseException as error:  # Any error is counted.
            place = traceback.extract_tb(error.__traceback__)[-1]
            result = f"{type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
        os.write(write, result.encode()[:4000])
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        result = pipe.read().decode()
    _, status = os.waitpid(child, 0)
    if os.WIFSIGNALED(status):
        return "hang" if os.WTERMSIG(status) == signal.SIGPROF else "crash"
    if result == "2" and out is not None and out.exists():
        return "written"
    if result == "0" and out is not None and any(f.severity == "error" and not f.local for f in check_file(out)):
        return "written"
    return result


Prepare = Callable[[np.random.Generator | None], tuple[list[str], Path | None]]


def count(kind: str, number: int, prepare: Prepare) -> None:
    """Run a command on `number` mutated inputs, and print what happened.

    `prepare(None)` gives the sound input, which must be taken. It runs in this process, so that the children fork with
    all imports done: importing is nine tenths of a command's time.
    """
    tokens, out = prepare(None)
    printed = io.StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            main_of_jaxfinger(tokens)
    except SystemExit:
        raise SystemExit(f"the sound input of {kind} is refused: {printed.getvalue()}") from None
    if out is not None:
        out.unlink()
    counts = Counts()
    for k in range(number):
        tokens, out = prepare(np.random.default_rng(k))
        result = outcome(lambda tokens=tokens: main_of_jaxfinger(tokens), out)
        counts.tried += 1
        match result:
            case "0":
                counts.taken += 1
            case "2":
                counts.refused += 1
            case "hang":
                counts.hangs += 1
            case "crash":
                counts.crashes += 1
            case "written":
                counts.written += 1
            case _:
                counts.tracebacks.append(f"{k}: {result}")
        if out is not None:
            out.unlink(missing_ok=True)
    print(
        f"{kind}: {counts.tried} tried, {counts.taken} taken, {counts.refused} refused, {len(counts.tracebacks)} "
        f"tracebacks, {counts.crashes} crashes, {counts.hangs} hangs, {counts.written} wrongly written",
        flush=True,
    )
    for text in sorted(set(counts.tracebacks))[:10]:
        print(f"  {text}")


def as_newer_matlab(old: Path, new: Path) -> None:
    """Write the recording of a case as MATLAB 7.3 does, and its mapping."""
    new.mkdir()
    signals = scipy.io.loadmat(old / "log.mat", simplify_cells=True)["S"]
    with h5py.File(new / "log.mat", "w", userblock_size=512) as file:
        for name, values in (("S/time", signals["time"]), ("S/signals/values", signals["signals"]["values"])):
            file[name] = np.asarray(values, np.float64)
            file[name].attrs["MATLAB_class"] = np.bytes_("double")
        for group in ("S", "S/signals"):
            file[group].attrs["MATLAB_class"] = np.bytes_("struct")
    shutil.copyfile(old / "m.toml", new / "m.toml")


def run_mutations(number: int) -> None:
    """Run mutated mappings and recordings through `import`, and mutated sessions through `check`."""
    sys.path.insert(0, str(ROOT))  # for `docs` and `tests`
    with tempfile.TemporaryDirectory() as name:
        mutate_texts(number, Path(name))
        mutate_recordings(number // 4, Path(name))
        mutate_sessions(number, Path(name))


def mutate_texts(number: int, folder: Path) -> None:
    """Count what becomes of mutated mappings and finger files of docs/your-own-data.md, with their sound recordings."""
    from docs.own_data_logs import main as write_own_data_logs

    write_own_data_logs(folder)
    guide = (ROOT / "docs" / "your-own-data.md").read_text(encoding="utf-8")
    for block, text in re.findall(r"^```toml (\S+)\n(.*?)^```", guide, re.M | re.S):
        (folder / block).write_text(text)
    logs, out = [str(path) for path in sorted(folder.glob("*.csv"))], folder / "out.h5"

    for kind, times, source, target, mapping in (
        ("mappings", number, "mapping.toml", "mutated.toml", "mutated.toml"),
        ("fingers", number // 4, "finger.toml", "finger.toml", "mapping.toml"),
    ):
        sound = (folder / source).read_text()

        def of_text(rng: np.random.Generator | None, sound=sound, target=target, mapping=mapping):
            (folder / target).write_text(mutated_text(sound, rng) if rng else sound)
            return ["import", *logs, "--mapping", str(folder / mapping), "-o", str(out)], out

        count(kind, times, of_text)


def mutate_recordings(number: int, folder: Path) -> None:
    """Count what becomes of mutated recordings of each format, with their sound mappings."""
    cases, out = ROOT / "tests" / "data" / "cases", folder / "out.h5"
    as_newer_matlab(cases / "simulink-signal-of-two-columns", folder / "newer")
    for kind, recording, mapped, mutate in (
        ("CSV", cases / "csv-as-other-programs-write-it/quoted.csv", "quoted.toml", mutated_table),
        ("CSV of Scope", cases / "csv-as-other-programs-write-it/scope.csv", "scope.toml", mutated_bytes),
        ("MAT", cases / "simulink-signal-of-two-columns/log.mat", "m.toml", mutated_bytes),
        ("MAT 7.3", folder / "newer/log.mat", "m.toml", mutated_bytes),
        ("MCAP", cases / "one-message-at-time-zero/log.mcap", "m.toml", mutated_bytes),
        ("bag", cases / "joint-states-of-two-publishers/log", "m.toml", mutated_bytes),
    ):
        target = folder / "mutated" / recording.name
        shutil.rmtree(folder / "mutated", ignore_errors=True)
        (folder / "mutated").mkdir()
        if recording.is_dir():
            shutil.copytree(recording, target, copy_function=shutil.copyfile)
            target.chmod(0o755)
        inner = next(target.glob("*.db3")) if recording.is_dir() else target
        raw = (next(recording.glob("*.db3")) if recording.is_dir() else recording).read_bytes()
        text = (recording.parent / mapped).read_text()
        text = text.replace('time = "t"', 'time = "q.time"') if kind == "CSV of Scope" else text
        text = text.replace("column = 0", 'column = "J"') if kind == "bag" else text
        (folder / "case.toml").write_text(text)

        def of_recording(rng: np.random.Generator | None, inner=inner, raw=raw, mutate=mutate, target=target):
            inner.write_bytes(mutate(raw, rng) if rng else raw)
            return ["import", str(target), "--mapping", str(folder / "case.toml"), "-o", str(out)], out

        count(kind, number, of_recording)


def mutate_sessions(number: int, folder: Path) -> None:
    """Count what becomes of sessions whose HDF5 structure or bytes are mutated."""
    from tests.data.conftest import make_session

    session = folder / "session.h5"
    write_session(make_session(), session)
    raw = session.read_bytes()

    def of_structure(rng: np.random.Generator | None):
        session.write_bytes(raw)
        with suppress(
            OSError, ValueError, TypeError, KeyError, RuntimeError, OverflowError
        ):  # h5py refuses to write it.
            if rng:
                mutate_structure(session, rng)
        return ["check", str(session)], None

    def of_bytes(rng: np.random.Generator | None):
        session.write_bytes(mutated_bytes(raw, rng) if rng else raw)
        return ["check", str(session)], None

    count("structure of a session", number // 2, of_structure)
    count("bytes of a session", number * 5, of_bytes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("mistakes")
    command.add_argument("sessions", nargs="+")
    command.add_argument("--sound", nargs="*", default=[])
    command = commands.add_parser("mutations")
    command.add_argument("--count", type=int, default=2000, help="of mappings; the other kinds in proportion")
    chosen = parser.parse_args()
    if chosen.command == "mistakes":
        run_mistakes(chosen.sessions, chosen.sound)
    else:
        run_mutations(chosen.count)


if __name__ == "__main__":
    main()
