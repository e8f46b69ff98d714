"""The least-squares solver behind every fit, as an optimistix solver: Gauss–Newton on what the data can see.

    min_y ½ ‖r(y)‖²   over   low ≤ y ≤ high

1. r is linearised at y, and compressed: with [J r] = Q [R d; 0 ρ],  ‖r + J δ‖² = ‖d + R δ‖² + ρ². A step is then a
   matter of small triangular matrices, however many rows there are.
2. R is scaled by columns; its singular vectors say which combinations of y the rows can see at all (`visible`). Along
   these, R = U diag(s) Vᵀ, the step has coordinates z = −Uᵀd in which every one counts one standard deviation of its
   estimate, where r is white. What is not seen stays where it is.
3. Bounds hold exactly: the quadratic problem is solved by active sets (Nocedal and Wright 2006, §16.5), so that an
   optimum on a bound is found as fast as any. A change of variables has no slope there, and crawls.
4. A step that the cost does not follow is cut to where a parabola through both ends is lowest (ibid., §3.5), and the
   next is as short, until the cost follows again. Linear problems end in one step, whatever their conditioning.
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

VISIBLE = 1e-7  # relative singular value of the column-scaled Jacobian below which a combination is not seen
FOLLOWS = 1e-3  # least share of the predicted descent by which a step counts as descent at all
POOR, GOOD = 0.25, 0.75  # shares of it below which the next step is shorter, and above which it is longer
# Where the cost shows no progress, a step at most so long as the last one is some: a search that converges at this rate
# or faster ends within a few steps. Steps that miss it, of which a few in a row end the search: a zigzag across a kink
# may still descend by one or two (tests/identify/test_gauss_newton.py).
SHORTER, STALLED = 0.5, 4
TANGENTS = 8  # columns of a Jacobian at a time: more do not fit into the processor's cache
ROUNDING = 1e-12  # of a cost, relative: it cannot be told lower by less


class Outcome(eqx.Enumeration):
    """How a search ended."""

    going = "the search has not ended"
    converged = ""
    kink = "the last steps lie within a kink of the cost, a tenth of a standard deviation wide"
    rounded = "rounding hides what the last steps do to the cost"
    no_descent = "no step along the descent lowers the cost: the model has a kink or a jump there"
    nowhere = "the model predicts nothing finite where the fit starts"


class Factor(NamedTuple):
    """‖r + J δ‖² = ‖d + R δ‖² + ρ² at a point."""

    R: Float[Array, "p p"]
    d: Float[Array, " p"]
    rho2: Float[Array, ""]

    @property
    def cost(self) -> Float[Array, ""]:
        """½ ‖r‖²."""
        return 0.5 * (self.d @ self.d + self.rho2)


class Iterate(eqx.Module):
    """Of a search: where it is tried next, what is known at the best point, and the step that leads on from there."""

    trial: PyTree
    here: Factor
    cost: Float[Array, ""]  # at the best point; infinite before the first
    step: Float[Array, " p"]  # whole, from the best point
    slope: Float[Array, ""]  # of the cost along it
    length: Float[Array, ""]  # share of it that is tried
    size: Float[Array, ""]  # of the whole step, in standard deviations
    stalled: Int[Array, ""]  # steps without progress since the cost last fell
    evaluations: Int[Array, ""]
    outcome: Outcome


class VisibleGaussNewton(optx.AbstractLeastSquaresSolver):
    """Ends where a whole step is shorter than `atol + rtol ‖r‖` in the coordinates z, or no longer than `kink` in them
    and lowers the cost no further, or where rounding hides what steps do to the cost and they become no shorter.
    Options: `lower` and `upper`, like y; a start outside of them stays until a step leads back. `jac` as in
    `optimistix.GaussNewton` is always forward.
    """

    rtol: float = 0.0
    atol: float = 1e-3
    kink: float = 0.0
    norm: Callable[[PyTree], Scalar] = optx.two_norm  # of z; the two-norm is that of the predicted descent

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Iterate:
        """Nothing is known: the start is the first trial."""
        del fn, args, options, f_struct, aux_struct, tags
        return begin(y)

    def step(self, fn, y, args, options, state: Iterate, tags):
        """Linearise at the trial, and go on from there or take a shorter step."""
        del tags
        at, unravel = ravel_pytree(state.trial)
        here, aux = _linearised(lambda v: fn(unravel(v), args), at)
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
        """The best point, and the state after the problem was linearised at the trial: the whole of a step but the
        linearisation, for callers that have programs of their own for that.
        """
        first = ~jnp.isfinite(state.cost)
        finite = jnp.isfinite(here.cost) & jnp.all(jnp.isfinite(here.R))
        moved = state.length * state.step
        predicted = -state.length * state.slope - 0.5 * jnp.sum((state.here.R @ moved) ** 2)
        descent = state.cost - here.cost
        follows = jnp.where(predicted > 0.0, descent / jnp.where(predicted > 0.0, predicted, 1.0), 1.0)
        hidden = (jnp.abs(descent) <= ROUNDING * state.cost) & (predicted <= ROUNDING * state.cost)
        accept = finite & (first | (follows >= FOLLOWS) | hidden)

        new = jax.tree.map(lambda a, b: jnp.where(accept, a, b), here, state.here)
        best = jnp.where(accept, state.trial, y)
        step, size = bounded_step(new, low - best, high - best, self.norm)
        step, size = (jnp.where(accept, a, b) for a, b in ((step, state.step), (size, state.size)))
        slope = jnp.where(accept, new.d @ (new.R @ step), state.slope)

        # The parabola with the start, its slope and the end of the step that was tried.
        curved = here.cost - state.cost - state.slope * state.length
        least = -state.slope * state.length**2 / jnp.where(curved > 0.0, 2.0 * curved, 1.0)
        shorter = jnp.where(finite & (curved > 0.0), least, 0.5 * state.length)
        shorter = jnp.clip(shorter, 0.1 * state.length, 0.5 * state.length)
        again = jnp.where(follows > GOOD, jnp.minimum(1.0, 2.0 * state.length), state.length)
        again = jnp.where(follows < POOR, jnp.clip(least, 0.1 * state.length, state.length), again)
        length = jnp.where(first & accept, 1.0, jnp.where(accept, again, shorter))
        # Where rounding hides what a step does to the cost, how long the next one is tells what it was worth.
        lost = accept & hidden & (size > SHORTER * state.size)
        stalled = jnp.where(accept & ~hidden, 0, state.stalled + lost.astype(int))

        enough = self.atol + self.rtol * jnp.sqrt(2.0 * new.cost)
        outcome = Outcome.going
        outcome = Outcome.where(accept & (size <= enough), Outcome.converged, outcome)
        outcome = Outcome.where(~accept & (state.length * size <= self.kink), Outcome.kink, outcome)
        outcome = Outcome.where(~accept & (shorter * size <= 0.1 * enough), Outcome.no_descent, outcome)
        outcome = Outcome.where(stalled >= STALLED, Outcome.rounded, outcome)
        outcome = Outcome.where(first & ~finite, Outcome.nowhere, outcome)
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
        """At the end of the search, whichever it is."""
        del fn, y, args, options, tags
        result = optx.RESULTS.where(
            state.outcome == Outcome.no_descent, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        result = optx.RESULTS.where(state.outcome == Outcome.nowhere, optx.RESULTS.nonfinite, result)
        return state.outcome != Outcome.going, result

    def postprocess(self, fn, y, aux, args, options, state: Iterate, tags, result):
        """The outcome in words of this solver, and how often the problem was linearised."""
        del fn, args, options, tags, result
        return y, aux, {"outcome": state.outcome, "linearisations": state.evaluations}


def begin(y: PyTree) -> Iterate:
    """Before anything is known."""
    flat = ravel_pytree(y)[0]
    none = Factor(jnp.zeros((flat.size, flat.size)), jnp.zeros_like(flat), jnp.array(0.0))
    zero, count = jnp.array(0.0), jnp.array(0)
    return Iterate(
        y, none, jnp.array(jnp.inf), jnp.zeros_like(flat), zero, jnp.array(1.0), zero, count, count, Outcome.going
    )


def state_of_vector(state: Iterate, trial: Float[Array, " p"]) -> Iterate:
    """The state with its trial flat."""
    return eqx.tree_at(lambda s: s.trial, state, trial, is_leaf=lambda s: s is state.trial)


def _linearised(fn, at: Float[Array, " p"]) -> tuple[Factor, Any]:
    def flat(v):
        r, aux = fn(v)
        return ravel_pytree(r)[0], aux

    r, push, aux = jax.linearize(flat, at, has_aux=True)
    J = jax.lax.map(push, jnp.eye(at.size), batch_size=TANGENTS) if at.size else jnp.zeros((0, r.size))
    return factor_of(jnp.concatenate([J, r[None]]).T), aux


def factor_of(rows: Float[Array, "N q"]) -> Factor:
    """Of [J r], q = p + 1 columns."""
    p = rows.shape[1] - 1
    T = jnp.linalg.qr(jnp.concatenate([rows, jnp.zeros((max(0, p + 1 - len(rows)), p + 1))]), mode="r")
    return Factor(T[:p, :p], T[:p, p], T[p, p] ** 2)


def scaled_directions(A: Float[Array | np.ndarray, "k p"]) -> tuple:
    """Of the column-scaled A = U diag(s) Vᵀ / scale: the step of one standard deviation along each singular vector (a
    column, zero where it is not seen), U, whether it is seen, V, and the scale. k ≥ p; NumPy's of NumPy's.
    """
    xp = A.__array_namespace__()
    norm = xp.linalg.norm(A, axis=0)
    scale = 1.0 / xp.where(norm > 0.0, norm, 1.0)
    U, s, Vt = xp.linalg.svd(A * scale[None], full_matrices=False)
    seen = s > VISIBLE * xp.maximum(s[:1], 1e-300)
    basis = scale[:, None] * Vt.T * xp.where(seen, 1.0 / xp.where(seen, s, 1.0), 0.0)[None]
    return basis, U, seen, Vt.T, scale


def bounded_step(
    here: Factor, low: Float[Array, " p"], high: Float[Array, " p"], norm: Callable = optx.two_norm
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """argmin ‖R δ + d‖ over low ≤ δ ≤ high along what is seen, where δ = 0 is allowed; and the size of that step."""
    low, high = jnp.minimum(low, 0.0), jnp.maximum(high, 0.0)
    p = low.size
    if p == 0:
        return jnp.zeros(0), jnp.array(0.0)

    def towards(carry):
        x, held, _, count = carry
        basis, U, *_ = scaled_directions(jnp.where(held[None], 0.0, here.R))
        target = jnp.where(held, x, -basis @ (U.T @ (here.d + here.R @ jnp.where(held, x, 0.0))))
        way = target - x
        room = jnp.where(way > 0.0, high - x, low - x)
        share = jnp.where((way > 0.0) & (target > high) | (way < 0.0) & (target < low), room / way, jnp.inf)
        whole = jnp.all(share >= 1.0)
        most = jnp.minimum(1.0, jnp.min(share))
        blocked = ~whole & (share <= most)
        end = jnp.where(blocked, jnp.where(way > 0.0, high, low), x + most * way)
        # At the end of a whole step: the bound that holds the cost up most is let go.
        gradient = here.R.T @ (here.R @ end + here.d)
        pulls = jnp.where(held & (end >= high), gradient, jnp.where(held & (end <= low), -gradient, -jnp.inf))
        pulls = pulls / jnp.maximum(jnp.linalg.norm(here.R, axis=0), 1e-300)
        free = whole & (jnp.max(pulls) > 1e-9 * jnp.linalg.norm(here.d)) & (jnp.arange(p) == jnp.argmax(pulls))
        return end, jnp.where(whole, held & ~free, held | blocked), whole & ~jnp.any(free), count + 1

    # What starts at a bound and would leave it is held from the start.
    gradient = here.R.T @ here.d
    held = ((low >= 0.0) & (gradient > 0.0)) | ((high <= 0.0) & (gradient < 0.0))
    start = (jnp.zeros(p), held, jnp.array(False), jnp.array(0))
    x, _, _, _ = jax.lax.while_loop(lambda c: ~c[2] & (c[3] < 4 * p + 4), towards, start)
    return x, norm(here.R @ x)
