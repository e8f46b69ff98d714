"""Summary of a diagnosis for a terminal: one screen, 100 columns wide."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping

from jaxfinger.gap.result import Cause, ChannelBudget, Closure, Diagnosis, Key
from jaxfinger.report import sentences
from jaxfinger.report.causes import parameters
from jaxfinger.report.names import cause_name, channel_name, effect_name, key_name, site_names
from jaxfinger.report.numbers import chance, measured, quantity, unbroken
from jaxfinger.report.plots.gap import rows_of, segments, shown

WIDTH, BAR = 100, 30  # Characters in a line and in a bar; beside the bar a channel's name must fit.
MAX_BARS = 6  # so that the summary fits on one screen
SIGNS = "█▓▒░▚▞"  # fills of the causes in a bar
NOISE, TOGETHER, OPEN = "·", "+", "?"  # fills of noise, of what several causes close together, and of the unexplained


def summary(d: Diagnosis, own: Iterable[str] = ()) -> str:
    """Verdict, budget, causes, closures and next experiment as text; `own` are ids of the user's effects.

    The user's effects that are not named have a line each with their probability, or the reason why they have none.
    """
    out = [f"{d.specimen} · {d.data}{f' · beside {d.against}' if d.against else ''}", "", sentences.headline(d)]
    out += [*_wrapped(sentences.summary(d)), ""]
    if d.channels:
        out += ["BUDGET     what the model misses in each channel, as mean square"]
        out += [_bar(x) for x in rows_of(d, MAX_BARS)]
        out += [f"  {_legend(d)}", ""]
    if d.budget:
        out += ["CAUSES     share of the gap (95 % interval), probability, parameters (± half of a 95 % interval)"]
        out += [line for k, c in enumerate(d.budget) for line in _cause(d, k, c)] + [""]
    if lines := shown(d.closures):
        out += ["HOW FAR    rms on held-out trials: noise, before → after, share closed (95 % interval)"]
        out += [_line(x) for x in lines] + [""]
    named = {key.effect for key in d.named}
    if lines := [_not_named(effect, d) for effect in own if effect not in named]:
        out += ["YOURS      effects of your own that are not named", *lines, ""]
    if step := d.next_experiment:
        out += ["NEXT       " + f"{step.experiment}: {sentences.next_trial(step)}", ""]
    return "\n".join(out).rstrip()


def comparison(diagnoses: Mapping[str, Diagnosis]) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table of causes (rows) in several sessions (columns).

    It holds every cause that some session names or cannot tell from others: its probability in each session, and its
    first parameter where it is one of these.
    """
    blamed = {key for d in diagnoses.values() for key in d.blamed}
    rows = [[key_name(key), *(_in_session(key, d) for d in diagnoses.values())] for key in sorted(blamed)]
    return ["cause", *diagnoses], rows


def _in_session(key: Key, d: Diagnosis) -> str:
    """Probability of a cause in one session, and its first parameter where it is named there, or a rival."""
    found = next((c for c in d.candidates if c.key == key), None)
    if found is None:
        return "not visible"
    sizes = [f", {v.name} {measured(v.value, v.std, v.units)}" for v in found.values[:1] if key in d.blamed]
    return chance(found.probability) + "".join(sizes)


def _wrapped(text: str, indent: str = "") -> list[str]:
    """Wrap a text to lines of WIDTH characters, with no break between a number and its unit."""
    lines = textwrap.wrap(unbroken(text), WIDTH, initial_indent=indent, subsequent_indent=indent)
    return [line.replace("\u00a0", " ") for line in lines]


def _bar(x: ChannelBudget) -> str:
    """The budget of one column as a bar of characters, with its name and gap."""
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
    name = f"{x.experiment} {channel_name(x.channel)} {x.column}"
    return f"  {text}  {name}, {quantity(x.gap, x.units)}"


def _legend(d: Diagnosis) -> str:
    parts = [f"{NOISE} noise", *(f"{SIGNS[k % len(SIGNS)]} {cause_name(c)}" for k, c in enumerate(d.budget))]
    seen = [segments(x) for x in rows_of(d, MAX_BARS)]
    parts += [f"{TOGETHER} several together"] if any(s[2] > 0.5 / BAR for s in seen) else []
    parts += [f"{OPEN} unexplained"] if any(s[3] > 0.5 / BAR for s in seen) else []
    return "  ".join(parts)


def _cause(d: Diagnosis, k: int, c: Cause) -> list[str]:
    says = f"{sentences.shared(d, c)}, probability {chance(c.probability)}"
    values = [" ".join(pair).lstrip() for pair in parameters(c.effect, c.values, d)]
    first, *rest = _wrapped(f"{SIGNS[k % len(SIGNS)]} {cause_name(c)}: {says}", "  ")
    return [first, *("    " + line for line in rest), *_wrapped("; ".join(values), " " * 6)]


def _not_named(effect: str, d: Diagnosis) -> str:
    """Probability of an effect at its most probable site, or why it has none."""
    name = effect_name(effect)
    if tried := [c for c in d.candidates if c.key.effect == effect]:
        likeliest = max(tried, key=lambda c: c.probability)
        return f"  {name}: probability {chance(likeliest.probability)} at {site_names([likeliest.key.site])}"
    if any(x.key.effect == effect for x in d.absorbed):
        return f"  {name}: the model's own parameters imitate it in these trials"
    return f"  {name}: no trial shows it"


def _line(x: Closure) -> str:
    name = f"{x.experiment} {channel_name(x.channel)}"
    text = sentences.closing(x)
    return f"  {name:<26} {text.noise:>7}  {text.before:>6} → {text.after:<8} {text.unit:<5}  {text.closed}"
