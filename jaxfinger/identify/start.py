"""Starting values of tendon friction, the only law of (1) with dead zones.

The loss min(max(a₀ + a₁ f, 0), f) has no derivative by a₀ and a₁ where it is zero at every tension, or where all of the
tension is lost. A search can neither start in such a zone nor leave it. So a few candidates, scaled by the highest
tension in the trials, are tried on the trials of each tendon, and the one of the lowest cost is the start.
"""

from dataclasses import replace

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxfinger.identify.linearise import white_of
from jaxfinger.identify.parameters import Parameter
from jaxfinger.identify.sources import Source, residuals_each
from jaxfinger.model import Model, TendonFriction

# Candidates for (a₀ over the highest tension, a₁). They span losses from 3 % to 80 % of the tension, and the forms of
# the law: proportional, constant, mixed, and with a negative a₀. The first is the start where all fit equally well.
LOSS_CANDIDATES = (
    *((0.0, 0.1), (0.0, 0.3), (0.0, 0.03), (0.0, 0.8)),
    *((0.1, 0.1), (0.1, 0.0), (0.03, 0.0), (0.4, 0.2), (-0.1, 0.5)),
)


def start_values(
    model: Model,
    free: Int[np.ndarray, " p"],
    parameters: list[Parameter],
    sources: dict[str, Source] | None = None,
) -> Model:
    """Set the friction of each tendon that is free and in a dead zone to the candidate that its trials fit best."""
    pulled = {e: s for e, s in (sources or {}).items() if _shows_friction(s, parameters)}
    highest = _highest(model, pulled)
    dead = [k for k in _free_tendons(model, free, parameters) if _is_dead(model, k, highest[k])]
    if not dead:
        return model
    tried = [_with_losses(model, dead, highest, shares) for shares in LOSS_CANDIDATES]
    if not pulled:
        return tried[0]
    costs = np.stack([_costs(m, pulled, dead) for m in tried])
    best = {k: LOSS_CANDIDATES[int(np.argmin(costs[:, j]))] for j, k in enumerate(dead)}
    for k, shares in best.items():
        model = _with_losses(model, [k], highest, shares)
    return model


def bounded_losses(
    model: Model, free: Int[np.ndarray, " p"], parameters: list[Parameter], highest: Float[np.ndarray, " n"]
) -> dict[str, str]:
    """Tendons whose friction is free and at a bound: `none` or `all` of the tension is lost, by name.

    That is so where it holds from half of the `highest` tension on (N; 0 where a tendon is not pulled): below, little
    torque comes that could tell.
    """
    friction = model.tendon_friction
    constant, proportional = np.asarray(friction.constant), np.asarray(friction.proportional)
    ends = {}
    for k in (k for k in _free_tendons(model, free, parameters) if highest[k] > 0.0):
        tension = highest[k] * np.array([0.5, 1.0])  # The loss is affine, so its ends tell.
        loss = constant[k] + proportional[k] * tension
        if np.all(loss <= 0.0) or np.all(loss >= tension):
            ends[model.finger.tendon_names[k]] = "none" if loss[-1] <= 0.0 else "all"
    return ends


def highest_tensions(model: Model, sources: dict[str, Source], parameters: list[Parameter]) -> Float[np.ndarray, " n"]:
    """Highest tension of each tendon, N, in the trials that show friction; 0 where none pulls it."""
    return _highest(model, {e: s for e, s in sources.items() if _shows_friction(s, parameters)})


def _shows_friction(source: Source, parameters: list[Parameter]) -> bool:
    return any(parameters[i].group == "tendon_friction" for i in source.positions)


def _free_tendons(model: Model, free: np.ndarray, parameters: list[Parameter]) -> list[int]:
    names = {parameters[i].tendon for i in free if parameters[i].group == "tendon_friction"}
    return [k for k, name in enumerate(model.finger.tendon_names) if name in names]


def _highest(model: Model, sources: dict[str, Source]) -> Float[np.ndarray, " n"]:
    """Highest tension of each tendon in these trials, N; zero where no trial pulls it."""
    none = np.zeros(model.finger.n)
    return np.max([none, *(np.asarray(s.batch.x.tension).max(axis=(1, 2)) for s in sources.values())], axis=0)


def _is_dead(model: Model, k: int, highest: float) -> bool:
    """Whether the tendon loses nothing at any tension up to the highest, or all of the highest."""
    friction = model.tendon_friction
    a0, a1 = (float(np.asarray(a)[k]) for a in (friction.constant, friction.proportional))
    nothing = a0 <= 0.0 and a0 + a1 * (highest or 1.0) <= 0.0
    return bool(nothing or 0.0 < highest <= a0 + a1 * highest)


def _with_losses(model: Model, tendons: list[int], highest: np.ndarray, shares: tuple[float, float]) -> Model:
    friction = model.tendon_friction
    constant, proportional = np.array(friction.constant), np.array(friction.proportional)
    constant[tendons], proportional[tendons] = shares[0] * highest[tendons], shares[1]
    return replace(model, tendon_friction=TendonFriction(*jax.device_put((constant, proportional))))


def _costs(model: Model, sources: dict[str, Source], tendons: list[int]) -> Float[np.ndarray, " k"]:
    """Cost ½ ‖white residuals‖² of each tendon, over the trials that pull it."""
    out = np.zeros(len(tendons))
    for e, residuals in residuals_each(model, sources).items():
        s = sources[e]
        cost = 0.5 * np.sum(white_of(residuals, s.batch, s.filters, s.reversals) ** 2, axis=1)
        pulls = np.asarray(s.batch.x.tension).max(axis=2) > 0.0  # (n, B)
        out += np.array([cost[pulls[k]].sum() for k in tendons])
    return out
