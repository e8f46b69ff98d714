"""What all visited sets of causes say together: how probable each cause is, «nothing», and which are rivals."""

from dataclasses import dataclass

import numpy as np
from scipy.special import expit, logsumexp

from jaxfinger.gap.exact import State
from jaxfinger.gap.formula import unexplained
from jaxfinger.gap.sets import Key, Search

IS_NAMED = 0.5  # probability from which on a verdict says that a cause is at work
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


def posterior(search: Search, state: State) -> Posterior:
    """From the sets that a search has weighed. A set's weight is exp(β (score − evidence needed) − log odds)."""
    p, base = search.bench.parameters, search.bench.null.score
    sets = list(search.visited.scores.items())
    log_w = np.array(
        [p.trust * (score - base - sum(search.evidence_needed(keys))) - search.odds(keys) for keys, score in sets]
    )
    w = np.exp(log_w - logsumexp(log_w))
    net = np.array([score - search.cost(keys) for keys, score in sets])
    causes, gains = {}, {}
    for key in search.table.keys:
        inside = np.array([key in keys for keys, _ in sets])
        causes[key] = float(w[inside].sum())
        gains[key] = float(net[inside].max(initial=-np.inf) - net[~inside].max()) if inside.any() else -np.inf
    left = float(unexplained(search.bench.columns, state.judged, search.bench.null.judged, p).sum())
    taken = max(search.bench.unknown - left, 0.0)
    unlisted = float(expit(p.sharp * (left - p.open - p.left * taken)))
    nothing = float(w[[not keys for keys, _ in sets]].sum())
    ambiguous = _ambiguous(dict(zip((k for k, _ in sets), w.tolist(), strict=True)), state, causes)
    named = tuple(k for k in state.keys if causes[k] >= IS_NAMED and not any(k in s for s in ambiguous))
    return Posterior(causes, gains, nothing * (1.0 - unlisted), unlisted, named, ambiguous)


def _ambiguous(w: dict[frozenset, float], state: State, causes: dict[Key, float]) -> tuple[tuple[Key, ...], ...]:
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
