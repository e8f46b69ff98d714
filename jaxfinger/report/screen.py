"""A diagnosis on one screen of a terminal, 100 columns."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping

from jaxfinger.gap.result import Cause, ChannelBudget, Closure, Diagnosis, Key
from jaxfinger.report import sentences
from jaxfinger.report.numbers import measured, percent, percent_range, quantity, unbroken
from jaxfinger.report.plots.gap import rows_of, segments, shown

WIDTH, BAR, MOST = 100, 30, 6
SIGNS = "█▓▒░▚▞"  # a cause each
NOISE, TOGETHER, OPEN = "·", "+", "?"


def summary(d: Diagnosis, own: Iterable[str] = ()) -> str:
    """Verdict, budget, causes, how far it closes, what next; and what came of the user's `own` effects, by id."""
    out = [f"{d.specimen} · {d.data}{f' · beside {d.against}' if d.against else ''}", "", sentences.headline(d)]
    out += [*_wrapped(sentences.summary(d)), ""]
    if d.channels:
        out += ["BUDGET     what the model misses in each channel, as mean square"]
        out += [_bar(x) for x in rows_of(d, MOST)]
        out += [f"  {_legend(d)}", ""]
    if d.budget:
        out += ["CAUSES     share of the gap (95 % interval), probability, parameters (± half of a 95 % interval)"]
        out += [line for k, c in enumerate(d.budget) for line in _cause(k, c)] + [""]
    if lines := shown(d.closures):
        out += ["HOW FAR    rms on held-out trials: noise, before → after, share closed (95 % interval)"]
        out += [_line(x) for x in lines] + [""]
    named = {key.effect for key in d.named}
    if lines := [_not_named(effect, d) for effect in own if effect not in named]:
        out += ["YOURS      effects of your own that are not named", *lines, ""]
    if step := d.next_experiment:
        out += ["NEXT       " + f"{step.experiment}: {sentences.next_trial(step)}", ""]
    return "\n".join(out).rstrip()


def across(diagnoses: Mapping[str, Diagnosis]) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table of several sessions: how probable every cause is in each that one of them names, and
    where it is named its first parameter.
    """
    named = {key for d in diagnoses.values() for key in d.named}
    rows = [[sentences.key_name(key), *(_said_of(key, d) for d in diagnoses.values())] for key in sorted(named)]
    return ["cause", *diagnoses], rows


def _said_of(key: Key, d: Diagnosis) -> str:
    found = next((c for c in d.candidates if c.key == key), None)
    if found is None:
        return "not visible"
    sizes = [f", {v.name} {measured(v.value, v.std, v.units)}" for v in found.values[:1] if key in d.named]
    return percent(found.probability) + "".join(sizes)


def _wrapped(text: str, indent: str = "") -> list[str]:
    """In lines, no number apart from its unit."""
    lines = textwrap.wrap(unbroken(text), WIDTH, initial_indent=indent, subsequent_indent=indent)
    return [line.replace("\u00a0", " ") for line in lines]


def _bar(x: ChannelBudget) -> str:
    noise, causes, together, left = segments(x)
    parts = [
        (noise, NOISE),
        *((s, SIGNS[k % len(SIGNS)]) for k, s in enumerate(causes)),
        (together, TOGETHER),
        (left, OPEN),
    ]
    text, end = "", 0.0
    for share, sign in parts:
        end += share
        text += sign * (round(BAR * end) - len(text))
    name = f"{x.experiment} {sentences.channel_name(x.channel)} {x.column}"
    return f"  {text}  {name}, {quantity(x.gap, x.units)}"


def _legend(d: Diagnosis) -> str:
    parts = [f"{NOISE} noise", *(f"{SIGNS[k % len(SIGNS)]} {sentences.cause_name(c)}" for k, c in enumerate(d.budget))]
    seen = [segments(x) for x in rows_of(d, MOST)]
    parts += [f"{TOGETHER} several together"] if any(s[2] > 0.5 / BAR for s in seen) else []
    parts += [f"{OPEN} unexplained"] if any(s[3] > 0.5 / BAR for s in seen) else []
    return "  ".join(parts)


def _cause(k: int, c: Cause) -> list[str]:
    says = f"{percent(c.share)} ({percent_range(*c.share_ci95)}), probability {percent(c.probability)}"
    at = [f" {'-'.join(v.site)}" if len(c.sites) > 1 else "" for v in c.values]
    values = [f"{v.name}{where} {measured(v.value, v.std, v.units)}" for v, where in zip(c.values, at, strict=True)]
    return [f"  {SIGNS[k % len(SIGNS)]} {sentences.cause_name(c)}: {says}", *_wrapped("; ".join(values), " " * 6)]


def _not_named(effect: str, d: Diagnosis) -> str:
    """How probable an effect is where it is likeliest, or why nothing is known of it."""
    name = sentences.effect_name(effect)
    if tried := [c for c in d.candidates if c.key.effect == effect]:
        likeliest = max(tried, key=lambda c: c.probability)
        return f"  {name}: probability {percent(likeliest.probability)} at {sentences.site_names([likeliest.key.site])}"
    if any(x.key.effect == effect for x in d.absorbed):
        return f"  {name}: the model's own parameters imitate it in these trials"
    return f"  {name}: no trial shows it"


def _line(x: Closure) -> str:
    name = f"{x.experiment} {sentences.channel_name(x.channel)}"
    said = sentences.closing(x)
    return f"  {name:<26} {said.noise:>7}  {said.before:>6} → {said.after:<8} {said.unit:<5}  {said.closed}"
