"""Each third of a session held out in turn, and what a candidate explains of trials that its refit has not seen."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.gap.problem import Problem

FOLDS = 3
KEPT = 0.05  # precision, in deviations of the whole fit, that keeps near it what the other folds do not see


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
    return J * scale, np.vstack([root * scale, KEPT * np.eye(len(size))]), scale


def held_out_energies(
    problem: Problem, members: list[Float[np.ndarray, "k N"]]
) -> tuple[float, Float[np.ndarray, " members"]]:
    """Sum of squared white residuals of trials for which neither the nominal parameters nor amplitudes were refitted:
    of the nominal model alone, and with each member's signatures.
    """
    J, kept, _ = equilibrated(problem.J, problem.root)
    p, of_row = J.shape[1], fold_of_row(problem)
    columns = np.column_stack([J, problem.r, *(z.T for z in members)])
    prior = np.zeros((len(kept), columns.shape[1]))
    prior[:, :p], prior[: len(problem.root), p] = kept, -problem.offset
    # The rows that keep near the whole fit bound the condition of J, so that products of columns are all it takes.
    products, of_prior = [rows.T @ rows for rows in (columns[of_row == k] for k in range(FOLDS))], prior.T @ prior
    ends = np.cumsum([1, *(len(z) for z in members)])
    alone, with_member = 0.0, np.zeros(len(members))
    for k in range(FOLDS):
        seen = of_prior + sum(products[i] for i in range(FOLDS) if i != k)
        nominal = np.linalg.solve(seen[:p, :p], seen[:p, p:])
        off = np.vstack([-nominal, np.eye(nominal.shape[1])])  # targets, less what the refitted parameters take of them
        fitted, left = (off.T @ x @ off for x in (seen, products[k]))
        alone += float(left[0, 0])
        for i, (a, b) in enumerate(pairwise(ends)):
            amplitudes = np.linalg.lstsq(fitted[a:b, a:b], fitted[a:b, 0], rcond=1e-10)[0]
            both, parts = np.concatenate([[1.0], -amplitudes]), [0, *range(a, b)]
            with_member[i] += float(both @ left[np.ix_(parts, parts)] @ both)
    return alone, with_member
