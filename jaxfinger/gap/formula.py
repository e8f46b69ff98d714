"""The formula behind every decision of a diagnosis: the log evidence of a set of causes.

The white residual r̃ of the nominal model, with the causes i of a set at work, is taken to be

    r̃ ~ N(0, σ²(I + Σ_i s_i² (z_i z_iᵀ + ρ² K_i) + s_u² K_u)),

where z_i is the signature of cause i, s_i the prior standard deviation of its amplitude, K_i the covariance of what an
inexact form of its law may leave, and K_u that of what unknown causes leave. From there to the code:

1. Columns. A column c (`columns`) has n_c rows and K_c smooth features, the columns of U_c. Let x be what is left of r̃
   after the causes of the set, and x⁰ what is left without any cause. In noise variances,

       e_c = ‖U_cᵀ x_c‖²,    o_c = ‖x_c‖² − e_c,    E_c = ‖U_cᵀ (x_c − x⁰_c)‖²

   are the energy left on the features, that left on the m_c = n_c − K_c directions outside of them, and the energy on
   the features that the causes explain.

2. The unknown. K_u and K_i are U_c U_cᵀ in every column, so that the features have the variance v_c. Its likeliest
   value is e_c / K_c (type-II maximum likelihood: MacKay, Neural Computation 4 (1992) 415). A column that the causes
   leave unexplained then costs ½ K_c log(e_c / K_c) instead of ½ e_c: a large error in one column hides no cause in
   another.

3. Lower bounds of v_c. Noise alone leaves up to φ_c = φ max(1, (ν + o_c) / (ν + m_c)): its colour is known from a few
   repeats, and its size is at least the one seen outside of the features. Inexact laws leave up to ρ² E_c / K_c.

4. Outside of the features. Less energy there than noise leaves on average, m_c, counts as in noise of known size, where
   repeats or holds tell the noise; where residuals do, which may hold a law, it does not count. The excess o_c − m_c
   counts as if it came from ν independent samples, as in Student's distribution: the size of the noise is known to one
   part in √ν, and misfits there come in bursts. Together

       log L = −½ Σ_c [ K_c log v_c + e_c / v_c + min(o_c − m_c, 0) + ν log(1 + max(o_c − m_c, 0) / ν) ],         (L)
       v_c   = max(e_c / K_c, φ_c, ρ² E_c / K_c).

5. Amplitudes. The unit of an amplitude a changes the prediction by as much as the nominal model misses in all, and its
   prior is N(0, 1). Nominal parameters θ are refitted with every set, under their own prior. The maximum is found by
   iteratively reweighted least squares: −2 ∂log L/∂e_c = 1 / v_c weighs the features, and
   −2 ∂log L/∂o_c = 1 / (1 + max(o_c − m_c, 0) / ν) all other directions, the bounds of step 3 held fixed.

6. Evidence. Laplace's approximation, with G the information on the amplitudes once θ is refitted, gives

       log evidence = log L + log prior(θ) − ½ ‖a‖² − ½ log det(I + G).                                           (E)

   The determinant of the information on θ is nearly the same for all sets, and left out.
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
    """Numbers of the formula that no recording gives.

    `benchmarks/formula.py fit` chose `imitator_gain`, `form_error_unlisted`, `unlisted_threshold` and `unlisted_slope`,
    rounded, from sealed cases, and an earlier fit chose `cause_cost`. The log score of cases with something unlisted
    chose `imitator_odds`; twice as much changes it by less than 0.1 a case. The others are set for the reasons beside
    them. The fit found no values that do better on cases it had not seen (docs/results.md).
    """

    variance_floor: float = 2.0  # φ, noise variances: the colour of the noise is known from a few repeats only.
    form_error: float = 0.02  # ρ²: an inexact form of a law may miss a seventh of its effect, 0.02 of the energy.
    outside_samples: float = 25.0  # ν: the standard deviation of the noise is known to a fifth, 1/√ν.
    cause_cost: float = 8.0  # nats that every cause must bring (`costs`)
    imitator_gain: float = 0.04  # share of Σ_c τ_c u_c (`costs`) that a cause must bring, since an imitator gains it
    tempering: float = 1.0  # β: power of the likelihood; below 1 it would allow for dependent features and columns.
    form_error_unlisted: float = 0.27  # ρ² in `unlisted`: less than that share of E_c may be the listed causes' own.
    unlisted_threshold: float = 6.0  # nats left unexplained at which something unlisted is as likely as not
    unlisted_slope: float = 1.0  # change of the log odds that something is unlisted, per nat left unexplained
    imitator_odds: float = 8.0  # λ: odds that the only cause imitates, if it leaves all energy and as much evidence


@dataclass(frozen=True)
class Weights:
    """Weights of the least squares in every column (step 5)."""

    feature: Float[np.ndarray, "*n C"]  # on the features, 1 / v_c
    outside: Float[np.ndarray, "*n C"]  # on all other directions

    @classmethod
    def plain(cls, columns: Columns) -> "Weights":
        """Weights of ordinary least squares: one everywhere."""
        return cls(*np.ones((2, len(columns.items))))


class Evidence(NamedTuple):
    """Everything that the formula needs to know of one set of causes."""

    e: Float[np.ndarray, " C"]  # energy left on the features, in noise variances
    o: Float[np.ndarray, " C"]  # energy left outside of them
    explained: Float[np.ndarray, " C"]  # E_c, energy on the features that the causes explain
    score: float  # log evidence (E), comparable between sets over the same rows


def log_likelihood(
    counts: Counts,
    e: Float[np.ndarray, "*n C"],
    o: Float[np.ndarray, "*n C"],
    explained: Float[np.ndarray, "*n C"],
    p: Parameters,
) -> tuple[Float[np.ndarray, "*n C"], Weights]:
    """Terms of the log likelihood (L), one for each column, and the weights of the next least squares, of n sets."""
    K, nu = counts.K, p.outside_samples
    v = np.maximum(e / K, _variance_floor(counts, o, explained, p))
    beyond = o - counts.outside
    excess = np.maximum(beyond, 0.0) / nu
    less = np.where(counts.noise_known, np.minimum(beyond, 0.0), 0.0)
    value = -0.5 * (K * np.log(v) + e / v + less + nu * np.log1p(excess))
    return value, Weights(1.0 / v, 1.0 / (1.0 + excess))


def likelihood_gain(counts: Counts, null: Evidence, now: Evidence, p: Parameters) -> Float[np.ndarray, " C"]:
    """Log likelihood in every column that a set gains over `null`, nats."""
    before, after = (log_likelihood(counts, x.e, x.o, x.explained, p)[0] for x in (null, now))
    return after - before


def _variance_floor(
    counts: Counts, o: Float[np.ndarray, "*n C"], explained: Float[np.ndarray, "*n C"], p: Parameters
) -> Float[np.ndarray, "*n C"]:
    """Variance on the features that noise and inexact laws may leave (step 3)."""
    noise = np.maximum((p.outside_samples + o) / (p.outside_samples + counts.outside), 1.0)
    return np.maximum(p.variance_floor * noise, p.form_error * explained / counts.K)


def unexplained(counts: Counts, evidence: Evidence, p: Parameters) -> Float[np.ndarray, " C"]:
    """Log evidence in every column that more is at work than noise and inexact forms of the causes' laws.

    It is u_c = ½ K_c max(0, log(e_c / K_c) − log v⁰_c), with v⁰_c the lower bound of v_c in step 3.
    """
    floor = _variance_floor(counts, evidence.o, evidence.explained, p)
    return 0.5 * counts.K * np.log(np.maximum(evidence.e / counts.K / floor, 1.0))


def unlisted(counts: Counts, evidence: Evidence, p: Parameters) -> float:
    """Probability that a cause is at work which is not in the set."""
    left = _beyond_listed(counts, evidence, p).sum()
    return float(expit(p.unlisted_slope * (left - p.unlisted_threshold)))


def _beyond_listed(counts: Counts, evidence: Evidence, p: Parameters) -> Float[np.ndarray, " C"]:
    """`unexplained`, where the listed causes may leave more of what they explain (`form_error_unlisted`)."""
    return unexplained(counts, evidence, replace(p, form_error=p.form_error_unlisted))


def imitation_odds(
    counts: Counts, without: Evidence, left: Evidence, explainable: Float[np.ndarray, " C"], p: Parameters
) -> float:
    """Odds ω that a cause of a set, beside something unlisted that listed causes imitate, is one of those that do.

    With l_c = max(e_c − φ K_c, 0) the energy beyond noise that the set leaves, l_c⁰ that without the cause, τ_c,
    `explainable`, as in `costs`, τ'_c the largest τ_c in any column of the channel, and u_c as in `unlisted`,

        A = Σ_c τ_c (l_c⁰ − l_c),    L = Σ_c τ'_c l_c,    U = Σ_c τ'_c u_c

    are the energy that the cause takes away, and the energy and the evidence that stay in the channels where it acts.
    With G the log evidence that it brings, one nat at least, ω = L / (A + L) · U / G. What is unlisted follows another
    law and seldom keeps to the one tendon or joint, or to the experiment, where a listed cause imitates it: an imitator
    leaves a good share of it in the same channels, and brings little more evidence than it leaves there.
    """
    now, before = (np.maximum(x.e - p.variance_floor * counts.K, 0.0) for x in (left, without))
    concerned = counts.largest_of_channel(explainable)
    stays, evidence = float(concerned @ now), float(concerned @ _beyond_listed(counts, left, p))
    if stays == 0.0:
        return 0.0
    taken, gain = max(float(explainable @ (before - now)), 0.0), max(left.score - without.score, 1.0)
    return stays / (taken + stays) * evidence / gain


@dataclass(frozen=True)
class LinearFit:
    """A set of rows Z at its optimum on top of a base (`LinearModel`)."""

    evidence: Evidence
    log_l: float  # log L + log prior(θ)
    amplitudes: Float[np.ndarray, " k"]  # of the rows Z, in prior standard deviations
    solution: Float[np.ndarray, " coefficients"]  # u = (1, −δ, −a): what is left is x = uᵀ [X; Z]
    b: Float[np.ndarray, " features"]  # U_cᵀ x_c of all columns: what is left on the features
    weights: Weights

    @property
    def score(self) -> float:
        """Log evidence (E)."""
        return self.evidence.score


# Rounds of reweighting. Scores of most sets then change by less than one nat. Where the gap is large they do not, and
# `exact.fit_set` goes on.
ROUNDS = 6
RIDGE = 1e-10  # relative. Keeps products of nearly collinear derivatives of the nominal parameters invertible.


class LinearModel:
    """The residual left, x = r̃ − Jδ − Zᵀa, as a linear function of what a set refits.

    The base X (k, N) has r̃ as its first row, with the coefficient 1, and then the derivatives J by everything that is
    refitted with every set: nominal parameters, and the causes that are in already. Sets are choices of rows Z, whose
    amplitudes a have the prior N(0, I). X and Z enter by their products in every column alone.

    Args:
        base: the rows of X, in parts.
        prior: (k, k) P with −2 log prior(θ) = uᵀ P u, but for a constant, for the coefficients u = (1, −δ).
        Z: rows that sets choose from.
        null: the optimum without any cause, from which E_c counts; fitted on this base if none is given.
        start: weights of the first round of that fit, one by default.
    """

    def __init__(
        self,
        columns: Columns,
        base: Sequence[ByColumn],
        prior: Float[np.ndarray, "k k"],
        Z: ByColumn,
        parameters: Parameters,
        null: LinearFit | None = None,
        start: Weights | None = None,
    ):
        self.columns, self.prior, self.Z, self.parameters = columns, prior, Z, parameters
        # Coefficients on the features, and products X_c X_cᵀ and X_c Z_cᵀ over all rows of a column.
        self.BX, self.BZ = np.concatenate([x.B for x in base], axis=1), Z.B
        self.XX = np.concatenate([Products.stacked([x.products(y) for x in base]).dense for y in base], axis=2)
        self.XZ = Products.stacked([x.products(Z) for x in base])
        self.null = null
        if null is None:
            self.null = self.fit(np.empty(0, int), start=start)

    def fit(
        self,
        picks: Int[np.ndarray, " k"],
        low: Float[np.ndarray, " k"] | None = None,
        high: Float[np.ndarray, " k"] | None = None,
        start: Weights | None = None,
        sizes: Float[np.ndarray, " k"] | None = None,
    ) -> LinearFit:
        """Fit the base and the amplitudes of the rows `picks` of Z by iteratively reweighted least squares.

        Args:
            low, high: bounds of the amplitudes.
            start: weights of the first round; those of the null by default.
            sizes: amplitudes that the residual already lacks, in prior standard deviations; the fitted ones add to them
                under the prior N(0, I). Zero by default.
        """
        k, n = self.BX.shape[1], len(picks)
        low = np.full(n, -np.inf) if low is None else low
        high = np.full(n, np.inf) if high is None else high
        sizes = np.zeros(n) if sizes is None else sizes
        B, T, prior = self._rows_of(picks, sizes)
        weights = start or (self.null.weights if self.null else Weights.plain(self.columns))
        for _ in range(ROUNDS):
            u = self._optimum(self._weighted(weights, B, B, T) + prior, low, high)
            b = B @ u
            e = self.columns.sums(b**2)
            o = np.maximum(np.einsum("i,cij,j->c", u, T, u) - e, 0.0)
            explained = self.columns.sums((b - self.null.b) ** 2) if self.null else np.zeros_like(e)
            by_column, weights = log_likelihood(self.columns.counts, e, o, explained, self.parameters)
        log_l = float(by_column.sum()) - 0.5 * float(u[:k] @ self.prior @ u[:k])
        H, a = self._weighted(weights, B, B, T) + prior, sizes - u[k:]
        occam = 0.5 * _log_det_refitted(H, k) + 0.5 * float(a @ a) if n else 0.0
        return LinearFit(Evidence(e, o, explained, log_l - occam), log_l, -u[k:], u, b, weights)

    def base_step(self, w: Weights) -> tuple[Float[np.ndarray, " p"], float]:
        """Step δ of what the base refits, in given weights, and the weighted sum of squares that it leaves."""
        H = self._weighted(w, self.BX, self.BX, self.XX) + self.prior
        u = self._optimum(H, *np.empty((2, 0)))
        return -u[1:], float(u @ H @ u)

    def step(
        self,
        w: Weights,
        low: Float[np.ndarray, " l"],
        high: Float[np.ndarray, " l"],
        sizes: Float[np.ndarray, " l"],
    ) -> tuple[Float[np.ndarray, " l"], Float[np.ndarray, "l l"]]:
        """Step of the amplitudes of all rows of Z in given weights, the base refitted with them; and its information.

        Bounds and `sizes` are as in `fit`. The information is without that of the prior.
        """
        B, T, prior = self._rows_of(np.arange(self.Z.count), sizes)
        H, k = self._weighted(w, B, B, T), self.BX.shape[1]
        G = _refitted(H + np.pad(self.prior, (0, len(sizes))), k)
        return -self._optimum(H + prior, low, high)[k:], G

    def _rows_of(self, picks: Int[np.ndarray, " k"], sizes: Float[np.ndarray, " k"]):
        """Rows [X; Z of a set]: coefficients on the features, products in every column, and products of the prior.

        With the coefficients −a of Z, the prior of amplitudes that start at `sizes` is ½ ‖sizes + a‖².
        """
        k, n = self.BX.shape[1], len(picks)
        B = np.concatenate([self.BX, self.BZ[:, picks]], axis=1)
        T = np.empty((len(self.columns.items), k + n, k + n))
        T[:, :k, :k], T[:, :k, k:] = self.XX, self.XZ.with_rows(picks)
        T[:, k:, :k], T[:, k:, k:] = np.swapaxes(T[:, :k, k:], 1, 2), self.Z.among(picks)
        prior = np.zeros((k + n, k + n))
        prior[:k, :k] = self.prior
        prior[k:, k:] = np.eye(n)
        prior[0, k:] = prior[k:, 0] = -sizes
        prior[0, 0] += float(sizes @ sizes)
        return B, T, prior

    def _weighted(self, w: Weights, B, B2, T):
        """Weighted products Σ_c X_c Ω_c Y_cᵀ, Ω_c = w_outside I + (w_feature − w_outside) U_c U_cᵀ.

        B and B2 are the coefficients of X and Y on the features, T their products in every column; or of several X and
        Y, which B and B2 have along their first axis and T along its second.
        """
        outside = T.summed(w.outside) if isinstance(T, Products) else np.tensordot(w.outside, T, 1)
        on_features = np.repeat(w.feature - w.outside, self.columns.counts.K)
        return outside + np.swapaxes(B * on_features[:, None], -1, -2) @ B2

    def _optimum(self, H, low, high):
        """Coefficients u = (1, −δ, −a) that minimise uᵀ H u, with amplitudes beyond a bound fixed at it.

        What is fixed once stays fixed. After the third round amplitudes beyond a bound are clipped.
        """
        d = H.shape[0]
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        M = H * np.outer(scale, scale) + RIDGE * np.eye(d)
        first = d - len(low)
        free, u = np.ones(d, bool), np.zeros(d)
        free[0], u[0] = False, 1.0
        for _ in range(3):
            at = np.flatnonzero(free)
            fixed = np.flatnonzero(~free)
            y = np.linalg.solve(M[np.ix_(at, at)], -M[np.ix_(at, fixed)] @ (u[fixed] / scale[fixed]))
            u[at] = y * scale[at]
            a = -u[first:]
            out = (a < low) | (a > high)
            out &= free[first:]
            if not out.any():
                break
            u[first:][out] = -np.clip(a, low, high)[out]
            free[first:][out] = False
        return u

    def screen(
        self,
        now: LinearFit,
        candidates: Sequence[Int[np.ndarray, " _k"]],
        bounds: Sequence[tuple[Float[np.ndarray, " _k"], Float[np.ndarray, " _k"]]],
    ) -> list[Evidence | None]:
        """Evidence of each candidate alone on top of the base, after one least squares in the weights of `now`.

        `now` is the fit of the base. A candidate is some rows of Z, with lower and upper bounds of their amplitudes.
        Its score is the gain over `now`. The evidence is None where every amplitude is zero.
        """
        assert self.null is not None
        if not candidates:
            return []
        w, u = now.weights, now.solution[: self.BX.shape[1]]
        HXX = self._weighted(w, self.BX, self.BX, self.XX) + self.prior
        HXZ = self._weighted(w, self.BX, self.BZ, self.XZ)
        absorbed = _ridge_solve(HXX[1:, 1:], HXZ[1:])  # coefficients of J that absorb each row of Z, (k − 1, l)
        # What is left is orthogonal to J in these weights, so that its products with Z need no projection.
        gradient = u @ HXZ
        amplitudes = [np.empty(0)] * len(candidates)
        occam, own = np.zeros(len(candidates)), np.zeros((len(candidates), len(self.columns.items)))
        for alike in _by_size(candidates):
            at = np.array([candidates[n] for n in alike])  # (candidates, rows of each)
            T, B = np.stack([self.Z.among(x) for x in at], axis=1), np.moveaxis(self.BZ[:, at], 0, 1)
            low, high = (np.array([bounds[n][side] for n in alike]) for side in (0, 1))
            absorbs = np.einsum("ink,inl->nkl", HXZ[1:, at], absorbed[:, at])
            G, eye = self._weighted(w, B, B, T) - absorbs, np.eye(at.shape[1])
            a = np.clip(np.linalg.solve(G + eye, gradient[at][:, :, None])[:, :, 0], low, high)
            occam[alike] = 0.5 * np.linalg.slogdet(eye + G)[1] + 0.5 * np.sum(a**2, axis=1)
            own[alike] = np.einsum("nk,cnkl,nl->nc", a, T, a)
            for n, one in zip(alike, a, strict=True):
                amplitudes[n] = one
        starts = np.cumsum([0, *(len(a) for a in amplitudes)])
        shape = self.BZ.shape[1], len(candidates)
        a = csc_array((np.concatenate(amplitudes), np.concatenate(candidates), starts), shape)
        # A candidate changes what is left by −Δ, Δ = Zᵀ a − Xᵀ q, where q refits the base. In every column
        # ‖x − Δ‖² = ‖x‖² − 2 xᵀ Δ + ‖Δ‖².
        q = np.vstack([np.zeros((1, len(candidates))), absorbed @ a])
        change = self.BZ @ a - self.BX @ q
        b = self.BX @ u
        e = self.columns.sums((b[:, None] - change) ** 2).T
        explained = self.columns.sums((b[:, None] - change - self.null.b[:, None]) ** 2).T
        along = self.XZ.along(u) @ a - np.einsum("i,cij->cj", u, self.XX) @ q
        norms = own.T - 2.0 * self.XZ.bilinear(q, a) + np.stack([np.sum(q * (T @ q), axis=0) for T in self.XX])
        o = np.maximum(now.evidence.e + now.evidence.o - 2.0 * along.T + norms.T - e, 0.0)
        by_column, _ = log_likelihood(self.columns.counts, e, o, explained, self.parameters)
        score = by_column.sum(axis=-1) - now.log_l - occam
        return [
            Evidence(e[n], o[n], explained[n], float(score[n])) if np.any(one) else None
            for n, one in enumerate(amplitudes)
        ]

    def std(self, at: Int[np.ndarray, " k"], w: Weights) -> Float[np.ndarray, " k"]:
        """Standard deviations of the amplitudes of rows `at` of Z, without their prior, the base refitted with them."""
        k, B = self.BX.shape[1], self.BZ[:, at]
        H = np.zeros((k + len(at),) * 2)
        H[:k, :k] = self._weighted(w, self.BX, self.BX, self.XX) + self.prior
        H[:k, k:] = self._weighted(w, self.BX, B, self.XZ.with_rows(at))
        H[k:, :k] = H[:k, k:].T
        H[k:, k:] = self._weighted(w, B, B, self.Z.among(at))
        scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[1:], 1e-300))
        inverse = np.linalg.pinv(H[1:, 1:] * np.outer(scale, scale), rcond=1e-12, hermitian=True)
        return (np.sqrt(np.maximum(np.diag(inverse), 0.0)) * scale)[k - 1 :]


def _by_size(candidates: Sequence[Int[np.ndarray, " _k"]]) -> list[Int[np.ndarray, " _n"]]:
    """Numbers of the candidates that have as many rows, for every number of rows."""
    sizes = np.array([len(at) for at in candidates])
    return [np.flatnonzero(sizes == k) for k in np.unique(sizes)]


def _log_det_refitted(H: Float[np.ndarray, "d d"], k: int) -> float:
    """log det of `_refitted`."""
    return float(np.linalg.slogdet(_refitted(H, k))[1])


def _refitted(H: Float[np.ndarray, "d d"], k: int) -> Float[np.ndarray, "m m"]:
    """Information on all but the first k coefficients, once those but the residual's are refitted."""
    A, C, D = H[1:k, 1:k], H[1:k, k:], H[k:, k:]
    return D - C.T @ _ridge_solve(A, C)


def _ridge_solve(A: Float[np.ndarray, "k k"], C: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "k n"]:
    """A⁻¹ C for an information A, scaled to a unit diagonal and with RIDGE added to it."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    inner = np.linalg.solve(A * np.outer(scale, scale) + RIDGE * np.eye(len(A)), C * scale[:, None])
    return inner * scale[:, None]
