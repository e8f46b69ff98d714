"""Tables of a fit and of a validation for people."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jaxfinger.cli.output import console, plain, table
from jaxfinger.jsonable import jsonable
from jaxfinger.report.numbers import HALF_95, MAX_CHI2, extremes, number, quantity, reach, scaled, with_error

if TYPE_CHECKING:
    from jaxfinger.data import Session
    from jaxfinger.identify import Fit
    from jaxfinger.identify.validate import Validation


def fit_to_read(fit: Fit, session: Session | None = None) -> dict:
    """Content of a fit's file, with a part `seen` that people read: parameters, and ranges of the fit's curves.

    `session`: that of the fit, whose highest tension the tendons' losses are said at.
    """
    from jaxfinger.identify.fit_file import content_of
    from jaxfinger.report.curves import model_curves

    found = model_curves(fit, session)
    seen = {
        "parameters": list(fit.table()),
        "moment_arms": [[t, j, *c.range()] for (t, j), c in found.moment_arm.items()],
        "joints": [
            {
                "joint": name,
                "prismatic": c.prismatic,
                "range": [float(c.elastic.x[0]), float(c.elastic.x[-1])],
                "gravity": [float(c.gravity.max()), float(c.gravity.min())],
                "elastic": c.elastic.range(),
                "friction": c.friction.range(),
                "damping": c.damping,
            }
            for name, c in found.joints.items()
        ],
        "tendon_friction": [[t, *map(float, (c.x[-1], c.y[-1], c.std[-1]))] for t, c in found.tendon_friction.items()],
    }
    return content_of(fit) | {"seen": jsonable(seen)}


def fit_as_dict(content: dict) -> dict:
    """Fit for JSON output: its origin, its stages, and its parameters in SI units."""
    kept = ("specimen", "data", "data_hash", "recipe", "created", "versions", "stages")
    return {k: content[k] for k in kept} | {
        "parameters": content["seen"]["parameters"],
        "effects": [{"effect": e["effect"], "site": e["site"]} for e in content["effects"]],
        "noise": [{k: n[k] for k in ("experiment", "channel", "std", "source")} for n in content["noise"]],
    }


def print_fit(content: dict, parameters: bool = True) -> None:
    """Print a fit: stages, warnings, and the finger as in the paper's tables. ± is half of a 95 % interval."""
    seen, stages = content["seen"], content["stages"]
    about = (content["specimen"], content["data"], f"recipe {content['recipe']['name']}", content["created"])
    print(plain(" · ".join(about) + "\n"))
    rows = [
        (s["name"], s["status"], str(len(s["trials"])), number(s["chi2_per_row"]), f"{100 * s['outliers']:.1f} %")
        for s in stages
    ]
    table("Stages", ("stage", "status", "trials", "χ² per row", "outliers"), rows, left=2)
    _warnings(stages)
    if seen["moment_arms"]:
        _moment_arms(seen["moment_arms"], content["finger"]["joint_names"], content["finger"]["prismatic"])
    if seen["joints"]:
        _joints(seen["joints"])
    if losses := seen["tendon_friction"]:
        rows = [(t, with_error(loss, std), f"{100 * (1 - loss / f):.0f} %") for t, f, loss, std in losses]
        table(f"Tendon friction at {quantity(losses[0][1], 'N')}", ("tendon", "loss N", "transmitted"), rows)
    if parameters and (rows := _parameters(seen["parameters"])):
        table("Parameters", ("parameter", "value", "units"), rows)
    for effect in content["effects"]:
        print(plain(f"with {effect['effect']} at {'-'.join(effect['site'])}"))


