"""Screening: the evidence of every candidate, linearly, against what is left to explain."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from jaxfinger.gap.evidence import Evidence, Projector, evidence
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signatures import Signatures, Variant, by_class

Progress = Callable[[str], None]

THREADS = 2
SHORTEST = 20.0  # s: the shortest period that is looked for


@dataclass(frozen=True)
class Scan:
    """Finds the periods in the session's time that variants of one effect and site leave open.

    As in a periodogram (Lomb 1976, Scargle 1982): where a session lasts L, valleys of a sum of squares lie 1/L apart.
    """

    items: list[Variant]
    periods: Float[np.ndarray, " n"]  # s
    middle: float  # s
    columns: Float[np.ndarray, "k+2n N"]  # signatures of the k amplitudes without a period, and of both of every period

    @classmethod
    def of(cls, signatures: Signatures, items: list[Variant]) -> "Scan":
        """All signatures, read once."""
        effect = items[0].effect
        problem, finger = signatures.problem, signatures.nominal.finger
        times = [problem.stacks[e].batch.x.session_time for e in effect.SHOWS if e in problem.stacks]
        start, end = min(map(np.min, times)), max(map(np.max, times))
        half = 0.5 / (end - start)
        fewest, middle = len(effect.PERIODS) + 0.5, float(start + end) / 2.0
        periods = 1.0 / np.arange(half, max(1.0 / SHORTEST, fewest * half), half)
        name, pair = next(iter(effect.PERIODS.items()))
        shape = dict(items[0].shape) | {"middle": middle}
        paired = {a for names in effect.PERIODS.values() for a in names}
        one = [({}, a) for a in effect.AMPLITUDES if a not in paired] + [({name: p}, a) for p in periods for a in pair]
        members = [
            effect.at(finger, items[0].site, **shape | period, **{a: effect.AMPLITUDES[a][1]}) for period, a in one
        ]
        return cls(items, periods, middle, signatures.of(members))

    def best(self, projector: Projector, rt: Float[np.ndarray, " N+prior"]) -> list[Variant]:
        """The variants with the periods that explain most together."""
        names = list(self.items[0].effect.PERIODS)
        A = projector(self.columns)
        A = A / np.maximum(np.linalg.norm(A, axis=1, keepdims=True), 1e-300)
        G, b, first = A @ A.T + 1e-9 * np.eye(len(A)), A @ rt, len(A) - 2 * len(self.periods)
        sets = np.array(list(combinations(range(len(self.periods)), len(names))))
        pairs = (first + 2 * sets[:, :, None] + np.arange(2)).reshape(len(sets), -1)
        kept = np.column_stack([np.tile(np.arange(first), (len(sets), 1)), pairs])
        solved = np.linalg.solve(G[kept[:, :, None], kept[:, None, :]], b[kept][:, :, None])
        best = sets[np.argmax(np.sum(b[kept] * solved[:, :, 0], axis=1))]
        shape = dict(zip(names, self.periods[best].tolist(), strict=True)) | {"middle": self.middle}
        return [Variant(v.effect, v.site, tuple((dict(v.shape) | shape).items()), v.size) for v in self.items]


@dataclass(frozen=True)
class Screening:
    """Signatures of every variant, read once and weighed against whatever is left."""

    signatures: Signatures
    groups: dict[str, list[Variant]]  # by effect
    columns: dict[str, Float[np.ndarray, "variants amplitudes N"]]
    scans: list[Scan]

    @classmethod
    def of(cls, problem: Problem, items: list[Variant], progress: Progress = lambda message: None) -> "Screening":
        """Signatures at the problem's nominal model; classes are compiled side by side."""
        signatures = Signatures(problem, problem.nominal)
        groups, columns, scans = by_class(items), {}, {}

        def read(name: str):
            effect = groups[name][0].effect
            if effect.PERIODS and any(e in problem.stacks for e in effect.SHOWS):
                return scans, [Scan.of(signatures, open_ones) for open_ones in _by_site(groups[name])]
            return columns, signatures.columns(groups[name])

        _ = signatures._groups
        with ThreadPoolExecutor(THREADS) as pool:
            for name, (into, what) in zip(groups, pool.map(read, groups), strict=True):
                into[name] = what
                progress(f"signatures of {name} ({len(columns) + len(scans)} of {len(groups)} effects)")
        return cls(signatures, groups, columns, [scan for found in scans.values() for scan in found])

    def __call__(self, projector: Projector, rt: Float[np.ndarray, " N+prior"]) -> list[Evidence]:
        """Evidence of every variant, strongest first."""
        found = [self._weighed(self.groups[name], Z, projector, rt) for name, Z in self.columns.items()]
        for scan in self.scans:
            items = scan.best(projector, rt)
            found.append(self._weighed(items, self.signatures.columns(items), projector, rt))
        return sorted((e for group in found for e in group), key=lambda e: -e.log_bf)

    def of_candidate(self, e: Evidence) -> Float[np.ndarray, "amplitudes N"]:
        """Signatures of its variant."""
        v = e.variant
        if v.effect.ID in self.columns:
            return self.columns[v.effect.ID][self.groups[v.effect.ID].index(v)]
        return self.signatures.columns([v])[0]

    @staticmethod
    def _weighed(items, Z, projector: Projector, rt) -> list[Evidence]:
        Zt = projector(Z.reshape(-1, Z.shape[-1])).reshape(*Z.shape[:2], -1)
        return [evidence(v, z, zt, rt) for v, z, zt in zip(items, Z, Zt, strict=True)]


def _by_site(items: list[Variant]) -> list[list[Variant]]:
    sites = dict.fromkeys(v.site for v in items)
    return [[v for v in items if v.site == site] for site in sites]


def by_site(found: list[Evidence]) -> dict[tuple, Evidence]:
    """The strongest variant of each effect and site, strongest first."""
    best: dict[tuple, Evidence] = {}
    for e in found:
        best.setdefault(e.variant.key, e)
    return best
