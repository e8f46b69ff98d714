"""Torques beside reversals of joints that a motor moves, which a diagnosis counts as well as their time allows."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np

from jaxfinger.experiments import Stack, predict_compiled
from jaxfinger.model import Model


def with_reversals(stack: Stack, model: Model) -> Stack:
    """The stack with the samples beside reversals, and the change of torque if these came later (`Batch.uncertain`).

    Where the model has no friction, none of these samples counts: friction that it lacks would reverse at a time that
    is not known.
    """
    if stack.reversals is None:
        return stack
    beside, changes = stack.reversals
    x, mask = stack.batch.x, np.asarray(stack.batch.mask["joint_torque"])
    moved = (eqx.tree_at(lambda x: x.joint_direction, x, x.joint_direction + jax.device_put(by)) for by in changes)
    torque, *then = (np.asarray(predict_compiled(model, at, ("joint_torque",))["joint_torque"]) for at in (x, *moved))
    counted = beside & mask.any(axis=-1, keepdims=True)
    uncertain = np.where(counted, np.stack(then) - torque, 0.0)
    counts = jax.device_put(np.where(np.any(uncertain != 0.0, axis=0), 1.0, mask))
    batch = replace(
        stack.batch, mask=stack.batch.mask | {"joint_torque": counts}, uncertain={"joint_torque": uncertain}
    )
    return replace(stack, batch=batch)
