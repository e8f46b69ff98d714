"""The page of a diagnosis: one HTML file without network, readable on a phone, in light and in dark mode."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from jinja2 import Environment, PackageLoader
from markupsafe import Markup, escape
from matplotlib.axes import Axes

from jaxfinger.data.atomic import atomic_path
from jaxfinger.data.schema import channel_units, units_where
from jaxfinger.gap.parts import MIN_VARIABLE_SHARE
from jaxfinger.gap.result import Absorbed, Candidate, Cause, Closure, Diagnosis, Key, Left, Place, Status, Value
from jaxfinger.report import plots, sentences
from jaxfinger.report.causes import parameters, words
from jaxfinger.report.curves import Curves, model_curves
from jaxfinger.report.measured import arm_points
from jaxfinger.report.names import VARIABLE_NAMES, cause_name, channel_name, effect_name, joined, key_name, site_names
from jaxfinger.report.numbers import HALF_95, chance, percent, quantity, unbroken
from jaxfinger.report.plots import gap as gap_plots
from jaxfinger.report.plots.fit import INTERVAL_ROWS, interval_size
from jaxfinger.report.theme import PALETTE, css, grid, inline, look
from jaxfinger.report.traces import Trace, worst_trial

ACCENTS = {
    Status.NO_GAP: "green",
    Status.EXPLAINED: "blue",
    Status.PARTLY: "orange",
    Status.AMBIGUOUS: "purple",
    Status.UNEXPLAINED: "open",
    Status.NOT_JUDGED: "wrong",
}
NARROW, WIDE = 3.35, 7.4  # Inches, the widths of figures: a phone of 360 px less its margins, and a reading column.
# The four limits keep the page readable; `gap.json` holds everything.
MIN_PROBABILITY = 0.01  # of a cause that is listed though it is not named
MIN_PLACE_SHARE = 0.02  # of the gap, for a place to be listed
MAX_CHANGES = 8  # changed parameters
MAX_INTERVALS = 24  # parameters in the figures of intervals: those of the causes, then those known worst
MAX_SIZE = 1e5  # SI units: no torque, length, mass or gain of a machine that is diagnosed is larger.
VARIABLE_UNITS = {"q": "rad", "qd": "rad/s", "tendon_force": "N", "time": "s"}  # units of a region's variable


def write_page(d: Diagnosis, path: str | Path, overwrite: bool = False) -> None:
    """Write the page of a diagnosis.

    Raises:
        UserError: the file exists and `overwrite` is false, or its folder cannot be written.
    """
    judged = d.status is not Status.NOT_JUDGED
    html = render(d, worst_trial(d) if judged else None, _curves(d) if judged and not d.quick else None)
    with atomic_path(path, overwrite) as part:
        part.write_text(html, encoding="utf-8")


@look()
def render(d: Diagnosis, trace: Trace | None = None, found: Curves | None = None) -> str:
    """The page as HTML text.

    Args:
        d: the diagnosis.
        trace: the trial to show, measured and predicted; None leaves it out.
        found: curves of the model, of which the moment arms are shown; None leaves them out.
    """
    environment = Environment(loader=PackageLoader("jaxfinger.report", "."), autoescape=True)
    environment.filters["code"] = _code
    template = environment.get_template("page.html.j2")
    prismatic = d.nominal.model.finger.prismatic
    simulator = sentences.is_simulator(d)
    change = sentences.contradicted if simulator else sentences.change
    judged = d.candidates if d.status is not Status.NOT_JUDGED else ()
    others = [c for c in judged if c.key not in d.blamed and c.probability >= MIN_PROBABILITY]
    return template.render(
        d=d,
        css=css(),
        accent=ACCENTS[d.status],
        headline=sentences.headline(d),
        summary=unbroken(sentences.summary(d)),
        experiments={k: v for k, v in sentences.EXPERIMENT_SENTENCES.items() if k in {*_experiments(d)}},
        budget=_budget(d) if d.channels else "",
        hidden_bars=max(len(d.channels) - gap_plots.MAX_BARS, 0),
        relevance=[_relevance(x) for x in d.relevance if x.tolerated or d.status is not Status.NO_GAP],
        cards=_cards(d),
        rivals=[sentences.sentence(sentences.cannot_tell(s)) for s in d.ambiguous_sets if d.status is Status.PARTLY],
        changes=[change(x) for x in d.changes[:MAX_CHANGES]],
        changed="What the measurements say of the simulator's parameters" if simulator else "What has changed",
        others=[{"name": key_name(c.key), "probability": chance(c.probability)} for c in others],
        places=[_place(p, prismatic) for p in d.where if p.share >= MIN_PLACE_SHARE],
        trace=_trace(trace) if trace else "",
        trace_name=f"{trace.trial}: {trace.name}" if trace else "",
        closure=_closure(d) if gap_plots.shown(d.closures) else "",
        lines=[_line(x) for x in d.closures],
        runaways=[sentences.sentence(sentences.diverged(x)) for x in d.closures if x.diverged],
        left=[_left(x) for x in d.left[:5]] if d.status in (Status.PARTLY, Status.UNEXPLAINED) else [],
        unlisted=sentences.unlisted(d) if d.status in (Status.PARTLY, Status.UNEXPLAINED) else "",
        proposal=sentences.proposal(d),
        next=sentences.next_trial(d.next_experiment) if d.next_experiment else "",
        not_judged=[sentences.reason(x) for x in d.not_judged],
        parameters=_parameters(d),
        arms=_arms(found) if found else [],
        absorbed=_absorbed(d.absorbed),
        hides=any(x.hidden for x in d.absorbed),
        gap=d.status is not Status.NO_GAP,
        trials=sorted({t for s in d.nominal.stages for t in s.trials}),
        noise=_noise(d, prismatic),
        versions=", ".join(f"{k} {v}" for k, v in d.nominal.versions.items()),
    )


def _experiments(d: Diagnosis) -> Iterator[str]:
    """Experiments that the page mentions."""
    for found in (d.channels, d.closures, d.relevance, d.where, d.left, d.not_judged):
        yield from (x.experiment for x in found)


# Pictures -------------------------------------------------------------------------------------------------------------
def _code(text: str) -> Markup:
    """A sentence as HTML, with names between backquotes set as code."""
    return Markup("".join(f"<code>{escape(x)}</code>" if k % 2 else escape(x) for k, x in enumerate(text.split("`"))))


def _both(
    draw: Callable[[Axes], object], name: str, label: str, size: Callable[[float], tuple[float, float]]
) -> Markup:
    """A picture in two widths, for a phone and for a wider screen, of which the page's style shows one."""
    parts = []
    for kind, width in (("narrow", NARROW), ("wide", WIDE)):
        parts.append(f'<div class="{kind}">{_picture(draw, f"{name}-{kind}", label, *size(width))}</div>')
    return Markup("".join(parts))


