"""Sentences of a diagnosis: all sentences about a verdict, a cause, a size or a trial, made from data and enums.

`summary`, read aloud, tells a colleague how large the gap is in physical units, what causes it and how sure that is,
what is left, and what to do about it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from jaxfinger.gap.posterior import MIN_NAMED_PROBABILITY
from jaxfinger.gap.result import (
    MIN_SHARE,
    Cause,
    Change,
    Closure,
    Diagnosis,
    ExperimentChannel,
    Key,
    NextExperiment,
    NotJudged,
    Posture,
    Reason,
    Relevance,
    Status,
    still_open,
)
from jaxfinger.report.names import VARIABLE_NAMES, cause_name, channel_name, joined, key_name
from jaxfinger.report.numbers import MAX_CHI2, alike, chance, measured, number, percent, percent_range, quantity

MAX_NAMES = 4  # Causes or channels in one sentence; more make it hard to read, and the page lists all.
# Share of a gap: with more left, what is named may imitate a law that nobody listed. Imitators left 28 to 48 %, true
# single causes 20 % at most (`fresh` in docs/results.md).
MAX_LEFT = 0.25
# Share of a gap. Where a cause's shares of two channels differ by more, their mean is a quarter of the gap or more away
# from one of them, and tells a reader about neither.
MAX_SPREAD = 0.5
# Probabilities from which a cause is said to be «very probably» and «almost certainly» at work: those of «very likely»
# and «virtually certain» in reports of the IPCC (Mastrandrea et al., Guidance Note on uncertainties, 2010).
VERY_PROBABLE, ALMOST_CERTAIN = 0.9, 0.99

HEADLINES = {
    Status.NO_GAP: "No gap beyond the noise",
    Status.EXPLAINED: "Explained",
    Status.PARTLY: "Partly explained",
    Status.AMBIGUOUS: "Cannot be told apart yet",
    Status.UNEXPLAINED: "Unexplained by any known cause",
    Status.NOT_JUDGED: "Nothing could be judged",
}
EXPERIMENT_SENTENCES = {
    "ID.2": "one joint is moved slowly through its range, tendons taut",
    "ID.3-static": "a motor takes a joint from one held angle to the next, tendons slack",
    "ID.3-dynamic": "a motor sweeps joints at several speeds, tendons slack",
    "ID.4": "at held joints one tendon is pulled, and let go again",
    "VD.1": "all joints are moved along a free path, tendons taut",
    "VD.2": "one tendon pulls the fingertip against a force sensor",
    "VD.3": "tendons move the free finger",
}
REASONS = {
    Reason.NOTHING_COUNTS: "no sample of it counts: record it with holds or at a speed at which friction is known",
    Reason.NOT_MEASURED: "no trial measured it: record this channel too",
    Reason.FEW_SAMPLES: "too few of its samples count to tell a law from noise: record it longer or more often",
    Reason.NOT_PREDICTED: "the other simulator does not predict it: add this channel to the file of its predictions",
}


def sentence(text: str) -> str:
    """Make a text a sentence, with a capital and a full stop."""
    return text[0].upper() + text[1:] + ("" if text.endswith((".", "!", "?")) else ".")


def certainty(probability: float) -> str:
    """Adverb for a probability of 50 % or more."""
    if probability >= VERY_PROBABLE:
        return "almost certainly" if probability >= ALMOST_CERTAIN else "very probably"
    return "probably"


# The verdict ----------------------------------------------------------------------------------------------------------
def headline(d: Diagnosis) -> str:
    """The whole verdict in one line."""
    text = HEADLINES[d.status]
    if not d.named and d.status in (Status.NO_GAP, Status.EXPLAINED) and tolerated(d):
        return "No gap beyond your tolerance"
    if d.status in (Status.EXPLAINED, Status.PARTLY):
        text = f"{text}: {_listed([cause_name(c) for c in named_causes(d)], 'cause')}"
        if d.status is Status.PARTLY:
            text += f"; {_rest(d)}"
    elif d.status is Status.AMBIGUOUS and d.ambiguous_sets:
        text = f"{text}: {joined([key_name(k) for k in d.ambiguous_sets[0]], 'or')}"
    return text


def _rest(d: Diagnosis) -> str:
    """What makes a diagnosis partial, in a few words."""
    if d.unexplained.share >= MIN_SHARE:
        return f"{percent(d.unexplained.share)} is left"
    if d.ambiguous_sets:
        return "other causes cannot be told apart"
    if stay := still_open(d.closures, d.relevance, d.tolerance):
        return (
            f"{len(stay)} channels stay open"
            if len(stay) > 1
            else f"{_of(stay[0].experiment, stay[0].channel)} stays open"
        )
    return "something more leaves traces"


def summary(d: Diagnosis) -> str:
    """Two or three sentences on how large the gap is, why, and what is left; then the caveats."""
    parts = {
        Status.NO_GAP: _no_gap,
        Status.EXPLAINED: _explained,
        Status.PARTLY: _partly,
        Status.AMBIGUOUS: _ambiguous,
        Status.UNEXPLAINED: _unexplained,
        Status.NOT_JUDGED: _nothing_judged,
    }[d.status](d)
    return " ".join(sentence(p) for p in (*parts, *_caveats(d)))


def tolerated(d: Diagnosis) -> bool:
    """Whether there are gaps and the user tolerates all of them."""
    return bool(d.relevance) and all(x.tolerated for x in d.relevance)


def named_causes(d: Diagnosis) -> list[Cause]:
    """Lines of the budget that the verdict names, largest share first."""
    return [c for c in d.budget if set(c.keys) & set(d.named)]


def size(d: Diagnosis) -> str:
    """Size of the gap in physical units, for at most two channels, each in the experiment where it matters most."""
    largest: dict[str, Relevance] = {}
    for x in sorted(d.relevance, key=lambda x: (x.tolerated, -x.relative)):
        largest.setdefault(x.channel, x)
    lines = list(largest.values())[:2]
    if not lines and (worse := _worse(d)):
        return f"{_subject(d)} predicts trials that no fit has seen worse than before, {worse}"
    if not lines:
        return f"all trials together show that {_subject(d)} misses something, but no channel by more than its noise"
    return f"{_subject(d)} misses {joined([how_large(x, d.tolerance) for x in lines])}"


def how_large(x: Relevance, tolerance: dict[str, float]) -> str:
    """Size of one channel's gap: «the tendon excursion by 6 µm in 20 mm (0.03 %, VD.1)»."""
    text = f"the {channel_name(x.channel)} by {quantity(x.gap, x.units)}"
    inside = f", within your tolerance of {percent(tolerance[x.channel])}" if x.tolerated else ""
    if not x.signal > 0:
        return f"{text} ({x.experiment}{inside})"
    return f"{text} in {quantity(x.signal, x.units)} ({percent(x.relative)}, {x.experiment}{inside})"


