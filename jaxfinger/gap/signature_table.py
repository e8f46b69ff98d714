"""Table of all signatures at the nominal model, and the offers of causes that a search makes of it."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.costs import CauseKey
from jaxfinger.gap.exact import Baseline
from jaxfinger.gap.formula import Weights
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.screening import Part
from jaxfinger.gap.signatures import Variant

# Share of a signature's norm that the nominal parameters must leave. A signature that they imitate leaves rounding,
# less than 1e-5. One that leaves 2e-3, as an encoder's offset does, is still linear over a plausible size: its
# curvature is 0.4 % of what is left.
MIN_UNABSORBED = 1e-3
# The energy left, ‖z‖² − ‖Qᵀz‖², is good to 1e-14 of ‖z‖². Less than this share of ‖z‖² is taken for zero.
MIN_UNABSORBED_ENERGY = (1e-3 * MIN_UNABSORBED) ** 2
# Norm of a signature in standard deviations of the noise. At a plausible size, less than this is rounding: predictions
# are up to 1e6 deviations and good to 1e-16, and the rounding of 1e4 samples adds up to 1e-8.
MIN_NORM = 1e-6


@dataclass(frozen=True)
class Offer:
    """One way to add a cause: an effect in one shape, at one site or at all of its sites together."""

    variants: tuple[Variant, ...]  # one for each site
    rows: Int[np.ndarray, " k"]  # rows of the table, one for each amplitude that the trials can see
    low: Float[np.ndarray, " k"]  # bounds of the amplitudes, in prior standard deviations
    high: Float[np.ndarray, " k"]

    @property
    def keys(self) -> tuple[CauseKey, ...]:
        """The causes: effect and site of each."""
        return tuple(v.key for v in self.variants)

    @property
    def choices(self) -> tuple[float, ...]:
        """Values of the shapes that no fit moves: a form, a side or a place."""
        shapes = self.variants[0].effect.shape_parameters()
        return tuple(v for n, v in self.variants[0].shape if shapes[n].moves == "not")

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.variants[0].effect.ID


@dataclass(frozen=True)
class SignatureTable:
    """Signatures of all M amplitudes of all candidates at the nominal model, and the offers made of them."""

    signatures: ByColumn  # M rows, in prior standard deviations of their amplitudes
    rows: dict[Variant, Int[np.ndarray, " _k"]]  # rows of every variant, one for each of its amplitudes
    units: Float[np.ndarray, " M"]  # prior standard deviations, in plausible sizes; zero if the trials see nothing
    absorbed: dict[CauseKey, float]  # share of a cause's energy that the nominal parameters imitate, at its best shape
    # Standard deviations of the cause's amplitudes, each alone, in their own units: as much of it could be hidden.
    hidden: dict[CauseKey, dict[str, float]]
    explainable: dict[CauseKey, Float[np.ndarray, " C"]]  # τ_c of every cause that the trials can see (`costs`)
    offers: list[Offer]

    @cached_property
    def _offer_of(self) -> dict[tuple[Variant, ...], Offer]:
        return {o.variants: o for o in self.offers}

    @cached_property
    def _numbers(self) -> dict[tuple[CauseKey, ...], list[int]]:
        found: dict[tuple[CauseKey, ...], list[int]] = {}
        for n, offer in enumerate(self.offers):
            found.setdefault(offer.keys, []).append(n)
        return found

    def numbers_of(self, key: CauseKey) -> list[int]:
        """Numbers of the offers of one cause at its site alone."""
        return self._numbers.get((key,), [])

    def neighbours(self, offer: Offer) -> list[Offer]:
        """The offers whose shapes differ from an offer's in one that fits move, by one step of its grid."""
        first, found = offer.variants[0], []
        grids, shapes = first.effect.worth_trying(first.scales, first.site), first.effect.shape_parameters()
        for name, value in first.shape:
            grid = sorted(set(grids[name]))
            if shapes[name].moves == "not" or value not in grid:
                continue
            at = grid.index(value)
            for other in grid[max(at - 1, 0) : at] + grid[at + 1 : at + 2]:
                variants = tuple(v.with_shape(**{name: other}) for v in offer.variants)
                found += [self._offer_of[variants]] if variants in self._offer_of else []
        return found

    def rows_of(self, offer: Offer) -> list[Int[np.ndarray, " _k"]]:
        """Rows of every variant of an offer, with those that the trials do not see."""
        return [self.rows[v] for v in offer.variants]

    @property
    def keys(self) -> list[CauseKey]:
        """Causes that the trials can see."""
        return list(self.explainable)