def _picture(draw: Callable[[Axes], object], name: str, label: str, width: float, height: float) -> Markup:
    """A picture of one panel, `width` by `height` inches; `label` is what a screen reader reads out."""
    figure, ((ax,),) = grid(1, 1, width, height)
    draw(ax)
    return inline(figure, name, label)


def _budget(d: Diagnosis) -> Markup:
    label = "Budget of the gap, a bar a channel: " + "; ".join(f"{cause_name(c)} {percent(c.share)}" for c in d.budget)
    return _both(
        lambda ax: plots.budget(d, ax), "budget", f"{label}; unexplained {percent(d.unexplained.share)}",
        lambda width: gap_plots.budget_size(d, width),
    )  # fmt: skip


def _closure(d: Diagnosis) -> Markup:
    label = "rms of every channel in units of its noise, before and after"
    return _both(
        lambda ax: plots.closure(d.closures, ax), "closure", label, lambda w: gap_plots.closure_size(d.closures, w)
    )


def _trace(trace: Trace) -> Markup:
    parts = []
    for kind, width in (("narrow", NARROW), ("wide", WIDE)):
        figure, axes = grid(2, 1, width, 1.9, sharex=True)
        plots.signal(trace, axes[0][0])
        plots.residuals(trace, axes[1][0])
        label = f"{trace.name} in {trace.trial}, measured and predicted, and what is missed"
        parts.append(f'<div class="{kind}">{inline(figure, f"trace-{kind}", label)}</div>')
    return Markup("".join(parts))


