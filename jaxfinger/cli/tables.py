"""A fit and a validation as tables that people read."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING

from jaxfinger.cli.output import console, plain, table
from jaxfinger.report.numbers import HALF_95, number, scaled, with_error

if TYPE_CHECKING:
    from jaxfinger.identify import Fit
    from jaxfinger.identify.validate import Validation


MISFIT = 1.5  # χ² per row above which a model or its noise is not right


def fit_as_dict(fit: Fit) -> dict:
    """What made the fit, its stages and its parameters (SI units)."""
    return {
        "specimen": fit.specimen,
        "data": fit.data,
        "data_hash": fit.data_hash,
        "recipe": asdict(fit.recipe),
        "created": fit.created,
        "versions": fit.versions,
        "stages": [asdict(s) for s in fit.stages],
        "parameters": fit.table(),
        "effects": [{"effect": type(e).__name__, "site": list(getattr(e, "site", ()))} for e in fit.model.effects],
        "noise": [
            {"experiment": e, "channel": c, "std": n.std.tolist(), "source": n.source}
            for (e, c), n in fit.noise.items()
        ],
    }


def print_fit(fit: Fit, parameters: bool = True) -> None:
    """Stages, warnings, and the finger as the paper describes it; ± is half of a 95 % interval."""
    from jaxfinger.report.curves import curves

    found = curves(fit)
    print(plain(f"{fit.specimen} · {fit.data} · recipe {fit.recipe.name} · {fit.created}\n"))
    rows = [
        (s.name, s.status, str(len(s.trials)), number(s.chi2_per_row), f"{100 * s.outliers:.1f} %") for s in fit.stages
    ]
    table("Stages", ("stage", "status", "trials", "χ² per row", "outliers"), rows, left=2)
    _warnings(fit)
    if found.moment_arm:
        _moment_arms(fit, found)
    if found.joints:
        _joints(found)
    if found.tendon_friction:
        rows = [(t, with_error(c.y[-1], c.std[-1]), f"{100 * (1 - c.y[-1] / c.x[-1]):.0f} %") for t, c in _taut(found)]
        table(f"Tendon friction at {_taut(found)[0][1].x[-1]:.0f} N", ("tendon", "loss N", "transmitted"), rows)
    if parameters and (rows := _parameters(fit)):
        table("Parameters", ("parameter", "value", "units"), rows)
    for effect in fit.model.effects:
        print(f"with {type(effect).__name__} at {'-'.join(getattr(effect, 'site', ()))}")


def _taut(found):
    return list(found.tendon_friction.items())


def _warnings(fit: Fit) -> None:
    out, said = console(), False
    for s in fit.stages:
        said = said or bool(s.message or s.warnings)
        for text in ([s.message] if s.message else []) + list(s.warnings):
            out.print(plain(f"{s.name}: {text}"), markup=False, soft_wrap=True)
        if s.status == "fitted" and s.chi2_per_row > MISFIT:
            out.print(
                f"{s.name}: the residuals are {s.chi2_per_row**0.5:.1f} times the noise, so the model misses something "
                "and the intervals are wider by that or more: run `jaxfinger diagnose`, or give the recipe more terms",
                markup=False,
                soft_wrap=True,
            )
            said = True
    if said:
        out.print()


def _moment_arms(fit: Fit, found) -> None:
    joints = fit.model.finger.joint_names
    rows = []
    for t in dict.fromkeys(t for t, _ in found.moment_arm):
        cells = []
        for j in joints:
            if (t, j) in found.moment_arm:
                high, low, std = found.moment_arm[t, j].range()
                cells.append(_range(high, low, std))
            else:
                cells.append("–")
        rows.append((t, *cells))
    table("Moment arms in mm (max; min)", ("tendon", *joints), rows)


def _range(high: float, low: float, std: float) -> str:
    half = f"{HALF_95 * std:.2f}" if math.isfinite(std) else "?"
    return f"{high:.2f}; {low:.2f} ± {half}"


def _joints(found) -> None:
    rows = []
    for name, c in found.joints.items():
        unit = "N" if c.prismatic else "N mm"
        rate = "N s/m" if c.prismatic else "N mm s/rad"
        rows.append(
            (
                name,
                f"{c.gravity.max():.1f}; {c.gravity.min():.1f}",
                _range(*c.elastic.range()),
                _range(*c.friction.range()),
                unit,
                with_error(*c.damping),
                rate,
            )
        )
    header = ("joint", "gravity", "elastic", "friction", "", "damping", "")
    table("Torque of the joints over their range (max; min)", header, rows)


def _parameters(fit: Fit) -> list[tuple[str, str, str]]:
    """Name, value with its 95 % interval, and the unit that suits their size."""
    rows = []
    for p in fit.table():
        half = HALF_95 * (p["std"] or 0.0)
        factor, unit = scaled(max(abs(p["value"]), half), p["units"])
        std = None if p["std"] is None else p["std"] * factor
        rows.append((p["name"], with_error(p["value"] * factor, std), unit))
    return rows


def print_validation(result: Validation) -> None:
    """One row a channel's column."""
    print(plain(f"{result.specimen} · {result.session}\n"))
    for experiment in dict.fromkeys(s.experiment for s in result.scores):
        rows = []
        for s in (s for s in result.scores if s.experiment == experiment):
            ratio = s.rms / s.noise if s.noise else None
            what = s.channel + (f", {s.method}" if s.method else "")
            rows.append((what, s.column, number(s.rms), number(s.mean), number(s.noise), number(ratio, 2), s.units))
        header = ("channel", "", "rms error", "mean error", "noise", "rms/noise", "")
        table(experiment, header, rows, left=2)
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
