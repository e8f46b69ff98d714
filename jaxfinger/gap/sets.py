"""Which causes: sets grown, pruned and swapped by their evidence, each fitted exactly; what all visited sets say."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.costs import Costs, Key
from jaxfinger.gap.exact import (
    Baseline,
    Projector,
    SearchState,
    amplitudes_of,
    as_variant,
    fitted,
    led_plainly,
    prior_products,
)
from jaxfinger.gap.formula import Evidence, LinearFit, LinearModel, Weights, unexplained
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.screening import Part
from jaxfinger.gap.signatures import Variant
from jaxfinger.identify.stages import Progress

# Share of a signature that nominal parameters must leave. What they imitate altogether leaves rounding, below 1e-5. Of
# a cause that leaves 2e-3, as an encoder's offset does, the bend over a plausible size is 0.4 % of what is left.
SEEN = 1e-3
LEAST_LEFT = (1e-3 * SEEN) ** 2  # of ‖z‖²: ‖z‖² − ‖Qᵀ z‖² is good to 1e-14 of it, and less than this is taken for zero
SHORT_LIST = 12  # candidates whose amplitudes are weighed until the weights settle
EXACT = 3  # of them that are fitted exactly
MOST = 12  # changes of the set
CLOSE = 8.0  # score within which a candidate may overtake another once it is fitted exactly


@dataclass(frozen=True)
class Offer:
    """One way to add a cause: an effect at one site, or at all of its sites, in one shape."""

    variants: tuple[Variant, ...]
    rows: Int[np.ndarray, " k"]  # rows of its signatures in the table
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]

    @property
    def keys(self) -> tuple[Key, ...]:
        """What a verdict would name."""
        return tuple(v.key for v in self.variants)

    @property
    def choices(self) -> tuple[float, ...]:
        """Shapes that no refit moves."""
        shapes = self.variants[0].effect.shape_parameters()
        return tuple(v for n, v in self.variants[0].shape if shapes[n].moves == "not")

    @property
    def effect(self) -> str:
        """Its id."""
        return self.variants[0].effect.ID


@dataclass(frozen=True)
class SignatureTable:
    """All signatures at the nominal model, each in units of its prior, and what is made of them."""

    signatures: ByColumn
    rows: dict[Variant, Int[np.ndarray, " _k"]]  # of every variant: all of its amplitudes'
    units: Float[np.ndarray, " M"]
    absorbed: dict[Key, float]
    hidden: dict[Key, dict[str, float]]  # std of amplitudes, each alone, in their own units: what could hide
    explainable: dict[Key, Float[np.ndarray, " C"]]  # of all that the trials can see (`Costs`)
    offers: list[Offer]

    def rows_of(self, offer: Offer) -> list[Int[np.ndarray, " _k"]]:
        """Of every variant of an offer, those that no trial shows too."""
        return [self.rows[v] for v in offer.variants]

    @property
    def keys(self) -> list[Key]:
        """All that the trials can see."""
        return list(self.explainable)


def table_of(problem: Problem, baseline: Baseline, parts: Iterable[Part], together: bool = True) -> SignatureTable:
    """Every candidate that the trials can see."""
    plain = Projector(problem, baseline.columns, Weights.plain(baseline.columns))
    rt = plain.residual(problem.r)
    offered = [part.variant_rows(plain, rt, baseline.columns) for part in parts]
    items = [v for some, _ in offered for v in some]
    signatures = ByColumn.joined(baseline.columns, [rows for _, rows in offered])
    raw, left, units, claims = _visible(baseline, plain, signatures)
    kept = units > 0.0
    absorbed: dict[Key, float] = {}
    hidden: dict[Key, dict[str, float]] = {}
    explainable: dict[Key, Float[np.ndarray, " C"]] = {}
    offers, rows, start = [], {}, 0
    for v in items:
        at = np.arange(start, start + len(v.sizes))
        start += len(v.sizes)
        rows[v] = at
        share = 1.0 - float(np.sum(left[at] ** 2) / max(np.sum(raw[at] ** 2), 1e-300))
        if share < absorbed.get(v.key, np.inf):
            absorbed[v.key] = share
            hidden[v.key] = {
                n: size / float(max(left[i], 1e-12 * raw[i]))
                for i, (n, size) in zip(at, v.sizes.items(), strict=True)
                if raw[i] > 0.0
            }
        ends = [_ends(v, n, float(units[i])) for i, n in zip(at, v.sizes, strict=True) if kept[i]]
        if ends:
            low, high = np.array(ends).T
            offers.append(Offer((v,), at[kept[at]], low, high))
            explainable[v.key] = np.maximum(explainable.get(v.key, 0.0), claims[at].max(axis=0))
    offers += _together(offers) if together else []
    return SignatureTable(signatures.scaled(units), rows, units, absorbed, hidden, explainable, offers)


class Visible(NamedTuple):
    """How much of M signatures the trials can tell from the nominal parameters."""

    raw: Float[np.ndarray, " M"]  # norms
    left: Float[np.ndarray, " M"]  # norms of what the nominal parameters leave
    units: Float[np.ndarray, " M"]  # sizes that would make what is left as large as the whole gap; zero: not visible
    claims: Float[np.ndarray, "M C"]  # share of each column's gap that each would explain, that large


def _visible(baseline: Baseline, plain: Projector, Z: ByColumn) -> Visible:
    """With Q spanning what the nominal parameters can absorb, ‖z − Q Qᵀ z‖² = ‖z‖² − ‖Qᵀ z‖²."""
    columns, Q = baseline.columns, plain.Q
    square, onto = np.zeros(Z.count), np.zeros((Q.shape[1], Z.count))
    for c, (at, rows) in zip(columns.items, Z.held, strict=True):
        square[at] += np.sum(rows**2, axis=1)
        onto[:, at] += Q[c.rows].T @ rows.T
    rest = square - np.sum(onto**2, axis=0)
    raw, left = np.sqrt(square), np.sqrt(np.where(rest > LEAST_LEFT * square, rest, 0.0))
    units = np.where(left > SEEN * raw, baseline.gap / np.maximum(left, 1e-300), 0.0)
    absorbed = np.concatenate([c.basis.T @ Q[c.rows] for c in columns.items]) @ onto
    energy = columns.sums((Z.B - absorbed) ** 2).T
    share = units[:, None] ** 2 * energy / np.maximum(baseline.null.linear_fit.evidence.e, 1e-300)
    return Visible(raw, left, units, np.minimum(share, 1.0))


def _ends(v: Variant, name: str, unit: float) -> tuple[float, float]:
    amplitude = v.effect.amplitudes()[name]
    return -np.inf if amplitude.signed else 0.0, amplitude.most / (v.sizes[name] * unit)


def _together(offers: list[Offer]) -> list[Offer]:
    """One cause at all of its sites."""
    alike: dict[tuple, list[Offer]] = {}
    for o in offers:
        (v,) = o.variants
        alike.setdefault((v.effect.ID, v.size, v.shape), []).append(o)
    out = []
    for group in alike.values():
        if len({o.keys for o in group}) == len(group) > 1:
            parts = ([*o.variants] for o in group)
            rows, low, high = (np.concatenate([getattr(o, n) for o in group]) for n in ("rows", "low", "high"))
            out.append(Offer(tuple(v for p in parts for v in p), rows, low, high))
    return out


@dataclass
class Visited:
    """What was said of every set that was weighed."""

    evidence: dict[frozenset[Key], Evidence] = field(default_factory=dict)
    screened: set[frozenset[Key]] = field(default_factory=set)  # those of which `LinearModel.screen` alone has spoken

    @property
    def scores(self) -> dict[frozenset[Key], float]:
        """Costs not taken off."""
        return {keys: x.score for keys, x in self.evidence.items()}

    def screen(self, keys: Iterable[Key], evidence: Evidence) -> None:
        """By one step in the weights, which promises more than they give once they settle: no word against another."""
        key = frozenset(keys)
        if key not in self.evidence:
            self.screened.add(key)
        if key in self.screened:
            self._better(key, evidence)

    def add(self, keys: Iterable[Key], evidence: Evidence) -> None:
        """In settled weights: the best of those that it was given."""
        key = frozenset(keys)
        if key in self.screened:
            self.screened.remove(key)
            del self.evidence[key]
        self._better(key, evidence)

    def _better(self, key: frozenset[Key], evidence: Evidence) -> None:
        if key not in self.evidence or evidence.score > self.evidence[key].score:
            self.evidence[key] = evidence


class Rest(NamedTuple):
    """What is left of a set without one of its causes, linearly."""

    keys: list[Key]
    r: Float[np.ndarray, " N"]
    slopes: Float[np.ndarray, "k N"]
    score: float


class Screened(NamedTuple):
    """A set, or what is left of it, and the value of every set with one offer more."""

    keys: list[Key]
    score: float
    linear: LinearModel
    now: LinearFit
    values: Float[np.ndarray, " offers"]


class Search:
    """Sets of causes of one file."""

    def __init__(self, baseline: Baseline, table: SignatureTable, progress: Progress = lambda message: None):
        self.baseline, self.table, self.progress = baseline, table, progress
        self.visited = Visited()
        self.costs = Costs(baseline.parameters, baseline.unexplained, table.explainable)
        self.visited.add((), baseline.null.linear_fit.evidence)

    def value(self, state: SearchState) -> float:
        """Score less costs."""
        return state.score - self.costs.of(state.keys)

    def linear(self, state: SearchState, r: np.ndarray, slopes: np.ndarray) -> LinearModel:
        """The table's rows on top of a state's base."""
        columns = self.baseline.columns
        return LinearModel(
            columns,
            (ByColumn.of(columns, r[None]), state.nominal, ByColumn.of(columns, slopes)),
            prior_products(state.problem, len(slopes)),
            self.table.signatures,
            self.baseline.parameters,
            self.baseline.null.linear_fit,
        )

    def without(self, state: SearchState, cause: int | None) -> Rest:
        """What is left of a state without one cause; all of it for None."""
        kept = [i for i in range(len(state.effects)) if i != cause]
        at = [k for k, c in enumerate(state.coordinates) if c.effect in kept]
        keys, slopes = [state.keys[i] for i in kept], state.slopes[at]
        r, judged = state.problem.r - state.changes[kept].sum(axis=0), state.linear_fit
        if cause is not None:
            judged = self.baseline.fit_linear(
                state.problem, state.nominal, r, slopes, state.sizes()[at], state.room(at)
            )
        self.visited.add(keys, judged.evidence)
        return Rest(keys, r, slopes, judged.score)

    def screened(self, state: SearchState, without: int | None = None) -> Screened:
        """Every offer on top of the state, or of what is left of it without one cause."""
        keys, r, slopes, score = self.without(state, without)
        linear = self.linear(state, r, slopes)
        now = linear.fit(np.empty(0, int), start=state.linear_fit.weights)
        offers = self.table.offers
        found = linear.screen(now, [o.rows for o in offers], [(o.low, o.high) for o in offers])
        values = np.full(len(offers), -np.inf)
        for n, (o, more) in enumerate(zip(offers, found, strict=True)):
            if more is not None and not set(o.keys) & set(keys):
                together = [*keys, *o.keys]
                values[n] = score + more.score - self.costs.of(together)
                self.visited.screen(together, more._replace(score=score + more.score))
        return Screened(keys, score, linear, now, values)

    def best_offers(self, screened: Screened, most: int = EXACT) -> list[tuple[float, Offer, np.ndarray]]:
        """The offers whose sets are worth most once the weights settle, with amplitudes: one an effect, site and
        choice.
        """
        keys, score, linear, now, values = screened
        found, taken = [], {}
        for n in np.argsort(-values)[: 4 * SHORT_LIST]:
            o = self.table.offers[n]
            form = o.keys, o.choices
            if not np.isfinite(values[n]) or taken.get(form, 0) >= 2 or len(found) >= SHORT_LIST:
                continue
            taken[form] = taken.get(form, 0) + 1
            judged = linear.fit(o.rows, o.low, o.high, start=now.weights)
            together = [*keys, *o.keys]
            evidence = judged.evidence._replace(score=score + judged.score - now.score)
            self.visited.add(together, evidence)
            found.append((evidence.score - self.costs.of(together), o, judged.amplitudes))
        found.sort(key=lambda x: -x[0])
        seen, out = set(), []
        for x in found:
            form = x[1].keys, x[1].choices
            if form not in seen:
                seen.add(form)
                out.append(x)
        return [x for x in out[:most] if x[0] > out[0][0] - CLOSE]

    def exactly(
        self,
        state: SearchState,
        without: int | None,
        offer: Offer | None = None,
        amplitudes: Sequence[float] | np.ndarray = (),
        weights: Weights | None = None,
    ) -> SearchState:
        """The state with an offer, or without a cause, or both, fitted exactly."""
        kept = [i for i in range(len(state.effects)) if i != without]
        variants = [as_variant(state.effects[i], state.problem.scales) for i in kept]
        starts = [amplitudes_of(state.effects[i]) for i in kept]
        if offer is not None:
            self.progress(f"fitting with {offer.effect} at {', '.join('-'.join(s) for _, s in offer.keys)}")
            mine = {i: float(a) for i, a in zip(offer.rows.tolist(), amplitudes, strict=True)}
            for v, rows in zip(offer.variants, self.table.rows_of(offer), strict=True):
                variants.append(v)
                starts.append(
                    {
                        n: mine.get(int(i), 0.0) * float(self.table.units[i]) * size
                        for i, (n, size) in zip(rows, v.sizes.items(), strict=True)
                    }
                )
        return self._fitted(state.problem, variants, starts, weights or state.linear_fit.weights)

    def _fitted(self, problem, variants, starts, weights) -> SearchState:
        found = fitted(self.baseline, problem, variants, starts, weights)
        self.visited.add(found.keys, found.linear_fit.evidence)
        return found

    def in_its_best_form(self, state: SearchState, first: int) -> SearchState:
        """The state with those shapes of the causes from number `first` on that no refit moves as they suit it best,
        each tried from where the others have led.
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
                        other = self._fitted(best.problem, variants, starts, best.linear_fit.weights)
                        best = max(best, other, key=lambda x: x.score)
        return best

    def run(self) -> SearchState:
        """The best set that additions, drops and swaps lead to."""
        state = self.baseline.null
        if not self.table.offers:
            return state
        for _ in range(MOST):
            tried = self._tried(state, state)
            better = self._best(state, tried) or self._swapped(state) or self._best(state, self._pairs(state, tried))
            if better is None:
                break
            state = self._pruned(better)
        # What could replace a cause is fitted from where the state has led. The state is so too, that none is favoured.
        if state.effects:
            state = max(state, self.exactly(state, None), key=lambda s: s.score)
        for i, key in enumerate(state.keys):
            screened = self.screened(state, i)
            for _, offer, amplitudes in self.best_offers(screened):
                if key not in offer.keys:
                    found = self.exactly(state, i, offer, amplitudes, screened.now.weights)
                    self.in_its_best_form(found, len(state.effects) - 1)
        return state

    def _tried(self, state: SearchState, beside: SearchState, most: int = EXACT) -> list[SearchState]:
        """The state with each of the best offers that may be worth more than the one `beside`."""
        screened = self.screened(state)
        return [
            self.exactly(state, None, offer, amplitudes, screened.now.weights)
            for value, offer, amplitudes in self.best_offers(screened, most)
            if value >= self.value(beside) - CLOSE
        ]

    def _best(self, state: SearchState, tried: Iterable[SearchState]) -> SearchState | None:
        """That which is worth most, in its best form, if it is worth more than the state."""
        best = max(tried, key=self.value, default=state)
        if self.value(best) <= self.value(state):
            return None
        best = self.in_its_best_form(best, len(state.effects))
        return self._led_plainly(best) if self._open(best) else best

    def _led_plainly(self, state: SearchState) -> SearchState:
        found = led_plainly(self.baseline, state)
        self.visited.add(found.keys, found.linear_fit.evidence)
        return found

    def _open(self, state: SearchState) -> bool:
        """Whether more is left than the formula takes for noise and inexact laws."""
        left = unexplained(self.baseline.columns.counts, state.linear_fit.evidence, self.baseline.parameters)
        return bool(left.sum() > self.baseline.parameters.unlisted_threshold)

    def _pairs(self, state: SearchState, firsts: Sequence[SearchState]) -> Iterator[SearchState]:
        """Two causes more where neither alone is worth its cost, since each is hidden by what the other leaves open."""
        if self._open(state):
            for first in firsts:
                yield from self._tried(first, state, most=1)

    def _pruned(self, state: SearchState) -> SearchState:
        """Without those causes that explain too little beside the others."""
        while len(state.effects) > 1:
            now = self.value(state)
            rest = [self.without(state, i) for i in range(len(state.effects))]
            left = [x.score - self.costs.of(x.keys) for x in rest]
            worst = int(np.argmax(left))
            if left[worst] < now - CLOSE:
                return state
            found = self.exactly(state, worst, None)
            if max(self.value(found), left[worst]) < now:
                return state
            state = found
        return state

    def _swapped(self, state: SearchState) -> SearchState | None:
        now, best = self.value(state), None
        for i in range(len(state.effects)):
            screened = self.screened(state, i)
            for value, offer, amplitudes in self.best_offers(screened, 1):
                if value < now - 0.5 * CLOSE or offer.keys == (state.keys[i],):
                    continue
                found = self.exactly(state, i, offer, amplitudes, screened.now.weights)
                if self.value(found) > max(now + 1.0, self.value(best) if best else -np.inf):
                    best = found
        return best

    def only(self, state: SearchState, keys: Iterable[Key]) -> SearchState:
        """The state with no other causes than these."""
        keys = set(keys)
        while others := [i for i, k in enumerate(state.keys) if k not in keys]:
            if len(others) == len(state.keys):
                return self.baseline.null
            state = self.exactly(state, others[0], None)
        return state

    def rivals(self, state: SearchState, members: Iterable[Key]) -> list[SearchState]:
        """The state with each member of an ambiguous set in the place of the one that it holds."""
        members, out = list(members), [state]
        own = next(i for i, k in enumerate(state.keys) if k in members)
        screened = self.screened(state, own)
        for key in members:
            if key != state.keys[own] and (best := self._best_of(screened, key)) is not None:
                found = self.exactly(state, own, *best, screened.now.weights)
                out.append(self.in_its_best_form(found, len(state.effects) - 1))
        return out

    def _best_of(self, screened: Screened, key: Key) -> tuple[Offer, np.ndarray] | None:
        _, _, linear, now, values = screened
        mine = [n for n, o in enumerate(self.table.offers) if o.keys == (key,) and np.isfinite(values[n])]
        if not mine:
            return None
        offer = self.table.offers[max(mine, key=lambda n: values[n])]
        return offer, linear.fit(offer.rows, offer.low, offer.high, start=now.weights).amplitudes

    def alone(self, keys: Iterable[Key]) -> dict[Key, tuple[Offer, np.ndarray, np.ndarray]]:
        """Of causes alone on top of the nominal model, linearly: the shape that suits best, amplitudes, their std."""
        screened, out = self.screened(self.baseline.null), {}
        for key in keys:
            if (best := self._best_of(screened, key)) is not None:
                out[key] = (*best, screened.linear.std(best[0].rows, screened.now.weights))
        return out
