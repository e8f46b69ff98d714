"""A diagnosis for people: one page that carries all it needs, and one screen for the terminal."""

from __future__ import annotations

import io
import math
from collections import Counter
from pathlib import Path

from jinja2 import Environment, PackageLoader
from markupsafe import Markup
from matplotlib import rc_context

from jaxfinger.data.atomic import atomic_path
from jaxfinger.data.schema import channel_units, units_where
from jaxfinger.gap import Diagnosis, as_gap_json
from jaxfinger.gap.where import site
from jaxfinger.report.diagnosis_figures import VARIABLES, glance, people, places, probabilities, traces
from jaxfinger.report.theme import look

HEADLINES = {
    "no_gap": "No gap beyond the noise",
    "explained": "Explained",
    "ambiguous": "Cannot be told apart yet",
    "unexplained": "None that I know",
}
ACCENTS = {"no_gap": "#2a8f4f", "explained": "#c8342b", "ambiguous": "#d98a00", "unexplained": "#7b4fb0"}
ROWS = 15  # candidates in the table
REMAINS = 15.0  # squared standard deviations of what is left that are worth a line


def headline(gap: dict) -> str:
    """The verdict in one line."""
    named = " and ".join(_effect(e) for e in gap["verdict"]["effects"])
    text = HEADLINES[gap["verdict"]["status"]]
    return f"{text}: {named}" if gap["verdict"]["status"] == "explained" else text


def write_page(d: Diagnosis, path: str | Path, overwrite: bool = False) -> None:
    """Write the page (HTML, no network).

    Raises:
        UserError: the file exists and `overwrite` is false, or its folder cannot be written.
    """
    template = Environment(loader=PackageLoader("jaxfinger.report", "."), autoescape=True).get_template(
        "diagnosis.html.j2"
    )
    with atomic_path(path, overwrite) as part:
        part.write_text(template.render(_content(d)), encoding="utf-8")


def _content(d: Diagnosis) -> dict:
    gap = as_gap_json(d)
    sliding = d.problem.session.finger.prismatic
    named = {name for name, _, is_named in probabilities(gap, len(gap["candidates"])) if is_named}
    rest = gap["candidates"][ROWS:]
    together = _percent(sum(c["probability"] for c in rest))
    return {
        "gap": gap,
        "headline": headline(gap),
        "colour": ACCENTS[gap["verdict"]["status"]],
        "glance": _inline(glance(gap), "glance"),
        "traces": _inline(traces(d), "traces"),
        "places": [p | {"region": _region(p["region"], sliding), "share": _percent(p["share"])} for p in gap["where"]],
        "candidates": [
            {
                "effect": c["effect"],
                "site": "-".join(c["site"]),
                "probability": _percent(c["probability"]),
                "gain": _percent(c["held_out_gain"]),
                "parameters": "; ".join(_parameter(n, p) for n, p in c["parameters"].items()),
                "named": f"{c['effect']} · {'-'.join(c['site'])}" in named,
            }
            for c in gap["candidates"][:ROWS]
        ],
        "no_gap": _percent(gap["none"]),
        "unlisted": _percent(gap["unlisted"]),
        "others": f"{len(rest)} more candidates were tried; together they have {together}." if rest else "",
        "sets": [" or ".join(_effect(e) for e in members) for members in gap["ambiguous_sets"]],
        "lines": [_line(x) for x in gap["gap"]],
        "left": [_left(d, x) for x in d.search.left if x.energy > REMAINS][:8],
        "absorbed": _absorbed(d),
        "trials": d.problem.trial_names,
        "noise": [_noise(d, e, c, n) for (e, c), n in d.problem.noise.items()],
        "recipe": d.nominal.recipe.name,
        "hash": d.nominal.data_hash[:12],
        "created": d.nominal.created,
        "versions": ", ".join(f"{k} {v}" for k, v in d.nominal.versions.items()),
    }


@look()
def _inline(figure, salt: str) -> Markup:
    """A figure as SVG inside the page; text stays text."""
    out = io.StringIO()
    with rc_context({"svg.hashsalt": salt}):  # two figures in a page must not share the ids of their clip paths
        figure.savefig(out, format="svg", metadata={"Date": None})
    text = out.getvalue()
    return Markup(text[text.index("<svg") :])


def _effect(e: dict) -> str:
    return f"{e['effect']} at {'-'.join(e['site'])}"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.01 or share <= 0 else "< 1 %"


