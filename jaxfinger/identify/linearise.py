"""Equation (1) linearised at a model and compressed, trial by trial.

With J the Jacobian of a trial's white residuals r, one QR factorisation [J r] = Q [R d; 0 ρ] keeps all that least
squares needs: ‖r + J δ‖² = ‖d + R δ‖² + ρ². A stage, the joint refinement, a bootstrap resample and a leave-one-out
refit are sums over these small factors, at a cost that does not depend on the number of samples.

Outliers: Huber's cost is H(r) = r²/2 for |r| ≤ c, and c|r| − c²/2 beyond (Huber 1964). Least squares of

    s(r) = sign(r) √(2 H(r)),   ∂s/∂r = ψ(r)/s(r),

minimises that cost: the sum of squares of s is 2 Σ H(r), and its gradient is 2 Σ J ψ(r), with ψ = H′.
"""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float
from scipy.linalg import get_lapack_funcs
from scipy.sparse import csr_array

from jaxfinger.compilation import quick_jit
from jaxfinger.data.schema import CHANNELS
from jaxfinger.experiments import Batch, Block, blocks, in_rows, predict
from jaxfinger.identify.noise import whiten
from jaxfinger.identify.parameters import Free
from jaxfinger.model import Model

Tree = TypeVar("Tree")
Filters = dict[str, Float[Array, "_columns lags lags"]]  # `Noise.coefficients` of every channel
# By channel with torques beside reversals, for every column the matrix C that makes them white (`identify.reversals`).
Reversals = Mapping[str, Sequence[csr_array]]
NO_REVERSALS: Reversals = {}
PANEL = 32  # columns of a panel of ?geqrt: LAPACK's own choice for ?geqrf
(_geqrt,) = get_lapack_funcs(("geqrt",), dtype=np.float64)


@dataclass(frozen=True)
class Tangent:
    """Residuals of one experiment at a model and their derivatives by p free parameters, in each channel's unit."""

    before: dict[str, Float[np.ndarray, "_columns B T"]]  # measured − predicted, where the experiment was linearised
    slopes: dict[str, Float[np.ndarray, "p _columns B T"]]
    by: Float[np.ndarray, " p"] | None = None  # step of the parameters after that

    @cached_property
    def residuals(self) -> dict[str, Float[np.ndarray, "_columns B T"]]:
        """Measured − predicted after the step, which costs a sum over all slopes."""
        if self.by is None:
            return self.before
        return {c: r + np.tensordot(self.by, self.slopes[c], 1) for c, r in self.before.items()}

    def moved(self, by: Float[np.ndarray, " p"]) -> "Tangent":
        """Tangent after a step `by` of the parameters, exact where the residuals are affine in those that move."""
        return replace(self, by=by if self.by is None else self.by + by)


@dataclass(frozen=True)
class White:
    """Residuals of one experiment at a model, and its Jacobian by p free parameters, both white."""

    along: Tangent  # the same, in each channel's unit
    white: Float[np.ndarray, "B rows"]  # residuals, white and flat, before Huber's cost
    jacobian: Float[np.ndarray, "B rows p"]  # J of the white residuals, before Huber's cost

    @property
    def residuals(self) -> dict[str, Float[np.ndarray, "_columns B T"]]:
        """Measured − predicted, by channel, in the channel's unit."""
        return self.along.residuals


@dataclass(frozen=True)
class Linearised(White):
    """White residuals and Jacobian of one experiment, compressed trial by trial."""

    factor: Float[np.ndarray, "B k p+1"]  # triangular factor of [J r] under Huber's cost

    def moved(
        self,
        by: Float[np.ndarray, " p"],
        along: Tangent,
        limit: float,
        weights: Float[np.ndarray, " B"] | None,
    ) -> "Linearised":
        """Linearisation after a step `by` of the parameters, where the residuals are affine in them.

        `along` is the tangent at the new parameters. White rows change by J δ. The last column of the factors changes
        by R δ, unless Huber's cost gives the rows other weights. `limit` and `weights` must be those of this object.
        """
        white = self.white + self.jacobian @ by
        if limit:
            return Linearised(along, white, self.jacobian, factored(white, self.jacobian, limit, weights))
        factor = self.factor.copy()
        factor[..., -1] += factor[..., :-1] @ by
        return Linearised(along, white, self.jacobian, factor)


