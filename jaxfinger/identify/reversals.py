"""Torques beside reversals of joints that a motor moves: their friction is known but for the time at which it reverses.

With v the change of white rows by one standard deviation of a reversal's time, earlier or later, rows beside reversals
have the covariance I + V Vᵀ. Columns of V are the two v of every reversal, since noise of the encoder shifts each for
itself, and for each joint and trial the sum of the later ones, since what a contact yields delays all reversals alike.
With the singular values V = U S Wᵀ,

    x + C x,   C = U ((I + S²)^−½ − I) Uᵀ,

is white.
"""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import scipy.sparse
from jaxtyping import Float

from jaxfinger.experiments import Stack, predict_compiled
from jaxfinger.model import Model


def with_reversals(stack: Stack, model: Model) -> Stack:
    """The stack with torques beside reversals as valid samples, and their changes (`Batch.uncertain`).

    They count where the model has friction. Friction that it lacks would reverse at a time that is not known.
    """
    if stack.reversals is None:
        return stack
    beside, directions = stack.reversals
    x, mask = stack.batch.x, np.asarray(stack.batch.mask["joint_torque"])
    moved = (eqx.tree_at(lambda x: x.joint_direction, x, x.joint_direction + jax.device_put(d)) for d in directions)
    torque, *then = (np.asarray(predict_compiled(model, at, ("joint_torque",))["joint_torque"]) for at in (x, *moved))
    uncertain = np.where(beside & mask.any(axis=-1, keepdims=True), np.stack(then) - torque, 0.0)
    counts = jax.device_put(np.where(np.any(uncertain != 0.0, axis=0), 1.0, mask))
    batch = replace(
        stack.batch,
        mask=stack.batch.mask | {"joint_torque": counts},
        uncertain={"joint_torque": uncertain},
    )
    return replace(stack, batch=batch)


def change_by_reversals(v: Float[np.ndarray, "2 columns B T"]) -> scipy.sparse.csr_array:
    """C of the module's docstring, for rows in the order of (columns, B, T); v is zero away from reversals."""
    series = v.reshape(2, -1, v.shape[-1]).swapaxes(0, 1)
    return scipy.sparse.csr_array(scipy.sparse.block_diag([_change(each) for each in series]))


def _change(v: Float[np.ndarray, "2 T"]) -> scipy.sparse.csr_array:
    """C of one column in one trial."""
    T, at = v.shape[1], np.flatnonzero(v.any(axis=0))
    number = np.cumsum(np.diff(at, prepend=at[:1]) > 1)  # of the reversal beside each row
    each = [np.where(number == k, v[:, at], 0.0) for k in np.unique(number)]
    V = np.concatenate([*each, v[1:, at]]).T
    U, S, _ = np.linalg.svd(V, full_matrices=False)
    C = (U * ((1.0 + S**2) ** -0.5 - 1.0)) @ U.T
    return scipy.sparse.csr_array((C.ravel(), (np.repeat(at, at.size), np.tile(at, at.size))), (T, T))