def _warnings(stages: list[dict]) -> None:
    out, said = console(), False
    for s in stages:
        said = said or bool(s["message"] or s["warnings"])
        for text in ([s["message"]] if s["message"] else []) + list(s["warnings"]):
            out.print(plain(f"{s['name']}: {text}"), markup=False, soft_wrap=True)
        chi2 = s["chi2_per_row"]
        if s["status"] == "fitted" and chi2 is not None and chi2 > MAX_CHI2:
            out.print(
                f"{s['name']}: the residuals are {chi2**0.5:.1f} times the noise, so the model misses something "
                "and the intervals are wider by that or more: run `jaxfinger diagnose`, or give the recipe more terms",
                markup=False,
                soft_wrap=True,
            )
            said = True
    if said:
        out.print()


def _moment_arms(arms: list, joints: list[str], sliding: list[bool]) -> None:
    found = {(t, j): reach(*curve) for t, j, *curve in arms}
    rows = [(t, *(found.get((t, j), "–") for j in joints)) for t in dict.fromkeys(t for t, _ in found)]
    slides = ", of a sliding joint in mm/mm" if any(sliding) else ""
    table(f"Moment arms in mm{slides} over the range of the trials (max; min)", ("tendon", *joints), rows)


def _joints(joints: list[dict]) -> None:
    rows = []
    for c in joints:
        torque, damping = ("N", "N s/m") if c["prismatic"] else ("N m", "N m s/rad")
        terms, unit = _suited([c["gravity"], c["elastic"], c["friction"]], torque, c["prismatic"])
        (rate,), unit_of_rate = _suited([c["damping"]], damping, c["prismatic"])
        gravity, elastic, friction = extremes(*terms[0]), reach(*terms[1]), reach(*terms[2])
        low, high = c["range"]
        reaches = f"{round(low)} to {round(high)}" + (" mm" if c["prismatic"] else "°")
        rows.append((c["joint"], reaches, gravity, elastic, friction, unit, with_error(*rate), unit_of_rate))
    header = ("joint", "range", "gravity", "elastic", "friction", "", "damping", "")
    table("Torque of the joints over the range of the trials (max; min)", header, rows)


def _suited(groups: list[list], units: str, prismatic: bool) -> tuple[list[list], str]:
    """Groups of numbers, N mm (N of a prismatic joint), in the unit that suits the largest; None stays None."""
    si = 1.0 if prismatic else 1e-3
    factor, unit = scaled(si * max(abs(x) for group in groups for x in group if x is not None), units)
    return [[None if x is None else x * si * factor for x in group] for group in groups], unit


def _parameters(parameters: list[dict]) -> list[tuple[str, str, str]]:
    """Rows of name, value with its 95 % interval, and a unit that suits their size."""
    rows = []
    for p in parameters:
        half = HALF_95 * (p["std"] or 0.0)
        factor, unit = scaled(max(abs(p["value"]), half), p["units"])
        std = None if p["std"] is None else p["std"] * factor
        rows.append((p["name"], with_error(p["value"] * factor, std), unit))
    return rows


def print_validation(result: Validation) -> None:
    """Print a validation, one row for each column of a channel."""
    from jaxfinger.report.sentences import EXPERIMENT_SENTENCES

    print(plain(f"{result.specimen} · {result.session}\n"))
    for experiment in dict.fromkeys(s.experiment for s in result.scores):
        rows = []
        for s in (s for s in result.scores if s.experiment == experiment):
            ratio = s.rms / s.noise if s.noise else None
            what = s.channel + (f", {s.method}" if s.method else "")
            rows.append((what, s.column, number(s.rms), number(s.mean), number(s.noise), number(ratio, 2), s.units))
        header = ("channel", "", "rms error", "mean error", "noise", "rms/noise", "")
        table(f"{experiment}: {EXPERIMENT_SENTENCES[experiment]}", header, rows, left=2)
    if result.slopes:
        rows = [
            (
                f"{s.trial}, pulling {s.tendon}",
                s.axis,
                with_error(s.measured, s.measured_std),
                with_error(s.predicted, s.predicted_std),
            )
            for s in result.slopes
        ]
        table("Fingertip force against tension, slope in N/N", ("trial", "axis", "measured", "model"), rows, left=2)
    for message in result.messages:
        print(plain(message))
