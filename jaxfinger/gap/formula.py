"""The formula that every decision comes from: how well a set of causes explains the residual.

    r̃ ~ N(0, σ²(I + Σ_i s_i² (z_i z_iᵀ + ρ² K_i) + s_u² K_u))

column by column, in the basis of the smooth laws' features (`columns`). With e_c the energy of the residual on the K_c
features of column c, and o_c that outside of them over m_c rows, both in squared noise,

    log L = −½ Σ_c [ K_c log v_c + e_c / v_c + ν log(1 + max(o_c − m_c, 0) / ν) ],
    v_c   = max(e_c / K_c, floor, ρ² E_c / K_c).

v_c is the variance of what nobody knows, at its likeliest: so a column's unexplained energy costs ½ K_c log(e_c / K_c),
and a loud column drowns no quiet one. It is no less than what the form of the causes' laws may miss, a share ρ² of the
energy E_c that they explain there, and than `floor`, what coloured noise that is known from a few repeats may leave.
Outside of the features, ν looks count: the noise is known to a fifth, and misfits there come in bursts.

A cause's amplitudes have a Gaussian prior of the gap's own size: one standard deviation changes as much as is missed in
all. Nominal parameters are refitted with every set, in the weights that follow from v_c.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array
from scipy.special import expit

from jaxfinger.gap.by_column import ByColumn, Products
from jaxfinger.gap.columns import Columns, Counts


@dataclass(frozen=True)
class Parameters:
    """All that the formula does not take from the file at hand. Where each number comes from: docs/results.md."""

    variance_floor: float = 2.0  # v_c that noise alone may leave, since its colour is known from a few repeats
    form_error: float = 0.02  # ρ²: share of what causes explain in a column that the forms of their laws may miss
    outside_samples: float = 25.0  # ν: independent looks outside of the features
    cause_cost: float = 8.0  # log evidence that a cause must bring,
    imitator_gain: float = 0.04  # and as a share of what is unexplained where it acts: what an imitator gains of it
    tempering: float = 1.0  # β: of all log evidence, since neighbouring features and columns are no independent looks
    form_error_unlisted: float = (
        0.27  # share of what causes explain in a column, up to which what is left there is theirs as well
    )
    unlisted_threshold: float = 6.0  # log evidence beyond that, from which on something unlisted is as likely as not
    unlisted_slope: float = 1.0  # and how fast that probability grows with it


@dataclass(frozen=True)
class Weights:
    """What the likeliest unknown makes of the columns."""

    feature: Float[np.ndarray, "*n C"]  # 1 / v_c
    outside: Float[np.ndarray, "*n C"]

    @classmethod
    def plain(cls, columns: Columns) -> "Weights":
        """Those of plain least squares."""
        return cls(*np.ones((2, len(columns.items))))


class Evidence(NamedTuple):
    """All that the formula needs to know of one set of causes."""

    e: Float[np.ndarray, " C"]  # energy left on the features, in squared noise
    o: Float[np.ndarray, " C"]  # and outside of them
    explained: Float[np.ndarray, " C"]  # energy on the features that the causes have taken away
    score: float  # log L less Occam's factor: comparable between sets over the same rows


def log_likelihood(
    counts: Counts,
    e: Float[np.ndarray, "*n C"],
    o: Float[np.ndarray, "*n C"],
    explained: Float[np.ndarray, "*n C"],
    p: Parameters,
) -> tuple[Float[np.ndarray, " *n"], Weights]:
    """log L and the weights that belong to it."""
    K, nu = counts.K, p.outside_samples
    scale = (nu + o) / (nu + counts.outside)
    floor = p.variance_floor * np.maximum(scale, 1.0)
    v = np.maximum(np.maximum(e / K, floor), p.form_error * explained / K)
    excess = np.maximum(o - counts.outside, 0.0) / nu
    value = -0.5 * np.sum(K * np.log(v) + e / v + nu * np.log1p(excess), axis=-1)
    return np.asarray(value), Weights(1.0 / v, 1.0 / (1.0 + excess))


def unexplained(counts: Counts, x: Evidence, p: Parameters) -> Float[np.ndarray, " C"]:
    """Log evidence, column by column, that something is at work beyond noise and what the causes' forms may miss."""
    scale = np.maximum((p.outside_samples + x.o) / (p.outside_samples + counts.outside), 1.0)
    floor = np.maximum(p.variance_floor * scale, p.form_error * x.explained / counts.K)
    return 0.5 * counts.K * np.log(np.maximum(x.e / counts.K / floor, 1.0))


