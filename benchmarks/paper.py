"""Identified figures of the shipped paper finger beside those of the paper: `python benchmarks/paper.py`.

The session is simulated (`datasets/paper-finger`) from the paper's numbers. The table shows how well the identification
recovers them.
"""

from pathlib import Path

import numpy as np

from jaxfinger.cli.output import table
from jaxfinger.data import read_session
from jaxfinger.identify import identify
from jaxfinger.identify.validate import validate
from jaxfinger.report.numbers import with_error

SESSION = Path(__file__).parents[1] / "datasets" / "paper-finger" / "session.h5"
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


def comparison(fit, result) -> list[tuple[str, str, str, str]]:
    """Rows of quantity, the paper's figure, this fit's figure, and unit."""
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
    """Range of the gravity torque at the MCP. The other joints are straight here; the paper does not say."""
    import jax.numpy as jnp

    from jaxfinger.model import rigid_body

    q = jnp.radians(jnp.stack([jnp.linspace(10.0, 70.0, 61), jnp.zeros(61), jnp.zeros(61)]))
    torque = 1e3 * rigid_body.gravity_torque(fit.model.finger, q)[0]
    return f"{float(torque.min()):.1f} to {float(torque.max()):.1f}"


def _at(curve, x: float) -> str:
    """Value of a curve at x, with its error."""
    return with_error(float(np.interp(x, curve.x, curve.y)), float(np.interp(x, curve.x, curve.std)))


if __name__ == "__main__":
    session = read_session(SESSION)
    fit = identify(session)
    rows = comparison(fit, validate(fit, session))
    table("Simulated, beside the paper (± half of a 95 % interval)", ("quantity", "paper", "here", ""), rows)
