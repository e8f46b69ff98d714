"""Refit of a few candidates: amplitudes and shapes move, the nominal parameters with them.

Gauss–Newton on [nominal parameters, amplitudes, shapes] with signatures re-evaluated at each step and the nominal
parameters eliminated by projection: equation (1) is linear in them to a good approximation, but for slip and for large
effects. Signatures are read at the nominal model of the problem; the strongest rivals are then refitted at the nominal
model that each leads to (`relinearised`). The exact fit of the effects that a verdict names comes last (`augment`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from jaxfinger.effects import NOMINAL_TERMS, CatalogueEffect, Scales
from jaxfinger.gap.evidence import Projector
from jaxfinger.gap.problem import Problem, moved
from jaxfinger.gap.signatures import Signatures, Variant
from jaxfinger.identify.solve import bounded

STEPS = 10
STEP = 0.05  # of a difference, in units of a coordinate
FACTOR = 0.7  # logarithm of the most by which a step changes a shape
ROUNDS = 8  # of moving the nominal model and refitting there
SETTLED = 1.0  # change of the sum of squares below which it stays
MAY_LOSE = 0.1  # share of what is explained, that a step of the nominal model may lose; beyond it the step is halved
HALVINGS = 2
LARGE = 3.0  # plausible sizes: the width of the prior on an amplitude in the evidence, which has Cauchy's tails
WIDE = 10.0  # plausible sizes: the width of the prior that keeps amplitudes that no trial sees near nothing


@dataclass(frozen=True)
class Refined:
    """One set of effects, refitted together with the nominal parameters."""

    variants: tuple[Variant, ...]
    effects: tuple[CatalogueEffect, ...]  # at the optimum
    std: tuple[dict[str, float], ...]  # of every amplitude and moving shape, per effect
    chi2: float
    log_evidence: float  # Laplace, against the nominal model
    residual: Float[np.ndarray, " N"]  # white, at the optimum
    change: Float[np.ndarray, " N"]  # what the effects add to every row, at the optimum
    columns: Float[np.ndarray, "k N"]  # its derivatives by amplitudes and moving shapes

    @property
    def keys(self) -> tuple:
        """(effect, site) of each."""
        return tuple(v.key for v in self.variants)


@dataclass
class _Coordinate:
    effect: int
    name: str
    amplitude: bool
    unit: float  # plausible size, or step of the shape
    shifts: bool  # moves by differences, not by factors
    scales: Scales


def refine(
    problem: Problem,
    variants: list[Variant],
    start: list[dict[str, float]],
    chi2_null: float,
    projector: Projector | None = None,
) -> Refined:
    """The variants together, from amplitudes `start` (in their own units)."""
    finger = problem.nominal.finger
    effects = [within_bounds(v.at(finger, s), v.scales) for v, s in zip(variants, start, strict=True)]
    coordinates = _coordinates(variants)
    signatures, projector = Signatures(problem), projector or Projector(problem)
    reach = np.full(len(coordinates), STEP)
    base, slopes = _evaluate(signatures, effects, coordinates, reach)
    r = problem.r - base
    sizes = _sizes(effects, coordinates)
    cost = _cost(projector, problem, r) + float(sizes @ sizes)
    prior = _prior(coordinates)
    for _ in range(STEPS):
        rt = projector.residual(problem, r)
        St = projector(slopes)
        # Within bounds: what stays at one moves no other along as if it did not.
        A, b = np.vstack([St.T, np.diag(np.sqrt(prior))]), np.concatenate([-rt, sizes])
        delta = bounded(A, b, *_room(effects, coordinates))
        # No further than the trials resolve, where a sum of squares bends within a few per cent of a length.
        reach = np.clip(1.0 / np.maximum(np.linalg.norm(St, axis=1), 1e-300), STEP / 20.0, STEP)
        moved = False
        for _ in range(4):
            trial_effects = _moved(effects, coordinates, delta)
            trial_base, trial_slopes = _evaluate(signatures, trial_effects, coordinates, reach)
            trial_r = problem.r - trial_base
            trial_sizes = _sizes(trial_effects, coordinates)
            trial_cost = _cost(projector, problem, trial_r) + float(trial_sizes @ trial_sizes)
            if trial_cost < cost:
                moved = True
                break
            delta = delta / 3
        if not moved:
            break
        gain = cost - trial_cost
        effects, slopes, r, sizes, cost = trial_effects, trial_slopes, trial_r, trial_sizes, trial_cost
        if gain < 0.1 + 1e-4 * max(chi2_null - cost, 0.0):
            break
    St = projector(slopes)
    G = St @ St.T
    covariance = np.linalg.pinv(G + max(1e-12 * np.trace(G), 1e-20) * np.eye(len(G)), hermitian=True)
    std: list[dict[str, float]] = [{} for _ in variants]
    for c, v in zip(coordinates, np.sqrt(np.maximum(np.diag(covariance), 0.0)), strict=True):
        value = float(getattr(effects[c.effect], c.name))
        std[c.effect][c.name] = float(v * c.unit if c.shifts else v * value)
    chi2 = cost - float(sizes @ sizes)
    tails = float(np.sum(np.log1p(np.square(sizes * WIDE / LARGE))))
    occam = 0.5 * np.linalg.slogdet(np.eye(len(G)) + G)[1] + tails
    residual = projector.residual(problem, r)[: r.size]
    return Refined(
        tuple(variants),
        tuple(effects),
        tuple(std),
        chi2,
        float(0.5 * (chi2_null - chi2) - occam),
        residual,
        problem.r - r,
        slopes,
    )


def relinearised(problem: Problem, refined: Refined, chi2_null: float) -> tuple[Problem, Refined]:
    """The same effects with the nominal model where they lead it, and the problem there: what is left is then exact.

    A sensor's gain multiplies torques that are refitted with it, an encoder's offset shifts every polynomial of its
    joint: where effects are large, their products with the nominal parameters count. A share of a friction that its own
    refit takes to nothing grows without end: where a whole step loses what was explained, a part of it is taken. The
    best is kept where nothing settles.
    """
    least, best = np.inf, (problem, refined)
    for _ in range(ROUNDS):
        step = nominal_step(problem, problem.r - refined.change)
        here, effects, exact = _brought_along(problem, step, refined)
        if not abs(exact - refined.chi2) > SETTLED:
            return problem, refined
        if exact > least:
            break
        found = [(here, refine(here, *effects, chi2_null, Projector(here)))]
        least, best = exact, found[0]
        most = refined.chi2 + MAY_LOSE * (chi2_null - refined.chi2) + SETTLED
        while found[-1][1].chi2 > most and len(found) <= HALVINGS:
            step = step / 2
            here, effects, _ = _brought_along(problem, step, refined)
            found.append((here, refine(here, *effects, chi2_null, Projector(here))))
        problem, refined = min(found, key=lambda x: x[1].chi2)
    return best


def _brought_along(problem: Problem, step: Float[np.ndarray, " p"], refined: Refined):
    """The problem a step of the nominal model away; variants and amplitudes there, which change the rows as they did
    here (a share of a friction grows as that friction shrinks); and what they leave of the sum of squares.
    """
    here = moved(problem, step)
    signatures = Signatures(here)
    changes = np.concatenate([signatures.of([e]) for e in refined.effects])
    scale = np.linalg.lstsq(changes.T, refined.change, rcond=1e-9)[0]
    scale = np.where(scale > 0.0, scale, 1.0)
    left = here.r - scale @ changes
    items, starts = at_optimum(refined)
    starts = [{n: a * s for n, a in x.items()} for x, s in zip(starts, scale, strict=True)]
    return here, (items, starts), float(left @ left + here.offset @ here.offset)


def nominal_step(problem: Problem, r: np.ndarray) -> Float[np.ndarray, " p"]:
    """What the nominal parameters move by to absorb r."""
    A, b = np.vstack([problem.J, problem.root]), np.concatenate([r, -problem.offset])
    scale = np.linalg.norm(A, axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    return np.linalg.lstsq(A / scale, b, rcond=1e-7)[0] / scale


def at_optimum(refined: Refined) -> tuple[list[Variant], list[dict[str, float]]]:
    """Variants with the shapes that a refit found, and the amplitudes to start from."""
    items = [
        Variant(type(x), v.site, tuple((n, float(getattr(x, n))) for n in x.shape_parameters()), scales=v.scales)
        for v, x in zip(refined.variants, refined.effects, strict=True)
    ]
    return items, [{n: float(getattr(x, n)) for n in x.amplitudes()} for x in refined.effects]


def derivatives(signatures: Signatures, refined: Refined) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "k N"]]:
    """White change of other rows by the refitted effects, and its derivatives by amplitudes and moving shapes."""
    coordinates = _coordinates(refined.variants)
    return _evaluate(signatures, refined.effects, coordinates, np.full(len(coordinates), STEP))


def derivatives_by_name(refined: Refined) -> dict[str, Float[np.ndarray, " N"]]:
    """`columns` of one effect by the name of the parameter, in its own units."""
    (effect,), out = refined.effects, {}
    for c, column in zip(_coordinates(refined.variants), refined.columns, strict=True):
        out[c.name] = column / (c.unit if c.shifts else float(getattr(effect, c.name)))
    return out


def information(problem: Problem, refined: Refined) -> Float[np.ndarray, "p+k p+k"]:
    """What the trials and priors say of the nominal parameters and of the amplitudes and moving shapes together."""
    A, p = np.vstack([problem.J.T, refined.columns]), problem.J.shape[1]
    P = A @ A.T
    P[:p, :p] += problem.root.T @ problem.root
    P[p:, p:] += np.diag(_prior(_coordinates(refined.variants)))
    return P


def _sizes(effects, coordinates: list[_Coordinate]) -> Float[np.ndarray, " k"]:
    """Amplitudes in units of WIDE plausible sizes; zero for shapes.

    Zero too for a term that the recipe left out: it has the size of what it was.
    """
    return np.array(
        [
            float(getattr(effects[c.effect], c.name)) / (WIDE * c.unit)
            if c.amplitude and effects[c.effect].ID not in NOMINAL_TERMS
            else 0.0
            for c in coordinates
        ]
    )


def _coordinates(variants: Sequence[Variant]) -> list[_Coordinate]:
    out = []
    for i, v in enumerate(variants):
        out += [_Coordinate(i, n, True, unit, True, v.scales) for n, unit in v.sizes.items()]
        for n, values in v.effect.worth_trying(v.scales, v.site).items():
            moves = v.effect.shape_parameters()[n].moves
            if moves != "not" and len(values) > 1:
                shifts = moves == "by differences"
                unit = float(np.mean(np.abs(np.diff(np.sort(values))))) / 2 if shifts else 1.0
                out.append(_Coordinate(i, n, False, unit, shifts, v.scales))
    return out


def _prior(coordinates: list[_Coordinate]) -> Float[np.ndarray, " k"]:
    """Precision of amplitudes and shapes before any trial."""
    return np.array([WIDE**-2 if c.amplitude else 1.0 for c in coordinates])


def _shifted(effect: CatalogueEffect, c: _Coordinate, by: float) -> CatalogueEffect:
    value = float(getattr(effect, c.name))
    if c.shifts:
        value += by * c.unit
    else:
        value *= float(np.exp(np.clip(by, -FACTOR, FACTOR)))
    return within_bounds(replace(effect, **{c.name: jax.device_put(value)}), c.scales)


def within_bounds(effect: CatalogueEffect, scales: Scales) -> CatalogueEffect:
    """The effect with every number within its bounds."""
    values = {n: np.clip(float(getattr(effect, n)), *ends) for n, ends in effect.bounds(scales).items()}
    return replace(effect, **jax.device_put(values))


def _room(effects, coordinates: list[_Coordinate]) -> tuple[np.ndarray, np.ndarray]:
    """How far each coordinate may move, back and forth."""
    out = []
    for c in coordinates:
        value, ends = float(getattr(effects[c.effect], c.name)), effects[c.effect].bounds(c.scales)[c.name]
        ways = [(end - value) / c.unit if c.shifts else np.log(end / value) for end in ends]
        most = np.inf if c.shifts else FACTOR
        out.append((max(min(ways[0], 0.0), -most), min(max(ways[1], 0.0), most)))
    low, high = np.array(out).T
    return low, high


def _moved(effects, coordinates, delta):
    out = list(effects)
    for c, d in zip(coordinates, delta, strict=True):
        out[c.effect] = _shifted(out[c.effect], c, float(d))
    return out


def _evaluate(signatures: Signatures, effects, coordinates, reach: Float[np.ndarray, " k"]):
    """White change by all effects, and its derivatives by every coordinate, as differences over its `reach`."""
    size = signatures.problem.r.size
    base, slopes = np.zeros(size), np.zeros((len(coordinates), size))
    for i, effect in enumerate(effects):
        mine = [k for k, c in enumerate(coordinates) if c.effect == i]
        members = [effect] + [_beside(effect, coordinates[k], reach[k]) for k in mine]
        flat = signatures.of(members)
        base += flat[0]
        for row, k in enumerate(mine, start=1):
            step = _step_taken(effect, members[row], coordinates[k])
            slopes[k] = (flat[row] - flat[0]) / step if step else 0.0
    return base, slopes


def _beside(effect: CatalogueEffect, c: _Coordinate, h: float) -> CatalogueEffect:
    """A step for a difference: back where a bound leaves no way forward."""
    ahead = _shifted(effect, c, h)
    return ahead if float(getattr(ahead, c.name)) != float(getattr(effect, c.name)) else _shifted(effect, c, -h)


def _step_taken(before, after, c: _Coordinate) -> float:
    a, b = float(getattr(before, c.name)), float(getattr(after, c.name))
    return (b - a) / c.unit if c.shifts else float(np.log(b / a))


def _cost(projector, problem, r) -> float:
    rt = projector.residual(problem, r)
    return float(rt @ rt)
