"""What the model says each experiment's channels read, from the other measured channels."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxfinger.model import Model, Motion, excursion, external_torque, fingertip_force, simulated_ahead

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


def demean(y: Float[Array, "columns B T"], mask: Float[Array, "columns B T"]) -> Float[Array, "columns B T"]:
    """Without one constant a trial and column: the encoders' zero of an excursion is arbitrary."""
    mean = jnp.sum(y * mask, axis=-1, keepdims=True) / jnp.maximum(jnp.sum(mask, axis=-1, keepdims=True), 1.0)
    return (y - mean) * mask
