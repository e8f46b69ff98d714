"""How the gap of every channel is made up, on trials that no fit has seen.

A third of the trials is held out in turn. The others refit the causes' amplitudes and shapes in the weights of the
formula, and the nominal parameters to what the causes leave; then each cause alone is dropped, and the nominal
parameters are refitted without it. All of that is linear about the causes' optimum, and made of products of rows by
trial and column. The share of a cause is what is lost without it, in mean squares of white residuals beyond noise.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from jaxfinger.gap.exact import Baseline, SearchState
from jaxfinger.gap.folds import FOLD_PRIOR, FOLDS, equilibrated, fold_of_row
from jaxfinger.gap.problem import Problem

DRAWS = 400  # of the bootstrap over trials
A_GAP = 6.0  # log evidence of a column, from which on it is called one with a gap
STANDS_OUT = 1.05  # mean square of a held-out channel in that of its noise, below which shares of it mean nothing


@dataclass(frozen=True)
class Budget:
    """Sums of squares of held-out white residuals by trial (its running number) and column."""

    cells: list[tuple[int, int]]  # trial, column
    n: Float[np.ndarray, " cells"]
    before: Float[np.ndarray, " cells"]
    after: Float[np.ndarray, " cells"]
    without: Float[np.ndarray, "causes cells"]
    open: frozenset[int]  # columns with a gap
    channels: tuple[tuple[str, str], ...]  # of every column

    def of(self, columns: set[int]) -> tuple[float, Float[np.ndarray, " causes"], float]:
        """Gap per sample, share of it lost without each cause, and left with all."""
        return self._shares(np.isin([c for _, c in self.cells], list(columns)).astype(float))

    def _shares(self, weight: Float[np.ndarray, " cells"]):
        n = max(float(weight @ self.n), 1e-9)
        gap = float(weight @ (self.before - self.n))
        after = float(weight @ (self.after - self.n))
        lost = (self.without - self.after) @ weight
        safe = max(gap, (STANDS_OUT - 1.0) * n)
        return gap / n, np.clip(lost / safe, 0.0, 1.0), float(np.clip(after / safe, 0.0, 1.0))

    def overall(self) -> tuple[np.ndarray, np.ndarray, float, tuple[float, float]]:
        """Of each cause the mean share over channels with a gap, with a 95 % interval of a bootstrap over trials; and
        what is left.
        """
        rng = np.random.default_rng(0)
        column = np.array([c for _, c in self.cells], int)
        trial = np.array([t for t, _ in self.cells], int)
        by_channel: dict[tuple[str, str], list[int]] = {}
        for c in sorted(self.open):
            by_channel.setdefault(self.channels[c], []).append(c)
        inside = [np.isin(column, cs) for cs in by_channel.values()]

        def means(count: np.ndarray) -> np.ndarray:
            found = [self._shares(w * count[trial]) for w in inside if (w * count[trial] * self.n).sum() > 0]
            if not found:
                return np.zeros(len(self.without) + 1)
            return np.mean([np.append(lost, left) for _, lost, left in found], axis=0)

        size = int(trial.max(initial=0)) + 1
        value = means(np.ones(size))
        # Within an experiment, so that no draw lacks one.
        experiment = np.array([list(dict.fromkeys(self.channels)).index(self.channels[c]) for c in column], int)
        strata = {tuple(np.unique(trial[experiment == e])) for e in np.unique(experiment)}
        strata = [np.array(s) for s in sorted(strata)]

        def draw() -> np.ndarray:
            return np.bincount(np.concatenate([rng.choice(s, len(s)) for s in strata]), minlength=size).astype(float)

        draws = np.array([means(draw()) for _ in range(DRAWS if inside else 1)])
        low, high = np.quantile(draws, (0.025, 0.975), axis=0)
        low, high = np.minimum(low, value), np.maximum(high, value)
        return value[:-1], np.stack([low[:-1], high[:-1]], axis=1), float(value[-1]), (float(low[-1]), float(high[-1]))


def budget(baseline: Baseline, state: SearchState, plain: Problem, open_columns: frozenset[int]) -> Budget:
    """`plain`: the problem at the nominal model refitted to all trials, which is the model before."""
    fold, trial = fold_of_row(plain), plain.trial_of_row
    cells, null, full = _products(baseline, plain, state, fold, trial)
    n, before, after, without = [], [], [], []
    k, effects = state.problem.J.shape[1], len(state.effects)
    of_coordinate = np.array([c.effect for c in state.coordinates], int)
    for held in range(FOLDS):
        seen, unseen = (
            [i for i, c in enumerate(cells) if c[2] != held],
            [i for i, c in enumerate(cells) if c[2] == held],
        )
        weight = _weights(cells, full, seen, k)
        x0 = _nominal(null[seen].sum(axis=0), plain, np.eye(1 + k)[0], k)
        joint = _joint(full[seen], weight, state, k, of_coordinate, effects)
        x1 = _nominal(full[seen].sum(axis=0), state.problem, joint, k)
        less = []
        for i in range(effects):
            y = _joint(full[seen], weight, state, k, of_coordinate, effects, without=i)
            less.append(_nominal(full[seen].sum(axis=0), state.problem, y, k))
        for i in unseen:
            n.append((cells[i][0], cells[i][1], cells[i][3]))
            before.append(x0 @ null[i] @ x0)
            after.append(x1 @ full[i] @ x1)
            without.append([x @ full[i] @ x for x in less])
    found = np.array(without).reshape(len(n), effects).T
    return Budget(
        [(t, c) for t, c, _ in n],
        np.array([m for _, _, m in n], float),
        np.array(before),
        np.array(after),
        found,
        open_columns,
        tuple((c.experiment, c.channel) for c in baseline.columns.items),
    )


def _products(baseline: Baseline, plain: Problem, state: SearchState, fold, trial):
    """Cells (trial, column, fold, rows), and products of rows there: of the nominal model's, and of [residual, J,
    slopes, changes] of the set's.
    """
    here = state.problem
    rows0 = np.vstack([plain.r[None], plain.J.T])
    rows1 = np.vstack([state.r[None], here.J.T, state.slopes, state.changes])
    cells, null, full = [], [], []
    for c, column in enumerate(baseline.columns.items):
        key = trial[column.rows] * FOLDS + fold[column.rows]
        for u in np.unique(key):
            at = column.rows[key == u]
            cells.append((int(u) // FOLDS, c, int(u) % FOLDS, len(at)))
            null.append(rows0[:, at] @ rows0[:, at].T)
            full.append(rows1[:, at] @ rows1[:, at].T)
    return cells, np.array(null), np.array(full)


def _weights(cells, full, seen, k) -> np.ndarray:
    """Of the seen cells: a column that the causes leave open counts as noisy as it is."""
    column = np.array([cells[i][1] for i in seen])
    n = np.bincount(column, [cells[i][3] for i in seen])
    e = np.bincount(column, [full[i][0, 0] for i in seen])
    return (np.maximum(n, 1.0) / np.maximum(np.maximum(e, n), 1.0))[column]


def _joint(
    seen, weight, state: SearchState, k: int, of_coordinate, effects: int, without: int | None = None
) -> np.ndarray:
    """Coefficients of [residual, J, slopes, changes] with slopes refitted, J too, a cause taken out where asked."""
    H = np.tensordot(weight, seen, 1)
    m = len(of_coordinate)
    x = np.zeros(1 + k + m + effects)
    x[0] = 1.0
    if without is not None:
        x[1 + k + m + without] = 1.0
    moves = [1 + k + j for j in range(m) if of_coordinate[j] != without]
    prior = np.zeros((1 + k + m,) * 2)
    root = np.column_stack([-state.problem.offset, state.problem.root])
    prior[: 1 + k, : 1 + k] = root.T @ root
    prior[1 + k :, 1 + k :] = np.eye(m)
    return _solved(H, prior, x, [*range(1, 1 + k), *moves])


def _nominal(H, problem: Problem, x: np.ndarray, k: int) -> np.ndarray:
    """The same with the nominal parameters refitted in white weights, and the rest as it is in x."""
    x = x.copy()
    x[1 : 1 + k] = 0.0
    root = np.column_stack([-problem.offset, problem.root])
    return _solved(H, root.T @ root, x, list(range(1, 1 + k)))


def _solved(H, prior, x, free: list[int]) -> np.ndarray:
    """x with its free coefficients at the least squares; what the trials do not see stays near nothing."""
    d = len(prior)
    A = H.copy()
    A[:d, :d] += prior
    scale = np.sqrt(np.maximum(np.diag(H)[free], 1e-300))
    M = A[np.ix_(free, free)] / np.outer(scale, scale) + FOLD_PRIOR**2 / max(float(np.max(scale**2)), 1.0) * np.eye(
        len(free)
    )
    out = x.copy()
    out[free] = 0.0
    out[free] = np.linalg.solve(M + 1e-11 * np.eye(len(free)), -(A[free] @ out) / scale) / scale
    return out


def held_out_gains(problem: Problem, members: list[Float[np.ndarray, "_k N"]]) -> list[float]:
    """Share of the gap that signatures explain, each member's alone, on trials for which neither they nor the nominal
    parameters were refitted.
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
    gap = alone - problem.r.size
    return [float(np.clip((alone - x) / max(gap, 0.01 * problem.r.size), 0.0, 1.0)) for x in with_member]
