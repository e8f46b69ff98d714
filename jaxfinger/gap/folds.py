"""Each third of a session held out in turn."""

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.gap.problem import Problem

FOLDS = 3
FOLD_PRIOR = 0.05  # precision, in deviations of the whole fit, that keeps near it what the other folds do not see


def folds(problem: Problem) -> dict[str, np.ndarray]:
    """(B, T) fold of every sample, by experiment: whole trials, or contiguous blocks of one that stands alone."""
    strata = {n: (t.experiment, t.joint, t.tendon) for n in problem.trial_names for t in [problem.session[n]]}
    count = {s: list(strata.values()).count(s) for s in strata.values()}
    seen: dict[tuple, int] = {}
    out = {}
    for e, stack in problem.stacks.items():
        out[e] = np.zeros(stack.batch.x.time.shape, dtype=int)
        for b, name in enumerate(stack.trials):
            stratum = strata[name]
            if count[stratum] == 1:
                time = np.asarray(stack.batch.x.time)[b]
                out[e][b] = np.minimum(2 * FOLDS * time / max(time.max(), 1e-9), 2 * FOLDS - 1).astype(int) % FOLDS
                continue
            out[e][b] = seen.get(stratum, len(seen) % FOLDS)
            seen[stratum] = (out[e][b, 0] + 1) % FOLDS
    return out


def fold_of_row(problem: Problem) -> Int[np.ndarray, " N"]:
    """Fold of every white row."""
    fold = folds(problem)
    return np.concatenate([fold[e][rows.trial, rows.time] for e, rows in problem.rows.items()])


def equilibrated(
    J: Float[np.ndarray, "N p"], root: Float[np.ndarray, "k p"]
) -> tuple[Float[np.ndarray, "N p"], Float[np.ndarray, "k+p p"], Float[np.ndarray, " p"]]:
    """J in columns of length one, the prior's rows in the same units with those that keep near the whole fit what no
    trial shows, and the scale: zero where J has nothing.
    """
    size = np.linalg.norm(J, axis=0)
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    return J * scale, np.vstack([root * scale, FOLD_PRIOR * np.eye(len(size))]), scale
