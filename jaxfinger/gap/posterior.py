"""What all visited sets of causes say together: how probable each cause is, «nothing», and which are rivals."""

from dataclasses import dataclass

import numpy as np

from jaxfinger.gap.costs import Key
from jaxfinger.gap.exact import SearchState
from jaxfinger.gap.formula import unlisted
from jaxfinger.gap.sets import Search

MIN_NAMED_PROBABILITY = 0.5  # probability from which on a verdict says that a cause is at work
SURE = 0.9  # share of a cause's probability, beside its rivals', below which they are an ambiguous set
COVERED, RIVALS = 0.97, 3  # probability up to which a set takes in further ones, and how many at most


@dataclass(frozen=True)
class Posterior:
    """Probabilities that each is at work at all; they need not sum to one."""

    causes: dict[Key, float]
    gains: dict[Key, float]  # log evidence of the best set with a cause less the best without
    none: float
    unlisted: float
    named: tuple[Key, ...]
    ambiguous: tuple[tuple[Key, ...], ...]


def posterior(search: Search, state: SearchState) -> Posterior:
    """From the sets that a search has weighed."""
    costs, scores = search.costs, search.visited.scores
    w = costs.probabilities(scores)
    net = {keys: score - costs.of(keys) for keys, score in scores.items()}
    causes, gains = {}, {}
    for key in search.table.keys:
        inside = [keys for keys in scores if key in keys]
        causes[key] = sum(w[keys] for keys in inside)
        without = max(net[keys] for keys in scores if key not in keys)
        gains[key] = max((net[keys] for keys in inside), default=-np.inf) - without
    other = unlisted(search.baseline.columns.counts, state.linear_fit.evidence, search.baseline.parameters)
    ambiguous = _ambiguous(w, state, causes)
    named = tuple(k for k in state.keys if causes[k] >= MIN_NAMED_PROBABILITY and not any(k in s for s in ambiguous))
    return Posterior(causes, gains, w[frozenset()] * (1.0 - other), other, named, ambiguous)


def _ambiguous(w: dict[frozenset, float], state: SearchState, causes: dict[Key, float]) -> tuple[tuple[Key, ...], ...]:
    """Causes of the best set that others could take the place of."""
    out, whole = [], frozenset(state.keys)
    for key in state.keys:
        rest = whole - {key}
        rivals = {next(iter(s - rest)): v for s, v in w.items() if len(s) == len(whole) and rest < s}
        total = sum(rivals.values())
        if rivals.get(key, 0.0) >= SURE * total or total < 0.5:
            continue
        members, mass = [], 0.0
        for k in sorted(rivals, key=lambda k: -rivals[k]):
            if mass >= COVERED * total or len(members) == RIVALS:
                break
            members.append(k)
            mass += rivals[k]
        if len(members) > 1 and not any(set(members) == set(s) for s in out):
            out.append(tuple(members))
    return tuple(out)