def _subject(d: Diagnosis) -> str:
    simulator = "the retuned simulator" if d.changes else "the simulator"  # The gap is what retuning leaves.
    model = simulator if is_simulator(d) else f"the model of {d.against}" if d.against else "the model"
    return f"at a first look {model}" if d.quick else model


def is_simulator(d: Diagnosis) -> bool:
    """Whether another simulator is diagnosed instead of the identified model."""
    return d.problem is not None and d.problem.simulator is not None


def _no_gap(d: Diagnosis) -> list[str]:
    doubt = f"the probability that nothing is at work beyond it is {chance(d.none)}"
    if tolerated(d):
        return [size(d), doubt if d.none >= 0.5 else "nothing is missed by more than you tolerate"]
    if d.unlisted >= MIN_NAMED_PROBABILITY:
        doubt = "all trials together hold traces of something more, too small for any channel to show alone"
    judged = [x for x in d.closures if x.channel != "q"]  # Simulated angles are not judged by their noise.
    loud = [x for x in judged if 0.0 < MAX_CHI2 * x.noise**2 < x.after**2]
    if not loud:
        return [f"{_subject(d)} predicts {_counted(len(judged))} to within the noise", doubt]
    names = [f"{channel_name(x.channel)} of {x.experiment} ({number(x.after / x.noise, 2)} times)" for x in loud]
    return [
        f"{_subject(d)} leaves in {_counted(len(judged))} nothing that a law could explain",
        f"what it leaves is larger than the channel's own noise in {joined(names)}, as where {_why_loud(d, loud)}",
        doubt,
    ]


def _why_loud(d: Diagnosis, loud: Sequence[Closure]) -> str:
    """What may make the held-out errors of these channels larger than their noise, where no law does."""
    trials = {} if d.problem is None else {e: len(stack.trials) for e, stack in d.problem.stacks.items()}
    if any(trials.get(x.experiment) != 1 for x in loud):
        return "noise of angles or of accelerations moves a prediction"
    return (
        "a trial stands alone, and each part of it shows what no other part does: repeat it, and record it at other "
        "speeds and ranges"
    )


