"""Scores of the diagnosis on sealed cases, each with an interval, from `gap.json` and the truth alone."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from .truth import NONE, UNLISTED, Cause, Diagnosis, Truth, read_diagnosis, read_truth

LARGEST_SET = 3  # causes in an ambiguous set: more of them say too little to count as an answer
# Closable energy in units of a sample's noise variance, summed over channels. The share of less than that is undefined.
MIN_CLOSABLE = 0.01
Z95 = 1.959964  # standard deviations, half width of a 95 % interval
# Bins of the reliability diagram, narrow at 0 and 1, where most probabilities are.
BINS = (0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)


@dataclass(frozen=True)
class Figure:
    """A share or mean over `count` cases with its 95 % interval; NaN for no cases."""

    value: float
    low: float
    high: float
    count: int


@dataclass(frozen=True)
class Scores:
    """Scores of a set of cases. `score_cases` defines the figures."""

    cases: int
    failed: int
    figures: dict[str, Figure]
    by_effect: dict[str, dict[str, Figure]]
    by_severity: dict[str, dict[str, Figure]]
    by_specimen: dict[str, dict[str, Figure]]
    confusions: list[tuple[str, str, int]]
    reliability: list[dict[str, float]]
    missed: list[dict] = field(default_factory=list)

    def to_json(self) -> dict:
        """Plain dictionaries for a file."""
        return asdict(self)


def wilson(hits: int, count: int) -> Figure:
    """Share with Wilson's score interval (Wilson 1927), which stays within [0, 1] and keeps a width at 0 and 1."""
    if count == 0:
        return Figure(float("nan"), float("nan"), float("nan"), 0)
    p, z = hits / count, Z95
    centre = (p + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z * np.sqrt(p * (1 - p) / count + z**2 / (4 * count**2)) / (1 + z**2 / count)
    return Figure(p, float(max(centre - half, 0.0)), float(min(centre + half, 1.0)), count)


def bootstrap(values: Sequence[float], draws: int = 2000, of: Callable[..., np.ndarray] = np.mean) -> Figure:
    """Mean, or the statistic `of`, with a percentile interval over resampled cases. The seed is fixed."""
    x = np.asarray(values, dtype=float)
    if not len(x):
        return Figure(float("nan"), float("nan"), float("nan"), 0)
    drawn = of(x[np.random.default_rng(0).integers(len(x), size=(draws, len(x)))], axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return Figure(float(of(x)), float(low), float(high), len(x))


def cause_right(truth: Truth, diagnosis: Diagnosis) -> bool:
    """Whether the first named effect and its site are among the true causes."""
    return bool(diagnosis.named) and bool(diagnosis.answer) and diagnosis.named[0] in truth.causes


def all_right(truth: Truth, diagnosis: Diagnosis) -> bool:
    """Whether all listed causes that matter are named, and no cause that is not at work."""
    return set(truth.matters) <= set(diagnosis.named) <= set(truth.listed)


def covered(truth: Truth, diagnosis: Diagnosis) -> bool:
    """Whether the truth is the named effect or in an ambiguous set of at most `LARGEST_SET` causes.

    Cases without an effect and with an unlisted one count by the verdict's status.
    """
    if truth.kind == "none":
        return diagnosis.status == "no_gap"
    if truth.kind == "unlisted":
        return diagnosis.status == "unexplained"
    if diagnosis.status == "ambiguous":
        members = diagnosis.answer
        return len(members) <= LARGEST_SET and any(c in members for c in truth.causes)
    return cause_right(truth, diagnosis)


def brier(truth: Truth, diagnosis: Diagnosis) -> float:
    """Brier score Σ (p − y)² over all candidates, «none» and «unlisted»: p is the probability that each is at work.

    A true cause that is no candidate has probability zero.
    """
    concerned = {*diagnosis.probability, *truth.at_work}
    return float(sum((diagnosis.probability.get(c, 0.0) - (c in truth.at_work)) ** 2 for c in concerned))


def on_truth(truth: Truth, diagnosis: Diagnosis) -> float:
    """Mean probability of the causes at work."""
    return float(np.mean([diagnosis.probability.get(c, 0.0) for c in truth.at_work]))


def inside(truth: Truth, diagnosis: Diagnosis) -> list[bool]:
    """Whether each true value of named causes in the catalogue's own form lies in its 95 % interval."""
    return [
        abs(value - truth.known[cause][name]) <= Z95 * std
        for cause, values in diagnosis.values.items()
        for name, (value, std) in values.items()
        if cause in diagnosis.named and name in truth.known.get(cause, {})
    ]


def closed_share(rows: Sequence[Mapping], truth: Sequence[Mapping], by_law: bool = False) -> float:
    """Share of the closable gap that a diagnosis closes on fresh trials.

    `rows`: rms by experiment and channel before and after, and at best, which is a refit with the true effects.
    `truth`: the truth's rows. Where `rows` have no best, and everywhere with `by_law`, their `after` stands in for it.
    Rows of a truth without a `gap` come from another nominal model; only their `after` counts.
    Energies are in units of each channel's noise variance, summed over channels. The share is NaN where less than
    `MIN_CLOSABLE` can be closed. The forward simulation of VD.3 (`q`) amplifies differences and does not count.
    """
    at = {(r["experiment"], r["channel"]): r for r in rows}
    done = possible = 0.0
    for r in truth:
        ours = at.get((r["experiment"], r["channel"]))
        if ours is None or (r["experiment"], r["channel"]) == ("VD.3", "q"):
            continue
        noise = float(r.get("noise", r["after"])) or 1.0
        done += (ours["before"] ** 2 - ours["after"] ** 2) / noise**2
        if "best" in ours and not by_law:
            possible += (ours["before"] ** 2 - ours["best"] ** 2) / noise**2
        else:
            before = r["before"] if "gap" in r else ours["before"]
            possible += max(before**2 - r["after"] ** 2, 0.0) / noise**2
    return done / possible if possible > MIN_CLOSABLE else float("nan")


FIGURES: dict[str, tuple[Callable[[Truth], bool], Callable[[Truth, Diagnosis], bool]]] = {
    "cause": (lambda t: t.kind == "listed", cause_right),
    "cause, where distinguishable": (lambda t: t.kind == "listed" and t.rivals == 0, cause_right),
    "covered": (lambda t: t.kind == "listed", covered),
    "false alarm": (lambda t: t.kind == "none", lambda t, d: bool(d.answer)),
    "false gap": (lambda t: t.kind == "none", lambda t, d: d.status not in ("no_gap", "failed")),
    "open set": (lambda t: t.kind == "unlisted", covered),
    "open set, where distinguishable": (lambda t: t.kind == "unlisted" and t.rivals == 0, covered),
    "double, one right": (lambda t: t.kind == "double", cause_right),
    "double, both right": (lambda t: t.kind == "double", all_right),
    "several, all right": (lambda t: t.kind == "several", all_right),
    "several, called explained that is not": (
        lambda t: UNLISTED in t.at_work and len(t.causes) > 1,
        lambda t, d: d.status == "explained",
    ),
}


def score_cases(pairs: Sequence[tuple[Truth, Diagnosis]]) -> Scores:
    """Compute all scores of a set of cases.

    - cause, covered: cases with one listed effect. «where distinguishable»: those without a rival (see `rivals`).
    - false alarm: cases without an effect for which one is named. false gap: those with a verdict other than «no gap».
    - open set: cases with one unlisted effect. «where distinguishable»: those without a rival.
    - double, several: cases with two listed effects; with more, or with an unlisted one beside listed ones.
    - named, of those that matter: listed effects that close more than `MIN_CLOSED_SHARE` of some channel's gap.
    - at work, of those named: effects that are named in double and several cases.
    - values inside 95 % intervals: parameters of named effects in the catalogue's own form.
    - Brier, probability on the truth: all diagnosed cases.
    - set size: verdicts that name an effect.
    - closed: mean of `closed_share` over cases with predictions on the fresh trials. «of what the true law closes»:
      the median of `closed_share` by law, since rows of the linearised plant have outliers.
    - seconds: time of a case.
    """
    done = [(t, d) for t, d in pairs if d.status != "failed"]
    figures = _shares(pairs)
    many = [(t, d) for t, d in pairs if t.kind in ("double", "several")]
    named = [c in d.named for t, d in many for c in t.matters]
    true = [c in t.listed for t, d in many for c in d.answer]
    values = [x for t, d in done for x in inside(t, d)]
    figures["several, named, of those that matter"] = wilson(sum(named), len(named))
    figures["several, at work, of those named"] = wilson(sum(true), len(true))
    figures["values inside 95 % intervals"] = wilson(sum(values), len(values))
    figures["Brier"] = bootstrap([brier(t, d) for t, d in done])
    figures["probability on the truth"] = bootstrap([on_truth(t, d) for t, d in done])
    figures["set size"] = bootstrap(
        [float(len(d.answer)) if d.status == "ambiguous" else 1.0 for _, d in done if d.answer]
    )
    known = [(t, d) for t, d in done if d.fresh and t.listed]
    closed, by_law = ([closed_share(d.fresh, t.fresh, law) for t, d in known] for law in (False, True))
    figures["closed"] = bootstrap([x for x in closed if np.isfinite(x)])
    figures["closed, of what the true law closes"] = bootstrap([x for x in by_law if np.isfinite(x)], of=np.median)
    figures["seconds"] = bootstrap([d.seconds for _, d in pairs if d.seconds is not None])
    wrong = Counter((_truth_name(t), _answer_name(d)) for t, d in pairs if not _right(t, d))
    return Scores(
        cases=len(pairs),
        failed=len(pairs) - len(done),
        figures=figures,
        by_effect=_split(pairs, lambda t: t.causes[0][0] if t.kind in ("listed", "unlisted") else ""),
        by_severity=_split(
            pairs, lambda t: f"{t.severity:g}" if isinstance(t.severity, float | int) else str(t.severity or "")
        ),
        by_specimen=_split(pairs, lambda t: t.specimen),
        confusions=[(a, b, k) for (a, b), k in sorted(wrong.items(), key=lambda x: (-x[1], x[0]))],
        reliability=reliability(done),
        missed=[
            {
                "case": t.name,
                "truth": _truth_name(t),
                "answer": _answer_name(d),
                "severity": t.severity,
                "reached": t.reached,
                "probability": on_truth(t, d),
            }
            for t, d in pairs
            if not _right(t, d)
        ],
    )


def reliability(pairs: Sequence[tuple[Truth, Diagnosis]]) -> list[dict[str, float]]:
    """Mean probability and share that came true by bin, over all candidates, «none» and «unlisted» of all cases."""
    given = [(p, float(c in t.at_work)) for t, d in pairs for c, p in d.probability.items()]
    p, y = np.array(given).reshape(-1, 2).T
    rows = []
    for low, high in pairwise(BINS):
        inside = (p >= low) & ((p < high) | ((high == 1.0) & (p <= 1.0)))
        if inside.any():
            interval = wilson(round(float(y[inside].sum())), int(inside.sum()))
            rows.append(
                {
                    "low": low,
                    "high": high,
                    "said": float(p[inside].mean()),
                    "came true": float(y[inside].mean()),
                    "ci low": interval.low,
                    "ci high": interval.high,
                    "count": int(inside.sum()),
                }
            )
    return rows


def score_folder(cases: Path, diagnoses: Path, truth_root: Path | None) -> Scores:
    """Score the cases of a folder that have a folder of a diagnosis."""
    folders = sorted(f.parent for f in cases.glob("*/fit.h5"))
    return score_cases(
        [
            (read_truth(f, truth_root), read_diagnosis(diagnoses / f.name))
            for f in folders
            if (diagnoses / f.name).exists()
        ]
    )


@dataclass(frozen=True)
class Imitators:
    """Answers to the cases of an effect that was withheld from the catalogue."""

    effect: str
    unexplained: Figure  # share of cases with the verdict unexplained or ambiguous
    no_gap: int  # cases with the verdict no gap
    answers: list[tuple[str, int]]  # answers with their counts, most frequent first


def imitators(cases: Path, withheld: Path, truth_root: Path | None) -> list[Imitators]:
    """Count the answers to cases whose effect was withheld from the catalogue, by effect."""
    by_effect: dict[str, list[Diagnosis]] = {}
    for folder in sorted(f.parent for f in cases.glob("*/fit.h5")):
        truth, diagnosis = read_truth(folder, truth_root), read_diagnosis(withheld / folder.name)
        if truth.kind == "listed" and diagnosis.status != "failed":
            by_effect.setdefault(truth.causes[0][0], []).append(diagnosis)
    out = []
    for effect, found in sorted(by_effect.items()):
        open_ended = sum(d.status in ("unexplained", "ambiguous") for d in found)
        answers = Counter(_answer_name(d) for d in found if d.answer)
        none = sum(d.status == "no_gap" for d in found)
        out.append(Imitators(effect, wilson(open_ended, len(found)), none, answers.most_common()))
    return out


def _shares(pairs: Sequence[tuple[Truth, Diagnosis]]) -> dict[str, Figure]:
    out = {}
    for name, (concerns, right) in FIGURES.items():
        results = [right(t, d) for t, d in pairs if concerns(t)]
        out[name] = wilson(sum(results), len(results))
    return out


def _split(pairs: Sequence[tuple[Truth, Diagnosis]], key: Callable[[Truth], str]) -> dict[str, dict[str, Figure]]:
    keys = sorted({key(t) for t, _ in pairs} - {""})
    out = {}
    for k in keys:
        inside = [(t, d) for t, d in pairs if key(t) == k]
        figures = {n: f for n, f in _shares(inside).items() if f.count}
        figures["probability on the truth"] = bootstrap([on_truth(t, d) for t, d in inside if d.status != "failed"])
        out[k] = figures
    return out


def _right(truth: Truth, diagnosis: Diagnosis) -> bool:
    if truth.kind in ("none", "unlisted"):
        return covered(truth, diagnosis)
    return all_right(truth, diagnosis) if truth.kind in ("double", "several") else cause_right(truth, diagnosis)


def _name(cause: Cause) -> str:
    return cause[0] if cause in (NONE, UNLISTED) else f"{cause[0]} ({', '.join(cause[1])})"


def _truth_name(truth: Truth) -> str:
    return " + ".join(_name(c) for c in truth.causes) if truth.causes else "none"


def _answer_name(diagnosis: Diagnosis) -> str:
    names = [_name(c) for c in (diagnosis.answer or ())]
    joiner = " | " if diagnosis.status == "ambiguous" else " + "
    return joiner.join(names) if names else diagnosis.status