def table_of(problem: Problem, baseline: Baseline, parts: Iterable[Part], together: bool = True) -> SignatureTable:
    """Collect the signatures of all candidates, and offer those that the trials can see.

    With `together` an effect is offered at all of its sites together, too.
    """
    project = Projector(problem, baseline.columns, Weights.plain(baseline.columns))
    rt = project.residual(problem.r)
    read = [part.variant_rows(project, rt, baseline.columns) for part in parts]
    items = [v for some, _ in read for v in some]
    signatures = ByColumn.joined(baseline.columns, [rows for _, rows in read])
    most = np.array([v.effect.amplitudes()[n].most / size for v in items for n, size in v.sizes.items()])
    norm, left, units, share = _visibility(baseline, project, signatures, most)
    seen = units > 0.0
    absorbed: dict[CauseKey, float] = {}
    hidden: dict[CauseKey, dict[str, float]] = {}
    explainable: dict[CauseKey, Float[np.ndarray, " C"]] = {}
    offers, rows, start = [], {}, 0
    for v in items:
        at = np.arange(start, start + len(v.sizes))
        start += len(v.sizes)
        rows[v] = at
        imitated = 1.0 - float(np.sum(left[at] ** 2) / max(np.sum(norm[at] ** 2), 1e-300))
        if norm[at].any() and imitated < absorbed.get(v.key, np.inf):
            absorbed[v.key] = imitated
            hidden[v.key] = {
                n: size / float(max(left[i], 1e-12 * norm[i]))
                for i, (n, size) in zip(at, v.sizes.items(), strict=True)
                if norm[i] > 0.0
            }
        bounds = [_bounds(v, n, float(units[i])) for i, n in zip(at, v.sizes, strict=True) if seen[i]]
        if bounds:
            low, high = np.array(bounds).T
            offers.append(Offer((v,), at[seen[at]], low, high))
            explainable[v.key] = np.maximum(explainable.get(v.key, 0.0), share[at].max(axis=0))
    offers += _at_all_sites(offers) if together else []
    return SignatureTable(signatures.scaled(units), rows, units, absorbed, hidden, explainable, offers)


class Visibility(NamedTuple):
    """Norms of M signatures z and of what the nominal parameters leave of them."""

    norm: Float[np.ndarray, " M"]  # ‖z‖, zero where it is rounding
    left: Float[np.ndarray, " M"]  # ‖z − Q Qᵀ z‖, what the nominal parameters leave
    # Amplitude at which what is left is as large as the gap, or the largest allowed one; zero: not visible.
    units: Float[np.ndarray, " M"]
    share: Float[np.ndarray, "M C"]  # of each column's gap, that the signature would explain at that amplitude


def _visibility(baseline: Baseline, project: Projector, Z: ByColumn, most: Float[np.ndarray, " M"]) -> Visibility:
    """Compare signatures with what the nominal parameters, which Q spans, leave of them.

    With orthonormal Q, ‖z − Q Qᵀ z‖² = ‖z‖² − ‖Qᵀ z‖². An amplitude is at most `most`; what stays below the noise even
    there is not visible.
    """
    columns, Q = baseline.columns, project.Q
    square, onto = np.zeros(Z.count), np.zeros((Q.shape[1], Z.count))
    for c, (index, values) in zip(columns.items, Z.nonzero, strict=True):
        square[index] += np.sum(values**2, axis=1)
        onto[:, index] += Q[c.rows].T @ values.T
    square[square < MIN_NORM**2] = 0.0
    rest = square - np.sum(onto**2, axis=0)
    norm, left = np.sqrt(square), np.sqrt(np.where(rest > MIN_UNABSORBED_ENERGY * square, rest, 0.0))
    units = np.minimum(baseline.gap / np.maximum(left, 1e-300), most)
    units = np.where((left > MIN_UNABSORBED * norm) & (left > 1.0 / most), units, 0.0)
    absorbed = np.concatenate([c.basis.T @ Q[c.rows] for c in columns.items]) @ onto
    energy = columns.sums((Z.B - absorbed) ** 2).T
    share = units[:, None] ** 2 * energy / np.maximum(baseline.null.linear_fit.evidence.e, 1e-300)
    return Visibility(norm, left, units, np.minimum(share, 1.0))


def _bounds(v: Variant, name: str, unit: float) -> tuple[float, float]:
    """Bounds of an amplitude, in prior standard deviations."""
    amplitude, one = v.effect.amplitudes()[name], v.sizes[name] * unit
    return amplitude.least / one, amplitude.most / one


def _at_all_sites(offers: list[Offer]) -> list[Offer]:
    """Offers of one effect in one shape at all of its sites together, from those at one site each."""
    groups: dict[tuple, list[Offer]] = {}
    for o in offers:
        (v,) = o.variants
        groups.setdefault((v.effect.ID, v.size, v.shape), []).append(o)
    out = []
    for group in groups.values():
        if len({o.keys for o in group}) == len(group) > 1:
            rows, low, high = (np.concatenate([getattr(o, n) for o in group]) for n in ("rows", "low", "high"))
            out.append(Offer(tuple(v for o in group for v in o.variants), rows, low, high))
    return out