def _region(region: dict, prismatic: tuple[bool, ...]) -> str:
    factor, unit = people(units_where(VARIABLES[region["variable"]], prismatic))
    return f"{region['variable']} from {factor * region['low']:.3g} to {factor * region['high']:.3g} {unit}"


def _parameter(name: str, p: dict) -> str:
    units = "" if p["units"] == "1" else f" {p['units']}"
    if not p["std"]:
        return f"{name} {p['value']:.3g}{units}"
    return f"{name} {p['value']:.3g} ± {p['std']:.2g}{units}"


def _line(x: dict) -> dict:
    factor, unit = people(x["units"])
    low, high = x["closed_ci95"]
    shown = x["before"] > 1.05 * x["noise"]
    closed = f"{_signed(x['closed'])} ({_signed(low)} … {_signed(high)})" if shown else "no gap to close"
    scaled = {k: f"{factor * x[k]:.3g}" for k in ("noise", "before", "after")}
    if not x["noise"]:
        scaled["noise"] = "unknown"
    return x | scaled | {"unit": unit, "closed": closed}


def _signed(share: float) -> str:
    return f"{100 * share:.0f} %"


def _left(d: Diagnosis, x) -> dict:
    by = sorted(x.by_variable.items(), key=lambda kv: -kv[1])[:3]
    return {
        "experiment": x.experiment,
        "channel": x.channel,
        "site": site(d.problem, x.channel, x.column),
        "energy": f"{x.energy:.0f}",
        "by": ", ".join(f"{k} {v:.0f}" for k, v in by if v > 0.1 * x.energy),
    }


def _absorbed(d: Diagnosis) -> str:
    by_effect: dict[str, list[str]] = {}
    for (effect, where), _ in d.search.absorbed:
        by_effect.setdefault(effect, []).append("-".join(where))
    return "; ".join(f"{effect} at {', '.join(sorted(where))}" for effect, where in sorted(by_effect.items()))


def _noise(d: Diagnosis, experiment: str, channel: str, noise) -> dict:
    factor, unit = people(channel_units(channel, d.problem.session.finger.prismatic))
    names = [site(d.problem, channel, i) for i in range(len(noise.std))]
    std = ", ".join(
        f"{n} {factor * s:.3g}" for n, s in zip(names, noise.std, strict=True) if math.isfinite(s) and s > 0
    )
    return {"experiment": experiment, "channel": channel, "std": f"{std} {unit}", "source": noise.source}


def summary(d: Diagnosis) -> str:
    """The diagnosis on one screen of a terminal, 100 columns."""
    gap, sliding = as_gap_json(d), d.problem.session.finger.prismatic
    counts = Counter(d.problem.session[name].experiment for name in d.problem.trial_names)
    trials = ", ".join(f"{n} {e}" for e, n in counts.items())
    out = [f"{gap['specimen']} · {gap['data']} · {trials}", "", headline(gap), gap["verdict"]["summary"], ""]
    if shares := places(gap):
        out.append("WHERE      share of the gap")
        regions = {}
        for p in gap["where"]:
            regions.setdefault((p["experiment"], p["channel"], p["site"]), _region(p["region"], sliding))
        for key, share in list(shares.items())[:5]:
            out.append(f"  {_bar(share)} {100 * share:3.0f} %  {' · '.join(key)}, {regions[key]}")
        out.append("")
    out.append("WHICH      probability")
    for name, p, named in probabilities(gap, 5):
        out.append(f"  {_bar(p)} {100 * p:3.0f} %  {name}{' ◀' if named else ''}")
    for e in gap["verdict"]["effects"]:
        c = next(c for c in gap["candidates"] if (c["effect"], c["site"]) == (e["effect"], e["site"]))
        out.append(f"  {_effect(e)}: " + "; ".join(_parameter(n, p) for n, p in c["parameters"].items()))
    out += ["", "HOW FAR    rms on held-out trials: noise, before → after, share closed (95 %)"]
    for x in (_line(x) for x in gap["gap"]):
        what = f"{x['experiment']} {x['channel']}"
        out.append(f"  {what:<30} {x['noise']:>8}  {x['before']:>8} → {x['after']:<8} {x['unit']:<5} {x['closed']}")
    if step := gap["next_experiment"]:
        out += ["", f"NEXT       {step['experiment']}: {step['description']}"]
    return "\n".join(out)


def _bar(share: float, width: int = 12) -> str:
    full = round(width * min(max(share, 0.0), 1.0))
    return "█" * full + "░" * (width - full)