def _counted(channels: int) -> str:
    count = {1: "the one channel", 2: "both channels"}.get(channels, f"all {channels} channels")
    return f"{count} that could be judged"


def _explained(d: Diagnosis) -> list[str]:
    if not d.named:
        return [size(d), "nothing is missed by more than you tolerate"]
    it = "it" if len(named_causes(d)) < 2 else "them"
    end = "its noise, or to what you tolerate," if any(x.tolerated for x in d.relevance) else "its noise"
    closes = f"every channel comes down to {end} on trials that no fit has seen"
    said = [size(d), f"{_blamed(d)}; with {it} in the model {closes}"]
    if d.relevance and d.unexplained.share > MAX_LEFT:
        within = "what you tolerate or " if any(x.tolerated for x in d.relevance) else ""
        left = f"{percent(d.unexplained.share)} of the gap ({percent_range(*d.unexplained.share_ci95)})"
        said.append(f"what is left, {left}, is within {within}the error of the noise's own estimate")
    return said


def _partly(d: Diagnosis) -> list[str]:
    unknown = [cannot_tell(members) for members in d.ambiguous_sets[:1]]
    stay = still_open(d.closures, d.relevance, d.tolerance)
    left = [] if stay and d.unexplained.share < MIN_SHARE else [_left(d)]
    if stay:
        names = [f"{_of(x.experiment, x.channel)} ({number(x.after / x.noise, 2)} times its noise)" for x in stay]
        left.append(f"what stays open on trials that no fit has seen is {_listed(names, 'channel')}")
    said = [size(d), "; ".join([_blamed(d), *unknown])]
    if named_causes(d) and (worse := _worse(d)):
        doubt = f"but trials that no fit has seen are predicted worse with what is named, {worse}"
        return [*said, "; ".join(left), f"{doubt}: it may only imitate a law that nobody listed"]
    if named_causes(d) and d.unexplained.share > MAX_LEFT:
        left.append("so much is left that what is named may only imitate a law that nobody listed")
    return [*said, "; ".join(left)]


def _worse(d: Diagnosis) -> str:
    """Channels that are surely predicted worse on held-out trials, each with its rms then and before; else empty."""
    names = []
    for x in d.closures:
        if x.gets_worse:
            (before, after), unit = alike((x.before, x.after), x.units)
            names.append(f"{_of(x.experiment, x.channel)} ({after} instead of {before} {unit})")
    return _listed(names, "channel") if names else ""


def cannot_tell(members: Sequence[Key]) -> str:
    """Say that these trials cannot tell the members of an ambiguous set apart."""
    names = [key_name(k) for k in members]
    if len(names) == 2:
        return f"these trials cannot tell {names[0]} from {names[1]}"
    return f"these trials cannot tell {joined(names)} apart"


def _ambiguous(d: Diagnosis) -> list[str]:
    text = cannot_tell(d.ambiguous_sets[0] if d.ambiguous_sets else d.named)
    likeliest = _probability(d, d.named[0]) if d.named else None
    if likeliest is not None:
        text += f"; {key_name(d.named[0])} is the likelier with {chance(likeliest)}"
    step = d.next_experiment
    if step is None:
        return [size(d), text, "no trial of the format is expected to tell them apart"]
    return [size(d), text, f"a trial of {step.experiment} would: {next_trial(step)}"]


def _unexplained(d: Diagnosis) -> list[str]:
    pattern = _pattern(d)
    return [size(d), "none of the known causes explains it" + (f": it{pattern}" if pattern else "")]


def _nothing_judged(d: Diagnosis) -> list[str]:
    parts = ["this file says nothing about the gap: no channel has samples that count"]
    if d.not_judged:
        x = d.not_judged[0]
        more = len(d.not_judged) - 1
        parts.append(f"{_of(x.experiment, x.channel)}: {REASONS[x.reason]}" + _and_more(more, "channel"))
    return parts