def _parameters(d: Diagnosis) -> list[Markup]:
    """Figures of intervals (the causes' parameters and the nominal ones known worst) and of correlations."""
    fit = d.augmented
    table = fit.table()
    own = {r["name"] for r in table} - {r["name"] for r in d.nominal.table()}
    vague = sorted(table, key=lambda r: -(r["std"] or math.inf) / max(abs(r["value"]), 1e-300))
    chosen = own | {r["name"] for r in vague[: max(MAX_INTERVALS - len(own), 0)]}
    names = sorted((r["name"] for r in table if r["name"] in chosen), key=lambda n: n not in own)
    before = d.nominal if fit is not d.nominal else None
    out = []
    panels = max(math.ceil(len(names) / INTERVAL_ROWS), 1)
    each = math.ceil(len(names) / panels)  # Panels stand side by side, so they have as many rows.
    for k, start in enumerate(range(0, len(names), max(each, 1))):
        some = names[start : start + each]
        out.append(
            _picture(lambda ax, some=some: plots.intervals(fit, some, before, ax), f"intervals-{k}",
                     "95 % intervals of " + ", ".join(some), *interval_size(len(some), NARROW))
        )  # fmt: skip
    if len(table) > 1:
        size = NARROW, 3.0
        out.append(
            _picture(lambda ax: plots.correlation(fit, 10, ax), "correlation", "correlations of parameters", *size)
        )
    return out


def _curves(d: Diagnosis) -> Curves:
    """Curves of the augmented model, with moment arms from the measured excursions if the session has ID.2."""
    found = model_curves(d.augmented, d.problem and d.problem.session)
    if d.problem is None or "ID.2" not in d.problem.stacks:
        return found
    return replace(found, arm_points=arm_points(d.problem.session, d.problem.stacks["ID.2"]))


def _arms(found: Curves) -> list[Markup]:
    """One picture of moment arms for each joint."""
    joints = list(dict.fromkeys(j for _, j in found.moment_arm))
    return [
        _picture(lambda ax, j=j: plots.moment_arms(found, j, ax), f"arms-{k}", f"moment arms about {j}", NARROW, 2.9)
        for k, j in enumerate(joints)
    ]


# Words and tables -----------------------------------------------------------------------------------------------------
def _name(experiment: str, channel: str, column: str | None = None) -> str:
    return f"{experiment} · {channel_name(channel)}{f' {column}' if column else ''}"


def _relevance(x) -> dict:
    return {
        "name": _name(x.experiment, x.channel),
        "gap": quantity(x.gap, x.units),
        "signal": quantity(x.signal, x.units) if x.signal > 0 else "none",
        "relative": percent(x.relative) if x.signal > 0 else "",
        "matters": "tolerated" if x.tolerated else "matters",
    }


def _cards(d: Diagnosis) -> list[dict]:
    """A card for each cause of the budget and each rival; only rivals where the verdict is `ambiguous`."""
    rivals_alone = d.status is Status.AMBIGUOUS and d.ambiguous_sets
    causes, sets = ((), d.ambiguous_sets[:1]) if rivals_alone else (d.budget, d.ambiguous_sets)
    inside = {key for c in causes for key in c.keys}
    rivals = [key for members in sets for key in members if key not in inside]
    by_key = {c.key: c for c in d.candidates}
    return [
        *(_card(d, k, c) for k, c in enumerate(causes)),
        *(_rival(d, k, by_key.get(key), key) for k, key in enumerate(rivals, len(causes))),
    ]


