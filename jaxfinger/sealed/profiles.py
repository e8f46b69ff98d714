"""Smooth motions: velocity follows a quintic smoothstep between knots, so that acceleration is continuous.

Between knots of velocity v₀ and v₁ a time T apart, with x = (t − t₀)/T: v = v₀ + (v₁ − v₀) (10x³ − 15x⁴ + 6x⁵).
Value and acceleration are its exact integral and derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Profile:
    """One coordinate over time from its start and velocity knots, at rest before and after them."""

    start: float
    times: Float[np.ndarray, " k"]
    rates: Float[np.ndarray, " k"]

    def __call__(self, t: Float[np.ndarray, " N"]) -> tuple[Float[np.ndarray, " N"], ...]:
        """Value, first and second derivative at times t, s."""
        if len(self.times) < 2:
            return np.full_like(t, self.start), np.zeros_like(t), np.zeros_like(t)
        span = np.diff(self.times)
        step = np.diff(self.rates)
        reached = self.start + np.concatenate([[0.0], np.cumsum(span * (self.rates[:-1] + step / 2))])
        clipped = np.clip(t, self.times[0], self.times[-1])
        i = np.clip(np.searchsorted(self.times, clipped, side="right") - 1, 0, len(span) - 1)
        x = (clipped - self.times[i]) / span[i]
        smooth = x**3 * (10 + x * (-15 + 6 * x))
        integral = x**4 * (2.5 + x * (-3 + x))
        value = reached[i] + span[i] * (self.rates[i] * x + step[i] * integral)
        rate = self.rates[i] + step[i] * smooth
        accel = step[i] / span[i] * 30 * x**2 * (1 - x) ** 2
        return value, rate, accel


@dataclass(frozen=True)
class Builder:
    """Immutable builder of a `Profile` from rests and moves: each call returns a new builder."""

    start: float
    now: float = 0.0
    value: float | None = None
    times: tuple[float, ...] = ()
    rates: tuple[float, ...] = ()

    @property
    def here(self) -> float:
        """Value reached so far."""
        return self.start if self.value is None else self.value

    def rest(self, duration: float) -> Builder:
        """Rest for `duration` s."""
        return self._then([(duration, 0.0)], self.here)

    def move(self, to: float, duration: float) -> Builder:
        """Move to a value in `duration` s and stop there."""
        peak = 2.0 * (to - self.here) / duration
        return self._then([(duration / 2, peak), (duration / 2, 0.0)], to)

    def sweep(self, to: float, speed: float, turn: float) -> Builder:
        """Move to a value at constant speed, with `turn` s each to speed up and to slow down."""
        distance = to - self.here
        cruise = max(abs(distance) / speed - turn, 1e-3)
        rate = distance / (cruise + turn)
        return self._then([(turn, rate), (cruise, rate), (turn, 0.0)], to)

    def _then(self, pieces: list[tuple[float, float]], value: float) -> Builder:
        times, rates = list(self.times or (self.now,)), list(self.rates or (0.0,))
        now = self.now
        for duration, rate in pieces:
            now += duration
            times.append(now)
            rates.append(rate)
        return Builder(self.start, now, value, tuple(times), tuple(rates))

    def profile(self) -> Profile:
        return Profile(self.start, np.array(self.times), np.array(self.rates))
