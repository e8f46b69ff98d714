"""Commanded motions with their exact derivatives: steps, sweeps, strokes of a hand, sines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

Array = np.ndarray
Numbers = Sequence[float] | Float[Array, " _k"]


class Path(NamedTuple):
    """Position, velocity and acceleration of one coordinate."""

    x: Float[Array, " N"]
    v: Float[Array, " N"]
    a: Float[Array, " N"]


class Staircase(NamedTuple):
    """A path of steps with dwells between them."""

    path: Path
    step: Int[Array, " N"]  # index of the point that the sample is at or moving to
    dwelling: Int[Array, " N"]  # 1 where it dwells
    direction: Int[Array, " N"]  # −1, 0, 1: direction of the move, kept in the dwell after it


def minimum_jerk(time: Float[Array, " N"], points: Numbers, move: Numbers, dwell: Numbers) -> Staircase:
    """Minimum-jerk steps from points[0] to each next point: k-th move of move[k] s, then a dwell of dwell[k] s.

    x = x₀ + Δ (10 s³ − 15 s⁴ + 6 s⁵), s from 0 to 1 (Flash and Hogan 1985, eq. 3). The acceleration has no jumps.
    """
    start = np.concatenate([[0.0], np.cumsum(np.add(move, dwell))])[:-1]
    k = np.clip(np.searchsorted(start, time, side="right") - 1, 0, start.size - 1)
    duration = np.asarray(move, dtype=float)[k]
    s = np.clip((time - start[k]) / duration, 0.0, 1.0)
    x0, delta = np.asarray(points)[k], np.diff(points)[k]
    path = Path(
        x0 + delta * s**3 * (10.0 - 15.0 * s + 6.0 * s**2),
        delta / duration * 30.0 * s**2 * (1.0 - s) ** 2,
        delta / duration**2 * 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s),
    )
    return Staircase(path, k + 1, (s >= 1.0).astype(int), np.sign(delta).astype(int))


def sweeps(
    rate: float, lower: float, upper: float, speeds: Sequence[float], cycles: int, acceleration: float = 10.0
) -> Path:
    """Sweeps from lower to upper and back (rad), `cycles` times at each speed (rad/s), at `rate` Hz, from rest to rest.

    The velocity is constant except at the reversals. There it is v cos(π s / 2), s from −1 to 1, so the acceleration is
    continuous, and its peak `acceleration` (rad/s²) is the same at every speed. A range too short to reach a speed is
    swept at the highest speed that it allows.
    """
    fastest = np.sqrt(0.5 * acceleration * (upper - lower))
    v = np.minimum(speeds, fastest)
    turn = v / acceleration  # s. v · turn is the distance covered while speeding up.
    ramp = 0.5 * np.pi * turn  # s
    cruise = (upper - lower) / v - 2.0 * turn
    half = cruise + 2.0 * ramp
    start = np.concatenate([[0.0], np.cumsum(2.0 * cycles * half)])
    t = np.arange(int(start[-1] * rate) + 1) / rate
    k = np.clip(np.searchsorted(start, t, side="right") - 1, 0, v.size - 1)
    v, turn, ramp, cruise, half, t = v[k], turn[k], ramp[k], cruise[k], half[k], t - start[k]

    u = np.mod(t, half)
    up, down = np.clip(u / ramp, 0.0, 1.0), np.clip((half - u) / ramp, 0.0, 1.0)
    s = 0.5 * np.pi * (up - down)
    along = v * (turn * (1.0 - np.cos(0.5 * np.pi * up)) + np.clip(u - ramp, 0.0, cruise))
    along = along + v * turn * np.cos(0.5 * np.pi * down)
    back = np.mod(t, 2.0 * half) >= half
    sign = np.where(back, -1.0, 1.0)
    return Path(np.where(back, upper, lower) + sign * along, sign * v * np.cos(s), -sign * acceleration * np.sin(s))


def wander(
    time: Float[Array, " N"], lower: float, upper: float, rng: np.random.Generator, stroke: tuple[float, float]
) -> Path:
    """Path of a joint led by hand: minimum-jerk strokes to random places, each of a random time within `stroke` (s)."""
    strokes = rng.uniform(*stroke, int(time[-1] / stroke[0]) + 2)
    places = rng.uniform(lower, upper, strokes.size + 1)
    return minimum_jerk(time, places, strokes, np.zeros(strokes.size)).path


def swing(
    time: Float[Array, " N"],
    centre: float,
    amplitude: float,
    rng: np.random.Generator,
    slow: float = 0.25,
    fast: float = 0.7,
) -> Path:
    """Sum of two sines of `slow` to `fast` Hz about a centre, faded in over the first second: it starts at rest."""
    w = 2.0 * np.pi * np.sort(rng.uniform(slow, fast, 2))
    share = rng.uniform(0.4, 0.6)
    sines = [
        (share * amplitude, w[0], rng.uniform(-np.pi, np.pi)),
        ((1.0 - share) * amplitude, w[1], rng.uniform(-np.pi, np.pi)),
    ]
    y = sum(a * np.sin(w * time + p) for a, w, p in sines)
    dy = sum(a * w * np.cos(w * time + p) for a, w, p in sines)
    ddy = sum(-a * w**2 * np.sin(w * time + p) for a, w, p in sines)
    e, de, dde = minimum_jerk(time, (0.0, 1.0), (1.0,), (float(time[-1]),)).path
    return Path(centre + e * y, de * y + e * dy, dde * y + 2.0 * de * dy + e * ddy)
