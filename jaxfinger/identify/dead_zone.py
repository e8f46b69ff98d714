"""Torques whose tensions lie near the end of their friction's dead zone, which a fit does not count."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxfinger.data import Session
from jaxfinger.data.signals.sizes import Sizes, sizes_of
from jaxfinger.experiments import Stack
from jaxfinger.model import Model

# Standard deviations of one sample of a load cell, the usual three sigma. Behind the low-pass a tension has less white
# noise, but all of its slow noise, and the error of the converter where it hardly changes.
MIN_STDS_TO_DEAD_ZONE = 3.0


def clear_of_dead_zones(
    stacks: dict[str, Stack], model: Model, session: Session, sizes: Sizes | None = None
) -> dict[str, Stack]:
    """Leave out torques of joints that tendons drive where noise may carry a tension across its friction's dead zone.

    All of a tension below a₀/(1 − a₁) is lost (`bounded`). Near there the model passes noise of the load cell that
    raises the tension and not noise that lowers it, and a fit prefers the a₀ that passes least noise: errors in
    variables, of several standard deviations of a₀ where an antagonist is held there.
    """
    if not any(stack.experiment.unloaded for stack in stacks.values()):
        return stacks
    margin, friction = MIN_STDS_TO_DEAD_ZONE * (sizes or sizes_of(session)).noise, model.tendon_friction
    drives = np.asarray(session.finger.crosses) & np.asarray(session.finger.active)[:, None]

    def cleared(stack: Stack) -> Stack:
        below, above = (
            np.asarray(friction.loss(tension) > jnp.maximum(tension, 0.0))
            for tension in (stack.batch.x.tension - margin, stack.batch.x.tension + margin)
        )
        unclear = np.einsum("nm,nbt->mbt", drives, below != above) > 0
        mask = dict(stack.batch.mask)
        mask["joint_torque"] = jax.device_put(np.where(unclear, 0.0, mask["joint_torque"]))
        return replace(stack, batch=replace(stack.batch, mask=mask))

    return {e: cleared(stack) if stack.experiment.unloaded else stack for e, stack in stacks.items()}
