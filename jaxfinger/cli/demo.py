"""`jaxfinger demo`: identify, validate, diagnose and close, on a shipped session whose answer is known."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
from cyclopts import Parameter

from jaxfinger.cli.output import console, plain, progress, table
from jaxfinger.errors import UserError

if TYPE_CHECKING:
    from jaxfinger.identify.validate import Validation

BEFORE = """This finger is simulated, on a plant that shares no code with the model that is fitted (MuJoCo's rigid body
and dry friction). Two things are the matter with it that the nominal model does not know; what, is said at the end.
"""
ANSWER = """What is in fact the matter: tendon T3 stretches by 60 µm/N, and the friction of the MCP joint is 1.9 times
as high at rest as in motion, falling over 20°/s (Stribeck; datasets/demo-finger)."""
NEXT = """Next: open the page; the same for your own finger is
  jaxfinger look LOG                          what a recording holds, and mapping lines for it
  jaxfinger new finger.toml mapping.toml LOG  templates, filled in as far as LOG tells
  jaxfinger import LOG --mapping mapping.toml -o session.h5
  jaxfinger diagnose session.h5 -o diagnosis"""


def demo(
    *, output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("demo"), overwrite: bool = False
) -> None:
    """The whole story on a shipped session, which is simulated, and whose answer is known: identify the finger,
    diagnose what the model misses, and see how far that closes on trials that no fit has seen.

    Parameters
    ----------
    output
        Folder for the fits, gap.json and the page.
    overwrite
        Replace files that are already there.
    """
    from jaxfinger.cli.diagnose import refuse
    from jaxfinger.data.atomic import folder_to_fill

    refuse(output, overwrite)
    from jaxfinger.cli.tables import fit_to_read, print_fit
    from jaxfinger.data import read_session
    from jaxfinger.gap import diagnose
    from jaxfinger.identify import identify
    from jaxfinger.identify.validate import validate
    from jaxfinger.report.gap_json import write
    from jaxfinger.report.page import write_page
    from jaxfinger.report.screen import summary

    print(BEFORE)
    with folder_to_fill(output), progress("demo") as say:
        say("reading the sessions")
        session, fresh = read_session(shipped("session.h5")), read_session(shipped("fresh.h5"))
        fit = identify(session, progress=say)
    print_fit(fit_to_read(fit, session), parameters=False)
    with progress("demo") as say:
        found = diagnose(session, progress=say)
        say("writing the page")
        write(found, output, overwrite)
        write_page(found, output / "report.html", overwrite)
        say("predicting fresh trials")
        before, after = (validate(f, fresh) for f in (found.nominal, found.augmented))
    console().print(plain(summary(found)) + "\n", markup=False, soft_wrap=True)
    table(
        "Fresh trials that no fit has seen: rms error",
        ("", "noise", "nominal model", "with the causes", ""),
        closing(before, after),
    )
    print(f"{ANSWER}\n\n{output / 'report.html'}: the evidence\n\n{NEXT}")


def shipped(name: str) -> Path:
    """Path of a file of the demo finger, in the package or the source tree.

    Raises:
        UserError: the file is in neither.
    """
    here = Path(__file__).resolve().parents[1]
    for path in (here / "demo" / name, here.parent / "datasets" / "demo-finger" / name):
        if path.exists():
            return path
    raise UserError(f"{here}: the shipped session is missing; install jaxfinger again")


def closing(before: Validation, after: Validation) -> list[tuple[str, ...]]:
    """Rows of a table, one for each experiment and channel: noise and rms error of both models over all columns."""
    from jaxfinger.report.numbers import number

    rows: dict[tuple[str, ...], list[tuple[float | None, float, float]]] = defaultdict(list)
    for a, b in zip(before.scores, after.scores, strict=True):
        rows[a.experiment, a.channel, a.method, a.units].append((a.noise, a.rms, b.rms))
    out = []
    for (experiment, channel, method, units), values in rows.items():
        what = f"{experiment} {channel}" + (f", {method}" if method else "")
        cells = [number(_rms([x for x in column if x is not None])) for column in zip(*values, strict=True)]
        out.append((what, *cells, units))
    return out


def _rms(values: list[float]) -> float | None:
    return float(np.sqrt(np.mean(np.square(values)))) if values else None
