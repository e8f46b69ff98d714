"""Evidence for an effect, linearly: what its signature explains that the nominal parameters cannot.

With r̃ and Z̃ projected off the nominal parameters, amplitudes a ~ N(0, s²) in units of their plausible size:

    log BF = ½ bᵀ (G + s⁻² I)⁻¹ b − ½ log det(I + s² G),   G = Z̃ᵀ Z̃,   b = Z̃ᵀ r̃,

averaged over s. An amplitude of the wrong sign is no evidence, and a share counts as one at most. A term that a recipe
leaves out has the size of what it was: its own is one of the s.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.special import log_ndtr, logsumexp

from jaxfinger.effects import NOMINAL_TERMS
from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signatures import Variant

SCALES = (0.1, 0.3, 1.0, 3.0)


class Projector:
    """Projection off the nominal parameters, their prior rows included, and off further columns."""

    def __init__(self, problem: Problem, extra: Float[np.ndarray, "k N"] | None = None):
        self.N = problem.r.size
        A = np.vstack([problem.J, problem.root])
        scale = np.linalg.norm(A, axis=0)
        A = A / np.where(scale > 0, scale, 1.0)
        if extra is not None and len(extra):
            columns = extra / np.maximum(np.linalg.norm(extra, axis=1, keepdims=True), 1e-300)
            A = np.column_stack([A, np.pad(columns, ((0, 0), (0, len(problem.root)))).T])
        Q, R = np.linalg.qr(A)
        diagonal = np.abs(np.diag(R))
        self.Q = Q[:, diagonal > 1e-9 * diagonal.max()]

    def __call__(
        self, rows: Float[np.ndarray, "k N"], prior: np.ndarray | None = None
    ) -> Float[np.ndarray, "k N+prior"]:
        """Rows off the span; `prior` are the values of the prior rows (zero for a signature)."""
        tail = np.zeros((len(rows), self.Q.shape[0] - self.N)) if prior is None else prior[None]
        x = np.concatenate([rows, tail], axis=1)
        return x - (x @ self.Q) @ self.Q.T

    def residual(self, problem: Problem, r: np.ndarray | None = None) -> Float[np.ndarray, " N+prior"]:
        """r̃."""
        return self((problem.r if r is None else r)[None], -problem.offset)[0]


@dataclass(frozen=True)
class Evidence:
    """What one variant explains."""

    variant: Variant
    amplitudes: np.ndarray  # in plausible sizes
    std: np.ndarray
    explained: float  # drop of the sum of squared white residuals
    log_bf: float
    absorbed: float  # share of the signature that the nominal parameters imitate


def evidence(variant: Variant, Z: np.ndarray, Zt: np.ndarray, rt: np.ndarray) -> Evidence:
    """Evidence of a variant from its signatures (amplitudes, N), raw and projected."""
    G, b, kind = Zt @ Zt.T, Zt @ rt, variant.effect
    amplitudes = kind.amplitudes()
    one_sided = len(b) == 1 and not next(iter(amplitudes.values())).signed
    raw = float(np.sum(Z * Z))
    absorbed = 1.0 - float(np.trace(G)) / raw if raw > 0 else 1.0
    logs, k = [], len(b)
    floor = max(1e-12 * np.trace(G), 1e-20)
    information = G + floor * np.eye(k)
    a = np.linalg.lstsq(information, b, rcond=1e-10)[0]
    std = np.sqrt(np.diag(np.linalg.pinv(information, rcond=1e-10, hermitian=True)))
    own = (float(np.abs(a).max()),) if kind.ID in NOMINAL_TERMS and a.any() else ()
    for s in (*SCALES, *own):
        precision = G + np.eye(k) / s**2
        mean = np.linalg.solve(precision, b)
        log_bf = 0.5 * b @ mean - 0.5 * np.linalg.slogdet(np.eye(k) + s**2 * G)[1]
        if one_sided:
            # half-normal prior: twice the mass of the right sign
            log_bf += np.log(2.0) + log_ndtr(mean[0] * np.sqrt(precision[0, 0]))
        logs.append(log_bf)
    averaged = float(logsumexp(logs) - np.log(len(logs)))
    if one_sided and a[0] < 0:
        return Evidence(variant, np.zeros(1), std, 0.0, averaged, absorbed)
    most = np.array([amplitudes[n].most / unit for n, unit in variant.sizes.items()])
    beyond = np.maximum(a - most, 0.0)
    lost = float(beyond @ G @ beyond)
    return Evidence(variant, a - beyond, std, float(b @ a) - lost, averaged - 0.5 * lost, absorbed)
