"""`jaxfinger diagnose`: where the model misses the finger, which effects cause it, and how far the gap shrinks."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from jaxfinger.cli.output import Output, console, plain, print_json, progress, read, refuse_output, table
from jaxfinger.errors import UserError

if TYPE_CHECKING:
    from jaxfinger.data import Session
    from jaxfinger.gap.predicted import CheckedPredictions
    from jaxfinger.gap.result import Diagnosis

FILES = ("gap.json", "nominal.json", "augmented.json", "report.html")


def diagnose(
    *sessions: Path,
    output: Output,
    recipe: str | None = None,
    predictions: Path | None = None,
    against: Path | None = None,
    effects: Path | None = None,
    without: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    tolerance: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    quick: bool = False,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """Diagnose the gap between a session and the nominal model that is identified from it.

    Each of several sessions has a diagnosis of its own, and a table shows which cause is at work in which session.

    Parameters
    ----------
    sessions
        Session (HDF5), or several of one finger.
    output
        Folder for gap.json, nominal.json, augmented.json and report.html; it is made where there is none. Each of
        several sessions has a folder in it, named after its file.
    recipe
        The nominal model (TOML), or the name of a shipped recipe. A term that it leaves out is a candidate cause.
    predictions
        Another simulator's predictions of the session's trials (HDF5, as `predict` writes them): the gap is then
        that between the measurements and this simulator.
    against
        An earlier fit of the same finger (JSON, as `identify` writes it), to find what has changed since. Its intervals
        are the prior, its recipe is the nominal model, and each of its parameters is a candidate beside the effects.
    effects
        A Python file with effects of your own, beside those of the catalogue.
    without
        Effects of the catalogue to leave out, by id.
    tolerance
        Gaps that do not matter: a share of the channel's signal, for all channels (`2%`) or one (`joint_torque=5%`).
    quick
        A first look: half the samples, and no fit of causes and model together.
    json
        Print gap.json, and nothing else, on stdout; for several sessions one object with the gap.json of each file.
    overwrite
        Replace an earlier diagnosis in the folder.
    """
    folders = _folders(sessions, output)
    for folder in folders.values():
        refuse(folder, overwrite, *sessions, against, predictions)
    if predictions is not None:
        _refuse_predictions(predictions, sessions)
    tolerated, left_out = _tolerance(tolerance or []), tuple(without or ())
    from dataclasses import replace

    from jaxfinger.data.atomic import folder_to_fill
    from jaxfinger.effects import load
    from jaxfinger.gap import diagnose as run
    from jaxfinger.identify import load_fit, read_recipe
    from jaxfinger.report.gap_json import as_gap_json, write
    from jaxfinger.report.page import write_page
    from jaxfinger.report.screen import summary

    texts, gaps, found = {}, {}, {}
    with progress("first look" if quick else "diagnose") as say:
        wanted = None if recipe is None and against is not None else read_recipe(recipe)
        earlier = load_fit(against, effects) if against is not None else None
        own = load(effects) if effects is not None else {}
        say("reading the file")
        measured = {session: read(session) for session in folders}
        for session in measured:
            if earlier is not None and earlier.was_made_from(measured[session]):
                said = f"is a fit of {session} itself, whose data then count twice; give a fit of an earlier session"
                print(plain(f"{against}: {said}"), file=sys.stderr)
        simulated = None if predictions is None else _predictions(predictions, measured[sessions[0]])
        for session, folder in folders.items():
            name = session.name
            told = say if len(folders) == 1 else lambda message, name=name: say(f"{name}: {message}")
            with folder_to_fill(folder):
                d = run(measured[session], wanted, quick, own, left_out, told, simulated, tolerated, earlier)
                if against is not None:
                    d = replace(d, against=against.name)
                told("writing the report")
                write(d, folder, overwrite)
                write_page(d, folder / "report.html", overwrite)
            texts[name], gaps[name] = summary(d, own), as_gap_json(d)
            found[name] = replace(d, problem=None)  # The problem holds every row of the session: its memory is freed.
    if json:
        print_json(gaps if len(gaps) > 1 else gaps[sessions[0].name])
    else:
        _print(folders, texts, found)


def _folders(sessions: tuple[Path, ...], output: Path) -> dict[Path, Path]:
    """Output folder of each session; UserError where two sessions would share one."""
    if not sessions:
        raise UserError("diagnose needs a session (HDF5)")
    if len(sessions) == 1:
        return {sessions[0]: output}
    folders = {s: output / s.stem for s in sessions}
    if len(set(folders.values())) < len(sessions):
        raise UserError(f"{output}: needs a folder for each session; give each once, in files of different names")
    return folders


def _refuse_predictions(predictions: Path, sessions: tuple[Path, ...]) -> None:
    """Refuse predictions for several sessions, and a session in place of predictions."""
    if len(sessions) > 1:
        raise UserError(f"{predictions}: holds predictions of one session; give that session alone")
    if predictions.exists() and any(s.exists() and predictions.samefile(s) for s in sessions):
        raise UserError(f"{predictions}: is the session itself; give the simulator's predictions of its trials")


def _predictions(file: Path, session: Session) -> CheckedPredictions:
    """Read predictions of a session, print what is doubtful about them, and refuse what can only be a mistake."""
    from jaxfinger.data import read_predictions
    from jaxfinger.data.findings import Report
    from jaxfinger.gap.predicted import checked

    report = Report()
    simulated = checked(session, read_predictions(file, session, report), str(file))
    for finding in (*report, *simulated.doubts):
        print(plain(f"{file}: {finding}"), file=sys.stderr)
    return simulated


def _tolerance(texts: list[str]) -> dict[str, float]:
    """Tolerated shares of the signal by channel, from texts such as `2%` and `joint_torque=5%`."""
    channels, out = ("joint_torque", "tendon_excursion", "fingertip_force"), {}
    for text in texts:
        channel, _, share = text.rpartition("=")
        try:
            value = float(share.removesuffix("%")) / (100.0 if share.endswith("%") else 1.0)
        except ValueError:
            value = -1.0
        if not 0.0 <= value < 1.0 or (channel and channel not in channels):
            known = ", ".join(channels)
            raise UserError(f"--tolerance {text}: say a share such as 2%, or joint_torque=5%; channels: {known}")
        out |= dict.fromkeys([channel] if channel else channels, value)
    return out


def _print(folders: dict[Path, Path], texts: dict[str, str], found: dict[str, Diagnosis]) -> None:
    """Print the summary of each diagnosis with the place of its page, and of several the table that compares them."""
    from jaxfinger.report.screen import comparison

    for session, folder in folders.items():
        console().print(plain(texts[session.name]), markup=False, soft_wrap=True)
        print(f"\n{folder / 'report.html'}: the evidence\n")
    if len(found) > 1:
        header, rows = comparison(found)
        title = "Causes that a session names, or cannot tell apart: probability in every session, and size"
        table(title, header, rows)


def refuse(output: Path, overwrite: bool, *reads: Path | None) -> None:
    """Refuse a folder with an earlier diagnosis that may not be overwritten, before anything is read."""
    if output.exists() and not output.is_dir():
        raise UserError(f"{output}: is a file; name a folder")
    for name in FILES if output.is_dir() else ():
        refuse_output(output / name, overwrite, *reads)
