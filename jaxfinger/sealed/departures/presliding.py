"""Presliding: normalised friction z ∈ [−1, 1] as a function of displacement, in four textbook forms.

Dahl (1968): dz/dx = (1 − z sgn ẋ)/x₀, the bristle model's quasi-static limit.
LuGre (Canudas de Wit 1995): the same bristle with a micro-damping that matters only while z changes; quasi-static
here: an exponent above one makes its knee sharper.
Generalised Maxwell-slip (Lampaert 2003): parallel elasto-slip elements.
Bouc–Wen (Wen 1976): dz/dx = (1 − |z|ⁿ (γ + β sgn(ẋ z)))/x₀ with γ + β = 1, softer to load than to unload.
"""

from __future__ import annotations

import numpy as np

ELEMENTS = 5


def advance(form: str, z: np.ndarray, dx: np.ndarray, x0: float) -> np.ndarray:
    """Next state (..., ELEMENTS) after the displacement dx (...,), presliding distance x0."""
    dx = np.asarray(dx)[..., None]
    if form == "maxwell_slip":
        reach = x0 * np.linspace(0.25, 1.75, ELEMENTS)
        return np.clip(z + dx / reach, -1.0, 1.0)
    sign = np.sign(dx)
    if form == "dahl":  # exact over one step of constant direction
        return sign - (sign - z) * np.exp(-np.abs(dx) / x0)
    if np.all(np.abs(dx) > 6 * x0):
        return np.broadcast_to(sign, z.shape).astype(float)
    steps = int(min(50, 1 + np.ceil(np.max(np.abs(dx)) / (0.2 * x0))))  # sub-stepped where the step is long
    for _ in range(steps):
        if form == "bouc_wen":
            lacking = 1.0 - np.abs(z) ** 1.4 * (0.3 + 0.7 * np.sign(sign * z))
        else:  # a sharper knee: dz/dx = (1 − z sgn ẋ |z|^(p−1)) / x₀ with p = 3
            lacking = 1.0 - sign * z * np.abs(z) ** 2
        z = np.clip(z + dx / steps / x0 * lacking, -1.0, 1.0)
    return z


def towards_first_motion(x: np.ndarray) -> np.ndarray:
    """State (..., ELEMENTS) of a trial that goes on as it was approached: fully built up in the direction of
    its first motion.
    """
    moved = np.sign(np.where(np.abs(x - x[0]) > 1e-7, x - x[0], 0.0))
    first = np.take_along_axis(moved, np.argmax(moved != 0, axis=0)[None], axis=0)[0]
    return np.broadcast_to(first[..., None], (*first.shape, ELEMENTS)).astype(float)


def friction(z: np.ndarray) -> np.ndarray:
    """Share of the sliding friction that has built up, (...,)."""
    return np.asarray(z.mean(axis=-1))
