"""The one seam to optimistix: least squares on compressed trials.

    min_θ  Σ_trials ‖white residuals‖² + ‖W (θ − μ)‖²

1. Each experiment is linearised and compressed at the current model (`linearise`).
2. The stacked factors are scaled by columns; their singular vectors say which combinations of parameters the trials
   can see. The rest stays where it was, and is named.
3. optimistix solves in coordinates z along the visible singular vectors, θ = θ_k + B z, in which the Gauss–Newton
   matrix is the identity. Most of equation (1) is linear in its parameters: one step, whatever the conditioning of θ.
4. Where it is not (slip of held tendons, products of moment arms and losses) the model is linearised again at the new
   point, and a step that did not lower the cost is cut to where a parabola through both ends is lowest, until a
   step is a small part of a standard deviation, or a whole one that is a tenth of it leads no further down.
5. A mass that would fall to nothing stays on its floor, and what has limits within them, while the others are
   minimised with it there.
6. Outliers: Huber's weights from the white residuals at the optimum, then again from 1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int
from scipy.optimize import lsq_linear

from jaxfinger.compilation import side_by_side
from jaxfinger.errors import UserError
from jaxfinger.experiments import Batch
from jaxfinger.identify.linearise import Filters, Linearised, linearise, missed
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.model import Model

VISIBLE = 1e-7  # relative singular value of the column-scaled Jacobian below which a combination is not seen
SMALL = 0.02  # a step this small, in standard deviations of the estimate, ends the iteration
KINK = 0.1  # likewise one that does not lower the cost: what is left is a kink, where a tendon slips or a joint turns
STEPS = 40
LIGHTEST = 0.02  # share of its starting value below which no mass is let to fall
REMEMBERED = 5  # steps that the next one is mixed with
PAD = 48  # compressed problems are padded to multiples of this, to share compilations


class Prior(NamedTuple):
    """Gaussian prior rows `root (θ − mean)` on the free parameters; `root` is a square root of the precision."""

    mean: Float[np.ndarray, " p"]
    root: Float[np.ndarray, "rows p"]


class Source(NamedTuple):
    """One experiment as a fit reads it: its data, its whitening, and the parameters that it depends on."""

    batch: Batch
    filters: Filters
    positions: Int[np.ndarray, " k"]  # in the flat vector, ascending
    effects: bool = True  # whether the model's effects show in it, if it has any

    def seen(self, model: Model) -> Model:
        """The model as the experiment shows it: what does not show is not compiled."""
        return model if self.effects or not model.effects else eqx.tree_at(lambda m: m.effects, model, ())


@dataclass(frozen=True)
class Solution:
    """A least-squares estimate at its optimum."""

    converged: bool
    message: str
    cost: float  # half the sum of squared white residuals, weights included, priors apart
    rows: int  # white residuals that count
    information: Float[np.ndarray, "P P"]  # JᵀJ over the whole flat vector, priors apart
    invisible: Float[np.ndarray, "k p"]  # unit combinations of scaled parameters that neither trials nor prior see
    scale: Float[np.ndarray, " p"]
    outliers: float  # share of white residuals beyond the robust limit
    linearised: dict[str, Linearised]

    def chi2_per_row(self, estimated: int) -> float:
        """1 where model and noise are right, with so many parameters estimated."""
        return 2.0 * self.cost / max(1, self.rows - estimated)


def solve(
    model: Model,
    free: Int[np.ndarray, " p"],
    sources: dict[str, Source],
    prior: Prior | None = None,
    huber: float = 0.0,
    limits: tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]] | None = None,
) -> tuple[Model, Solution]:
    """The model with its free parameters (positions in the flat vector) at the optimum, and what is known of it.

    `limits`: of each free parameter, below and above; what starts outside of them stays until a step leads back.

    Raises:
        UserError: the model is not defined at its start.
    """
    size = ravel(model).size
    moved = Free.at(model, free)
    theta = np.asarray(moved.get(model))
    masses = np.array([p.group == "mass" for p in describe(model)])[free]
    low, high = limits or (np.full(theta.size, -np.inf), np.full(theta.size, np.inf))
    low = np.where(masses, np.maximum(low, LIGHTEST * theta), low)
    if prior is None:
        prior = Prior(theta, np.zeros((0, theta.size)))
    weights: dict[str, np.ndarray] = {}
    share = 0.0
    for robust in (False, True) if huber else (False,):
        if robust:
            weights, share = huber_weights(linearised, huber)
            # Gaussian residuals pass a limit of 3 in 0.3 % of cases: half as many again are outliers.
            if share < 0.005:
                break
        best, before, converged = np.inf, None, False
        step = gradient = np.zeros_like(theta)
        steps: list[tuple[np.ndarray, np.ndarray]] = []  # whole ones, and where they started
        for _ in range(STEPS):
            linearised = linearise_each(model, sources, weights)
            factor = _stacked(linearised, sources, size)
            offset = prior.root @ (theta - prior.mean)
            cost = 0.5 * float(factor[:, -1] @ factor[:, -1] + offset @ offset)
            if not cost <= best * (1 + 1e-9) and np.any(step):  # higher, or outside of where the model is defined
                if before and small < KINK:
                    theta, (model, linearised), converged = theta - step, before, True
                    break
                shorter = _shorter(best, float(gradient @ step), cost)
                theta = theta - (1.0 - shorter) * step
                step, small, before = shorter * step, shorter * small, None
                model = moved.set(model, jax.device_put(theta))
                if small < SMALL * 0.1:
                    break
                continue
            if not np.isfinite(cost):
                raise UserError("the model predicts nothing finite where the fit starts: start from other parameters")
            best = cost
            A = np.concatenate([factor[:, free], prior.root])
            b = np.concatenate([factor[:, -1], offset])
            gradient = A.T @ b
            basis, invisible, scale = visible(A)
            z = _minimise(A @ basis, b)
            step = basis @ z
            if np.any(theta + step < low) or np.any(theta + step > high):
                step = bounded(A, b, low - theta, high - theta)
                z = np.linalg.lstsq(basis, step, rcond=None)[0]
            steps = [*steps[-REMEMBERED:], (theta, step)]
            small = float(np.max(np.abs(z), initial=0.0))
            if small < SMALL:
                converged = True
                break
            before = model, linearised  # a whole step away
            mixed = _mixed(A, steps)
            if gradient @ mixed < 0 and np.all(theta + mixed >= low) and np.all(theta + mixed <= high):
                step = mixed
            theta = theta + step
            model = moved.set(model, jax.device_put(theta))
    message = (
        ""
        if converged
        else f"no further descent after {STEPS} linearisations; the last step was {small:.2g} standard deviations"
    )
    factor = _stacked(linearised, sources, size)
    rows = sum(int(np.count_nonzero(lin.white)) for lin in linearised.values())
    information = factor[:, :-1].T @ factor[:, :-1]
    cost = 0.5 * float(factor[:, -1] @ factor[:, -1])
    return model, Solution(converged, message, cost, rows, information, invisible, scale, share, linearised)


def _mixed(A: np.ndarray, steps: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The latest step, in the light of those before it: of their affine combinations the one whose own step is
    shortest, and on from there (Anderson 1965; Walker and Ni 2011).
    """
    theta, step = steps[-1]
    if len(steps) == 1:
        return step
    moves, changes = (np.stack(d, axis=1) for d in zip(*((theta - x, step - s) for x, s in steps[:-1]), strict=True))
    share = np.linalg.lstsq(A @ changes, A @ step, rcond=1e-6)[0]
    return step - (moves + changes) @ share


