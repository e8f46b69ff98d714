"""Posterior over all visited sets of causes: probabilities of causes and of «nothing», and ambiguous sets."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from jaxfinger.gap.columns import Counts
from jaxfinger.gap.costs import CauseKey, Costs
from jaxfinger.gap.exact import SearchState
from jaxfinger.gap.formula import Evidence, imitation_odds, unlisted
from jaxfinger.gap.sets import Search

MIN_NAMED_PROBABILITY = 0.5  # More likely at work than not.
# Shares of the probability of a cause and its rivals together:
MIN_UNAMBIGUOUS_SHARE = 0.9  # The cause itself has odds of nine to one; with less it is one of an ambiguous set.
MIN_COVERAGE = 0.97  # Members are added to an ambiguous set up to here; `next_experiment.DECISIVE` asks as much of one.
MAX_MEMBERS = 3  # of an ambiguous set. Sealed cases count no larger set as an answer (`sealed.score`).
MIN_RIVALRY = 0.5  # probability of a cause and its rivals. With less the best set is no likely answer at all.


@dataclass(frozen=True)
class Posterior:
    """Probabilities of the causes. Several may be at work, so that they need not sum to one."""

    causes: dict[CauseKey, float]  # probability that the cause is at work, alone or with others
    gains: dict[CauseKey, float]  # nats: net evidence of the best set with the cause less that of the best without it
    none: float  # probability that nothing is at work
    unlisted: float  # probability that something is at work which the catalogue lacks
    named: tuple[CauseKey, ...]  # causes of the best set that are likely and not ambiguous
    ambiguous: tuple[tuple[CauseKey, ...], ...]  # sets of causes that could replace one another in the best set


def posterior(search: Search, state: SearchState) -> Posterior:
    """Posterior over the sets that a search has visited; `state` is the best of them."""
    costs, scores, counts = search.costs, search.visited.scores, search.baseline.columns.counts
    w = costs.probabilities(scores)
    other = unlisted(counts, state.linear_fit.evidence, costs.parameters)
    genuine = genuine_probabilities(costs, counts, search.visited.evidence, frozenset(state.keys), other)
    net = {keys: score - costs.of(keys) for keys, score in scores.items()}
    causes, gains = {}, {}
    for key in search.table.keys:
        inside = [keys for keys in scores if key in keys]
        causes[key] = sum(w[keys] for keys in inside) * genuine.get(key, 1.0)
        without = max(net[keys] for keys in scores if key not in keys)
        gains[key] = max((net[keys] for keys in inside), default=-np.inf) - without
    ambiguous = ambiguous_sets(w, state.keys, genuine)
    named = tuple(k for k in state.keys if causes[k] >= MIN_NAMED_PROBABILITY and not any(k in s for s in ambiguous))
    return Posterior(causes, gains, w[frozenset()] * (1.0 - other), other, named, ambiguous)


def genuine_probabilities(
    costs: Costs,
    counts: Counts,
    evidence: Mapping[frozenset[CauseKey], Evidence],
    best: frozenset[CauseKey],
    other: float,
) -> dict[CauseKey, float]:
    """Probability of each cause of the best set that it does not merely imitate something unlisted.

    Something unlisted is at work with the probability P_u, `other`. Nothing imitates it, or the effects of a set M do,
    with the odds λ Π_{e∈M} Ω_e, since it is one effect, and hard to imitate or not. Ω_e is the largest ω
    (`formula.imitation_odds`) of an effect at any of its sites. So cause i of effect e imitates with the probability

        P_u λ ω_i R / (1 + λ ((1 + ω_i) R − 1)),    R = Π_{f≠e} (1 + Ω_f).

    A cause is left out if the search has not weighed the set without it.
    """
    p, left = costs.parameters, evidence[best]
    without = {key: evidence[best - {key}] for key in best if best - {key} in evidence}
    odds = {k: imitation_odds(counts, x, left, costs.explainable[k], p) for k, x in without.items()}
    largest: dict[str, float] = {}
    for (effect, _), x in odds.items():
        largest[effect] = max(x, largest.get(effect, 0.0))
    out = {}
    for key, x in odds.items():
        R = math.prod(1.0 + y for effect, y in largest.items() if effect != key[0])
        imitates = p.imitator_odds * x * R / (1.0 + p.imitator_odds * ((1.0 + x) * R - 1.0))
        out[key] = 1.0 - other * imitates
    return out


def ambiguous_sets(
    w: Mapping[frozenset[CauseKey], float], best: tuple[CauseKey, ...], genuine: Mapping[CauseKey, float]
) -> tuple[tuple[CauseKey, ...], ...]:
    """Causes of the `best` set, each with the rivals that could take its place, likeliest first.

    `w` are the posterior probabilities of all visited sets, `genuine` those of `genuine_probabilities`. Rivals
    compare by the probability of the best set with the rival in the cause's place. A cause that is less likely than
    as many rivals as there is room for comes last.
    """
    out, whole = [], frozenset(best)
    for key in best:
        rest = whole - {key}
        rivals = {next(iter(s - rest)): v for s, v in w.items() if len(s) == len(whole) and rest < s}
        total = sum(rivals.values())
        if rivals.get(key, 0.0) >= MIN_UNAMBIGUOUS_SHARE * total or total * genuine.get(key, 1.0) < MIN_RIVALRY:
            continue
        members, mass = [], 0.0
        for k in sorted(rivals, key=lambda k: -rivals[k]):
            if mass >= MIN_COVERAGE * total or len(members) == MAX_MEMBERS:
                break
            members.append(k)
            mass += rivals[k]
        if key not in members:
            members = [*members[: MAX_MEMBERS - 1], key]
        if len(members) > 1 and not any(set(members) == set(s) for s in out):
            out.append(tuple(members))
    return tuple(out)