def _card(d: Diagnosis, k: int, c: Cause) -> dict:
    says = f"{sentences.shared(d, c, ' of the gap')}; probability {chance(c.probability)}."
    return _texts(d, k, c.effect) | {
        "name": sentences.sentence(cause_name(c)).rstrip("."),
        "says": says,
        "sizes": _sizes(c.effect, c.values, d),
    }


def _rival(d: Diagnosis, k: int, c: Candidate | None, key: Key) -> dict:
    return _texts(d, k, key.effect) | {
        "name": sentences.sentence(key_name(key)).rstrip("."),
        "says": f"Probability {chance(c.probability)}." if c else "",
        "sizes": _sizes(key.effect, c.values, d) if c else [],
    }


def _texts(d: Diagnosis, k: int, effect: str) -> dict:
    """Colour number `k` and the effect's texts about itself."""
    return {"colour": PALETTE[k % len(PALETTE)].name} | asdict(words(effect, d))


def _sizes(effect: str, values: Sequence[Value], d: Diagnosis) -> list[str]:
    """Parameters of a cause, one text each."""
    return [": ".join(filter(None, pair)) for pair in parameters(effect, values, d)]


def _place(p: Place, prismatic: tuple[bool, ...]) -> dict:
    units = units_where(VARIABLE_UNITS.get(p.variable, "1"), prismatic)
    variable = VARIABLE_NAMES.get(p.variable, p.variable)
    return {
        "name": _name(p.experiment, p.channel, p.site),
        "trial": p.trial,
        "share": percent(p.share),
        "region": f"{variable} from {quantity(p.low, units)} to {quantity(p.high, units)}",
    }


def _line(x: Closure) -> dict:
    return {"name": _name(x.experiment, x.channel), **sentences.closing(x)._asdict(), "wrong": x.diverged}


def _left(x: Left) -> str:
    most = sorted(x.by_variable.items(), key=lambda kv: -kv[1])[:2]
    named = [VARIABLE_NAMES.get(k, k) for k, v in most if v > MIN_VARIABLE_SHARE * x.energy]
    return f"{_name(x.experiment, x.channel, x.column)}" + (f": goes with {joined(named)}" if named else "")


def _absorbed(found: Sequence[Absorbed]) -> list[str]:
    """One line for each effect: its sites, and how much could stay hidden there, half of a 95 % interval."""
    by_effect: dict[str, list[Absorbed]] = {}
    for x in found:
        by_effect.setdefault(x.key.effect, []).append(x)
    lines = []
    for effect, some in by_effect.items():
        hidden: dict[tuple[str, str], float] = {}
        for v in (v for x in some for v in x.hidden if math.isfinite(v.std)):
            hidden[v.name, v.units] = max(hidden.get((v.name, v.units), 0.0), HALF_95 * v.std)
        amounts = "".join(f", {_up_to(half, units)} of {name}" for (name, units), half in hidden.items())
        lines.append(f"{effect_name(effect)} at {site_names([x.key.site for x in some])}{amounts}")
    return lines


def _up_to(half: float, units: str) -> str:
    """Upper limit of a hidden amount; none where it exceeds half a turn or MAX_SIZE."""
    unlimited = half > math.pi if units == "rad" else half > MAX_SIZE
    return "any amount" if unlimited else f"up to {quantity(half, units)}"


def _noise(d: Diagnosis, prismatic: tuple[bool, ...]) -> list[dict]:
    """Standard deviations of each channel's noise, and where they were estimated from."""
    out = []
    for (experiment, channel), n in d.nominal.noise.items():
        units = channel_units(channel, prismatic)
        std = sorted({quantity(float(s), units) for s in n.std if math.isfinite(s) and s > 0})
        out.append({"name": _name(experiment, channel), "std": ", ".join(std), "source": n.source})
    return out
