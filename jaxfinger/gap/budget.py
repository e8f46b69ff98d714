"""The share of each cause in the gap of each channel, on trials that no fit has seen.

Each third of the trials is held out in turn. On the others the amplitudes and shapes of the causes are refitted, where
a column that they leave open weighs less, and then the nominal parameters to what the causes leave. The same is done
with each cause alone taken out. With E the mean square of held-out white residuals, the share of cause i is

    (E without i − E with all) / (E of the nominal model − 1),

where 1 is the mean square of the noise. All refits are linear about the causes' optimum, so they need only the products
of rows (residual, Jacobian, slopes, changes) by trial and column.
"""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.gap.exact import Baseline, SearchState, prior_products
from jaxfinger.gap.folds import FOLD_PRIOR, FOLDS, equilibrated, fold_of_row
from jaxfinger.gap.problem import Problem

DRAWS = 400  # Draws of the bootstrap over trials: the quantiles of a 95 % interval then rest on ten draws each.
# Log evidence from which a column is said to have a gap: the same at which, over all columns, something unlisted is as
# likely as not (`formula.Parameters.unlisted_threshold`).
MIN_GAP_EVIDENCE = 6.0
# Shares are relative to a gap of at least 0.05 in mean square of the noise. Below that, noise divides noise: the mean
# square of N white rows has a standard deviation of √(2/N), which is 0.05 for the 800 rows of a column.
MIN_RELATIVE_GAP = 0.05
# Likewise for the rows of all columns together: √(2/N) is 0.01 for 20 000.
MIN_RELATIVE_GAP_OF_ALL = 0.01
# Of the square of a column scaled to length 1. It keeps products invertible where the seen trials do not show a column,
# or do not tell it from others, since FOLD_PRIOR, relative to the largest column, may be below rounding there. Rounding
# of such products is some 1e-13; a column that 1e-11 of its square could hold back is not told from others.
RIDGE = 1e-11


class Cell(NamedTuple):
    """Rows of one trial and fold in one column."""

    trial: int  # number in `Problem.trial_of_row`
    column: int  # number in `Columns.items`
    fold: int
    rows: int  # how many


class Shares(NamedTuple):
    """Mean shares over the channels with a gap, of each the mean over its columns with a gap, and 95 % intervals."""

    of_causes: Float[np.ndarray, " causes"]  # what comes back without each cause
    of_causes_ci95: Float[np.ndarray, "causes 2"]
    left: float  # with all causes
    left_ci95: tuple[float, float]


