"""Search for the causes: the sets of causes with the most evidence.

A set starts empty. It grows by one cause, or by two that hide each other, loses causes that are not worth their cost,
and swaps a cause for a better one, or for two that it imitates, as long as its net evidence grows: log evidence less
cost (`costs`). Candidates are compared at three levels, each more exact and for fewer of them:

1. all offers, by one least squares in fixed weights (`LinearModel.screen`);
2. the best SHORT_LIST of them, with the weights settled (`LinearModel.fit`);
3. the best MAX_EXACT of these, with amplitudes, shapes and nominal parameters fitted exactly (`exact.fit_set`).

The evidence of every set on the way is kept, and `posterior` makes probabilities of it.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum, auto
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.costs import CauseKey, Costs
from jaxfinger.gap.exact import (
    Baseline,
    SearchState,
    amplitudes_of,
    as_variant,
    fit_set,
    prior_products,
    refit_from_plain,
)
from jaxfinger.gap.formula import Evidence, LinearFit, LinearModel, Weights, unexplained
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signature_table import Offer, SignatureTable
from jaxfinger.gap.signatures import Variant
from jaxfinger.progress import Progress

SHORT_LIST = 12  # offers that are compared with settled weights: a few for each of the likeliest causes
MAX_PER_CHOICE = 2  # of the short list, for one cause and one choice of its fixed shapes
MAX_EXACT = 3  # offers that are fitted exactly: each fit takes seconds
MAX_CHANGES = 12  # changes of the set in one search
MAX_SCORE_GAP = 8.0  # nats. A set whose linear fit is further behind is not fitted exactly: each fit takes seconds.
# Share of the best offer's promised gain by which others may promise less. Where a law is curved, or a large cause has
# bent the nominal model, a linear fit promises a part of what the exact one brings.
MAX_GAIN_SHORTFALL = 0.5
MIN_SWAP_GAIN = 1.0  # nats that a swap must bring, so that two sets of like evidence are not swapped back and forth


class Weighed(IntEnum):
    """How the evidence of a set was found, the roughest way first."""

    SCREENED = auto()  # `LinearModel.screen`, in fixed weights, in which evidence is higher than in settled ones
    LINEAR = auto()  # `LinearModel.fit`, which promises too much where a law is curved or a shape is at its bound
    EXACT = auto()  # `exact.fit_set`


@dataclass
class Visited:
    """Evidence of every set that the search has visited; costs are not taken off."""

    evidence: dict[frozenset[CauseKey], Evidence] = field(default_factory=dict)
    weighed: dict[frozenset[CauseKey], Weighed] = field(default_factory=dict)

    @property
    def scores(self) -> dict[frozenset[CauseKey], float]:
        """Log evidence of every set."""
        return {keys: x.score for keys, x in self.evidence.items()}

    def add(self, keys: Iterable[CauseKey], evidence: Evidence, weighed: Weighed) -> None:
        """Record evidence of a set. A better way replaces a rougher one; of one way the highest evidence counts."""
        key = frozenset(keys)
        if key not in self.evidence or (weighed, evidence.score) > (self.weighed[key], self.evidence[key].score):
            self.evidence[key], self.weighed[key] = evidence, weighed


class Reduced(NamedTuple):
    """A set without one of its causes, fitted linearly."""

    keys: list[CauseKey]
    r: Float[np.ndarray, " N"]
    slopes: Float[np.ndarray, "k N"]
    score: float


class Screened(NamedTuple):
    """A set, perhaps without one of its causes, and the net evidence of it with each offer added."""

    keys: list[CauseKey]
    score: float
    model: LinearModel
    now: LinearFit  # fit of the set alone
    net: Float[np.ndarray, " offers"]  # −∞ for offers that add nothing


class Addition(NamedTuple):
    """An offer, and its amplitudes on top of a set, in prior standard deviations."""

    net: float  # net evidence that the set with the offer may have
    offer: Offer
    amplitudes: Float[np.ndarray, " k"]


class Alone(NamedTuple):
    """A cause alone on top of the nominal model, in its best offer, by a linear fit."""

    offer: Offer
    amplitudes: Float[np.ndarray, " k"]  # in prior standard deviations
    std: Float[np.ndarray, " k"]  # of the amplitudes
    tried: list[Offer]
    net: Float[np.ndarray, " tried"]  # log evidence of each tried offer, less its Occam factor


class Search:
    """Search for the causes of one problem."""

    def __init__(self, baseline: Baseline, table: SignatureTable, progress: Progress = lambda message: None):
        self.baseline, self.table, self.progress = baseline, table, progress
        self.visited = Visited()
        self.costs = Costs(baseline.parameters, baseline.unexplained, table.explainable)
        self.visited.add((), baseline.null.linear_fit.evidence, Weighed.EXACT)

    def run(self) -> SearchState:
        """Search from the empty set, and return the set with the most net evidence.

        It begins near the least squares of the nominal model, and at its best fit if nothing is found from there.
        """
        start, null = self.baseline.start, self.baseline.null
        found = self._found_from(start)
        if start is not null and self.net_evidence(found) <= null.score:
            found = self._found_from(null)
        return max(found, null, key=self.net_evidence)

    def _found_from(self, state: SearchState) -> SearchState:
        """The set with the most net evidence that is found from an empty one."""
        if not self.table.offers:
            return state
        for _ in range(MAX_CHANGES):
            state = self._climbed(state)
            rival = self._best_rival(state)
            if rival is None:
                break
            state = self._pruned(rival)
        return state

    def net_evidence(self, state: SearchState) -> float:
        """Log evidence of a set less its cost."""
        return state.score - self.costs.of(state.keys)

    def _climbed(self, state: SearchState) -> SearchState:
        """The set after changes until none makes it better.

        It is fitted once more at the end, since its rivals are fitted from there, and none of them may be favoured.
        """
        for _ in range(MAX_CHANGES):
            better = self._better(state) or self._with_other_choices(state)
            if better is None:
                break
            state = self._pruned(better)
        return max(state, self.fit_exactly(state, None), key=lambda s: s.score) if state.effects else state

    # One change of a set ----------------------------------------------------------------------------------------------
    def _better(self, state: SearchState) -> SearchState | None:
        """A set with more net evidence, one change away; None if there is none.

        The changes, in this order: one cause more; one swapped for another; two more, of which each alone is not worth
        its cost while the other is missing; two in the place of one that imitates both.
        """
        kept, now = len(state.effects), self.net_evidence(state)
        added = self._added(state, now)
        if better := self._best(state, added, kept):
            return better
        open_set = self._leaves_more(state)
        replaced = self._replaced(state, -np.inf if open_set else now - 0.5 * MAX_SCORE_GAP)
        if better := self._best(state, (x for _, x in replaced), kept - 1, MIN_SWAP_GAIN):
            return better
        if not open_set:
            return None
        pairs = (x for first in added for x in self._added(first, now, most=1))
        if better := self._best(state, pairs, kept):
            return better
        pairs = (x for key, first in replaced for x in self._added(first, now, most=1, other_than=key))
        return self._best(state, pairs, kept - 1)

    def _added(
        self, state: SearchState, now: float, most: int = MAX_EXACT, other_than: CauseKey | None = None
    ) -> list[SearchState]:
        """The set with each of the best offers, fitted exactly, if it may have more net evidence than `now`."""
        screened = self.screen(state)
        return [
            self.fit_exactly(state, None, offer, amplitudes, screened.now.weights)
            for net, offer, amplitudes in self.best_offers(screened, most, other_than)
            if net >= now - MAX_SCORE_GAP
        ]

    def _replaced(self, state: SearchState, least: float, most: int = 1) -> list[tuple[CauseKey, SearchState]]:
        """Every cause, and the set with the best others in its place that may have net evidence `least`, fitted.

        Another that is not worth its cost in that place is no rival.
        """
        found = []
        for i, key in enumerate(state.keys):
            screened = self.screen(state, i)
            empty = screened.score - self.costs.of(screened.keys)
            for net, offer, amplitudes in self.best_offers(screened, most, other_than=key):
                if net >= max(least, empty):
                    found.append((key, self.fit_exactly(state, i, offer, amplitudes, screened.now.weights)))
        return found

    def _best(
        self, state: SearchState, found: Iterable[SearchState], kept: int, gain: float = 0.0
    ) -> SearchState | None:
        """The best of the sets found, with its best choices, if it has over `gain` more net evidence than `state`.

        Its first `kept` causes are the state's.
        """
        best = max(found, key=self.net_evidence, default=state)
        if self.net_evidence(best) <= self.net_evidence(state) + gain:
            return None
        best = self.with_best_choices(best, kept)
        if self._leaves_more(best):
            best = refit_from_plain(self.baseline, best)
            self.visited.add(best.keys, best.linear_fit.evidence, Weighed.EXACT)
        return best

    def _with_other_choices(self, state: SearchState) -> SearchState | None:
        """The set with better choices of its causes, if there are any: the first were chosen without the others.

        Choices of the only cause have been compared when it was added.
        """
        if len(state.effects) < 2:
            return None
        found = self.with_best_choices(state, 0)
        return found if found.score > state.score + MIN_SWAP_GAIN else None

    def _leaves_more(self, state: SearchState) -> bool:
        """Whether a set leaves more than the formula takes for noise and inexact laws."""
        left = unexplained(self.baseline.columns.counts, state.linear_fit.evidence, self.baseline.parameters)
        return bool(left.sum() > self.baseline.parameters.unlisted_threshold)

    def _pruned(self, state: SearchState) -> SearchState:
        """The set without causes that explain less than they cost beside the others."""
        while len(state.effects) > 1:
            now = self.net_evidence(state)
            reduced = [self.without(state, i) for i in range(len(state.effects))]
            net = [x.score - self.costs.of(x.keys) for x in reduced]
            worst = int(np.argmax(net))
            if net[worst] < now - MAX_SCORE_GAP:
                return state
            found = self.fit_exactly(state, worst)
            if max(self.net_evidence(found), net[worst]) < now:
                return state
            state = found
        return state

    def _best_rival(self, state: SearchState) -> SearchState | None:
        """Fit the best others in the place of each cause, for the posterior; the best such set, if it is better."""
        replaced = self._replaced(state, -np.inf, MAX_EXACT)
        found = [self.with_best_choices(x, len(state.effects) - 1) for _, x in replaced]
        best = max(found, key=self.net_evidence, default=state)
        return best if self.net_evidence(best) > self.net_evidence(state) + MIN_SWAP_GAIN else None

    # Linear: all offers at once ---------------------------------------------------------------------------------------
    def without(self, state: SearchState, cause: int | None) -> Reduced:
        """The set without one cause, or as it is for None, fitted linearly."""
        kept = [i for i in range(len(state.effects)) if i != cause]
        at = [k for k, c in enumerate(state.coordinates) if c.effect in kept]
        keys, slopes = [state.keys[i] for i in kept], state.slopes[at]
        r, fit = state.problem.r - state.changes[kept].sum(axis=0), state.linear_fit
        if cause is not None:
            model = self.baseline.linear_model(state.problem, state.nominal, r, slopes)
            fit = model.fit(np.arange(len(at)), *state.step_bounds(at), sizes=state.sizes()[at])
        self.visited.add(keys, fit.evidence, Weighed.LINEAR)
        return Reduced(keys, r, slopes, fit.score)

    def screen(self, state: SearchState, without: int | None = None) -> Screened:
        """Weigh every offer on top of a set, or of the set without one cause."""
        keys, r, slopes, score = self.without(state, without)
        columns = self.baseline.columns
        model = LinearModel(
            columns,
            (ByColumn.of(columns, r[None]), state.nominal, ByColumn.of(columns, slopes)),
            prior_products(state.problem, len(slopes)),
            self.table.signatures,
            self.baseline.parameters,
            self.baseline.null.linear_fit,
        )
        now = model.fit(np.empty(0, int), start=state.linear_fit.weights)
        offers = self.table.offers
        found = model.screen(now, [o.rows for o in offers], [(o.low, o.high) for o in offers])
        net = np.full(len(offers), -np.inf)
        for n, (o, more) in enumerate(zip(offers, found, strict=True)):
            if more is not None and not set(o.keys) & set(keys):
                together = [*keys, *o.keys]
                net[n] = score + more.score - self.costs.of(together)
                self.visited.add(together, more._replace(score=score + more.score), Weighed.SCREENED)
        return Screened(keys, score, model, now, net)

    def best_offers(
        self, screened: Screened, most: int = MAX_EXACT, other_than: CauseKey | None = None
    ) -> list[Addition]:
        """Offers that may be best once they are fitted, each of another cause or choice, best first.

        They are the best `most` with shapes of the grid, and the best `most` with shapes between those; each without
        offers that are both MAX_SCORE_GAP and MAX_GAIN_SHORTFALL behind the first. Weights are settled. The cause
        `other_than` is left out.
        """
        keys, score, model, now, net = screened
        empty = score - self.costs.of(keys)
        found, taken = [], {}
        for n in np.argsort(-net)[: 4 * SHORT_LIST]:
            o = self.table.offers[n]
            choice = o.keys, o.choices
            if (
                o.keys == (other_than,)
                or not np.isfinite(net[n])
                or taken.get(choice, 0) >= MAX_PER_CHOICE
                or len(found) >= SHORT_LIST
            ):
                continue
            taken[choice] = taken.get(choice, 0) + 1
            fit = model.fit(o.rows, o.low, o.high, start=now.weights)
            together = [*keys, *o.keys]
            evidence = fit.evidence._replace(score=score + fit.score - now.score)
            self.visited.add(together, evidence, Weighed.LINEAR)
            found.append(Addition(evidence.score - self.costs.of(together), o, fit.amplitudes))
        on_grid: dict[tuple, Addition] = {}
        for x in sorted(found, key=lambda x: -x.net):
            on_grid.setdefault((x.offer.keys, x.offer.choices), x)
        fitted = {form: self._with_fitted_shapes(screened, x) for form, x in on_grid.items()}
        chosen = _nearest_best(on_grid, most, empty) | _nearest_best(fitted, most, empty)
        return sorted((fitted[form] for form in chosen), key=lambda x: -x.net)

    def _with_fitted_shapes(self, screened: Screened, found: Addition) -> Addition:
        """An addition with the net evidence that it may have once its shapes are fitted.

        The signature of a shape between two of the grid is nearly a sum of theirs. Where noise is small, the grid alone
        misses tens of nats, of which such a sum recovers about half (`tests/gap/test_sets.py`).
        """
        keys, score, model, now, _ = screened
        net, o = found.net, found.offer
        for other in self.table.neighbours(o):
            rows, low, high = (np.concatenate([getattr(o, n), getattr(other, n)]) for n in ("rows", "low", "high"))
            both = model.fit(rows, low, high, start=now.weights)
            net = max(net, score + both.score - now.score - self.costs.of([*keys, *o.keys]))
        return found._replace(net=net + (net - found.net))

    # Exact ------------------------------------------------------------------------------------------------------------
    def fit_exactly(
        self,
        state: SearchState,
        without: int | None,
        offer: Offer | None = None,
        amplitudes: Sequence[float] | Float[np.ndarray, " k"] = (),
        weights: Weights | None = None,
    ) -> SearchState:
        """Fit a set with an offer added, or without one cause, or both, from where the set is.

        `amplitudes` of the offer are in prior standard deviations.
        """
        kept = [i for i in range(len(state.effects)) if i != without]
        variants = [as_variant(state.effects[i], state.problem.scales) for i in kept]
        starts = [amplitudes_of(state.effects[i]) for i in kept]
        if offer is not None:
            self.progress(f"fitting with {offer.effect} at {', '.join('-'.join(s) for _, s in offer.keys)}")
            variants += offer.variants
            starts += self._in_own_units(offer, amplitudes)
        return self._fit(state.problem, variants, starts, weights or state.linear_fit.weights)

    def _in_own_units(
        self, offer: Offer, amplitudes: Sequence[float] | Float[np.ndarray, " k"]
    ) -> list[dict[str, float]]:
        """Amplitudes of an offer by name for each of its variants; zero where the trials see nothing of one."""
        of_row = {i: float(a) for i, a in zip(offer.rows.tolist(), amplitudes, strict=True)}
        return [
            {
                n: of_row.get(int(i), 0.0) * float(self.table.units[i]) * size
                for i, (n, size) in zip(rows, v.sizes.items(), strict=True)
            }
            for v, rows in zip(offer.variants, self.table.rows_of(offer), strict=True)
        ]

    def _fit(
        self, problem: Problem, variants: Sequence[Variant], starts: Sequence[dict[str, float]], weights: Weights
    ) -> SearchState:
        found = fit_set(self.baseline, problem, variants, starts, weights)
        self.visited.add(found.keys, found.linear_fit.evidence, Weighed.EXACT)
        return found

    def with_best_choices(self, state: SearchState, first: int) -> SearchState:
        """The set with the best values of shapes that no fit moves, for the causes from number `first` on.

        Each value is fitted from where the values before have led.
        """
        best, scales = state, state.problem.scales
        for i in range(first, len(state.effects)):
            effect = type(state.effects[i])
            grids, shapes = effect.worth_trying(scales, state.effects[i].site), effect.shape_parameters()
            for name in (n for n, p in shapes.items() if p.moves == "not"):
                for value in set(grids[name]) - {float(getattr(best.effects[i], name))}:
                    variants = [as_variant(e, scales) for e in best.effects]
                    variants[i] = variants[i].with_shape(**{name: value})
                    if effect.sensible(scales, variants[i].site, dict(variants[i].shape)):
                        starts = [amplitudes_of(e) for e in best.effects]
                        other = self._fit(best.problem, variants, starts, best.linear_fit.weights)
                        best = max(best, other, key=lambda x: x.score)
        return best

    # For the verdict --------------------------------------------------------------------------------------------------
    def only(self, state: SearchState, keys: Iterable[CauseKey]) -> SearchState:
        """The set without all causes but these, fitted exactly."""
        keys = set(keys)
        while others := [i for i, k in enumerate(state.keys) if k not in keys]:
            if len(others) == len(state.keys):
                return self.baseline.null
            state = self.fit_exactly(state, others[0])
        return state

    def likeliest(self, state: SearchState, ambiguous: Iterable[Sequence[CauseKey]]) -> SearchState:
        """The set with the first member of each ambiguous set, the likeliest, in place of the one that it holds.

        The search swaps a cause only where that gains MIN_SWAP_GAIN, so that a rival can be a little likelier.
        """
        for members in ambiguous:
            if members[0] not in state.keys:
                state = next((s for s in self.rivals(state, members) if members[0] in s.keys), state)
        return state

    def rivals(self, state: SearchState, members: Iterable[CauseKey]) -> list[SearchState]:
        """The set, which holds one member of an ambiguous set, and the sets with each other member in its place."""
        members, out = list(members), [state]
        own = next(i for i, k in enumerate(state.keys) if k in members)
        screened = self.screen(state, own)
        for key in members:
            if key != state.keys[own] and (best := self._best_offer_of(screened, key)) is not None:
                found = self.fit_exactly(state, own, *best, screened.now.weights)
                out.append(self.with_best_choices(found, len(state.effects) - 1))
        return out

    def _best_offer_of(self, screened: Screened, key: CauseKey) -> tuple[Offer, Float[np.ndarray, " k"]] | None:
        """Best offer of one cause alone on top of a set, with its amplitudes; None where there is none."""
        mine = self._finite(screened, key)
        if not mine:
            return None
        offer = self.table.offers[max(mine, key=lambda n: screened.net[n])]
        fit = screened.model.fit(offer.rows, offer.low, offer.high, start=screened.now.weights)
        return offer, fit.amplitudes

    def _finite(self, screened: Screened, key: CauseKey) -> list[int]:
        """Numbers of the offers of one cause whose evidence on top of a set is finite."""
        return [n for n in self.table.numbers_of(key) if np.isfinite(screened.net[n])]

    def alone(self, keys: Iterable[CauseKey]) -> dict[CauseKey, Alone]:
        """Each cause alone on top of the nominal model, in the offer with the most evidence."""
        screened, out = self.screen(self.baseline.start), {}
        for key in keys:
            if (best := self._best_offer_of(screened, key)) is not None:
                mine = self._finite(screened, key)
                std = screened.model.std(best[0].rows, screened.now.weights)
                out[key] = Alone(*best, std, [self.table.offers[n] for n in mine], screened.net[mine])
        return out


def _nearest_best(found: Mapping[tuple, Addition], most: int, empty: float) -> set[tuple]:
    """Keys of the `most` additions with the most net evidence that are not far behind the best.

    `empty`: net evidence without any of them.
    """
    order = sorted(found, key=lambda k: -found[k].net)[:most]
    if not order:
        return set()
    best = found[order[0]].net
    return {k for k in order if found[k].net > best - max(MAX_SCORE_GAP, MAX_GAIN_SHORTFALL * (best - empty))}