def white_rows(model: Model, batch: Batch, filters: Filters) -> tuple[dict, Float[Array, "B rows"]]:
    """Residuals by channel, and the same whitened, one row a trial: unit variance where model and noise are right."""
    residuals = _residuals(model, batch, tuple(filters))
    return residuals, white_of(residuals, batch, filters)


def white_of(residuals: dict, batch: Batch, filters: Filters, reversals: Reversals = NO_REVERSALS):
    """Whiten residuals by channel, (…, columns, B, T), into rows (…, B, rows); entries that are not finite stay so.

    `reversals`: for NumPy's arrays only.
    """
    with np.errstate(invalid="ignore"):
        white = {c: _white(residuals[c], batch, filters, c) for c in filters}
    return _flat(white | {c: _with_reversals(np.asarray(white[c]), C) for c, C in reversals.items()})


def _residuals(model: Model, batch: Batch, channels: tuple[str, ...]) -> dict[str, Array]:
    predicted = predict(model, batch.x, channels)
    return {c: batch.y[c] - predicted[c] for c in channels}


def _white(r, batch: Batch, filters: Filters, channel: str):
    return whiten(r, batch.mask[channel], filters[channel], demean=CHANNELS[channel].free_zero)


def _with_reversals(
    white: Float[np.ndarray, "*more columns B T"], C: Sequence[csr_array]
) -> Float[np.ndarray, "*more columns B T"]:
    """x + C x of the rows x of every column."""
    columns = np.moveaxis(white, -3, 0)
    rows = columns.reshape(len(C), -1, white.shape[-2] * white.shape[-1])
    added = np.stack([(c @ x.T).T for c, x in zip(C, rows, strict=True)])
    return np.moveaxis(columns + added.reshape(columns.shape), 0, -3)


def _white_jacobian(
    slopes: dict[str, Float[np.ndarray, "p columns B T"]], batch: Batch, filters: Filters, reversals: Reversals
) -> Float[np.ndarray, "B rows p"]:
    """Whiten derivatives, in the order of `white_rows`.

    A column does not depend on most parameters. Those derivatives are zero, and are not filtered.
    """
    p, _, B, T = next(iter(slopes.values())).shape
    out, row = np.zeros((B, sum(slopes[c].shape[1] for c in filters), T, p)), 0
    for c in filters:
        coefficients, mask = np.asarray(filters[c]), np.asarray(batch.mask[c])
        for k, by_parameter in enumerate(np.moveaxis(slopes[c], 1, 0)):
            at, column = np.flatnonzero(by_parameter.any(axis=(1, 2))), slice(k, k + 1)
            with np.errstate(invalid="ignore"):
                white = whiten(by_parameter[at, None], mask[column], coefficients[column], CHANNELS[c].free_zero)
            if c in reversals:
                white = _with_reversals(np.asarray(white), reversals[c][column])
            out[:, row, :, at] = white[:, 0]
            row += 1
    return out.reshape(B, -1, p)


def _flat(white: dict):
    """Flatten channels of (…, columns, B, T) into rows (…, B, rows)."""
    values = list(white.values())
    xp = values[0].__array_namespace__()
    wide = xp.moveaxis(xp.concat(values, axis=-3), -2, -3)
    return wide.reshape(*wide.shape[:-2], -1)


def robust_residuals(
    r: Float[Array | np.ndarray, "*N"], limit: float | Float[Array, ""]
) -> Float[Array | np.ndarray, "*N"]:
    """s(r) of the module's docstring, whose squares are Huber's cost; a `limit` of 0 leaves r as it is."""
    xp, a = r.__array_namespace__(), abs(r)
    beyond = (limit > 0.0) & (a > limit)
    root = xp.sqrt(xp.where(beyond, limit * (2.0 * a - limit), 1.0))
    return xp.where(beyond, xp.sign(r) * root, r)


def robust_share(r: Float[np.ndarray, "*N"], limit: float) -> Float[np.ndarray, "*N"]:
    """∂s/∂r: factor of the Jacobian's rows under Huber's cost, computed by NumPy; 1 where `limit` is 0."""
    a = np.maximum(np.abs(r), limit)
    return limit / np.sqrt(limit * (2.0 * a - limit)) if limit else np.ones_like(a)


def residuals_of(model: Model, batch: Batch, channels: tuple[str, ...]) -> dict[str, Float[np.ndarray, "_columns B T"]]:
    """Measured − predicted of every trial, in the channels' units, also at samples whose mask is 0."""
    return _by_blocks(lambda block: _residuals_jit(model, block, channels), model, batch)


