"""The part of a residual that smooth laws, with or without memory, could explain.

Features of a column are polynomials of angles and tensions, functions of speed, direction, time, and of the distance
since the last reversal; speeds and directions also times polynomials of angles. They bound what any listed or unlisted
law could explain; they never name a cause. The direction in which a tendon moves is none: where it rests, its measured
excursion tells it, whose noise is in the residual too.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import uniform_filter1d

from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signatures import whitened
from jaxfinger.model import Finger

MIN_ROWS = 50  # rows. A column has some forty features, which would fit the noise of fewer rows.
# Nearly collinear features differ in a few samples only. A direction with a smaller singular value, relative to the
# largest, would therefore fit single samples.
MIN_DISTINCT_SINGULAR_VALUE = 0.1
SMOOTHING = 15  # samples. Averages of so many have a quarter of the noise, which would add reversals of its own.
MIN_REVERSAL = 0.02  # share of a signal's range. A way back that is shorter is noise, or no change of direction.

# Scales of laws, as shares of the specimen's own (`effects.Scales`), from the smallest that the catalogue tries. They
# are a factor of four or five apart, so that neighbouring features and terms (`propose`) are clearly distinct.
SPEEDS = (0.05, 0.2, 0.8)  # of a joint's highest speed: Stribeck's velocity, and friction that differs by direction
LENGTHS = (0.015, 0.08, 0.3)  # of a joint's range: its pre-sliding and backlash
PULL = 0.08  # of the highest tension: pre-sliding of a tendon, as the tension that changes over it
TIMES = (0.03, 0.15)  # of the longest trial: creep and relaxation within a trial


@dataclass(frozen=True)
class SmoothPart:
    """Energy of one column's residual that smooth laws explain, in squared noise standard deviations."""

    experiment: str
    channel: str
    column: int  # joint, tendon or axis
    energy: float  # drop of the sum of squares, less its expectation under noise
    by_variable: dict[str, float]  # the same by the features of one variable alone


def features(
    problem: Problem, experiment: str, channel: str, column: int
) -> dict[str, list[Float[np.ndarray, "_B _T"]]]:
    """Features of one column, each (B, T), grouped by the variable that they depend on."""
    stack = problem.stacks[experiment]
    x, scales = stack.batch.x, problem.scales
    finger = problem.nominal.finger
    q, qd, f = np.asarray(x.q), np.asarray(x.qd), np.asarray(x.tension)
    direction, time = np.asarray(x.joint_direction), np.asarray(x.time)
    own, taut = concerned(finger, channel, column)
    out: dict[str, list[np.ndarray]] = {
        "q": [],
        "qd": [],
        "direction": [],
        "tension": [],
        "distance since reversal": [],
        "time": [],
        "other joints": [],
    }
    for i in own:
        u = _unit(q[i])
        # Powers of an angle would be nearly collinear, also times a speed or a direction.
        chebyshev = [np.cos(k * np.arccos(u)) for k in range(7)]
        out["q"] += chebyshev[1:]
        v = _unit(qd[i])
        out["qd"] += [v**2, v**3] + [v * p for p in chebyshev[:4]]
        out["qd"] += [np.exp(-np.abs(qd[i]) / w) for w in np.multiply(SPEEDS, scales.speed[i])]
        out["direction"] += [direction[i] * p for p in chebyshev[:3]]
        travelled = since_reversal(_smoothed(q[i]))
        for length in np.multiply(LENGTHS, scales.angle[i]):
            out["distance since reversal"] += [
                np.exp(-np.abs(travelled) / length) * s
                for s in (1.0, direction[i], np.tanh(travelled / (0.1 * length)))
            ]
    for k in taut:
        if f[k].max() > 0.0:
            u = f[k] / f[k].max()
            out["tension"] += [u, u**2, np.sqrt(np.maximum(u, 0))] + [u * _unit(q[i]) for i in own]
            pulled = since_reversal(_smoothed(f[k])) / (PULL * scales.tension[k])
            out["distance since reversal"] += [np.exp(-np.abs(pulled)) * np.tanh(10.0 * pulled)]
    for i in range(finger.m):
        if i not in own:
            out["other joints"] += [_unit(q[i]), _unit(q[i]) ** 2] + [_unit(q[i]) * _unit(q[j]) for j in own]
        else:
            out["other joints"] += [_unit(q[i]) * _unit(q[j]) for j in own if j > i]
    span = max(float(time.max()), 1e-9)
    out["time"] += [(time / span) ** p for p in (1, 2)] + [np.exp(-time / (s * scales.trial)) for s in TIMES]
    out["time"] += [np.asarray(x.session_time) / max(float(np.asarray(x.session_time).max()), 1e-9)]
    return out


