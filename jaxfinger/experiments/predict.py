"""What the model says each experiment's channels read, from the other measured channels."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.effects import CatalogueEffect
from jaxfinger.model import (
    Model,
    Motion,
    Terms,
    excursion,
    external_torque,
    fingertip_force,
    resisting,
    resisting_change,
    resisting_torque,
    simulated_ahead,
)

_TRUTH = {
    "tendon_excursion": excursion,
    "joint_torque": external_torque,
    "fingertip_force": fingertip_force,
    "q": simulated_ahead,
}


def predict(model: Model, measured: Motion, channels: tuple[str, ...]) -> dict[str, Float[Array, "columns *T"]]:
    """Each channel by its dataset's name, batch last; units of the format."""
    x = model.true_motion(measured)
    return {c: model.reading(c, x, _TRUTH[c](model, x)) for c in channels}


def change(
    channel: str,
    effect: CatalogueEffect,
    nominal: Model,
    x: Motion,
    y0: Float[Array, "columns *T"],
    plain: Terms | None,
    contact: Float[Array, "3 m *T"] | None,
) -> Float[Array, "columns *T"]:
    """What an effect changes in a channel's prediction `y0`, of which only that is evaluated.

    `plain`: the nominal terms of (1) behind a torque or a force; `contact`: of a force, the `contact_map`.
    """
    model = replace(nominal, effects=(effect,))
    true = model.true_motion(x)
    same = true is x  # but for a sensor's effect
    if channel == "tendon_excursion":
        y = excursion(model, true, y0 if same else None)
    elif effect.moves_rigid_body() and contact is not None:
        y = fingertip_force(model, true)
    elif effect.moves_rigid_body():
        y = external_torque(model, true, plain=plain if same else None)
    else:
        assert plain is not None
        more = resisting_change(model, x, plain) if same else resisting_torque(model, true) - resisting(plain)
        y = y0 + (more if contact is None else jnp.sum(contact * more[None], axis=1))
    return effect.reading(channel, true, y) - y0


def demean(y: Float[Array, "columns B T"], mask: Float[Array, "columns B T"]) -> Float[Array, "columns B T"]:
    """Without one constant a trial and column: the encoders' zero of an excursion is arbitrary."""
    mean = jnp.sum(y * mask, axis=-1, keepdims=True) / jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1.0)
    return (y - mean) * mask
