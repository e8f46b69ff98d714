"""Predictions of an experiment's channels by a model, from the other measured channels."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from equinox import tree_at
from jaxtyping import Array, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.effects import CatalogueEffect
from jaxfinger.model import (
    Model,
    Motion,
    Terms,
    changed_torque,
    excursion,
    external_torque,
    fingertip_force,
    memories,
    resisting_change,
    simulated_ahead,
)


def _joint_torque(model: Model, x: Motion, nominal: Terms | None = None) -> Float[Array, "m *T"]:
    """τ_ext of (1), N m, behind the low-pass of a fit (`Motion.blur`) and the means of its blocks.

    Their variances add up to σ² (of a block of length Δ it is Δ²/12). The mean of a smooth function of time g about t
    is nearly (g(t − σ) + g(t + σ))/2, by the Gauss–Hermite rule with two nodes. Terms that are not linear in the
    low-passed angles and speeds, such as gravity, are therefore evaluated at q ± σ q̇ and q̇ ± σ q̈. States of effects
    are low-passed already. `nominal`: as of `external_torque`, for motion without a low-pass.
    """
    if x.blur is None or x.block is None or x.held:
        return external_torque(model, x, nominal=nominal)
    std = jnp.sqrt(x.blur**2 + x.block**2 / 12.0)
    memory = memories(model, x)

    def at(side: Float[Array, ""]) -> Float[Array, "m *T"]:
        away = (side * std)[None]
        there = tree_at(lambda m: (m.q, m.qd), x, (x.q + away * x.qd, x.qd + away * x.qdd))
        return external_torque(model, there, memory=memory)

    return jnp.mean(jax.vmap(at)(jnp.array([-1.0, 1.0])), axis=0)


_PREDICTORS = {
    "tendon_excursion": excursion,
    "joint_torque": _joint_torque,
    "fingertip_force": fingertip_force,
    "q": simulated_ahead,
}


def predict(model: Model, measured: Motion, channels: tuple[str, ...]) -> dict[str, Float[Array, "columns *T"]]:
    """Predict the reading of each channel, by its dataset's name, in the format's units; batch last."""
    x = model.true_motion(measured)
    return {c: model.reading(c, x, _PREDICTORS[c](model, x)) for c in channels}


# Compiled functions cannot call this one: JAX takes compiler options of the outermost function only.
predict_compiled = quick_jit(predict)


def change(
    channel: str,
    effect: CatalogueEffect,
    nominal: Model,
    x: Motion,
    y0: Float[Array, "columns *T"],
    terms: Terms | None,
    contact: Float[Array, "3 m *T"] | None,
) -> Float[Array, "columns *T"]:
    """Change of a channel's nominal prediction `y0` by one effect; only changed terms of (1) are evaluated.

    `terms`: nominal terms (`terms_without_effects`), for a torque or a force. `contact`: `contact_map`, for a force,
    else None.
    """
    model = replace(nominal, effects=(effect,))
    true = model.true_motion(x)
    same = true is x  # false for effects of sensors
    if channel == "tendon_excursion":
        y = excursion(model, true, y0 if same else None)
    elif contact is not None and true.q is not x.q:
        y = fingertip_force(model, true)
    elif effect.moves_rigid_body():
        y = _joint_torque(model, true, terms if same else None)
        y = y if contact is None else jnp.sum(contact * y[None], axis=1)
    else:
        assert terms is not None
        if contact is None:
            y = changed_torque(model, x, terms, y0)
        else:
            y = y0 + jnp.sum(contact * resisting_change(model, x, terms)[None], axis=1)
    return effect.reading(channel, true, y) - y0


def demean(y: Float[Array, "columns B T"], mask: Float[Array, "columns B T"]) -> Float[Array, "columns B T"]:
    """Remove the mean over valid samples of each trial and column, since the zero of an encoder is arbitrary."""
    mean = jnp.sum(y * mask, axis=-1, keepdims=True) / jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1.0)
    return (y - mean) * mask