def concerned(finger: Finger, channel: str, column: int) -> tuple[list[int], list[int]]:
    """Joints and tendons that a column's features depend on.

    A joint's torque depends on the joint and the tendons across it, a tendon's excursion on the tendon and the joints
    that it crosses, a component of the fingertip's force on all.
    """
    if channel == "joint_torque":
        return [column], [k for k in range(finger.n) if finger.crosses[k][column]]
    if channel == "tendon_excursion":
        return [i for i in range(finger.m) if finger.crosses[column][i]], [column]
    return list(range(finger.m)), list(range(finger.n))


def measured_columns(problem: Problem) -> Iterator[tuple[str, str, int, Int[np.ndarray, " n"]]]:
    """Experiment, channel, column and rows of every column with MIN_ROWS rows; rows count within the experiment."""
    for e, rows in problem.rows.items():
        for number, c in enumerate(problem.stacks[e].experiment.channels):
            for k in np.unique(rows.column[rows.channel == number]):
                pick = np.flatnonzero((rows.channel == number) & (rows.column == k))
                if len(pick) >= MIN_ROWS:
                    yield e, c, int(k), pick


def white_features(
    problem: Problem, experiment: str, channel: str, column: int, pick: Int[np.ndarray, " n"]
) -> dict[str, Float[np.ndarray, "_k n"]]:
    """Features of a column in its rows `pick`, whitened as the residuals are, by variable."""
    out, shape = {}, problem.stacks[experiment].batch.y[channel].shape
    for variable, members in features(problem, experiment, channel, column).items():
        if members:
            raw = np.zeros((len(members), *shape))
            raw[:, column] = np.stack(members)
            out[variable] = whitened(raw, problem, problem.rows[experiment], pick, channel)
    return out


def orthonormal_basis(features: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "n K"]:
    """Orthonormal basis of the span of normalised features, without directions that only near copies differ in."""
    A = features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-300)
    U, s, _ = np.linalg.svd(A.T, full_matrices=False)
    return U[:, s > MIN_DISTINCT_SINGULAR_VALUE * s[0]]


def smooth_parts(problem: Problem, residual: Float[np.ndarray, " N"]) -> list[SmoothPart]:
    """Energy that smooth laws explain of a white residual in every column, largest first."""
    found = []
    for e, c, k, pick in measured_columns(problem):
        r, white = residual[problem.rows[e].start + pick], white_features(problem, e, c, k, pick)
        by_variable = {variable: _energy(features, r) for variable, features in white.items()}
        found.append(SmoothPart(e, c, k, _energy(np.concatenate(list(white.values())), r), by_variable))
    return sorted(found, key=lambda x: -x.energy)


def _energy(features: Float[np.ndarray, "k n"], r: Float[np.ndarray, " n"]) -> float:
    """Energy of a residual in the span of features, less its expectation under white noise."""
    U = orthonormal_basis(features)
    b = U.T @ r
    return float(b @ b - U.shape[1])


def _unit(u: Float[np.ndarray, "*B T"]) -> Float[np.ndarray, "*B T"]:
    """Scale a signal linearly onto [−1, 1]; zero where it is constant but for rounding."""
    low, high = float(u.min()), float(u.max())
    if high - low <= 1e-9 * max(-low, high):
        return np.zeros_like(u)
    return np.clip(2 * (u - low) / (high - low) - 1, -1, 1)


def _smoothed(u: Float[np.ndarray, "*B T"]) -> Float[np.ndarray, "*B T"]:
    """Moving average, so that noise makes no reversals.

    The noise of an angle or a tension is in the residual too. A feature that turned with it would correlate with the
    residual without any law behind it.
    """
    return uniform_filter1d(u, SMOOTHING, axis=-1, mode="nearest")


def since_reversal(u: Float[np.ndarray, "*B T"]) -> Float[np.ndarray, "*B T"]:
    """Signed distance from the last reversal, along the last axis."""
    step = np.diff(u, axis=-1, prepend=u[..., :1])
    threshold = MIN_REVERSAL * max(float(np.ptp(u)), 1e-12)
    out = np.zeros_like(u)
    for index in np.ndindex(u.shape[:-1]):
        turn = extreme = u[index][0]
        sign = 0.0
        for t, (value, d) in enumerate(zip(u[index].tolist(), step[index].tolist(), strict=True)):
            if sign * (value - extreme) >= 0:
                extreme = value
                sign = sign or float(np.sign(d))
            elif abs(value - extreme) > threshold:
                turn, sign, extreme = extreme, -sign, value
            out[(*index, t)] = value - turn
    return out
