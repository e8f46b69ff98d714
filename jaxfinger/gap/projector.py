"""Projection off the nominal parameters, in the weights of the formula."""

import numpy as np
from jaxtyping import Float

from jaxfinger.gap.columns import Columns
from jaxfinger.gap.formula import Weights
from jaxfinger.gap.problem import Problem

# Relative to the largest variance of columns: sums of ten thousand products are good to 100 times the rounding 2.2e-16.
MIN_RELATIVE_VARIANCE = 1e-14


class Projector:
    """Projection of weighted rows off what the nominal parameters can absorb.

    A row x of N numbers becomes (I − Q Qᵀ) [Ω^½ x; 0] with the weights Ω of the formula, where Q spans [Ω^½ J; R] and R
    is the root of the information of the nominal parameters' prior.
    """

    def __init__(self, problem: Problem, columns: Columns, weights: Weights):
        self.columns, self.weights = columns, weights
        A = np.vstack([self.weighted(problem.J.T).T, problem.root])
        scale = np.linalg.norm(A, axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        self.Q, self.T = orthonormalise(A / scale)
        self.T /= scale[:, None]  # Q = A T
        self.offset = problem.offset

    def weighted(self, x: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "k N"]:
        """Multiply rows by Ω^½."""
        out = x.copy()
        for c, inside, outside in zip(self.columns.items, self.weights.feature, self.weights.outside, strict=True):
            mine = x[:, c.rows]
            out[:, c.rows] = (
                np.sqrt(outside) * mine + (np.sqrt(inside) - np.sqrt(outside)) * (mine @ c.basis) @ c.basis.T
            )
        return out

    def __call__(self, x: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "k rows"]:
        """Project signatures. Their prior rows are zero, since effects do not enter the prior."""
        return self._off(np.pad(self.weighted(x), ((0, 0), (0, len(self.offset)))))

    def residual(self, r: Float[np.ndarray, " N"]) -> Float[np.ndarray, " rows"]:
        """Project a residual, together with that of the nominal parameters' prior."""
        return self._off(self._with_prior(r)[None])[0]

    def nominal_step(self, r: Float[np.ndarray, " N"]) -> Float[np.ndarray, " p"]:
        """Change of the nominal parameters that absorbs as much of a residual as they can."""
        return self.T @ (self.Q.T @ self._with_prior(r))

    def _with_prior(self, r):
        return np.concatenate([self.weighted(r[None])[0], -self.offset])

    def _off(self, x):
        return x - (x @ self.Q) @ self.Q.T


def orthonormalise(A: Float[np.ndarray, "N p"]) -> tuple[Float[np.ndarray, "N k"], Float[np.ndarray, "p k"]]:
    """Q and T with Q = A T and Qᵀ Q = I, where Q spans the columns of A but for directions that are rounding.

    The products AᵀA cost a quarter of Householder's QR where rows are many. If A is ill-conditioned, the first pass
    leaves Q oblique, and the second one mends that (as in CholeskyQR2: Yamamoto et al., ETNA 44 (2015) 306).
    """
    Q, T = A, np.eye(A.shape[1])
    for _ in range(2):
        variance, V = np.linalg.eigh(Q.T @ Q)
        kept = variance > MIN_RELATIVE_VARIANCE * variance.max(initial=0.0)
        step = V[:, kept] / np.sqrt(variance[kept])
        Q, T = Q @ step, T @ step
    return Q, T
