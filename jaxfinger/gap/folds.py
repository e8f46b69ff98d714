"""Folds of a session for cross-validation: each third of it is held out in turn."""

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.gap.problem import Problem

FOLDS = 3  # Every refit then has two thirds of the trials.
# A weak prior holds every nominal parameter near the fit to all trials, so that one which the other folds do not show
# stays there. This is the root of its information, relative to that of all trials on the parameter: 0.05² is 0.25 %.
FOLD_PRIOR = 0.05


def folds(problem: Problem) -> dict[str, Int[np.ndarray, "_B _T"]]:
    """Fold of every sample, by experiment.

    Trials of one experiment, joint and tendon are dealt to the folds as wholes. One that stands alone is divided into
    2 FOLDS contiguous blocks of equal duration. Trials of which no sample counts, as where another simulator does not
    predict them, stand beside none.
    """
    counts = {problem.stacks[e].trials[b] for e, rows in problem.rows.items() for b in np.unique(rows.trial)}
    strata = {n: (t.experiment, t.joint, t.tendon) for n in counts for t in [problem.session[n]]}
    count = {s: list(strata.values()).count(s) for s in strata.values()}
    seen: dict[tuple, int] = {}
    out = {}
    for e, stack in problem.stacks.items():
        out[e] = np.zeros(stack.batch.x.time.shape, dtype=int)
        for b, name in enumerate(stack.trials):
            if name not in counts:
                continue
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
    """Scale the nominal parameters so that the columns of J have length one, and add the prior of FOLD_PRIOR.

    Returns the scaled J, the prior's rows in the same units, and the scale, which is zero for a zero column of J.
    """
    size = np.linalg.norm(J, axis=0)
    scale = np.divide(1.0, size, out=np.zeros_like(size), where=size > 0)
    return J * scale, np.vstack([root * scale, FOLD_PRIOR * np.eye(len(size))]), scale
