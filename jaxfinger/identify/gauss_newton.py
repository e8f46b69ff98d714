"""Gauss–Newton solver of every fit, as an optimistix solver: steps along visible combinations, within bounds.

    min_y ½ ‖r(y)‖²   over   low ≤ y ≤ high

1. r is linearised at y and compressed by QR: with [J r] = Q [R d; 0 ρ],  ‖r + J δ‖² = ‖d + R δ‖² + ρ². The cost of a
   step then depends on the number of parameters, and not on the number of rows.
2. R is scaled by columns, R diag(scale) = U diag(s) Vᵀ. A combination of y is called visible where its relative
   singular value exceeds `MIN_RELATIVE_SINGULAR_VALUE` (`scaled_directions`). Along the visible ones the step has the
   coordinates z = −Uᵀd. Where r is white, one unit of a coordinate is one standard deviation of its estimate. Invisible
   combinations are not changed.
3. Bounds hold exactly: the quadratic problem is solved by active sets (Nocedal and Wright 2006, §16.5), so that an
   optimum on a bound costs no more iterations than another. A change of variables would have zero slope at the bound
   and converge slowly.
4. Rows whose cost is linear, as Huber's is beyond its limit, have no curvature (`with_linear_rows`). Gauss–Newton would
   give them some, and where they are many each of its steps leaves a good share of the way, always the same.
5. Where the cost falls by too little, the step is shortened to the minimum of a parabola (ibid., §3.5). The next step
   starts with the same length, which doubles where the cost falls as predicted. A linear problem ends in one step,
   whatever its conditioning.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree, Scalar

# Of the column-scaled Jacobian. Below it a combination is invisible: the square, in JᵀJ, is zero to rounding.
MIN_RELATIVE_SINGULAR_VALUE = 1e-7
# Actual descent over predicted descent. Below the first a step is rejected, below the second the next one is shorter,
# above the third it is longer (Nocedal and Wright 2006, algorithm 4.1, with a small η).
MIN_DESCENT_RATIO, POOR_DESCENT_RATIO, GOOD_DESCENT_RATIO = 1e-3, 0.25, 0.75
# Least eigenvalue of the Hessian in the coordinates z. Where nearly all rows are linear it would be zero, and the step
# without end. So a step is at most ten times as long as that of Gauss–Newton, and is shortened where that is too long.
MIN_CURVATURE = 0.1
# A shortened step over the last one, as in a backtracking line search (Dennis and Schnabel 1996, §6.3.2).
MIN_SHORTENING, MAX_SHORTENING = 0.1, 0.5
# Where rounding hides the descent, a step counts as progress if it is at most this share of the last one. A search that
# converges at this rate or faster ends within a few steps.
MAX_LENGTH_RATIO = 0.5
# So many steps without progress end the search. One or two may occur in a zigzag across a kink that still descends
# (tests/identify/test_gauss_newton.py).
MAX_STALLED_STEPS = 4
TANGENTS_AT_ONCE = 8  # columns of a Jacobian computed together: more do not fit into the processor's cache
COST_ROUNDING = 1e-12  # relative: a cost sums some 10⁴ squares, each rounded by 10⁻¹⁶


class Outcome(eqx.Enumeration):
    """Ending of a search, in a sentence for users."""

    running = "the search has not ended"
    converged = ""
    kink = "the last steps lie within a kink of the cost, a tenth of a standard deviation wide"
    rounded = "rounding hides what the last steps do to the cost"
    no_descent = "no step along the descent lowers the cost: the model has a kink or a jump there"
    undefined_start = "the model predicts nothing finite where the fit starts"


class Factor(NamedTuple):
    """Compressed linearisation at a point: ‖r + J δ‖² = ‖d + R δ‖² + ρ²."""

    R: Float[Array | np.ndarray, "p p"]
    d: Float[Array | np.ndarray, " p"]
    rho2: Float[Array | np.ndarray, ""]

    @property
    def cost(self) -> Float[Array | np.ndarray, ""]:
        """½ ‖r‖²."""
        return 0.5 * (self.d @ self.d + self.rho2)


class LinearRows(NamedTuple):
    """Rows A of J whose cost is linear, as that of rows beyond Huber's limit."""

    gram: Float[Array | np.ndarray, "p p"]  # Aᵀ A
    count: int  # of all rows of J