def _blamed(d: Diagnosis) -> str:
    """Causes and shares: «tendon stretch at T3 almost certainly causes 96 % of it (95 % interval 94 to 98 %)»."""
    causes = named_causes(d)
    if not causes:
        return f"the cause is {_listed([key_name(k) for k in d.named], 'cause')}"
    sure = certainty(min(c.probability for c in causes))
    if not d.relevance:
        are = "is" if len(causes) == 1 else "are"
        return f"{_listed([cause_name(c) for c in causes], 'cause')} {are} {sure} at work"
    if len(causes) == 1:
        c = causes[0]
        share = shared(d, c, " of it", "95 % interval ")
        if c.share < MIN_SHARE:
            return f"{cause_name(c)} is {sure} at work, but closes {share} on trials that no fit has seen"
        return f"{cause_name(c)} {sure} causes {share}"
    first, *rest = causes
    parts = [
        f"{cause_name(first)} ({percent(first.share)} of it)",
        *(f"{cause_name(c)} ({percent(c.share)})" for c in rest),
    ]
    return f"the causes are {sure} {_listed(parts, 'cause')}"


def shared(d: Diagnosis, c: Cause, of: str = "", interval: str = "") -> str:
    """A cause's mean share of the channels' gaps with its interval: «96 % of the gap (94 to 98 %)».

    Where channels disagree, their shares stand in place of the interval: «50 % of the gap (3 % in joint torque of ID.4,
    97 % in tendon excursion of ID.4)», of more than two channels the smallest and the largest. `of` and `interval` name
    what the share is of, and the interval.
    """
    judged = [ExperimentChannel(x.experiment, x.channel) for x in d.channels]
    by_channel = {k: c.channels.get(k, 0.0) for k in judged}  # `channels` lacks those of which it closes nothing
    if not by_channel or max(by_channel.values()) - min(by_channel.values()) <= MAX_SPREAD:
        return f"{percent(c.share)}{of} ({interval}{percent_range(*c.share_ci95)})"
    ends = min(by_channel, key=by_channel.__getitem__), max(by_channel, key=by_channel.__getitem__)
    low, high = (f"{percent(by_channel[k])} in {_of(k.experiment, k.name)}" for k in ends)
    return f"{percent(c.share)}{of} ({f'{low}, {high}' if len(by_channel) == 2 else f'from {low} to {high}'})"


def _left(d: Diagnosis) -> str:
    u = d.unexplained
    pattern = _pattern(d) or " has no pattern"
    if u.share < MIN_SHARE:
        few = "hardly anything of the gap is left"
        if d.unlisted < MIN_NAMED_PROBABILITY:
            return few
        trace = f": its trace{_pattern(d)}" if _pattern(d) else ""
        return f"{few}, but something that the catalogue lacks is {certainty(d.unlisted)} at work{trace}"
    return f"what is left, {percent(u.share)} of the gap ({percent_range(*u.share_ci95)}),{pattern}"


def _pattern(d: Diagnosis) -> str:
    """Column in which most of the unexplained gap lies, and the variables that it depends on; empty where unknown."""
    u = d.unexplained
    parts = [f"lies mostly in {_of(u.where.experiment, u.where.name, u.where.column)}"] if u.where else []
    parts += [f"goes with {joined([VARIABLE_NAMES.get(v, v) for v in u.depends_on])}"] if u.depends_on else []
    return f" {joined(parts)}" if parts else ""


def unlisted(d: Diagnosis) -> str:
    """Sentence on the probability that a cause is at work which the catalogue lacks."""
    return f"Something that the catalogue lacks is at work with a probability of {chance(d.unlisted)}."


def proposal(d: Diagnosis) -> str | None:
    """Sentence on the closed form proposed for what is left; None where there is none."""
    p = d.unexplained.proposal
    if p is None:
        return None
    fits = f"A formula that fits {percent(p.share)} of what is left, unproven, with angles in rad and tensions in N"
    return f"{fits}: {p.formula}."


def _of(experiment: str, channel: str, column: str | None = None) -> str:
    return f"{channel_name(channel)}{f' {column}' if column else ''} of {experiment}"


def _listed(parts: Sequence[str], what: str) -> str:
    """Join all parts, or the first few and the number of the others."""
    if len(parts) <= MAX_NAMES:
        return joined(parts)
    return ", ".join(parts[:MAX_NAMES]) + _and_more(len(parts) - MAX_NAMES, what)


def _and_more(count: int, what: str) -> str:
    return f", and {count} more {what}{'s' * (count > 1)}" if count else ""


def _probability(d: Diagnosis, key: Key) -> float | None:
    return next((c.probability for c in d.candidates if c.key == key), None)


