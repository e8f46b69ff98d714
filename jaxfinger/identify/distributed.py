"""The same work spread over processes and machines with JAX's own runtime: each maps its share, results are gathered.

A cluster job is a launch command: start one process a machine with the same arguments and its own number,

    initialise("host:port", processes=4, process=k)
    theta, failed = refit_distributed(compressed, weights)
    members = fit_many_distributed(sessions, fit, session)

or leave the arguments of `initialise` out where the scheduler is one that JAX knows (Slurm, Open MPI, a TPU pod).
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
    """Join the job; before anything else touches a device."""
    jax.distributed.initialize(coordinator_address=address, num_processes=processes, process_id=process)


def share(count: int) -> slice:
    """The members of this process: equal shares in order, the last one may be shorter."""
    size = -(-count // jax.process_count())
    return slice(min(count, jax.process_index() * size), min(count, (jax.process_index() + 1) * size))


def refit_distributed(
    compressed: Compressed,
    weights: Float[np.ndarray, "R K"],
    given: Float[np.ndarray, "R k"] | None = None,
    batching: Batching | None = None,
) -> tuple[Float[np.ndarray, "R P"], Bool[np.ndarray, " R"]]:
    """`refit`, every process its share; all of them return all members."""
    mine = share(len(weights))
    theta, failed = refit(compressed, weights[mine], None if given is None else given[mine], batching)
    return gather(theta, len(weights)), gather(failed, len(weights)).astype(bool)


def fit_many_distributed(
    sessions: Sequence[Session], template: Fit, of: Session, batching: Batching | None = None
) -> Members:
    """`fit_many`, every process its share; all of them return all members. No process reads another's sessions, so
    `sessions` may be a sequence that reads its files when asked for them.
    """
    mine = share(len(sessions))
    found = fit_many([sessions[k] for k in range(mine.start, mine.stop)], template, of, batching)
    values, std, failed, steps = (
        gather(a, len(sessions)) for a in (found.values, found.std, found.failed, found.steps)
    )
    return Members(values, std, failed.astype(bool), steps.astype(int), template)


def gather(mine: np.ndarray, count: int) -> np.ndarray:
    """The shares of all processes, in order, on every process."""
    from jax.experimental.multihost_utils import process_allgather

    size = -(-count // jax.process_count())
    padded = np.zeros((size, *mine.shape[1:]))
    padded[: len(mine)] = mine
    return np.asarray(process_allgather(padded, tiled=True)).reshape(-1, *mine.shape[1:])[:count]
