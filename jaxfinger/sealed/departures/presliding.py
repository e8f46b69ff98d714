"""Presliding: normalised friction z ∈ [−1, 1] as a function of displacement, in four textbook forms.

Dahl (1968): dz/dx = (1 − z sgn ẋ)/x₀, the quasi-static limit of a bristle model.
LuGre (Canudas de Wit 1995): a bristle with micro-damping, which matters only while z changes. The quasi-static form
here has the sharper knee of a cubic, dz/dx = (1 − |z|³ sgn(ẋ z))/x₀.
Generalised Maxwell slip (Lampaert 2003): parallel elasto-slip elements.
Bouc–Wen (Wen 1976): dz/dx = (1 − |z|ⁿ (γ + β sgn(ẋ z)))/x₀ with γ + β = 1, here n = 1.4, γ = 0.3, β = 0.7.
"""

from __future__ import annotations

import numpy as np

ELEMENTS = 5  # of Maxwell slip; the other forms repeat one state


def advance(form: str, z: np.ndarray, dx: np.ndarray, x0: float) -> np.ndarray:
    """Next state (..., ELEMENTS) after a displacement dx (...,) with presliding distance x0, in the same unit."""
    dx = np.asarray(dx)[..., None]
    if form == "maxwell_slip":
        reach = x0 * np.linspace(0.25, 1.75, ELEMENTS)
        return np.clip(z + dx / reach, -1.0, 1.0)
    sign = np.sign(dx)
    if form == "dahl":  # Exact for one direction.
        return sign - (sign - z) * np.exp(-np.abs(dx) / x0)
    if np.all(np.abs(dx) > 6 * x0):
        return np.broadcast_to(sign, z.shape).astype(float)
    steps = int(min(50, 1 + np.ceil(np.max(np.abs(dx)) / (0.2 * x0))))  # Euler steps of at most 0.2 x₀.
    for _ in range(steps):
        if form == "bouc_wen":
            lacking = 1.0 - np.abs(z) ** 1.4 * (0.3 + 0.7 * np.sign(sign * z))
        else:
            lacking = 1.0 - sign * z * np.abs(z) ** 2
        z = np.clip(z + dx / steps / x0 * lacking, -1.0, 1.0)
    return z


def towards_first_motion(x: np.ndarray) -> np.ndarray:
    """State (..., ELEMENTS) at the start of positions x, time first: built up in the direction of the first motion."""
    moved = np.sign(np.where(np.abs(x - x[0]) > 1e-7, x - x[0], 0.0))
    first = np.take_along_axis(moved, np.argmax(moved != 0, axis=0)[None], axis=0)[0]
    return np.broadcast_to(first[..., None], (*first.shape, ELEMENTS)).astype(float)


def friction(z: np.ndarray) -> np.ndarray:
    """Share (...,) of the sliding friction that has built up."""
    return np.asarray(z.mean(axis=-1))