def _caveats(d: Diagnosis) -> list[str]:
    """Sentences beside the verdict: diverged simulations, retuned or changed parameters, channels not judged."""
    out = [diverged(x) for x in d.closures if x.diverged]
    out += d.doubts
    if is_simulator(d):
        out.append(retuned(d.changes))
        if d.relevance and not d.named and (worse := _worse(d)):  # Without a gap, `size` says it.
            out.append(f"but trials that no fit has seen are predicted worse with these parameters, {worse}")
    elif d.against:
        out += [change(x) for x in d.changes if x.probability >= 0.5][:2]
    if d.not_judged and d.status is not Status.NOT_JUDGED:
        names = [_of(x.experiment, x.channel) for x in d.not_judged[:2]]
        out.append(f"not judged: {joined(names) if len(d.not_judged) <= 2 else ', '.join(names)}"
                   f"{_and_more(max(len(d.not_judged) - 2, 0), 'channel')}")  # fmt: skip
    return out


# Single items ---------------------------------------------------------------------------------------------------------
def diverged(x: Closure) -> str:
    """Say that a forward simulation ran away, and what to judge by instead."""
    return (
        f"simulated forward, {x.experiment} diverges, so that its angles close nothing and say nothing; judge by "
        f"its torques and by the motion a fraction of a second ahead"
    )


def retuned(changes: Sequence[Change]) -> str:
    """Say which parameters of another simulator the measurements contradict."""
    if not changes:
        return "the simulator's parameters agree with the measurements"
    most = [
        f"{x.name}, {measured(x.before, None, x.units)} to {measured(x.after, x.after_std, x.units)}" for x in changes
    ]
    return f"all this is with the simulator's parameters retuned, most of all {'; '.join(most[:2])}"


def reason(x: NotJudged) -> str:
    """Say why a channel was not judged, and what to do about it."""
    return sentence(f"{_of(x.experiment, x.channel)}: {REASONS[x.reason]}")


def change(x: Change) -> str:
    """Sentence on a nominal parameter that has changed since an earlier fit."""
    return sentence(
        f"{x.name} was {measured(x.before, x.before_std, x.units)} and is {measured(x.after, x.after_std, x.units)}: "
        f"{certainty(x.probability) if x.probability >= 0.5 else 'perhaps'} changed ({chance(x.probability)})"
    )


def contradicted(x: Change) -> str:
    """Sentence on a parameter of another simulator that the measurements contradict."""
    old, new = measured(x.before, None, x.units), measured(x.after, x.after_std, x.units)
    return sentence(f"{x.name} is {old} in the simulator, and {new} by the measurements")


def next_trial(step: NextExperiment) -> str:
    """Instructions for a suggested trial: joint or tendon, posture, tension, speed and number of repeats."""
    parts = ["the session lacks this experiment"] if step.lacking else []
    parts += [f"joint {step.joint}"] if step.joint else []
    parts += [f"tendon {step.tendon}"] if step.tendon else []
    parts.append(joined([_posture(p) for p in step.postures]))
    if step.tension is not None:
        steps = "in steps to" if step.steps else "tension up to"
        parts.append(f"{steps} {step.tension:.0f} N{' and down again' if step.released else ''}")
    if step.speed is not None:
        parts.append(f"up to {number(step.speed, 2)} {'m/s' if step.slides else 'rad/s'}")
    parts += ["twice" if step.times == 2 else f"{step.times} times"] if step.times > 1 else []
    return ", ".join(p for p in parts if p)


def _posture(p: Posture) -> str:
    low, high = (f"{1e3 * v:.0f} mm" if p.slides else f"{math.degrees(v):.0f}°" for v in (p.low, p.high))
    return f"{p.joint} from {low} to {high}" if p.moves else f"{p.joint} at {low}"


class Closing(NamedTuple):
    """Texts of one line of closures; the numbers are in `unit`."""

    noise: str
    before: str
    after: str
    unit: str
    closed: str


def closing(x: Closure) -> Closing:
    """Texts of one line of a diagnosis's closures."""
    (noise, before, after), unit = alike((x.noise, x.before, x.after), x.units)
    closed = f"{percent(x.closed)} ({percent_range(*x.closed_ci95)})" if x.resolvable else "no gap to close"
    if x.diverged:
        after, closed = "diverges", "nothing"
    return Closing(noise if x.noise else "unknown", before, after, unit, closed)