@dataclass(frozen=True)
class Budget:
    """Sums of squares of held-out white residuals in each cell."""

    cells: list[Cell]
    before: Float[np.ndarray, " cells"]  # with the nominal model
    after: Float[np.ndarray, " cells"]  # with all causes
    without: Float[np.ndarray, "causes cells"]  # with all causes but one
    open: frozenset[int]  # columns with a gap
    channels: tuple[tuple[str, str], ...]  # experiment and channel of each column

    @cached_property
    def n(self) -> Float[np.ndarray, " cells"]:
        """Rows of each cell, which is also the sum of squares that the noise leaves."""
        return np.array([c.rows for c in self.cells], float)

    def of(self, columns: Collection[int]) -> tuple[Float[np.ndarray, " causes"], float]:
        """Mean shares over columns: of each cause what comes back without it, and what is left with all causes.

        A joint with much noise, or with few samples, counts as much as any other.
        """
        shares = self._shares(self._in(columns)).mean(axis=0)
        return shares[:-1], float(shares[-1])

    def _in(self, columns: Collection[int]) -> Float[np.ndarray, "columns cells"]:
        """For each of the columns, 1 for its cells and 0 for others."""
        return np.array([[c.column == column for c in self.cells] for column in columns], float)

    def _shares(self, weights: Float[np.ndarray, "columns cells"]) -> Float[np.ndarray, "columns shares"]:
        """Share of each column's gap that comes back without each cause, then the share left with all causes."""
        n = np.maximum(weights @ self.n, 1e-9)
        gap = np.maximum(weights @ (self.before - self.n), MIN_RELATIVE_GAP * n)
        lost = weights @ (self.without - self.after).T
        # Without causes all of a gap is left, also of one that is smaller than the least that shares are relative to.
        left = weights @ (self.after - self.n) if len(self.without) else gap
        return np.clip(np.column_stack([lost, left]) / gap[:, None], 0.0, 1.0)

    @cached_property
    def overall(self) -> Shares:
        """Shares of the whole gap.

        Their intervals, from a bootstrap over trials, say how the mean depends on the trials that were recorded, and
        not how channels differ.
        """
        if not self.open:
            none = np.zeros(len(self.without))
            return Shares(none, np.zeros((len(none), 2)), 0.0, (0.0, 0.0))
        rng = np.random.default_rng(0)
        unit, strata = self._drawn()
        inside = [
            self._in([c for c in sorted(self.open) if self.channels[c] == channel])
            for channel in sorted({self.channels[c] for c in self.open})
        ]

        def means(channels: list[Float[np.ndarray, "_columns cells"]]) -> Float[np.ndarray, " shares"]:
            return np.mean([self._shares(weights).mean(axis=0) for weights in channels], axis=0)

        value, draws = means(inside), []
        for _ in range(DRAWS):
            count = np.bincount(np.concatenate([rng.choice(s, len(s)) for s in strata]), minlength=unit.max() + 1)
            weights = [w * count[unit] for w in inside]
            if all(np.all(w @ self.n > 0) for w in weights):  # Without one of the columns the mean is another quantity.
                draws.append(means(weights))
        low, high = np.quantile([value, *draws], (0.025, 0.975), axis=0)
        low, high = np.minimum(low, value), np.maximum(high, value)
        left_ci95 = float(low[-1]), float(high[-1])
        return Shares(value[:-1], np.stack([low[:-1], high[:-1]], axis=1), float(value[-1]), left_ci95)

    def _drawn(self) -> tuple[Int[np.ndarray, " cells"], list[np.ndarray]]:
        """What the bootstrap draws: the unit to which each cell belongs, and strata of units.

        Units are trials. A stratum holds those that show the same columns with a gap, so that each draw holds each
        column as often as the session does. The parts of a trial that is alone in its stratum are drawn in its place:
        a trial drawn from itself would give an interval of no width.
        """
        shown: dict[int, set[int]] = {}
        for c in self.cells:
            shown.setdefault(c.trial, set()).update({c.column} & self.open)
        alike: dict[frozenset, list[int]] = {}
        for trial in sorted(shown):
            alike.setdefault(frozenset(shown[trial]), []).append(trial)
        alone = {trials[0] for trials in alike.values() if len(trials) == 1}
        unit = np.array([c.trial * FOLDS + (c.fold if c.trial in alone else 0) for c in self.cells], int)
        trial = np.array([c.trial for c in self.cells], int)
        return unit, [np.unique(unit[np.isin(trial, trials)]) for trials in alike.values()]


def budget(baseline: Baseline, state: SearchState, plain: Problem, open_columns: frozenset[int]) -> Budget:
    """Hold out each third of the trials in turn, and sum the squares that the causes leave there.

    `plain` is the problem at the nominal model without causes, the model before; `state` holds the causes.
    """
    cells, null, full = _products(baseline, plain, state)
    fold = np.array([c.fold for c in cells], int)
    order, before, after, without = [], [], [], []
    for held in range(FOLDS):
        seen, unseen = np.flatnonzero(fold != held), np.flatnonzero(fold == held)
        weight = _weights(cells, full, seen)
        H0, H1 = null[seen].sum(axis=0), full[seen].sum(axis=0)
        x0 = _nominal(H0, plain, np.eye(len(H0))[0])
        x1 = _nominal(H1, state.problem, _joint(full[seen], weight, state))
        less = [_nominal(H1, state.problem, _joint(full[seen], weight, state, i)) for i in range(len(state.effects))]
        for i in unseen:
            order.append(cells[i])
            before.append(x0 @ null[i] @ x0)
            after.append(x1 @ full[i] @ x1)
            without.append([x @ full[i] @ x for x in less])
    return Budget(
        order,
        np.array(before),
        np.array(after),
        np.array(without).reshape(len(order), len(state.effects)).T,
        open_columns,
        tuple((c.experiment, c.channel) for c in baseline.columns.items),
    )


