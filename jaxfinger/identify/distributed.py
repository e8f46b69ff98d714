"""Refits and batches of fits spread over processes and machines by JAX's distributed runtime.

Each process computes its share of the members, and all results are gathered. A job starts one process on each machine,
with the same arguments and a number of its own:

    initialise("host:port", processes=4, process=k)
    theta, failed = refit_distributed(compressed, weights)
    members = fit_many_distributed(sessions, fit, session)

Under a scheduler that JAX knows (Slurm, Open MPI, a TPU pod), `initialise` needs no arguments.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxfinger.data import Session
from jaxfinger.identify.batch import Members, fit_many
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.resample import Batching, Compressed, refit


def initialise(address: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Join the job. Call it before any other use of a device."""
    jax.distributed.initialize(coordinator_address=address, num_processes=processes, process_id=process)


def share(count: int) -> slice:
    """Members of this process out of `count`: equal shares in order, of which the last may be shorter or empty."""
    size = -(-count // jax.process_count())
    return slice(min(count, jax.process_index() * size), min(count, (jax.process_index() + 1) * size))


def refit_distributed(
    compressed: Compressed,
    weights: Float[np.ndarray, "R K"],
    given: Float[np.ndarray, "R k"] | None = None,
    batching: Batching | None = None,
) -> tuple[Float[np.ndarray, "R P"], Bool[np.ndarray, " R"]]:
    """Run `refit` with the members shared among processes; each process returns all members."""
    mine = share(len(weights))
    theta, failed = refit(compressed, weights[mine], None if given is None else given[mine], batching)
    return gather(theta, len(weights)), gather(failed, len(weights)).astype(bool)


def fit_many_distributed(
    sessions: Sequence[Session], template: Fit, of: Session, batching: Batching | None = None
) -> Members:
    """Run `fit_many` with the sessions shared among processes; each process returns all members.

    A process reads its own sessions only, so that `sessions` may be a sequence that reads files on access.
    """
    mine = share(len(sessions))
    found = fit_many([sessions[k] for k in range(mine.start, mine.stop)], template, of, batching)
    values, std, failed, steps = (
        gather(a, len(sessions)) for a in (found.values, found.std, found.failed, found.steps)
    )
    return Members(values, std, failed.astype(bool), steps.astype(int), template)


def gather(mine: np.ndarray, count: int) -> np.ndarray:
    """Shares of all processes, joined in order, `count` rows, on every process."""
    from jax.experimental.multihost_utils import process_allgather

    size = -(-count // jax.process_count())
    padded = np.zeros((size, *mine.shape[1:]))
    padded[: len(mine)] = mine
    return np.asarray(process_allgather(padded, tiled=True)).reshape(-1, *mine.shape[1:])[:count]