def tangent(
    model: Model, free: Free, batch: Batch, channels: tuple[str, ...], parts: Collection[str] | None = None
) -> Tangent:
    """Residuals and their derivatives by the parameters in `free`.

    `parts`: fields of the model by whose parameters derivatives are computed, by default all; the others are zero. The
    program is compiled for a block of trials (`blocks`); the block's padding is removed from the result.
    """
    if batch.x.simulated:
        return Tangent(*jax.tree.map(np.asarray, _simulated_tangent(model, free, batch, channels)))
    wanted = _wanted(free, free.parts if parts is None else parts)
    return Tangent(*_by_blocks(lambda block: _tangent(model, free, block, channels, wanted), model, batch))


def residuals_by_tangent(
    model: Model, free: Free, batch: Batch, channels: tuple[str, ...]
) -> dict[str, Float[np.ndarray, "_columns B T"]]:
    """Residuals as of `residuals_of`, computed by the program of `tangent`, so that none is compiled for them alone."""
    if batch.x.simulated:
        return residuals_of(model, batch, channels)
    none = _wanted(free, ())
    return _by_blocks(lambda block: _tangent(model, free, block, channels, none)[0], model, batch)


def _wanted(free: Free, parts: Collection[str]) -> Bool[Array, " parts"]:
    """Whether derivatives by each part of the model that has free parameters are wanted."""
    return jax.device_put(np.array([part in parts for part in dict.fromkeys(free.parts)]))


def linearise(model: Model, free: Free, batch: Batch, filters: Filters, limit: float = 0.0) -> Linearised:
    """Residuals and per-trial factors at `model`, with respect to the parameters in `free`."""
    return whitened(tangent(model, free, batch, tuple(filters)), batch, filters, limit)


def whitened(
    along: Tangent,
    batch: Batch,
    filters: Filters,
    limit: float = 0.0,
    weights: Float[np.ndarray, " B"] | None = None,
    reversals: Reversals = NO_REVERSALS,
) -> Linearised:
    """Whiten and compress a tangent.

    `limit`: Huber's, in standard deviations, 0 for none. `weights`: of the trials, 1 by default.
    """
    x = white_tangent(along, batch, filters, reversals)
    return Linearised(along, x.white, x.jacobian, factored(x.white, x.jacobian, limit, weights))


def white_tangent(along: Tangent, batch: Batch, filters: Filters, reversals: Reversals = NO_REVERSALS) -> White:
    """Whiten a tangent, without compressing it."""
    white = white_of(along.residuals, batch, filters, reversals)
    return White(along, white, _white_jacobian(along.slopes, batch, filters, reversals))


def factored(
    white: Float[np.ndarray, "B rows"],
    J: Float[np.ndarray, "B rows p"],
    limit: float,
    weights: Float[np.ndarray, " B"] | None = None,
) -> Float[np.ndarray, "B p+1 p+1"]:
    """Triangular factor of [J r] of every trial under Huber's cost, from its rows and columns that are not all zero."""
    B, _, p = J.shape
    share, s = robust_share(white, limit), robust_residuals(white, limit)
    out = np.zeros((B, p + 1, p + 1))
    for b in range(B):
        touched = J[b] != 0.0
        rows = np.flatnonzero(touched.any(axis=1) | (white[b] != 0.0))
        columns = np.append(np.flatnonzero(touched.any(axis=0)), p)
        A = np.empty((rows.size, columns.size), order="F")
        A[:, :-1] = J[b][np.ix_(rows, columns[:-1])] * share[b, rows, None]
        A[:, -1] = s[b, rows]
        R = triangular(A)
        out[b, : len(R)][:, columns] = R
    return out if weights is None else np.sqrt(weights)[:, None, None] * out


def gram_of_linear_rows(
    white: Float[np.ndarray, "B rows"],
    J: Float[np.ndarray, "B rows p"],
    limit: float,
    weights: Float[np.ndarray, " B"] | None = None,
) -> Float[np.ndarray, "p p"]:
    """Gram matrix of the rows of `factored` beyond Huber's limit, whose cost is linear."""
    trial, row = np.nonzero(np.abs(white) > limit)
    share = robust_share(white[trial, row], limit) * (1.0 if weights is None else np.sqrt(weights[trial]))
    A = J[trial, row] * share[:, None]
    return A.T @ A


