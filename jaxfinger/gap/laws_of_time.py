"""Noise of repeats, without what a law of the session's time makes of them.

Noise is best estimated from trials that repeat one motion. A sensor that drifts, or a joint that warms up, makes
repeats differ, and so counts as noise; what lies below the noise is no evidence for it. Here such laws are first fitted
to the differences of repeats alone, where neither the nominal model nor other effects have a share.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.effects import CatalogueEffect
from jaxfinger.experiments import differs_in_repeats
from jaxfinger.gap.problem import MAX_ROUNDS, Problem, with_noise
from jaxfinger.gap.screening import Scan, explained
from jaxfinger.gap.signatures import Signatures, Variant, variants
from jaxfinger.identify import Fit
from jaxfinger.identify.noise import MIN_SAMPLES_OF_REPEAT, Noise, estimate, repeated_motions

# Steps of a second scan for periods, in those of the first. The phase at a session's ends is then wrong by a 32nd of a
# turn at most, instead of an eighth.
FINER_STEP = 0.25


@dataclass(frozen=True)
class Repeats:
    """Deviations of white rows from their mean over the repeats of a motion, in channels whose noise they tell."""

    rows: tuple[Int[np.ndarray, "_repeats _n"], ...]  # of each motion; the same sample of each repeat in one column

    @classmethod
    def of(cls, problem: Problem) -> "Repeats":
        """Find the rows of all motions that are repeated."""
        found = []
        for e, rows in problem.rows.items():
            stack = problem.stacks[e]
            told = np.array([problem.noise[e, c].of_repeats for c in stack.experiment.channels])
            number = np.where(told[rows.channel], rows.start + np.arange(rows.size), -1)
            place = np.full((len(stack.trials), len(told), rows.column.max(initial=0) + 1, stack.holds.shape[1]), -1)
            place[rows.trial, rows.channel, rows.column, rows.time] = number
            for members in repeated_motions(stack):
                mine = place[members].reshape(len(members), -1)
                common = mine[:, (mine >= 0).all(axis=0)]
                if common.shape[1] >= MIN_SAMPLES_OF_REPEAT:
                    found.append(common)
        return cls(tuple(found))

    def deviations(self, white: Float[np.ndarray, "*k N"]) -> list[Float[np.ndarray, "*k _n"]]:
        """Deviations of white rows from the means over repeats, for each motion."""
        each = [white[..., rows] for rows in self.rows]
        return [(x - x.mean(axis=-2, keepdims=True)).reshape(*x.shape[:-2], -1) for x in each]


@dataclass(frozen=True)
class LawOfTime:
    """One cause that may make repeats differ: its signatures in their deviations, by choices of its shapes.

    Signatures are per plausible size of an amplitude, and the prior of that is N(0, 1).
    """

    items: list[Variant]
    scan: Scan | None  # of its periods, if it has any
    rows: list[Float[np.ndarray, "M _n"]]  # signatures in the deviations of each motion
    sets: Int[np.ndarray, "S k"]  # the rows of each choice of shapes

    @classmethod
    def of(cls, signatures: Signatures, repeats: Repeats, items: list[Variant]) -> "LawOfTime":
        """Read the signatures of a cause in all shapes; of one with periods, in its first other shapes."""
        scan = Scan.of(signatures, items) if items[0].effect.periods() else None
        if scan is None:
            white = signatures.per_amplitude(items)
            sets = np.arange(white.shape[0] * white.shape[1]).reshape(white.shape[:2])
            white = white.reshape(sets.size, -1)
        else:
            white, sets = scan.rows, scan.sets
        return cls(items, scan, repeats.deviations(white), sets)

    def evidence(self, r: list[Float[np.ndarray, " _n"]]) -> float:
        """Log evidence of the cause in the deviations r of each motion, as far as the other motions foretell them.

        Shapes and amplitudes that are fitted to all other motions take an energy from this one, which is honest however
        slow the noise is. Half of the sum over motions counts, less Schwarz's (1978) cost of the amplitudes and the
        logarithm of the number of choices.
        """
        (G, b), gain = _products(self.rows, r), 0.0
        for A, x in zip(self.rows, r, strict=True):
            energy, amplitudes = explained(G - A @ A.T, b - A @ x, self.sets, 1.0)
            best = np.argmax(energy)
            gain += float(x @ x - np.sum((x - amplitudes[best] @ A[self.sets[best]]) ** 2))
        S, k = self.sets.shape
        return 0.5 * gain - 0.5 * k * np.log(sum(x.size for x in r)) - np.log(S)

    def fitted(
        self, signatures: Signatures, repeats: Repeats, r: list[Float[np.ndarray, " _n"]]
    ) -> tuple[CatalogueEffect, list[Float[np.ndarray, " _n"]]]:
        """The effect in its best shapes, fitted to the deviations by least squares, and what it leaves of them."""
        best = _best(signatures, repeats, self.items_with_periods(r), r)
        if self.scan is not None:
            best = _best(signatures, repeats, self.periods_near(best.variant, self.scan.periods[0]), r)
        v = best.variant
        sizes = {n: a * size for a, (n, size) in zip(best.amplitudes, v.sizes.items(), strict=True)}
        left = [x - best.amplitudes @ A for x, A in zip(r, best.rows, strict=True)]
        return v.at(signatures.problem.nominal.finger, sizes), left

    def items_with_periods(self, r: list[Float[np.ndarray, " _n"]]) -> list[Variant]:
        """The cause in all shapes, with the periods of the scan that explain most of the deviations."""
        if self.scan is None:
            return self.items
        energy, _ = explained(*_products(self.rows, r), self.sets, 1.0)
        shape = {"middle": self.scan.middle} | self.scan.periods_of(self.sets[np.argmax(energy)])
        return [v.with_shape(**shape) for v in self.items]

    def periods_near(self, v: Variant, longest: float) -> list[Variant]:
        """A variant with frequencies up to half a step of the scan away, whose step is 1 / `longest`."""
        steps = {name: longest / dict(v.shape)[name] for name in v.effect.periods()}
        near = product(*([n + k * FINER_STEP for k in (-2, -1, 0, 1, 2)] for n in steps.values()))
        return [v.with_shape(**{name: longest / n for name, n in zip(steps, ns, strict=True)}) for ns in near]


class Fitted(NamedTuple):
    """A variant fitted to deviations of repeats."""

    left: float  # energy
    variant: Variant
    amplitudes: Float[np.ndarray, " k"]  # in plausible sizes
    rows: list[Float[np.ndarray, "k _n"]]


def _best(signatures: Signatures, repeats: Repeats, items: list[Variant], r: list[Float[np.ndarray, " _n"]]) -> Fitted:
    """The variant that leaves least of the deviations, fitted by least squares with the amplitudes' prior."""
    fits = []
    for v, white in zip(items, signatures.per_amplitude(items), strict=True):
        rows = repeats.deviations(white)
        G, b = _products(rows, r)
        amplitudes = np.linalg.solve(G + np.eye(len(b)), b)
        left = sum(float(np.sum((x - amplitudes @ A) ** 2)) for x, A in zip(r, rows, strict=True))
        fits.append(Fitted(left, v, amplitudes, rows))
    return min(fits, key=lambda fit: fit.left)


