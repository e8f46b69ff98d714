"""`jaxfinger check`, `look`, `simulate`, `import`: session files in and out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from jaxfinger.cli.output import Output, console, plain, print_json, print_warnings, progress, refuse_output, table
from jaxfinger.errors import UserError, counted
from jaxfinger.progress import Step

if TYPE_CHECKING:
    from jaxfinger.data import Session
    from jaxfinger.data.importing.recording import Recording
    from jaxfinger.data.importing.survey import ColumnSurvey

_NOTHING = {"mounting": None, "motion": None}


def check(file: Path, *, json: bool = False) -> None:
    """Say what is wrong with a session file, one sentence a finding. Exits 2 where the file breaks the format.

    Parameters
    ----------
    file
        Session (HDF5).
    json
        Print the findings as JSON.
    """
    from jaxfinger.data.findings import merged
    from jaxfinger.data.hdf5 import read_and_check_all

    with progress("check") as say:
        say(file.name)
        session, report = read_and_check_all(file)
    to_compare = _to_compare(session) if session is not None and report.fatal is None else _NOTHING
    findings, count = list(report), Counter(f.severity for f in report)
    errors = count["error"]
    if json:
        print_json({"file": file, "ok": not errors, **to_compare, "findings": [asdict(f) for f in findings]})
    else:
        for finding in merged(findings):
            said = f"{finding.severity}: {file}: {finding.message}" if finding.place == "/" else finding
            console().print(plain(said), markup=False, soft_wrap=True)
        for what, said in to_compare.items():
            if said is not None:
                print(plain(f"{what}: {said}"))
        found = ", ".join(counted(count[s], s) for s in ("error", "warning", "note") if s == "error" or count[s])
        print(f"{file}: {found if findings else 'nothing to complain about'}")
    if errors:
        raise SystemExit(2)


def _to_compare(session: Session) -> dict[str, str | None]:
    """What no check can judge of a session, and a person can compare with the rig: one line each."""
    from jaxfinger.data.mounting import mounting_in_words
    from jaxfinger.data.signals.pace import pace_in_words

    return {"mounting": mounting_in_words(session.finger), "motion": pace_in_words(session)}


def _as_dict(recording: Recording, seen: Sequence[ColumnSurvey]) -> dict:
    """Survey of a recording for JSON."""
    from jaxfinger.data.importing.survey import clocks_of

    return {
        "file": recording.path,
        "columns": [asdict(s) for s in seen],
        "clocks": [asdict(clock) for clock in clocks_of(recording, seen)],
        "unusable": dict(recording.unusable),
        "remarks": list(recording.remarks),
    }


def look(*recordings: Path, finger: Path | None = None, json: bool = False) -> None:
    """Say what recordings hold: names, sizes, units, rates and gaps; and propose a mapping for `import`.

    Parameters
    ----------
    recordings
        CSV, MATLAB, JSON, NumPy, HDF5, rosbag2 or MCAP.
    finger
        The finger's description (TOML) or a session: the mapping then names its joints and tendons.
    json
        Print what is seen as JSON.
    """
    if not recordings:
        raise UserError("no recording was given; name at least one")
    from jaxfinger.data.finger_file import finger_from
    from jaxfinger.data.importing.leverage import surveyed
    from jaxfinger.data.importing.proposal import proposal
    from jaxfinger.data.importing.sources import load_recording
    from jaxfinger.data.importing.survey import clocks_of
    from jaxfinger.data.signals.sizes import MAX_RATE
    from jaxfinger.data.toml import Place

    described = finger_from(str(finger.resolve()), Place(str(finger))) if finger is not None else None
    loaded = [load_recording(path) for path in recordings]
    surveys = list(zip(loaded, surveyed(loaded, described), strict=True))
    if json:
        print_json([_as_dict(recording, seen) for recording, seen in surveys])
        return
    for recording, seen in surveys:
        rows = [
            (
                s.name + ("" if s.column is None else f"[{s.column}]"),
                s.meaning or "–",
                (s.units or s.foreign or "?") + ("" if s.stated or not s.units else " ?"),
                str(s.samples),
                f"{s.low:.5g}",
                f"{s.high:.5g}",
                str(s.missing or "–"),
            )
            for s in seen
        ]
        table(str(recording.path), ("variable", "may be", "units", "samples", "from", "to", "missing"), rows, left=3)
        for clock in clocks_of(recording, seen):
            gaps = f"{counted(clock.gaps, 'gap')}, the longest {clock.longest:.3g} s" if clock.gaps else "no gaps"
            odd = counted(clock.disordered, "stamp")
            order = f"; {odd} out of order or repeated, the rate is of sorted ones" if clock.disordered else ""
            if clock.restarts:
                order = f"; it begins again or wraps at {counted(clock.restarts, 'place')}"
            if clock.rate > MAX_RATE:
                order += "; no sensor is so fast, so the times are in other units"
            print(plain(f"{clock.name}: {clock.duration:.4g} s at {clock.rate:.4g} Hz, {gaps}{order}"))
        for name, reason in recording.unusable.items():
            print(plain(f"{name} {reason}"))
        for text in recording.remarks:
            print(plain(f"{recording.path} {text}"))
    print("\n# a mapping to correct: what each trial is, its joint, signs and units\n")
    print(plain(proposal(loaded, described)))


def simulate(
    source: Path,
    *,
    output: Output,
    protocol: Path | None = None,
    effects: Path | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> None:
    """Write a simulated session: the finger and the protocol of a recipe, or the finger that a fit describes.

    Parameters
    ----------
    source
        Finger file or recipe of the simulator (TOML), or a fit (JSON): then its model is the finger.
    output
        Session to write (HDF5).
    protocol
        With a fit: the recipe whose trials and sensors it goes through; by default all experiments at 1 kHz.
    effects
        The Python file of effects of your own, where the fit's model has some.
    seed
        Seed of the noise; by default the recipe's.
    overwrite
        Replace a file that is already there.
    """
    refuse_output(output, overwrite, source, protocol, effects)
    if protocol is not None and source.suffix != ".json":
        raise UserError(f"{source}: a recipe brings its own trials; leave out --protocol, or give a fit")
    from jaxfinger.data import write_session
    from jaxfinger.synthetic import SessionRecipe, read_session_recipe
    from jaxfinger.synthetic import simulate as run

    with progress("simulate") as say:

        def count(done: int, total: int, name: str) -> None:
            say(Step(f"trial {done + 1} of {total}, {name}", done / max(total, 1)))

        if source.suffix == ".json":
            from jaxfinger.identify import load_fit
            from jaxfinger.synthetic.fitted import session_of_model

            fit = load_fit(source, effects)
            recipe = read_session_recipe(protocol) if protocol else SessionRecipe()
            session = session_of_model(fit.model, fit.specimen, recipe, seed, count)
        else:
            session = run(read_session_recipe(source), seed, progress=count)
        say("writing")
        write_session(session, output, overwrite)
    print(plain(f"{output}: {counted(len(session), 'trial')} of {session.specimen}"))


def import_(
    *sources: Path,
    mapping: Annotated[Path, Parameter(name=["--mapping", "-m"])],
    output: Output,
    overwrite: bool = False,
) -> None:
    """Turn recordings (CSV, MATLAB, JSON, NumPy, HDF5, rosbag2, MCAP) into one session.

    Exits 2, as `check` does, where the session that it wrote breaks the format.

    Parameters
    ----------
    sources
        The recordings that the mapping names.
    mapping
        Mapping file (TOML): which variable is which channel, units, the finger.
    output
        Session to write (HDF5).
    overwrite
        Replace a file that is already there.
    """
    if not sources:
        raise UserError(f"{mapping}: no recording was given; name at least one before --mapping")
    refuse_output(output, overwrite, mapping, *sources)
    from jaxfinger.data.findings import Report
    from jaxfinger.data.importing.by_mapping import import_file
    from jaxfinger.data.importing.recording import told_apart

    report = Report()
    try:
        with progress("import") as say:
            say(", ".join(told_apart(sources)))
            session = import_file(sources, mapping, output, overwrite, report)
    finally:
        print_warnings(report, mapping)
    print(plain(f"{output}: {counted(len(session), 'trial')} of {session.specimen}"))
    for what, said in _to_compare(session).items():
        print(plain(f"{what}: {said}"))
    if any(finding.severity == "error" for finding in report):
        raise SystemExit(2)
