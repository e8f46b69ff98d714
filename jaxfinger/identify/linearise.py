"""Equation (1) linearised at a model, trial by trial, and compressed: the common ground of every fit.

With J the Jacobian of a trial's white residuals r, one QR factorisation [J r] = Q [R d; 0 ρ] keeps all that least
squares needs: ‖r + J δ‖² = ‖d + R δ‖² + ρ². A stage, the joint refinement, a bootstrap resample and a leave-one-out
refit are sums over these small factors; their cost no longer depends on the number of samples.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.experiments import Batch, predict, widened
from jaxfinger.identify.noise import whiten
from jaxfinger.identify.parameters import Free
from jaxfinger.model import Model

Filters = dict[str, Float[Array, "columns order+1 order+1"]]


class Linearised(NamedTuple):
    """One experiment's residuals and compressed Jacobian at a model."""

    residuals: dict[str, Float[np.ndarray, "columns B T"]]  # measured − predicted, by channel, in the channel's unit
    white: Float[np.ndarray, "B rows"]  # the same, whitened and flat, before weights
    jacobian: Float[np.ndarray, "B rows p"]  # J, before weights
    factor: Float[np.ndarray, "B p+1 p+1"]  # triangular, of [J r] with weights


def white_rows(model: Model, batch: Batch, filters: Filters) -> tuple[dict, Float[Array, "B rows"]]:
    """Residuals by channel, and the same white, one row a trial: unit variance where model and noise are right."""
    predicted = predict(model, batch.x, tuple(filters))
    residuals = {c: batch.y[c] - predicted[c] for c in filters}
    white = [whiten(residuals[c], batch.mask[c], filters[c], demean=c == "tendon_excursion") for c in filters]
    return residuals, jnp.concatenate([jnp.moveaxis(w, 1, 0).reshape(w.shape[1], -1) for w in white], axis=1)


def residuals_of(model: Model, batch: Batch, channels: tuple[str, ...]) -> dict[str, Float[np.ndarray, "columns B T"]]:
    """Measured − predicted, by channel, in the channel's unit; also where a sample does not count."""
    B, T = batch.x.time.shape
    return {c: np.asarray(a)[:, :B, :T] for c, a in _residuals(model, widened(batch), channels).items()}


def linearise(
    model: Model, free: Free, batch: Batch, filters: Filters, weights: Float[np.ndarray, "B rows"] | None = None
) -> Linearised:
    """Residuals and per-trial factors at `model`, with respect to the parameters in `free`; all weights one by default.

    Compiled for the batch `widened`, whose additions are cut off again.
    """
    (B, T), wide = batch.x.time.shape, widened(batch)
    shape = len(wide.x.time), sum(len(f) for f in filters.values()), wide.x.time.shape[-1]
    weight = np.ones(shape)
    if weights is not None:
        weight[:B, :, :T] = weights.reshape(B, -1, T)
    residuals, white, J, factor = _linearise(model, free, wide, filters, jnp.asarray(weight.reshape(shape[0], -1)))

    def cut(rows):
        each = np.asarray(rows).reshape(*shape, *rows.shape[2:])
        return each[:B, :, :T].reshape(B, -1, *rows.shape[2:])

    residuals = {c: np.asarray(a)[:, :B, :T] for c, a in residuals.items()}
    return Linearised(residuals, cut(white), cut(J), np.asarray(factor)[:B])


@quick_jit
def _residuals(model: Model, batch: Batch, channels: tuple[str, ...]) -> dict[str, Array]:
    predicted = predict(model, batch.x, channels)
    return {c: batch.y[c] - predicted[c] for c in channels}


@quick_jit
def _linearise(model: Model, free: Free, batch: Batch, filters: Filters, weights: Float[Array, "B rows"]):
    theta = free.get(model)

    def f(theta):
        residuals, white = white_rows(free.set(model, theta), batch, filters)
        return white, residuals

    white, pushforward, residuals = jax.linearize(f, theta, has_aux=True)
    J = jnp.moveaxis(jax.lax.map(pushforward, jnp.eye(theta.size)), 0, -1)
    columns = jnp.concatenate([J, white[..., None]], axis=-1) * weights[..., None]
    return residuals, white, J, jnp.linalg.qr(columns, mode="r")