def unlisted(counts: Counts, x: Evidence, p: Parameters) -> float:
    """Probability that something is at work which no cause of a set is."""
    return float(
        expit(
            p.unlisted_slope
            * (unexplained(counts, x, replace(p, form_error=p.form_error_unlisted)).sum() - p.unlisted_threshold)
        )
    )


@dataclass(frozen=True)
class LinearFit:
    """One set of causes on top of what is refitted with every set."""

    evidence: Evidence
    log_l: float
    amplitudes: Float[np.ndarray, " k"]  # of the further rows, in units of their prior
    solution: Float[np.ndarray, " coefficients"]  # coefficients of all rows in the residual: 1, −δ, −a
    b: Float[np.ndarray, " features"]  # of what is left, on the features
    weights: Weights

    @property
    def score(self) -> float:
        """Log evidence."""
        return self.evidence.score


ROUNDS = 6  # of reweighting; scores then change by less than one
RIDGE = 1e-10  # relative, of the base's products


class Linear:
    """Sets of further rows Z on top of a base X: the residual, and all that is refitted with every set."""

    def __init__(
        self,
        columns: Columns,
        base: Sequence[ByColumn],
        prior: Float[np.ndarray, "k k"],
        further: ByColumn,
        parameters: Parameters,
        null: LinearFit | None = None,
    ):
        self.columns, self.parameters, self.prior = columns, parameters, prior
        self.further = further
        self.BX, self.BZ = np.concatenate([x.B for x in base], axis=1), further.B
        self.TX = np.concatenate([Products.stacked([y.products(x) for y in base]).dense for x in base], axis=2)
        self.TXZ = Products.stacked([x.products(further) for x in base])
        self.null = null
        if null is None:
            self.null = self.fit(np.empty(0, int))

    def _inside(self, w: Weights) -> Float[np.ndarray, " features"]:
        """What a feature weighs beyond what lies outside of it."""
        return np.repeat(w.feature - w.outside, self.columns.counts.K)

    def _weighted(self, w: Weights, B, B2, T):
        """Products in the weights, summed over columns."""
        outside = T.summed(w.outside) if isinstance(T, Products) else np.tensordot(w.outside, T, 1)
        return outside + (B * self._inside(w)[:, None]).T @ B2

    def fit(
        self, picks: Int[np.ndarray, " k"], low=None, high=None, start: Weights | None = None, middle=None
    ) -> LinearFit:
        """The likeliest amplitudes of the rows `picks` within `low` and `high`, in units of their prior."""
        k, n = self.BX.shape[1], len(picks)
        low = np.full(n, -np.inf) if low is None else low
        high = np.full(n, np.inf) if high is None else high
        T = np.empty((len(self.columns.items), k + n, k + n))
        T[:, :k, :k], T[:, :k, k:] = self.TX, self.TXZ.with_rows(picks)
        T[:, k:, :k], T[:, k:, k:] = np.swapaxes(T[:, :k, k:], 1, 2), self.further.among(picks)
        B = np.concatenate([self.BX, self.BZ[:, picks]], axis=1)
        prior = np.zeros((k + n, k + n))
        prior[:k, :k] = self.prior
        prior[k:, k:] = np.eye(n)
        if middle is not None:  # amplitudes count from where they are
            prior[0, k:] = prior[k:, 0] = middle
            prior[0, 0] += float(middle @ middle)
        before = self.null.b if self.null else None
        weights = start or (self.null.weights if self.null else Weights.plain(self.columns))
        for _ in range(ROUNDS):
            H = self._weighted(weights, B, B, T) + prior
            x = self._solve(H, low, high)
            b = B @ x
            e = self.columns.sums(b**2)
            o = np.maximum(np.einsum("i,cij,j->c", x, T, x) - e, 0.0)
            explained = self.columns.sums((b - before) ** 2) if before is not None else np.zeros_like(e)
            log_l, weights = log_likelihood(self.columns.counts, e, o, explained, self.parameters)
        log_l = float(log_l) - 0.5 * float(x[:k] @ self.prior @ x[:k])
        H = self._weighted(weights, B, B, T) + prior
        sizes = -x[k:] if middle is None else -x[k:] - middle
        occam = 0.5 * _further_information(H, k) + 0.5 * float(sizes @ sizes) if n else 0.0
        return LinearFit(Evidence(e, o, explained, log_l - occam), log_l, -x[k:], x, b, weights)

    def _solve(self, H, low, high):
        """Coefficients (1, −δ, −a); amplitudes that leave their bounds stay at them."""
        d = H.shape[0]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        M = H * np.outer(scale, scale) + RIDGE * np.eye(d)
        first = d - len(low)
        free, x = np.ones(d, bool), np.zeros(d)
        free[0], x[0] = False, 1.0
        for _ in range(3):
            at = np.flatnonzero(free)
            fixed = np.flatnonzero(~free)
            y = np.linalg.solve(M[np.ix_(at, at)], -M[np.ix_(at, fixed)] @ (x[fixed] / scale[fixed]))
            x[at] = y * scale[at]
            a = -x[first:]
            out = (a < low) | (a > high)
            out &= free[first:]
            if not out.any():
                break
            x[first:][out] = -np.clip(a, low, high)[out]
            free[first:][out] = False
        return x

    def screen(self, now: LinearFit, candidates: list[Int[np.ndarray, " _k"]], bounds) -> list[Evidence | None]:
        """Of each candidate alone on top of the base, by one step in the weights; the score is its gain."""
        w, k = now.weights, self.BX.shape[1]
        x = now.solution[:k]
        HXX = self._weighted(w, self.BX, self.BX, self.TX) + self.prior
        HXZ = self._weighted(w, self.BX, self.BZ, self.TXZ)
        A = HXX[1:, 1:]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
        absorbed = np.linalg.solve(A * np.outer(scale, scale) + RIDGE * np.eye(k - 1), HXZ[1:] * scale[:, None])
        absorbed *= scale[:, None]  # of every further row, by the base
        b = x @ HXZ  # the residual is optimal in the base, so that projecting Z is all it takes
        amplitudes, occam, own = [], np.zeros(len(candidates)), np.zeros((len(candidates), len(self.columns.items)))
        for n, (at, (low, high)) in enumerate(zip(candidates, bounds, strict=True)):
            TZ, mine = self.further.among(at), self.BZ[:, at]
            G = self._weighted(w, mine, mine, TZ) - HXZ[1:, at].T @ absorbed[:, at]
            a = np.clip(np.linalg.solve(G + np.eye(len(at)), b[at]), low, high)
            amplitudes.append(a)
            occam[n] = 0.5 * np.linalg.slogdet(np.eye(len(at)) + G)[1] + 0.5 * float(a @ a)
            own[n] = (TZ @ a) @ a
        starts = np.cumsum([0, *(len(a) for a in amplitudes)])
        shape = self.BZ.shape[1], len(candidates)
        a = csc_array((np.concatenate(amplitudes), np.concatenate(candidates), starts), shape)
        # What each candidate changes, refitted: Z a − X q.
        q = np.vstack([np.zeros((1, len(candidates))), absorbed @ a])
        change = self.BZ @ a - self.BX @ q
        assert self.null is not None
        r, null = self.BX @ x, self.null.b
        e = self.columns.sums((r[:, None] - change) ** 2).T
        explained = self.columns.sums((r[:, None] - change - null[:, None]) ** 2).T
        along = self.TXZ.along(x) @ a - np.einsum("i,cij->cj", x, self.TX) @ q
        norms = own.T - 2.0 * self.TXZ.bilinear(q, a) + np.stack([np.sum(q * (T @ q), axis=0) for T in self.TX])
        total = now.evidence.e + now.evidence.o - 2.0 * along.T + norms.T
        o = np.maximum(total - e, 0.0)
        log_l, _ = log_likelihood(self.columns.counts, e, o, explained, self.parameters)
        score = log_l - now.log_l - occam
        return [
            Evidence(e[n], o[n], explained[n], float(score[n])) if np.any(one) else None
            for n, one in enumerate(amplitudes)
        ]

    def std(self, at: Int[np.ndarray, " k"], w: Weights) -> Float[np.ndarray, " k"]:
        """Of the amplitudes of further rows, refitted with the base and with one another, without their prior."""
        k, base = self.BX.shape[1], self.prior
        H = np.zeros((k + len(at),) * 2)
        H[:k, :k] = self._weighted(w, self.BX, self.BX, self.TX) + base
        H[:k, k:] = self._weighted(w, self.BX, self.BZ[:, at], self.TXZ.with_rows(at))
        H[k:, :k] = H[:k, k:].T
        H[k:, k:] = self._weighted(w, self.BZ[:, at], self.BZ[:, at], self.further.among(at))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[1:], 1e-300))
        inverse = np.linalg.pinv(H[1:, 1:] * np.outer(scale, scale), rcond=1e-12, hermitian=True)
        return (np.sqrt(np.maximum(np.diag(inverse), 0.0)) * scale)[k - 1 :]


def _further_information(H: Float[np.ndarray, "d d"], k: int) -> float:
    """log det of the information on what follows the first k, the base but the residual refitted."""
    A, C, D = H[1:k, 1:k], H[1:k, k:], H[k:, k:]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    inner = np.linalg.solve(A * np.outer(scale, scale) + RIDGE * np.eye(k - 1), C * scale[:, None])
    return float(np.linalg.slogdet(D - (C * scale[:, None]).T @ inner)[1])