def _shorter(start: float, slope: float, end: float) -> float:
    """The share of a step at which the parabola with this start, slope there and end is least, a tenth to a half
    (Nocedal and Wright 2006, §3.5); a half where the end is nothing finite.
    """
    return float(np.clip(slope / (2.0 * (start + slope - end)), 0.1, 0.5)) if np.isfinite(end) else 0.5


def linearise_each(
    model: Model, sources: dict[str, Source], weights: Mapping[str, np.ndarray] | None = None
) -> dict[str, Linearised]:
    """Every experiment at the model."""
    weights = weights or {}

    def one(name: str) -> Linearised:
        s = sources[name]
        seen = s.seen(model)
        return linearise(seen, Free.at(seen, s.positions), s.batch, s.filters, weights.get(name))

    return dict(zip(sources, side_by_side(one, sources), strict=True))


def missed_each(model: Model, sources: dict[str, Source]) -> dict[str, dict[str, Float[np.ndarray, "columns B T"]]]:
    """Measured − predicted of every experiment's channels; also where a sample does not count."""

    def one(s: Source):
        seen = s.seen(model)
        return missed(seen, Free.at(seen, s.positions), s.batch, s.filters)

    return dict(zip(sources, side_by_side(one, sources.values()), strict=True))


def _stacked(linearised: dict[str, Linearised], sources: dict[str, Source], size: int) -> Float[np.ndarray, "k P+1"]:
    """One triangular factor of all trials, its columns those of the flat vector, then the residual."""
    blocks = []
    for name, lin in linearised.items():
        factor = np.asarray(lin.factor)
        block = np.zeros((factor.shape[0] * factor.shape[1], size + 1))
        block[:, [*sources[name].positions, size]] = factor.reshape(-1, factor.shape[-1])
        blocks.append(block)
    used = np.flatnonzero(np.any(np.concatenate(blocks) != 0, axis=0))
    used = np.union1d(used, [size])
    small = triangular(np.concatenate(blocks)[:, used])
    out = np.zeros((small.shape[0], size + 1))
    out[:, used] = small
    return out


