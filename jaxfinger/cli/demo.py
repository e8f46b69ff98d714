"""`jaxfinger demo`: the whole pipeline on the shipped session, beside the paper's figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

from jaxfinger.cli.output import print_json, progress, refuse_existing, table
from jaxfinger.errors import UserError
from jaxfinger.report.numbers import with_error

# Li et al. 2024, Table I: largest and smallest moment arm in mm.
PAPER_ARMS = {
    ("T1", "MCP"): (3.7, -0.9),
    ("T1", "PIP"): (8.8, 4.3),
    ("T2", "MCP"): (-5.9, -7.7),
    ("T2", "PIP"): (-4.8, -7.7),
    ("T2", "DIP"): (-5.8, -6.6),
    ("T3", "MCP"): (10.3, 5.8),
    ("T4", "MCP"): (10.5, 5.5),
}
PAPER_VD1 = {"T1": "0.424", "T3": "0.008", "T4": "0.023"}  # mm, mean error of the integral
PAPERS = ", the paper's"


def demo(
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    json: bool = False,
    overwrite: bool = False,
) -> None:
    """Identify and validate the shipped session of the paper's finger, and compare the result with the paper.

    Parameters
    ----------
    output
        Folder for the fit, the figures and the predictions; without it nothing is written.
    json
        Print the comparison as JSON.
    overwrite
        Replace files that are already there.
    """
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
        refuse_existing(output / "fit.json", overwrite)
    from jaxfinger.cli.tables import print_fit, print_validation
    from jaxfinger.data import read_session
    from jaxfinger.identify import identify
    from jaxfinger.identify.validate import validate

    with progress("demo") as say:
        say("reading the session")
        session = read_session(shipped_session())
        fit = identify(session, progress=say)
        result = validate(fit, session, progress=say)
        rows = comparison(fit, result)
        if output is not None:
            say("drawing")
            _write(fit, session, output, overwrite)
    if json:
        print_json([{"quantity": q, "paper": p, "here": h, "units": u} for q, p, h, u in rows])
        return
    print_fit(fit, parameters=False)
    print_validation(result)
    table("Beside the paper (± half of a 95 % interval)", ("quantity", "paper", "here", ""), rows)
    if output is not None:
        print(f"{output}: fit.json, predictions.h5, figures")


def shipped_session() -> Path:
    """The session in the package, or in the source tree.

    Raises:
        UserError: it is in neither.
    """
    here = Path(__file__).resolve().parents[1]
    for path in (here / "demo" / "session.h5", here.parent / "datasets" / "paper-finger" / "session.h5"):
        if path.exists():
            return path
    raise UserError(f"{here}: the shipped session is missing; install jaxfinger again")


def comparison(fit, result) -> list[tuple[str, str, str, str]]:
    """Quantity, the paper's figure, this fit's, unit."""
    from jaxfinger.report.curves import curves

    found = curves(fit)
    rows = []
    for (tendon, joint), (high, low) in PAPER_ARMS.items():
        ours_high, ours_low, std = found.moment_arm[tendon, joint].range()
        here = f"{ours_high:.2f}; {ours_low:.2f} ± {1.96 * std:.2f}"
        rows.append((f"moment arm {tendon} {joint}, max; min", f"{high}; {low}", here, "mm"))
    mcp = found.joints["MCP"]
    rows.append(("gravity torque at the MCP, 10° to 70°, others straight", "5 to 15", _gravity(fit), "N mm"))
    rows.append(("elastic torque at the MCP, 45°", "30", _at(mcp.elastic, 45), "N mm"))
    rows.append(("friction torque at the MCP, 70°", "9", _at(mcp.friction, 70), "N mm"))
    rows.append(("damping at the MCP", "close to none", with_error(*mcp.damping), "N mm s/rad"))
    for tension, lost in ((4, "1.5"), (10, "4")):
        rows.append((f"loss of T3 at {tension} N", lost, _at(found.tendon_friction["T3"], tension), "N"))
    for s in result.scores:
        if s.experiment == "VD.1" and s.column in PAPER_VD1:
            name = f"VD.1 mean error {s.column}, {s.method.removesuffix(PAPERS)}"
            rows.append((name, PAPER_VD1[s.column] if s.method.endswith(PAPERS) else "", f"{s.mean:.3f}", "mm"))
    slope = next(s for s in result.slopes if s.tendon == "T2" and s.axis == "x")
    rows.append(("VD.2 slope, measured", "-0.1485", with_error(slope.measured, slope.measured_std), "N/N"))
    rows.append(("VD.2 slope, model", "-0.1788", with_error(slope.predicted, slope.predicted_std), "N/N"))
    return rows


def _gravity(fit) -> str:
    """At the MCP, the other joints straight: the paper does not say how it held them."""
    import jax.numpy as jnp

    from jaxfinger.model import rigid_body

    q = jnp.radians(jnp.stack([jnp.linspace(10.0, 70.0, 61), jnp.zeros(61), jnp.zeros(61)]))
    torque = 1e3 * rigid_body.gravity_torque(fit.model.finger, q)[0]
    return f"{float(torque.min()):.1f} to {float(torque.max()):.1f}"


def _at(curve, x: float) -> str:
    return with_error(float(np.interp(x, curve.x, curve.y)), float(np.interp(x, curve.x, curve.std)))


def _write(fit, session, folder: Path, overwrite: bool) -> None:
    from jaxfinger.data import write_predictions
    from jaxfinger.identify import save_fit
    from jaxfinger.identify.predictions import predict_session
    from jaxfinger.report.identification import draw_identification
    from jaxfinger.report.validation import draw_validation

    save_fit(fit, folder / "fit.json", overwrite)
    draw_identification(fit, session, folder, overwrite)
    draw_validation(fit, session, folder, overwrite)
    write_predictions(folder / "predictions.h5", session, predict_session(fit, session), overwrite)
