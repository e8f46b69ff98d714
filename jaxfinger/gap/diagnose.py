"""Diagnose the sim-to-real gap of a session: where, which effect, how far it shrinks, what next; and write it down."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from jaxfinger.data import Predictions, Session
from jaxfinger.data.atomic import atomic_path
from jaxfinger.effects import CatalogueEffect
from jaxfinger.errors import UserError, did_you_mean
from jaxfinger.gap.augment import Fitted, as_refitted, augmented_fit, nominal_fit, parameter_values
from jaxfinger.gap.evidence import Projector
from jaxfinger.gap.next_experiment import NextExperiment, next_experiment
from jaxfinger.gap.problem import Problem, build
from jaxfinger.gap.propose import Proposal, propose
from jaxfinger.gap.refine import Refined, at_optimum, refine
from jaxfinger.gap.search import DETECT, Search, search, start_of
from jaxfinger.gap.shrinkage import Shrinkage, contradicts, shrinkage
from jaxfinger.gap.signatures import Signatures, catalogue_for
from jaxfinger.gap.standin import energy_left
from jaxfinger.gap.where import Place, where
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.fit_file import save_fit
from jaxfinger.identify.parameters import describe, ravel, units_at
from jaxfinger.identify.stages import Progress

MOST_IN_A_SET = 3
COARSE = 2  # times as long averages in a first look
FIRST_LOOK = " This is a first look, for one effect, at half the samples."
UNSEEN = 10.0  # plausible sizes: the stated deviation of an amplitude that the trials do not see at all


@dataclass(frozen=True)
class Verdict:
    """What is the matter."""

    status: str  # no_gap, explained, ambiguous, unexplained
    effects: tuple[tuple[str, tuple[str, ...]], ...]
    summary: str


@dataclass(frozen=True)
class Diagnosis:
    """Everything that a report shows."""

    problem: Problem
    verdict: Verdict
    where: list[Place]
    search: Search
    shrinkage: list[Shrinkage]
    next: NextExperiment | None
    nominal: Fit
    augmented: Fit
    proposal: Proposal | None = None  # a closed form for what no known effect explains


def diagnose(
    session: Session,
    recipe: Recipe | None = None,
    quick: bool = False,
    effects: dict[str, type[CatalogueEffect]] | None = None,
    without: tuple[str, ...] = (),
    progress: Progress = lambda message: None,
    predictions: Predictions | None = None,
) -> Diagnosis:
    """Diagnose a session. `effects` adds a user's own, `without` withholds some of the catalogue by id.

    With `predictions` the gap is that between the measurements and another simulator's predictions.
    """
    recipe = recipe or Recipe()
    catalogue = catalogue_for(recipe, effects)
    if unknown := set(without) - set(catalogue):
        raise UserError(
            f"the catalogue has no effect {', '.join(sorted(unknown))} to leave out"
            f"{did_you_mean(min(unknown), catalogue)}; "
            f"it has {', '.join(sorted(catalogue))}"
        )
    problem = build(session, recipe, progress, predictions, COARSE if quick else 1)
    kept = set(problem.fit.recipe.model.terms) | set(without)
    catalogue = {k: c for k, c in catalogue.items() if k not in kept}
    progress("reading the signatures of all effects")
    found = search(problem, catalogue, quick, progress)
    nominal = nominal_fit(problem)
    chosen = found.chosen
    if chosen is None:
        return _nothing_named(problem, found, nominal, quick)
    if quick:
        augmented = as_refitted(found.there, chosen)
    else:
        progress("fitting the effects and all nominal parameters together")
        augmented = augmented_fit(problem, chosen)
    named = {*chosen.keys, *(k for members in found.rival_sets for k in members)}
    progress("refitting without each third of the trials")
    lines = shrinkage(problem, augmented, _rivals(problem, found), named, not quick)
    if contradicts(lines) and found.unlisted <= 0.5:
        found = found.doubted()
    verdict, proposal = _verdict(found, lines), None
    if verdict.status == "unexplained" and found.left:
        progress("looking for a closed form of what remains")
        proposal = propose(problem, chosen.residual, found.left, chosen.columns)
        verdict = replace(verdict, summary=verdict.summary + _proposed(proposal))
    verdict = replace(verdict, summary=verdict.summary + _remarks(problem, augmented.fit, quick))
    places = where(problem)
    suggestion = None
    if verdict.status == "ambiguous":
        progress("looking for the trial that would tell them apart")
        suggestion = next_experiment(problem, _members(problem, found))
    return Diagnosis(problem, verdict, places, found, lines, suggestion, nominal.fit, augmented.fit, proposal)


def _nothing_named(problem: Problem, found: Search, nominal: Fitted, quick: bool) -> Diagnosis:
    """No gap, or one of which no known effect explains any."""
    verdict, places, proposal = Verdict("no_gap", (), _no_gap_summary(found)), [], None
    if found.detected:
        places, proposal = where(problem), propose(problem, problem.r, found.left, np.empty((0, problem.r.size)))
        text = f"There is a gap, and none of the known effects explains any of it. {_depends(found)}"
        verdict = Verdict("unexplained", (), text + _proposed(proposal))
    verdict = replace(verdict, summary=verdict.summary + _remarks(problem, nominal.fit, quick))
    lines = shrinkage(problem, nominal, [], set(), not quick)
    return Diagnosis(problem, verdict, places, found, lines, None, nominal.fit, nominal.fit, proposal)


def _proposed(proposal: Proposal | None) -> str:
    if proposal is None:
        return ""
    return f" A proposal, unproven, for {100 * proposal.share:.0f} % of that: {proposal.formula}."


def _remarks(problem: Problem, fit: Fit, quick: bool) -> str:
    """What holds whatever the verdict."""
    return _retuned(problem, fit) + (FIRST_LOOK if quick else "")


def _retuned(problem: Problem, fit: Fit) -> str:
    """For another simulator: which of its parameters the measurements contradict most."""
    if problem.simulator is None:
        return ""
    old, new = (np.asarray(ravel(model))[problem.free] for model in (problem.simulator, fit.model))
    std = fit.std[problem.free]
    weight = np.abs(new - old) * np.linalg.norm(problem.J, axis=0) * (np.abs(new - old) > 3.0 * std)
    worst = [i for i in np.argsort(-weight)[:3] if weight[i] > 0]
    if not worst:
        return " The simulator's parameters agree with the measurements."
    parameters = describe(problem.nominal)
    named = [
        f"{p.name} ({old[i]:.3g} to {new[i]:.3g} ± {std[i]:.1g} {p.units})"
        for i in worst
        for p in [parameters[problem.free[i]]]
    ]
    return f" All this is with the simulator's parameters retuned, most of all {', '.join(named)}."


def _rivals(problem: Problem, found: Search):
    """The strongest candidates with their signatures."""
    signatures = Signatures(problem)
    top = [(c.evidence, c.refined) for c in found.candidates if c.refined][:6]
    return [(evidence, signatures.columns(at_optimum(refined)[0])[0]) for evidence, refined in top]


def _members(problem: Problem, found: Search) -> list[Refined]:
    """Refits of the members of the first ambiguous set."""
    if not found.rival_sets:
        return []
    projector = Projector(problem)
    rt = projector.residual(problem)
    chi2 = float(rt @ rt)
    by_key = {c.key: c for c in found.candidates}
    out = []
    for key in found.rival_sets[0][:MOST_IN_A_SET]:
        c = by_key[key]
        items, starts = at_optimum(c.refined) if c.refined else ([c.evidence.variant], [start_of(c.evidence)])
        out.append(refine(problem, items, starts, chi2, projector))
    return out


def _verdict(found: Search, lines: list[Shrinkage]) -> Verdict:
    chosen = found.chosen
    assert chosen is not None
    order = np.argsort(-np.asarray(found.shares))
    effects = tuple(chosen.keys[i] for i in order)
    names = " and ".join(f"{e} at {'-'.join(s)}" for e, s in effects)
    share = sum(found.shares) if len(effects) == 1 else 1.0 - _left_share(found)
    if found.unlisted > 0.5:
        end = "s" if len(effects) == 1 else ""
        fails = f"leave{end} {100 * _left_share(found):.0f} % of what a smooth law could explain"
        if contradicts(lines):
            worst = max((x for x in lines if x.plain), key=lambda x: x.before / x.noise)
            fails = f"close{end} {100 * worst.closed:.0f} % of the gap in {_channel(worst)} on held-out trials"
        text = f"There is a gap, and none of the known effects explains it: the nearest, {names}, {fails}."
        return Verdict("unexplained", (), f"{text} {_depends(found)}")
    if found.rival_sets:
        rivals = "; ".join(f"{e} at {'-'.join(s)}" for e, s in found.rival_sets[0][:MOST_IN_A_SET])
        return Verdict(
            "ambiguous",
            effects[:1],
            f"The gap is explained about equally well by {rivals}; these trials cannot tell them apart. "
            f"The most probable is {effects[0][0]} at {'-'.join(effects[0][1])}.",
        )
    text = f"The gap is explained by {names}: {100 * share:.0f} % of what can be explained. {_closing(lines)}"
    return Verdict("explained", effects, text)


def _closing(lines: list[Shrinkage]) -> str:
    """How far the gap closes on held-out trials, and where it stays open."""
    shown = [x for x in lines if x.resolvable and x.channel != "q"]
    if not shown:
        return "No channel of the held-out trials stands out of its noise, so that they cannot say how far it closes."
    best = max(x.closed for x in shown)
    return (
        f"On held-out trials it closes up to {100 * best:.0f} % of the gap in the channel that shows it best."
        + "".join(f" {_channel(x)} stays at {x.after / x.noise:.1f} times its noise." for x in lines if x.stays_open)
    )


def _channel(line: Shrinkage) -> str:
    return f"{line.channel} of {line.experiment}"


def _left_share(found: Search) -> float:
    return energy_left(found.left) / max(found.gap, 1e-9)


def _depends(found: Search) -> str:
    if not found.left:
        return ""
    worst = found.left[0]
    variables = sorted(worst.by_variable.items(), key=lambda kv: -kv[1])[:2]
    named = " and ".join(k for k, v in variables if v > 0.2 * max(worst.energy, 1e-9)) or "no single variable"
    return f"What remains lies mostly in {worst.channel} of {worst.experiment} and depends on {named}."


def _no_gap_summary(found: Search) -> str:
    strongest = max(found.candidates, key=lambda c: (c.refined is not None, c.log_evidence))
    says = "which the noise of such a file also gives"
    if strongest.log_evidence > DETECT:
        says = f"but explains {100 * strongest.held_out:.0f} % of what it fitted on trials that its fit has not seen"
    return (
        f"No gap beyond the noise: the strongest candidate, {strongest.key[0]} at {'-'.join(strongest.key[1])}, has a "
        f"log evidence of {strongest.log_evidence:.1f}, {says}."
    )


def _with_prior(amplitude: float, std: float, size: float) -> tuple[float, float]:
    """Value and std of an amplitude that was found in plausible sizes, with a prior of UNSEEN of them."""
    seen = 1.0 / (1.0 + (std / UNSEEN) ** 2)
    return amplitude * seen * size, std * seen**0.5 * size


def as_gap_json(d: Diagnosis) -> dict:
    """`gap.json`, to the letter."""
    by_effect = {
        e.ID + "".join(e.site): parameter_values(d.augmented, i)
        for i, e in enumerate(d.augmented.model.effects)
        if isinstance(e, CatalogueEffect)
    }
    candidates = []
    for c in d.search.candidates:
        values = by_effect.get(c.key[0] + "".join(c.key[1]))
        if values is None:
            effect = c.evidence.variant.effect
            units = units_at(d.problem.nominal.finger, effect, c.key[1])
            found = zip(c.evidence.variant.sizes.items(), c.evidence.amplitudes, c.evidence.std, strict=True)
            stated = {n: _with_prior(float(a), float(u), s) for (n, s), a, u in found}
            values = {n: {"value": v, "std": std, "units": units[n]} for n, (v, std) in stated.items()}
        candidates.append(
            {
                "effect": c.key[0],
                "site": list(c.key[1]),
                "probability": c.probability,
                "parameters": values,
                "held_out_gain": c.held_out,
            }
        )
    return {
        "schema": "jaxfinger-gap/1",
        "data": Path(d.problem.session.file).name,
        "specimen": d.problem.session.specimen,
        "verdict": {
            "status": d.verdict.status,
            "effects": [{"effect": e, "site": list(s)} for e, s in d.verdict.effects],
            "summary": d.verdict.summary,
        },
        "where": [
            {
                "experiment": p.experiment,
                "trial": p.trial,
                "channel": p.channel,
                "site": p.site,
                "region": {"variable": p.variable, "low": p.low, "high": p.high},
                "share": p.share,
            }
            for p in d.where
        ],
        "candidates": candidates,
        "none": d.search.none,
        "unlisted": d.search.unlisted,
        "ambiguous_sets": [
            [{"effect": e, "site": list(s)} for e, s in members[:MOST_IN_A_SET]]
            for members in (d.search.rival_sets if d.verdict.status == "ambiguous" else [])
        ],
        "next_experiment": asdict(d.next) | {"separates": list(d.next.separates)} if d.next else None,
        "gap": [
            {
                "experiment": x.experiment,
                "channel": x.channel,
                "units": x.units,
                "noise": x.noise,
                "before": x.before,
                "after": x.after,
                "closed": x.closed,
                "closed_ci95": list(x.closed_ci95),
            }
            for x in d.shrinkage
        ],
    }


def write(d: Diagnosis, folder: str | Path, overwrite: bool = False) -> None:
    """`gap.json`, `nominal.json` and `augmented.json` in a folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / "gap.json", overwrite) as part:
        part.write_text(json.dumps(as_gap_json(d), indent=1, allow_nan=False), encoding="utf-8")
    save_fit(d.nominal, folder / "nominal.json", overwrite)
    save_fit(d.augmented, folder / "augmented.json", overwrite)
