"""Prior on the parameters: from the finger's description, or from an earlier fit."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


class Prior(NamedTuple):
    """Gaussian prior rows `root (θ − mean)` on the free parameters; `root` is a square root of the precision."""

    mean: Float[np.ndarray, " p"]
    root: Float[np.ndarray, "rows p"]

    @classmethod
    def none(cls, theta: Float[np.ndarray, " p"]) -> "Prior":
        """Empty prior, with no rows."""
        return cls(theta, np.zeros((0, theta.size)))

    def cost(self, theta: Float[np.ndarray, " p"]) -> float:
        """½ ‖root (θ − mean)‖²."""
        offset = self.root @ (theta - self.mean)
        return 0.5 * float(offset @ offset)


def prior_of(
    values: Float[np.ndarray, " P"], covariance: Float[np.ndarray, "P P"], free: Int[np.ndarray, " p"]
) -> Prior:
    """Prior on the free parameters from an earlier fit of other recordings, with its full covariance.

    Parameters whose variance is zero or infinite get no row.
    """
    variance = np.diag(covariance)[free]
    known = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    std = np.sqrt(variance[known])
    correlation = covariance[np.ix_(free[known], free[known])] / np.outer(std, std)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    root = np.zeros((known.size, free.size))
    # Rounding may leave an eigenvalue of zero or less.
    root[:, known] = (vectors / np.sqrt(np.maximum(eigenvalues, 1e-12))).T / std
    return Prior(values[free], root)