def triangular(A: np.ndarray) -> np.ndarray:
    """R of A = Q R."""
    return np.asarray(np.linalg.qr(A, mode="r"))


def visible(A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Basis B of the combinations that data or prior see, the others, and the scale of each parameter."""
    norm = np.linalg.norm(A, axis=0)
    scale = 1.0 / np.where(norm > 0, norm, 1.0)
    _, s, Vt = np.linalg.svd(A * scale, full_matrices=True)
    s = np.concatenate([s, np.zeros(len(Vt) - len(s))])
    seen = s > VISIBLE * max(s[0], 1e-300)
    return scale[:, None] * Vt[seen].T / s[seen], Vt[~seen], scale


def bounded(A: np.ndarray, b: np.ndarray, low: np.ndarray, high: np.ndarray | float = np.inf) -> np.ndarray:
    """argmin ‖A δ + b‖ over low ≤ δ ≤ high, where δ = 0 is allowed: optimistix has no bounds, so the few problems that
    need them go to scipy.
    """
    R = triangular(np.column_stack([A, b]))
    norm = np.linalg.norm(A, axis=0)
    scale = 1.0 / np.where(norm > 0, norm, 1.0)
    bounds = np.minimum(low, 0.0) / scale, np.maximum(high, 0.0) / scale
    return scale * lsq_linear(R[:, :-1] * scale, -R[:, -1], bounds, method="bvls").x


def _compressed(z: Float[Array, " k"], problem: tuple[Array, Array]) -> Float[Array, " rows"]:
    A, b = problem
    return A @ z + b


@eqx.filter_jit
def _dogleg(A: Float[Array, "k k"], b: Float[Array, " k"]):
    solver = optx.Dogleg(rtol=1e-6, atol=1e-6, norm=optx.rms_norm)
    return optx.least_squares(_compressed, solver, jnp.zeros(A.shape[1]), (A, b), max_steps=64, throw=False).value


def _minimise(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """argmin ‖A z + b‖ by optimistix, on the triangular factor, padded to a common size."""
    k = A.shape[1]
    R = triangular(np.column_stack([A, b]))[:k]
    size = -(-max(k, 1) // PAD) * PAD
    square, right = np.eye(size), np.zeros(size)
    square[:k, :k], right[:k] = 0.0, 0.0
    square[: len(R), :k], right[: len(R)] = R[:, :k], R[:, k]
    return np.asarray(_dogleg(*jax.device_put((square, right))))[:k]


def huber_weights(linearised: dict[str, Linearised], limit: float) -> tuple[dict[str, np.ndarray], float]:
    """Square roots of Huber's weights, and the share of residuals beyond the limit."""
    beyond = count = 0
    weights = {}
    for name, lin in linearised.items():
        r = np.abs(np.asarray(lin.white))
        beyond, count = beyond + int((r > limit).sum()), count + int((r > 0).sum())
        weights[name] = np.sqrt(np.where(r > limit, limit / np.maximum(r, limit), 1.0))
    return weights, beyond / max(1, count)
