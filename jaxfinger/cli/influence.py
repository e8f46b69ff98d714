"""`jaxfinger influence`: the trials, sensors and CAD values on which each parameter of a fit depends."""

from __future__ import annotations

from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from jaxfinger.cli.output import print_json, progress, refuse_effects, refuse_figure, table

if TYPE_CHECKING:
    import numpy as np

    from jaxfinger.identify import Fit
    from jaxfinger.identify.sensitivity import Sensitivity

MAX_INFLUENCES = 3  # strongest influences of each kind for a parameter, so that a row fits the screen
MAX_NAMES = 40  # rows and columns of the picture: more names are too small to read on a page.
STEPS = {"trials": "left out", "sensors": "gain + 1 %", "cad": "+ 1 standard deviation"}


def influence(
    fit: Path, file: Path, *, figure: Path | None = None, json: bool = False, overwrite: bool = False
) -> None:
    """Show on which trials, sensors and CAD values each parameter depends.

    A derivative, not a rerun: by how many of its standard deviations a parameter moves when a trial is left out, a
    sensor reads one per cent more, or a value of CAD is one standard deviation larger.

    Parameters
    ----------
    fit
        Fit (JSON).
    file
        The session (HDF5) that it was made from.
    figure
        Picture to write (.svg or .png): parameters against trials, sensors and CAD values.
    json
        Print every derivative as JSON.
    overwrite
        Replace a figure that is already there.
    """
    if figure is not None:
        refuse_figure(figure, overwrite)
    refuse_effects(fit)
    from jaxfinger.data import read_session
    from jaxfinger.identify import load_fit
    from jaxfinger.identify.parameters import describe
    from jaxfinger.identify.sensitivity import sensitivity

    with progress("influence") as say:
        say("reading the files")
        loaded, session = load_fit(fit), read_session(file)
        say("differentiating the fit")
        found = sensitivity(loaded, session)
        names = [describe(loaded.model)[i].name for i in loaded.estimated]
        if figure is not None:
            from jaxfinger.report.plots import influence as draw
            from jaxfinger.report.theme import save

            picture = draw(found, loaded, MAX_NAMES).get_figure(root=True)
            assert picture is not None
            save(picture, figure, overwrite)
    if json:
        print_json({kind: _as_json(s, loaded, names) for kind, s in found.items()})
        return
    for s in found.values():
        _print(s, s.shifts(loaded), names)


def _as_json(s: Sensitivity, fit: Fit, names: list[str]) -> dict:
    """Derivatives of the parameters `names` by one kind of data."""
    return {
        "step": STEPS[s.kind],
        "of": list(s.names),
        "parameters": names,
        "shift_in_std": s.shifts(fit).tolist(),
        "derivative_si": s.values[:, fit.estimated].tolist(),
    }


def _print(s: Sensitivity, shifts: np.ndarray, names: list[str]) -> None:
    """Print the strongest influences on each of the parameters `names`; `shifts` in their standard deviations."""
    rows = []
    for name, by in zip(names, shifts.T, strict=True):
        strongest = sorted(range(len(s.names)), key=lambda k, by=by: -abs(by[k]))[:MAX_INFLUENCES]
        rows.append((name, ", ".join(_in_words(s.names[k], by[k]) for k in strongest if by[k])))
    title = f"By {s.kind}, {STEPS[s.kind]}: standard deviations that each parameter moves"
    table(title, ("parameter", ""), rows, left=2)


def _in_words(name: str, shift: float) -> str:
    return f"{name} {shift:+.2f}" if isfinite(shift) else f"{name} alone determines it"