def _products(
    baseline: Baseline, plain: Problem, state: SearchState
) -> tuple[list[Cell], Float[np.ndarray, "cells d d"], Float[np.ndarray, "cells f f"]]:
    """Cells, and the products of rows in each of them.

    First those of [residual, J] at the nominal model, then those of [residual, J, slopes, changes] at the causes'
    optimum.
    """
    fold, trial = fold_of_row(plain), plain.trial_of_row
    rows0 = np.vstack([plain.r[None], plain.J.T])
    rows1 = np.vstack([state.r[None], state.problem.J.T, state.slopes, state.changes])
    cells, null, full = [], [], []
    for c, column in enumerate(baseline.columns.items):
        key = trial[column.rows] * FOLDS + fold[column.rows]
        for u in np.unique(key):
            at = column.rows[key == u]
            cells.append(Cell(int(u) // FOLDS, c, int(u) % FOLDS, len(at)))
            null.append(rows0[:, at] @ rows0[:, at].T)
            full.append(rows1[:, at] @ rows1[:, at].T)
    return cells, np.array(null), np.array(full)


def _weights(
    cells: list[Cell], full: Float[np.ndarray, "cells f f"], seen: Int[np.ndarray, " s"]
) -> Float[np.ndarray, " s"]:
    """Weight of each seen cell: the inverse of its column's mean square with all causes, at most 1."""
    column = np.array([cells[i].column for i in seen], int)
    n = np.bincount(column, [cells[i].rows for i in seen])
    e = np.bincount(column, full[seen, 0, 0])
    return (np.maximum(n, 1.0) / np.maximum(np.maximum(e, n), 1.0))[column]


def _joint(
    products: Float[np.ndarray, "s f f"],
    weight: Float[np.ndarray, " s"],
    state: SearchState,
    without: int | None = None,
) -> Float[np.ndarray, " f"]:
    """Coefficients of [residual, J, slopes, changes] after a refit of J and slopes, without one cause if asked.

    `products`: of the rows in each seen cell. A cause is taken out where its change, which the residual lacks, comes
    back with coefficient 1.
    """
    k, m, H = state.problem.J.shape[1], len(state.coordinates), np.tensordot(weight, products, 1)
    x = np.zeros(len(H))
    x[0] = 1.0
    if without is not None:
        x[1 + k + m + without] = 1.0
    moves = [1 + k + j for j, c in enumerate(state.coordinates) if c.effect != without]
    return _solved(H, prior_products(state.problem, m), x, [*range(1, 1 + k), *moves])


def _nominal(H: Float[np.ndarray, "f f"], problem: Problem, x: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """Coefficients x with those of J refitted with equal weights for all rows, the others unchanged."""
    k, x = problem.J.shape[1], x.copy()
    x[1 : 1 + k] = 0.0
    return _solved(H, prior_products(problem, 0), x, list(range(1, 1 + k)))


def _solved(
    H: Float[np.ndarray, "f f"], prior: Float[np.ndarray, "d d"], x: Float[np.ndarray, " f"], free: list[int]
) -> Float[np.ndarray, " f"]:
    """Coefficients x with the free ones at the least squares, and near zero where H does not show them."""
    d = len(prior)
    A = H.copy()
    A[:d, :d] += prior
    scale = np.sqrt(np.maximum(np.diag(H)[free], 1e-300))
    eye = np.eye(len(free))
    M = A[np.ix_(free, free)] / np.outer(scale, scale) + FOLD_PRIOR**2 / max(float(np.max(scale**2)), 1.0) * eye
    out = x.copy()
    out[free] = 0.0
    out[free] = np.linalg.solve(M + RIDGE * eye, -(A[free] @ out) / scale) / scale
    return out


def held_out_gains(problem: Problem, members: list[Float[np.ndarray, "_k N"]]) -> list[float]:
    """Share of the gap that each member's signatures explain alone, on trials that their refit has not seen.

    Each third of the trials is held out in turn, and nominal parameters and amplitudes are refitted to the others.
    """
    J, kept, _ = equilibrated(problem.J, problem.root)
    p, of_row = J.shape[1], fold_of_row(problem)
    columns = np.column_stack([J, problem.r, *(z.T for z in members)])
    prior = np.zeros((len(kept), columns.shape[1]))
    prior[:, :p], prior[: len(problem.root), p] = kept, -problem.offset
    # Normal equations are accurate enough: the rows of `kept` bound the condition number of J.
    products, of_prior = [rows.T @ rows for rows in (columns[of_row == k] for k in range(FOLDS))], prior.T @ prior
    ends = np.cumsum([1, *(len(z) for z in members)])
    alone, with_member = 0.0, np.zeros(len(members))
    for k in range(FOLDS):
        seen = of_prior + sum(products[i] for i in range(FOLDS) if i != k)
        nominal = np.linalg.solve(seen[:p, :p], seen[:p, p:])
        off = np.vstack([-nominal, np.eye(nominal.shape[1])])  # subtracts what the refitted nominal parameters absorb
        fitted, left = (off.T @ x @ off for x in (seen, products[k]))
        alone += float(left[0, 0])
        for i, (a, b) in enumerate(pairwise(ends)):
            amplitudes = np.linalg.lstsq(fitted[a:b, a:b], fitted[a:b, 0], rcond=1e-10)[0]
            both, parts = np.concatenate([[1.0], -amplitudes]), [0, *range(a, b)]
            with_member[i] += float(both @ left[np.ix_(parts, parts)] @ both)
    gap = max(alone - problem.r.size, MIN_RELATIVE_GAP_OF_ALL * problem.r.size)
    return [float(np.clip((alone - x) / gap, 0.0, 1.0)) for x in with_member]
