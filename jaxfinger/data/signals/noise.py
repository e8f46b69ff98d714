"""How large the noise of a sensor is, and the error of its resolution, told from readings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.signals.quantiles import median

if TYPE_CHECKING:
    from jaxtyping import Float

HALF_95 = 1.96  # standard deviations from the mean to either end of a normal distribution's central 95 % interval
STD_PER_MAD = 1.4826  # standard deviation of Gaussian values, per median absolute deviation: 1/Φ⁻¹(3/4)


def robust_std(values: Float[np.ndarray, " N"]) -> float:
    """Robust standard deviation, from the median absolute deviation: exact for Gaussian values."""
    return STD_PER_MAD * median(np.abs(values - median(values)))


def quantisation(values: Float[np.ndarray, " N"]) -> tuple[float, float]:
    """Error of a coarse converter: its standard deviation in the readings' unit, and for how many samples it lasts.

    Readings in steps of δ under noise σ have a mean that is off by δ/√12 exp(−2π² σ²/δ²), nearly: enough noise dithers
    the converter (Widrow and Kollár 2008, «Quantization noise»). Successive readings differ with the probability
    2σ/(√π δ), which tells σ. A signal that moves by steps dithers it likewise. The error lasts as long as a reading,
    here that of a sample drawn at random. NaN is no reading.
    """
    values = values[np.isfinite(values)]
    if len(values) < 2:
        return 0.0, 1.0
    changes = np.flatnonzero(np.diff(values)) + 1
    dither = 0.5 * np.sqrt(np.pi) * len(changes) / (len(values) - 1)
    runs = np.diff(np.concatenate([[0], changes, [len(values)]]))
    error = resolution(values) / np.sqrt(12.0) * np.exp(-2.0 * np.pi**2 * dither**2)
    return float(error), float((runs @ runs) / runs.sum())


def resolution(values: Float[np.ndarray, " N"]) -> float:
    """Resolution of a sensor: the smallest change between samples that is more than rounding."""
    changes = np.abs(np.diff(values))
    changes = changes[changes > 1e-6 * np.ptp(values)]
    return float(changes.min()) if len(changes) else 0.0
