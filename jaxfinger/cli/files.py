"""`jaxfinger check`, `simulate`, `import`: session files in and out."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from jaxfinger.cli.output import Output, console, plain, print_json, progress, refuse_existing, remark
from jaxfinger.errors import UserError
from jaxfinger.progress import Step


def check(file: Path, *, json: bool = False) -> None:
    """Say what is wrong with a session file, one sentence a finding. Exits 2 where the file breaks the format.

    Parameters
    ----------
    file
        Session (HDF5).
    json
        Print the findings as JSON.
    """
    from jaxfinger.data import check_file

    with progress("check") as say:
        say(file.name)
        findings = check_file(file)
    errors = sum(f.severity == "error" for f in findings)
    if json:
        print_json({"file": file, "ok": not errors, "findings": [asdict(f) for f in findings]})
    else:
        for finding in findings:
            console().print(plain(finding), markup=False, soft_wrap=True)
        rest = len(findings) - errors
        print(f"{file}: " + (f"{errors} errors, {rest} remarks" if findings else "nothing to complain about"))
    if errors:
        raise SystemExit(2)


def simulate(
    source: Path,
    *,
    output: Output,
    protocol: Path | None = None,
    effects: Path | None = None,
    seed: int | None = None,
    overwrite: bool = False,
) -> None:
    """Write a simulated session: the specimen and protocol of a recipe, or the finger that a fit describes.

    Parameters
    ----------
    source
        Recipe of the simulator (TOML), or a fit (JSON): then its model takes the place of the specimen.
    output
        Session to write (HDF5).
    protocol
        With a fit: the recipe whose trials and sensors it goes through; by default all experiments at 1 kHz.
    effects
        The Python file of effects of your own, where the fit's model has some.
    seed
        Of the noise; by default the recipe's.
    overwrite
        Replace a file that is already there.
    """
    refuse_existing(output, overwrite)
    if protocol is not None and source.suffix != ".json":
        raise UserError(f"{source}: a recipe brings its own trials; leave out --protocol, or give a fit")
    from jaxfinger.data import write_session
    from jaxfinger.synthetic import Recipe, read_recipe
    from jaxfinger.synthetic import simulate as run

    with progress("simulate") as say:

        def count(done: int, total: int, name: str) -> None:
            say(Step(f"trial {done + 1} of {total}, {name}", done / max(total, 1)))

        if source.suffix == ".json":
            from jaxfinger.identify import load_fit
            from jaxfinger.synthetic.fitted import session_of_model

            fit = load_fit(source, effects)
            recipe = read_recipe(protocol) if protocol else Recipe()
            session = session_of_model(fit.model, fit.specimen, recipe, seed, count)
        else:
            session = run(read_recipe(source), seed, progress=count)
        say("writing")
        write_session(session, output, overwrite)
    print(plain(f"{output}: {len(session)} trials of {session.specimen}"))


def import_(
    *sources: Path,
    mapping: Annotated[Path, Parameter(name=["--mapping", "-m"])],
    output: Output,
    overwrite: bool = False,
) -> None:
    """Turn recordings (MATLAB v5 and v7.3, CSV, rosbag2, MCAP) into one session.

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
    refuse_existing(output, overwrite)
    from jaxfinger.data import import_file
    from jaxfinger.data.findings import Report

    report = Report()
    try:
        with progress("import") as say:
            say(", ".join(s.name for s in sources))
            session = import_file(sources, mapping, output, overwrite, report)
    finally:
        remark(report, mapping)
    print(plain(f"{output}: {len(session)} trials of {session.specimen}"))