def triangular(A: Float[np.ndarray, "N p"]) -> Float[np.ndarray, "k p"]:
    """R of A = Q R, k = min(N, p).

    LAPACK's ?geqrt factors its panels recursively, and takes a third of ?geqrf's time on tall matrices.
    """
    if not A.size:
        return np.zeros((0, A.shape[1]))
    return np.triu(_geqrt(min(PANEL, *A.shape), A)[0][: A.shape[1]])


def _by_blocks(f: Callable[[Batch], Tree], model: Model, batch: Batch) -> Tree:
    """Apply f to the blocks of a batch, and join its arrays (…, B, T) without their padding.

    A block's result is released before the next one is computed. Without effects, which may have a memory, (1) of
    joints that are not held is pointwise in time.
    """
    (B, T), out = batch.x.time.shape, None
    pointwise = not (model.effects or batch.x.held or batch.x.simulated)
    batch = in_rows(batch) if pointwise else batch
    for block in blocks(batch, pointwise):
        part = f(block.batch)
        if out is None:
            out = jax.tree.map(lambda a: np.empty((*a.shape[:-2], *batch.x.time.shape)), part)
        jax.tree.map(partial(_put, block), out, part)
    assert out is not None
    if not pointwise:
        return out
    rows = math.prod(batch.x.time.shape)
    return jax.tree.map(lambda a: a.reshape(*a.shape[:-2], rows)[..., : B * T].reshape(*a.shape[:-2], B, T), out)


def _put(block: Block, out: Float[np.ndarray, "*k B T"], part: Float[Array, "*k b t"]) -> None:
    """Copy a block's array without its padding into `out`."""
    b, t = part.shape[-2:]
    room = out[..., block.trial : block.trial + b, block.sample : block.sample + t]
    room[...] = np.asarray(part)[..., : room.shape[-2], : room.shape[-1]]


_residuals_jit = quick_jit(_residuals)


@quick_jit
def _simulated_tangent(model: Model, free: Free, batch: Batch, channels: tuple[str, ...]) -> tuple[dict, dict]:
    """Residuals of simulations and their derivatives, one start at a time, in reverse mode.

    Reverse mode is cheaper here: a start predicts m angles, which depend on many more parameters.
    """
    values, split = ravel_pytree(free.values(model))

    def one(values, start: Batch):
        residuals = _residuals(free.put(model, split(values)), start, channels)
        return residuals, residuals

    each = jax.vmap(jax.jacrev(one, has_aux=True), in_axes=(None, -1), out_axes=-1)  # start of a trial
    slopes, residuals = jax.vmap(each, in_axes=(None, -2), out_axes=-2)(values, batch)
    return residuals, {c: jnp.moveaxis(J, 1, 0) for c, J in slopes.items()}


@quick_jit
def _tangent(model: Model, free: Free, batch: Batch, channels: tuple[str, ...], wanted: Bool[Array, " parts"]):
    """Residuals and their derivatives, which are zero and not computed for the parts of the model not `wanted`."""

    def f(leaves):
        return _residuals(free.put_whole(model, leaves), batch, channels)

    whole = free.whole(model)
    residuals, pushforward = jax.linearize(f, whole)
    still = jax.tree.map(jnp.zeros_like, whole)

    def columns(part: str, wanted: Bool[Array, ""]) -> dict[str, Array]:
        """Derivatives by the free entries of one part of the model.

        The pushforward is linear, so that its derivative at zero is itself. Taking the derivative lets JAX drop the
        operations that only the other parts' zeros pass through, which are most of them.
        """
        mine = [k for k, p in enumerate(free.parts) if p == part]
        zero, split = ravel_pytree([still[k] for k in mine])
        starts = np.cumsum([0, *(still[k].size for k in mine)])
        at = jnp.concatenate([start + free.entries[k] for start, k in zip(starts, mine, strict=False)])

        def alone(step):
            moved = dict(zip(mine, split(step), strict=True))
            return pushforward([moved.get(k, z) for k, z in enumerate(still)])

        def along(entry) -> dict[str, Array]:
            unit = (jnp.arange(zero.size) == entry).astype(float)
            return jax.jvp(alone, (zero,), (unit,))[1]

        return jax.lax.cond(
            wanted,
            lambda: jax.lax.map(along, at),
            lambda: {c: jnp.zeros((at.size, *r.shape)) for c, r in residuals.items()},
        )

    parts = [columns(part, of_part) for part, of_part in zip(dict.fromkeys(free.parts), wanted, strict=True)]
    return residuals, jax.tree.map(lambda *a: jnp.concatenate(a), *parts)
