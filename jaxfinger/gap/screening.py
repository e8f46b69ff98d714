"""Signatures of every candidate at the nominal model, read once before the search.

Shapes are tried on the grid of each effect. Periods in the session's time are scanned for instead, since the residual's
sum of squares has a narrow valley for each.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.compilation import side_by_side
from jaxfinger.experiments import affected_channels
from jaxfinger.gap.by_column import ByColumn
from jaxfinger.gap.columns import Columns
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signatures import CHUNK, Signatures, Variant, own, placed
from jaxfinger.progress import Progress

MIN_PERIOD = 20.0  # s. Drifts take minutes; shorter periods are those of the motion itself.
# Limits memory. In sessions longer than 50 minutes the shortest period therefore grows with the session.
MAX_PERIODS = 300
RIDGE = 1e-9  # relative. Keeps products of nearly collinear rows invertible.

# Projection of k rows of N numbers off the nominal parameters; the prior's rows come after the N (`projector`).
Project = Callable[[Float[np.ndarray, "k N"]], Float[np.ndarray, "k rows"]]
VariantRows = tuple[list[Variant], ByColumn]  # variants, and one row for each amplitude of each


@dataclass(frozen=True)
class FixedShapes:
    """Variants whose shapes are fixed, with their signatures."""

    items: list[Variant]
    rows: ByColumn

    @classmethod
    def of(cls, signatures: Signatures, items: list[Variant], columns: Columns) -> "FixedShapes":
        """Read the signatures of `items`, CHUNK at a time, since hundreds of whole rows would take gigabytes."""
        parts = [items[k : k + CHUNK] for k in range(0, len(items), CHUNK)]
        return cls(items, ByColumn.joined(columns, [by_column(signatures, part, columns) for part in parts]))

    def variant_rows(self, project: Project, rt: Float[np.ndarray, " rows"], columns: Columns) -> VariantRows:
        """All variants and their rows, whatever the residual."""
        return self.items, self.rows


@dataclass(frozen=True)
class Scan:
    """Variants of one effect and site, whose periods in the session's time are to be found.

    In a session of length L the valleys of a sum of squares lie 1/L apart in frequency, as in a periodogram (Lomb 1976,
    Scargle 1982). The scan takes frequencies 1/(2L) apart.
    """

    signatures: Signatures
    items: list[Variant]
    periods: Float[np.ndarray, " n"]  # s, descending
    middle: float  # s, session time from which phases count
    rows: Float[np.ndarray, "members N"]  # signatures of amplitudes without a period, then of the pair of every period

    @classmethod
    def of(cls, signatures: Signatures, items: list[Variant]) -> "Scan":
        """Read the signatures of an effect at one site for all periods of the scan."""
        effect, site = items[0].effect, items[0].site
        stacks, finger = signatures.problem.stacks, signatures.problem.nominal.finger
        where = affected_channels(effect, finger)
        times = np.concatenate([np.ravel(stacks[e].batch.x.session_time) for e in where if e in stacks])
        start, end = float(times.min()), float(times.max())
        longest, middle = 2.0 * max(end - start, MIN_PERIOD), (start + end) / 2.0
        periods = longest / np.arange(1, int(np.clip(longest / MIN_PERIOD, len(effect.periods()), MAX_PERIODS)) + 1)
        shape = dict(items[0].shape) | {"middle": middle}
        size = items[0].sizes
        name, pair = next(iter(effect.periods().items()))
        without = set(size).difference(*effect.periods().values())
        members = [shape | {a: size[a]} for a in size if a in without]
        members += [shape | {name: period, a: size[a]} for period in periods for a in pair]
        there, none = placed(items, finger)[site], dict.fromkeys(size, 0.0)
        rows = signatures.white_changes([there.with_values(**none | values) for values in members])
        return cls(signatures, items, periods, middle, rows)

    def variant_rows(self, project: Project, rt: Float[np.ndarray, " rows"], columns: Columns) -> VariantRows:
        """All variants, with the periods that explain most of the projected residual `rt`."""
        shape = {"middle": self.middle} | self.best(project, rt)
        items = [v.with_shape(**shape) for v in self.items]
        return items, by_column(self.signatures, items, columns)

    @property
    def sets(self) -> Int[np.ndarray, "S k"]:
        """Rows of every set of periods: the amplitudes without a period, and the pairs of its periods."""
        n, each = len(self.periods), len(self.items[0].effect.periods())
        sets = np.array(list(combinations(range(n), each)))
        k = len(self.rows) - 2 * n  # The first k rows have no period.
        pairs = (k + 2 * sets[:, :, None] + np.arange(2)).reshape(len(sets), -1)
        return np.column_stack([np.tile(np.arange(k), (len(sets), 1)), pairs])

    def periods_of(self, chosen: Int[np.ndarray, " k"]) -> dict[str, float]:
        """Periods, s, by shape, of one of the `sets`."""
        names, n = list(self.items[0].effect.periods()), len(self.periods)
        pairs = chosen[-2 * len(names) :: 2] - (len(self.rows) - 2 * n)
        return dict(zip(names, self.periods[pairs // 2].tolist(), strict=True))

    def best(self, project: Project, rt: Float[np.ndarray, " rows"]) -> dict[str, float]:
        """Periods, s, by shape: of all sets of the scan's periods that which explains most of `rt` by least squares."""
        A = project(self.rows)
        A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
        return self.periods_of(self.sets[np.argmax(explained(A @ A.T, A @ rt, self.sets, RIDGE)[0])])


def explained(
    G: Float[np.ndarray, "M M"], b: Float[np.ndarray, " M"], sets: Int[np.ndarray, "S k"], precision: float
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, "S k"]]:
    """What each set of rows A explains of r by least squares, and its amplitudes, from G = A Aᵀ and b = A r.

    `precision`: of the amplitudes' prior, whose mean is zero.
    """
    within = G[sets[:, :, None], sets[:, None, :]] + precision * np.eye(sets.shape[1])
    amplitudes = np.linalg.solve(within, b[sets][:, :, None])[:, :, 0]
    return np.sum(b[sets] * amplitudes, axis=1), amplitudes


Part = FixedShapes | Scan


def by_column(signatures: Signatures, items: list[Variant], columns: Columns) -> ByColumn:
    """Signatures of variants of one class per plausible size, one row for each amplitude of each."""
    rows = signatures.per_amplitude(items)
    return ByColumn.of(columns, rows.reshape(-1, rows.shape[-1]))


def read_parts(
    problem: Problem, items: list[Variant], columns: Columns, progress: Progress = lambda message: None
) -> Iterator[Part]:
    """Read the signatures of all variants at the problem's nominal model; classes are compiled side by side.

    Raises:
        UserError: an effect of the user's predicts no numbers, acts at zero amplitude, or alike at two joints.
    """
    signatures, groups = Signatures(problem), {}
    for kind in dict.fromkeys(v.effect for v in items if own(v.effect)):
        signatures.refuse_odd(kind, problem.scales)
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
    """Group of variants that are read together: one class, and one site if it has periods."""
    return (v.effect.ID, v.site) if v.effect.periods() else (v.effect.ID,)