class Iterate(eqx.Module):
    """State of a search: its next trial point, the linearisation at the best point so far, and the step from there."""

    trial: PyTree
    here: Factor
    cost: Float[Array | np.ndarray, ""]  # at the best point; infinite before the first
    step: Float[Array | np.ndarray, " p"]  # full Gauss–Newton step from the best point
    slope: Float[Array | np.ndarray, ""]  # derivative of the cost along the step
    length: Float[Array | np.ndarray, ""]  # share of the step that is tried
    size: Float[Array | np.ndarray, ""]  # norm of the full step, in standard deviations
    stalled: Int[Array | np.ndarray, ""]  # steps without progress since the cost last fell
    evaluations: Int[Array | np.ndarray, ""]  # linearisations so far
    outcome: Outcome


class VisibleGaussNewton(optx.AbstractLeastSquaresSolver):
    """Gauss–Newton with bounds and a line search, in the coordinates z of the visible combinations.

    The search ends where the full step is shorter than `atol + rtol ‖r‖`, or where a step shorter than `kink` is
    rejected, or where rounding hides the change of the cost and steps become no shorter.

    Options: `lower` and `upper`, shaped like y. An entry that starts outside of its bounds moves only towards them.
    `linear_beyond`, a number for each leaf of the residual: beyond it a row is a square root of Huber's cost
    (`linearise`). Jacobians are always computed forwards.
    """

    rtol: float = 0.0
    atol: float | Float[Array, ""] = 1e-3
    kink: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.two_norm  # of z; half the squared two-norm is the predicted descent

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Iterate:
        """State before the first linearisation, with the start as the trial point."""
        del fn, args, options, f_struct, aux_struct, tags
        return begin(y)

    def step(self, fn, y, args, options, state: Iterate, tags):
        """Linearise at the trial point, then accept it or shorten the step."""
        del tags
        at, unravel = ravel_pytree(state.trial)
        here, aux = _linearised(lambda v: fn(unravel(v), args), at, options.get("linear_beyond"))
        low, high = (
            jnp.broadcast_to(ravel_pytree(options[k])[0], at.shape) if k in options else jnp.full_like(at, infinite)
            for k, infinite in (("lower", -jnp.inf), ("upper", jnp.inf))
        )
        best, after = self.advance(ravel_pytree(y)[0], state_of_vector(state, at), here, low, high)
        return unravel(best), eqx.tree_at(lambda s: s.trial, after, unravel(after.trial)), aux

    def advance(
        self,
        y: Float[Array, " p"],
        state: Iterate,
        here: Factor,
        low: Float[Array, " p"],
        high: Float[Array, " p"],
    ) -> tuple[Float[Array, " p"], Iterate]:
        """Best point and next state, given the linearisation `here` at the trial point.

        This is `step` without the linearisation, for callers that compile that apart.
        """
        first = ~jnp.isfinite(state.cost)
        finite = jnp.isfinite(here.cost) & jnp.all(jnp.isfinite(here.R))
        moved = state.length * state.step
        predicted = -state.length * state.slope - 0.5 * jnp.sum((state.here.R @ moved) ** 2)
        descent = state.cost - here.cost
        follows = jnp.where(predicted > 0.0, descent / jnp.where(predicted > 0.0, predicted, 1.0), 1.0)
        hidden = (jnp.abs(descent) <= COST_ROUNDING * state.cost) & (predicted <= COST_ROUNDING * state.cost)
        accept = finite & (first | (follows >= MIN_DESCENT_RATIO) | hidden)

        new = jax.tree.map(lambda a, b: jnp.where(accept, a, b), here, state.here)
        best = jnp.where(accept, state.trial, y)
        step, size = bounded_step(new, low - best, high - best, self.norm)
        step, size = (jnp.where(accept, a, b) for a, b in ((step, state.step), (size, state.size)))
        slope = jnp.where(accept, new.d @ (new.R @ step), state.slope)

        # Minimum of the parabola through the costs at both ends of the tried step, with the slope at its start.
        curved = here.cost - state.cost - state.slope * state.length
        least = -state.slope * state.length**2 / jnp.where(curved > 0.0, 2.0 * curved, 1.0)
        shorter = jnp.where(finite & (curved > 0.0), least, MAX_SHORTENING * state.length)
        shorter = jnp.clip(shorter, MIN_SHORTENING * state.length, MAX_SHORTENING * state.length)
        again = jnp.where(follows > GOOD_DESCENT_RATIO, jnp.minimum(1.0, 2.0 * state.length), state.length)
        poor = jnp.clip(least, MIN_SHORTENING * state.length, state.length)
        again = jnp.where(follows < POOR_DESCENT_RATIO, poor, again)
        length = jnp.where(first & accept, 1.0, jnp.where(accept, again, shorter))
        # Where rounding hides the change of the cost, the length of the next step shows whether this one was progress.
        no_progress = accept & hidden & (size > MAX_LENGTH_RATIO * state.size)
        stalled = jnp.where(accept & ~hidden, 0, state.stalled + no_progress.astype(int))

        enough = self.atol + self.rtol * jnp.sqrt(2.0 * new.cost)
        outcome = Outcome.running
        outcome = Outcome.where(accept & (size <= enough), Outcome.converged, outcome)
        outcome = Outcome.where(~accept & (state.length * size <= self.kink), Outcome.kink, outcome)
        outcome = Outcome.where(~accept & (shorter * size <= 0.1 * enough), Outcome.no_descent, outcome)
        outcome = Outcome.where(stalled >= MAX_STALLED_STEPS, Outcome.rounded, outcome)
        outcome = Outcome.where(first & ~finite, Outcome.undefined_start, outcome)
        after = Iterate(
            best + length * step,
            new,
            jnp.where(accept, here.cost, state.cost),
            step,
            slope,
            length,
            size,
            stalled,
            state.evaluations + 1,
            outcome,
        )
        return best, after

    def terminate(self, fn, y, args, options, state: Iterate, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        """Whether the search has ended, and optimistix's result code."""
        del fn, y, args, options, tags
        result = optx.RESULTS.where(
            state.outcome == Outcome.no_descent, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        result = optx.RESULTS.where(state.outcome == Outcome.undefined_start, optx.RESULTS.nonfinite, result)
        return state.outcome != Outcome.running, result

    def postprocess(self, fn, y, aux, args, options, state: Iterate, tags, result):
        """Statistics of the search: its outcome and the number of linearisations."""
        del fn, args, options, tags, result
        return y, aux, {"outcome": state.outcome, "linearisations": state.evaluations}


def begin(y: PyTree) -> Iterate:
    """State of a search before the first linearisation, with `y` as the trial point; NumPy's where `y` is."""
    flat = y if isinstance(y, np.ndarray) else ravel_pytree(y)[0]
    xp = flat.__array_namespace__()
    # Scalars get their type here, as those of later states have it, so that one compiled step serves all states.
    zero, one, infinite, count = (xp.asarray(x) for x in (0.0, 1.0, xp.inf, 0))
    none = Factor(xp.zeros((flat.size, flat.size)), xp.zeros_like(flat), zero)
    return Iterate(y, none, infinite, xp.zeros_like(flat), zero, one, zero, count, count, Outcome.running)


def state_of_vector(state: Iterate, trial: Float[Array, " p"]) -> Iterate:
    """Copy of the state with the trial point as a flat vector."""
    return eqx.tree_at(lambda s: s.trial, state, trial, is_leaf=lambda s: s is state.trial)


def _linearised(fn, at: Float[Array, " p"], limits: PyTree | None) -> tuple[Factor, Any]:
    def flat(v):
        r, aux = fn(v)
        return ravel_pytree(r)[0], (r, aux)

    r, push, (tree, aux) = jax.linearize(flat, at, has_aux=True)
    J = jax.lax.map(push, jnp.eye(at.size), batch_size=TANGENTS_AT_ONCE) if at.size else jnp.zeros((0, r.size))
    here = factor_of(jnp.concatenate([J, r[None]]).T)
    if limits is not None and at.size:
        beyond = jnp.abs(r) > ravel_pytree(jax.tree.map(jnp.full_like, tree, limits))[0]
        linear = jnp.where(beyond[None], J, 0.0)
        here = with_linear_rows(here, LinearRows(linear @ linear.T, r.size))
    return here, aux


def factor_of(rows: Float[Array, "N q"]) -> Factor:
    """Compress the rows of [J r], which have q = p + 1 columns."""
    p = rows.shape[1] - 1
    T = jnp.linalg.qr(jnp.concatenate([rows, jnp.zeros((max(0, p + 1 - len(rows)), p + 1))]), mode="r")
    return Factor(T[:p, :p], T[:p, p], T[p, p] ** 2)


def with_linear_rows(here: Factor, linear: LinearRows) -> Factor:
    """The factor for Newton's step, where the cost of some rows A is linear.

    In the coordinates z the Hessian is H = I − Bᵀ B, with B = A · basis (`scaled_directions`). With H = W diag(h) Wᵀ
    the factor [diag(√h) Wᵀ Uᵀ R, diag(1/√h) Wᵀ Uᵀ d] has that Hessian, and the gradient and cost of `here`. Where the
    step of Gauss–Newton changes all rows by more than one in rms, others will be linear there, and H = I.
    """
    xp = here.R.__array_namespace__()
    basis, U, seen, *_ = scaled_directions(here.R)
    to_z = xp.where(seen[None], U, 0.0).T
    near = xp.sum((to_z @ here.d) ** 2) < linear.count
    h, W = xp.linalg.eigh(xp.eye(seen.size) - xp.where(near, 1.0, 0.0) * (basis.T @ linear.gram @ basis))
    root, turned = xp.sqrt(xp.clip(h, MIN_CURVATURE, 1.0)), W.T @ to_z
    d = turned @ here.d / root
    return Factor(root[:, None] * (turned @ here.R), d, here.rho2 + here.d @ here.d - d @ d)


def scaled_directions(A: Float[Array | np.ndarray, "k p"]) -> tuple:
    """Singular directions of the column-scaled matrix A diag(scale) = U diag(s) Vᵀ, k ≥ p, in the array type of A.

    Returns:
        basis (p, p), U (k, p), seen (p,), V (p, p), scale (p,). A column of `basis` is the step of one standard
        deviation along a singular vector, zero where that is invisible; `seen` says which are visible.
    """
    xp = A.__array_namespace__()
    norm = xp.linalg.norm(A, axis=0)
    scale = 1.0 / xp.where(norm > 0.0, norm, 1.0)
    U, s, Vt = xp.linalg.svd(A * scale[None], full_matrices=False)
    seen = s > MIN_RELATIVE_SINGULAR_VALUE * xp.maximum(s[:1], 1e-300)
    basis = scale[:, None] * Vt.T * xp.where(seen, 1.0 / xp.where(seen, s, 1.0), 0.0)[None]
    return basis, U, seen, Vt.T, scale


def bounded_step(
    here: Factor, low: Float[Array, " p"], high: Float[Array, " p"], norm: Callable = optx.two_norm
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Minimum δ of ‖R δ + d‖ over low ≤ δ ≤ high along visible combinations, and its norm in standard deviations.

    δ = 0 counts as allowed: bounds that exclude it are moved to it.
    """
    low, high = jnp.minimum(low, 0.0), jnp.maximum(high, 0.0)
    p = low.size
    if p == 0:
        return jnp.zeros(0), jnp.array(0.0)

    def active_set_step(carry):
        x, held, _, count = carry
        basis, U, *_ = scaled_directions(jnp.where(held[None], 0.0, here.R))
        target = jnp.where(held, x, -basis @ (U.T @ (here.d + here.R @ jnp.where(held, x, 0.0))))
        way = target - x
        room = jnp.where(way > 0.0, high - x, low - x)
        share = jnp.where((way > 0.0) & (target > high) | (way < 0.0) & (target < low), room / way, jnp.inf)
        whole = jnp.all(share >= 1.0)
        share_taken = jnp.minimum(1.0, jnp.min(share))
        blocked = ~whole & (share <= share_taken)
        end = jnp.where(blocked, jnp.where(way > 0.0, high, low), x + share_taken * way)
        # At the end of a full step, release the bound whose multiplier lowers the cost most.
        gradient = here.R.T @ (here.R @ end + here.d)
        multipliers = jnp.where(held & (end >= high), gradient, jnp.where(held & (end <= low), -gradient, -jnp.inf))
        multipliers = multipliers / jnp.maximum(jnp.linalg.norm(here.R, axis=0), 1e-300)
        positive = jnp.max(multipliers) > 1e-9 * jnp.linalg.norm(here.d)  # beyond rounding
        free = whole & positive & (jnp.arange(p) == jnp.argmax(multipliers))
        return end, jnp.where(whole, held & ~free, held | blocked), whole & ~jnp.any(free), count + 1

    # Entries that start at a bound, and whose descent would cross it, are held from the start.
    gradient = here.R.T @ here.d
    held = ((low >= 0.0) & (gradient > 0.0)) | ((high <= 0.0) & (gradient < 0.0))
    start = (jnp.zeros(p), held, jnp.array(False), jnp.array(0))
    x, _, _, _ = jax.lax.while_loop(lambda c: ~c[2] & (c[3] < 4 * p + 4), active_set_step, start)
    return x, norm(here.R @ x)
