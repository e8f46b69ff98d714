"""Torques beside reversals of joints that a motor moves: their friction is known but for the time at which it reverses.

With v the change of white rows by one standard deviation of a reversal's time, earlier or later, rows beside reversals
have the covariance I + V Vᵀ. Columns of V are the two v of every reversal, since noise of the encoder shifts each for
itself, and for each joint and trial the sum of the later ones, since a contact that yields delays all reversals alike.
With the singular values V = U S Wᵀ,

    x + C x,   C = U ((I + S²)^−½ − I) Uᵀ,

is white.
"""

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.sparse import block_diag, csr_array

from jaxfinger.experiments import Stack, predict_compiled
from jaxfinger.identify.noise import whiten
from jaxfinger.identify.sources import Source
from jaxfinger.model import Model

TORQUE = "joint_torque"


def torque_changes(stack: Stack, model: Model) -> Float[np.ndarray, "2 m B T"] | None:
    """Change of torques, N m, if every reversal came one standard deviation of its time earlier, and later.

    It is zero where a torque does not count beside a reversal, as where the model has no friction: friction that it
    lacks would reverse at a time that is not known. None where no reversals have been looked for.
    """
    if stack.reversals is None:
        return None
    x = stack.batch.x
    moved = [eqx.tree_at(lambda x: x.joint_direction, x, x.joint_direction + d) for d in stack.reversals.changes]
    torque, *then = (np.asarray(predict_compiled(model, at, (TORQUE,))[TORQUE]) for at in (x, *moved))
    measured = np.asarray(stack.batch.mask[TORQUE]).any(axis=-1, keepdims=True)
    return np.where(stack.reversals.beside & measured, np.stack(then) - torque, 0.0)


def with_reversals(source: Source, changes: Float[np.ndarray, "2 m B T"] | None) -> Source:
    """The source with the torques beside reversals, as well as they are known. `changes`: of `torque_changes`."""
    if changes is None:
        return source
    mask = np.where(changes.any(axis=0), 1.0, np.asarray(source.batch.mask[TORQUE]))
    v = np.asarray(whiten(changes, mask, np.asarray(source.filters[TORQUE]), False))
    batch = eqx.tree_at(lambda b: b.mask[TORQUE], source.batch, jax.device_put(mask))
    return source._replace(batch=batch, reversals={TORQUE: [_of_column(column) for column in v.swapaxes(0, 1)]})


def _of_column(v: Float[np.ndarray, "2 B T"]) -> csr_array:
    """C of the module's docstring for the rows of one column, trial by trial; v is zero away from reversals."""
    return csr_array(block_diag([_of_trial(trial) for trial in v.swapaxes(0, 1)]))


def _of_trial(v: Float[np.ndarray, "2 T"]) -> csr_array:
    T, at = v.shape[1], np.flatnonzero(v.any(axis=0))
    number = np.cumsum(np.diff(at, prepend=at[:1]) > 1)  # of the reversal beside each row
    each = [np.where(number == k, v[:, at], 0.0) for k in np.unique(number)]
    V = np.concatenate([*each, v[1:, at]]).T
    U, S, _ = np.linalg.svd(V, full_matrices=False)
    C = (U * ((1.0 + S**2) ** -0.5 - 1.0)) @ U.T
    return csr_array((C.ravel(), (np.repeat(at, at.size), np.tile(at, at.size))), (T, T))
