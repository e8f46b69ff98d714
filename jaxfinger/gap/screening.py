"""Screening: the signatures of every candidate, read once."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from jaxfinger.compilation import side_by_side
from jaxfinger.experiments import affected_channels
from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signatures import CHUNK, Signatures, Variant
from jaxfinger.identify.stages import Progress

SHORTEST = 20.0  # s: the shortest period that is looked for
MOST = 300  # periods: beyond 50 minutes the shortest grows with the session, for memory's sake
RIDGE = 1e-9  # relative, of products of columns


@runtime_checkable
class Project(Protocol):
    """Rows off what the nominal parameters can absorb: the N of the trials, then the prior's."""

    def __call__(self, x: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "k rows"]:
        """Of signatures."""
        ...


VariantRows = tuple[list[Variant], ByColumn]  # a row an amplitude of each


@dataclass(frozen=True)
class FixedShapes:
    """Variants whose shapes are fixed, with their signatures."""

    items: list[Variant]
    rows: ByColumn

    @classmethod
    def of(cls, signatures: Signatures, items: list[Variant], columns: Columns) -> "FixedShapes":
        """Some at a time: whole rows of hundreds take gigabytes."""
        parts = [items[k : k + CHUNK] for k in range(0, len(items), CHUNK)]
        return cls(items, ByColumn.joined(columns, [by_column(signatures, part, columns) for part in parts]))

    def variant_rows(self, projector: Project, rt: Float[np.ndarray, " rows"], columns: Columns) -> VariantRows:
        """All of them, whatever is left."""
        return self.items, self.rows


@dataclass(frozen=True)
class Scan:
    """Variants of one effect and site whose periods in the session's time are open.

    As in a periodogram (Lomb 1976, Scargle 1982): where a session lasts L, valleys of a sum of squares lie 1/L apart in
    frequency, and the scan takes half of that.
    """

    signatures: Signatures
    items: list[Variant]
    periods: Float[np.ndarray, " n"]  # s
    middle: float  # s
    # Signatures of the amplitudes without a period, and of both of every period.
    rows: Float[np.ndarray, "members N"]

    @classmethod
    def of(cls, signatures: Signatures, items: list[Variant]) -> "Scan":
        """All signatures, read once."""
        effect, site = items[0].effect, items[0].site
        stacks, finger = signatures.problem.stacks, signatures.problem.nominal.finger
        where = affected_channels(effect, finger)
        times = np.concatenate([np.ravel(stacks[e].batch.x.session_time) for e in where if e in stacks])
        start, end = float(times.min()), float(times.max())
        longest, middle = 2.0 * max(end - start, SHORTEST), (start + end) / 2.0
        periods = longest / np.arange(1, int(np.clip(longest / SHORTEST, len(effect.periods()), MOST)) + 1)
        shape = dict(items[0].shape) | {"middle": middle}
        size = items[0].sizes
        name, pair = next(iter(effect.periods().items()))
        without = set(size).difference(*effect.periods().values())
        members = [shape | {a: size[a]} for a in size if a in without]
        members += [shape | {name: period, a: size[a]} for period in periods for a in pair]
        rows = signatures.white_changes([effect.at(finger, site, **values) for values in members])
        return cls(signatures, items, periods, middle, rows)

    def variant_rows(self, projector: Project, rt: Float[np.ndarray, " rows"], columns: Columns) -> VariantRows:
        """Every variant with those periods that explain most together."""
        shape = {"middle": self.middle} | self.best(projector, rt)
        items = [v.with_shape(**shape) for v in self.items]
        return items, by_column(self.signatures, items, columns)

    def best(self, projector: Project, rt: Float[np.ndarray, " rows"]) -> dict[str, float]:
        """The periods, s, by least squares over all sets of them."""
        names, n = list(self.items[0].effect.periods()), len(self.periods)
        A = projector(self.rows)
        A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
        G, b, k = A @ A.T + RIDGE * np.eye(len(A)), A @ rt, len(A) - 2 * n
        sets = np.array(list(combinations(range(n), len(names))))
        pairs = (k + 2 * sets[:, :, None] + np.arange(2)).reshape(len(sets), -1)
        rows = np.column_stack([np.tile(np.arange(k), (len(sets), 1)), pairs])
        amplitudes = np.linalg.solve(G[rows[:, :, None], rows[:, None, :]], b[rows][:, :, None])[:, :, 0]
        most = np.argmax(np.sum(b[rows] * amplitudes, axis=1))
        return dict(zip(names, self.periods[sets[most]].tolist(), strict=True))


Part = FixedShapes | Scan


def by_column(signatures: Signatures, items: list[Variant], columns: Columns) -> ByColumn:
    """Signatures per plausible size, a row an amplitude of each of the variants, which are of one class."""
    rows = signatures.per_amplitude(items)
    return ByColumn.of(columns, rows.reshape(-1, rows.shape[-1]))


def read_parts(
    problem: Problem, items: list[Variant], columns: Columns, progress: Progress = lambda message: None
) -> Iterator[Part]:
    """Signatures of every candidate at the problem's nominal model. Classes of effects are compiled side by side."""
    signatures, groups = Signatures(problem), {}
    for v in items:
        groups.setdefault(_part(v), []).append(v)

    def read(group: list[Variant]) -> Part:
        effect = group[0].effect
        if effect.periods() and any(e in problem.stacks for e in affected_channels(effect, problem.nominal.finger)):
            return Scan.of(signatures, group)
        return FixedShapes.of(signatures, group, columns)

    for count, (key, part) in enumerate(zip(groups, side_by_side(read, groups.values()), strict=True), start=1):
        progress(f"signatures of {key[0]} ({count} of {len(groups)} effects)")
        yield part


def _part(v: Variant) -> tuple:
    """What is read together: a class of effects, and one site where its periods are open."""
    return (v.effect.ID, v.site) if v.effect.periods() else (v.effect.ID,)
