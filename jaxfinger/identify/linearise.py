"""Equation (1) linearised at a model, trial by trial, and compressed: the common ground of every fit.

With J the Jacobian of a trial's white residuals r, one QR factorisation [J r] = Q [R d; 0 ρ] keeps all that least
squares needs: ‖r + J δ‖² = ‖d + R δ‖² + ρ². A stage, the joint refinement, a bootstrap resample and a leave-one-out
refit are sums over these small factors; their cost no longer depends on the number of samples.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.data.schema import CHANNELS
from jaxfinger.experiments import Batch, blocks, predict
from jaxfinger.identify.noise import whiten
from jaxfinger.identify.parameters import Free
from jaxfinger.model import Model

Filters = dict[str, Float[Array, "columns order+1 order+1"]]


class Linearised(NamedTuple):
    """One experiment's residuals and compressed Jacobian at a model."""

    residuals: dict[str, Float[np.ndarray, "columns B T"]]  # measured − predicted, by channel, in the channel's unit
    white: Float[np.ndarray, "B rows"]  # the same, whitened and flat, before weights
    jacobian: Float[np.ndarray, "B rows p"]  # J, before weights
    factor: Float[np.ndarray, "B k p+1"]  # triangular, of [J r] with weights


def white_rows(model: Model, batch: Batch, filters: Filters) -> tuple[dict, Float[Array, "B rows"]]:
    """Residuals by channel, and the same white, one row a trial: unit variance where model and noise are right."""
    predicted = predict(model, batch.x, tuple(filters))
    residuals = {c: batch.y[c] - predicted[c] for c in filters}
    white = [whiten(residuals[c], batch.mask[c], filters[c], demean=CHANNELS[c].free_zero) for c in filters]
    return residuals, jnp.concatenate([jnp.moveaxis(w, 1, 0).reshape(w.shape[1], -1) for w in white], axis=1)


def residuals_of(model: Model, batch: Batch, channels: tuple[str, ...]) -> dict[str, Float[np.ndarray, "columns B T"]]:
    """Measured − predicted, by channel, in the channel's unit; also where a sample does not count."""
    return _cut([_residuals(model, block, channels) for block in blocks(batch)], batch)


def linearise(
    model: Model, free: Free, batch: Batch, filters: Filters, weights: Float[np.ndarray, "B rows"] | None = None
) -> Linearised:
    """Residuals and per-trial factors at `model`, with respect to the parameters in `free`; all weights one by default.

    Compiled for a block of trials (`blocks`), whose additions are cut off again.
    """
    B, T = batch.x.time.shape
    parts = [_linearise(model, free, block, filters, jax.device_put(True)) for block in blocks(batch)]
    residuals, *rows = zip(*parts, strict=True)

    def cut(parts):
        each = np.concatenate([np.asarray(a) for a in parts])[:B]
        wide = each.reshape(B, -1, residuals[0][next(iter(filters))].shape[-1], *each.shape[2:])
        return wide[:, :, :T].reshape(B, -1, *each.shape[2:])

    white, J = map(cut, rows)
    columns = np.concatenate([J, white[..., None]], axis=-1)
    if weights is not None:
        columns *= weights[..., None]
    return Linearised(_cut(residuals, batch), white, J, np.asarray(np.linalg.qr(columns, mode="r")))


def missed(model: Model, free: Free, batch: Batch, filters: Filters) -> dict[str, Float[np.ndarray, "columns B T"]]:
    """`residuals_of`, by the program of `linearise`: where that is compiled, it costs no compilation."""
    return _cut([_linearise(model, free, block, filters, jax.device_put(False))[0] for block in blocks(batch)], batch)


def _cut(parts: Sequence[dict[str, Array]], batch: Batch) -> dict[str, Float[np.ndarray, "columns B T"]]:
    """Blocks of residuals put together again."""
    B, T = batch.x.time.shape
    return {c: np.concatenate([np.asarray(x[c]) for x in parts], axis=1)[:, :B, :T] for c in parts[0]}


@quick_jit
def _residuals(model: Model, batch: Batch, channels: tuple[str, ...]) -> dict[str, Array]:
    predicted = predict(model, batch.x, channels)
    return {c: batch.y[c] - predicted[c] for c in channels}


@quick_jit
def _linearise(model: Model, free: Free, batch: Batch, filters: Filters, slopes: Array):
    """Residuals, white rows, and their Jacobian: zero unless `slopes`."""

    def f(values):
        residuals, white = white_rows(free.put(model, values), batch, filters)
        return white, residuals

    values = free.values(model)
    white, pushforward, residuals = jax.linearize(f, values, has_aux=True)
    still = jax.tree.map(jnp.zeros_like, values)

    def columns(part: str) -> Float[Array, "k B rows"]:
        """Derivatives by the parameters of one part of the model. The derivative of a linear function is itself, but
        for what the zeros of the other parts pass through: most of it.
        """
        mine = [k for k, p in enumerate(free.parts) if p == part]
        zero, split = ravel_pytree([still[k] for k in mine])

        def alone(step):
            moved = dict(zip(mine, split(step), strict=True))
            return pushforward([moved.get(k, z) for k, z in enumerate(still)])

        return jax.lax.map(lambda unit: jax.jvp(alone, (zero,), (unit,))[1], jnp.eye(zero.size))

    def jacobian():
        return jnp.concatenate([columns(part) for part in dict.fromkeys(free.parts)])

    count = sum(v.size for v in values)
    J = jax.lax.cond(slopes, jacobian, lambda: jnp.zeros((count, *white.shape)))
    return residuals, white, jnp.moveaxis(J, 0, -1)