def _products(
    rows: list[Float[np.ndarray, "M _n"]], r: list[Float[np.ndarray, " _n"]]
) -> tuple[Float[np.ndarray, "M M"], Float[np.ndarray, " M"]]:
    """A Aᵀ and A r over all motions."""
    return np.sum([A @ A.T for A in rows], axis=0), np.sum([A @ x for A, x in zip(rows, r, strict=True)], axis=0)


def without_laws_of_time(
    problem: Problem, candidates: Mapping[str, type[CatalogueEffect]], against: Fit | None = None
) -> Problem:
    """The problem with the noise that repeats show once the candidates' laws of the session's time are taken away.

    Laws are taken one by one, the one with the most evidence first, as long as one has any. They are fitted again with
    the noise that they leave, until no standard deviation changes by `problem.NOISE_CHANGE`. The problem itself is
    returned where no law has any evidence. `against`: as in `problem.build`.
    """
    finger = problem.nominal.finger
    of_time = {k: kind for k, kind in candidates.items() if differs_in_repeats(kind, finger)}
    repeats = Repeats.of(problem)
    if not of_time or len(repeats.rows) < 2:
        return problem
    for _ in range(MAX_ROUNDS):
        quieter = with_noise(problem, _noise_without(problem, _laws(problem, repeats, of_time)), against)
        if quieter is problem:
            break
        problem = quieter
    return problem


def _laws(problem: Problem, repeats: Repeats, of_time: Mapping[str, type[CatalogueEffect]]) -> list[CatalogueEffect]:
    """The effects that make repeats differ, each fitted to what those before it leave."""
    signatures, groups = Signatures(problem), {}
    for v in variants(of_time, problem.nominal.finger, problem.scales):
        groups.setdefault(v.key, []).append(v)
    causes = {key: LawOfTime.of(signatures, repeats, items) for key, items in groups.items()}
    r, found = repeats.deviations(problem.r), []
    while causes:
        evidence = {key: cause.evidence(r) for key, cause in causes.items()}
        best = max(causes, key=evidence.__getitem__)
        if evidence[best] <= 0.0:
            break
        law, r = causes.pop(best).fitted(signatures, repeats, r)
        found.append(law)
    return found


def _noise_without(problem: Problem, laws: list[CatalogueEffect]) -> dict[tuple[str, str], Noise]:
    """Noise of the channels that these effects change and repeats tell, estimated without the effects."""
    left = {}
    for law in laws:
        for e, c, change in Signatures(problem).changes([law]):
            if problem.noise[e, c].of_repeats:
                y = np.asarray(problem.stacks[e].batch.y[c])
                left[e, c] = left.get((e, c), y - problem.predicted[e, c]) - change[0]
    return {(e, c): estimate(problem.stacks[e], c, residual) for (e, c), residual in left.items()}
