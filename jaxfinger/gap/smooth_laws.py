"""How much of a residual a smooth law, with or without memory, could explain.

Features of each channel's column: polynomials of the angles, tension, speed, directions, distance since reversal and
time in the trial. It is the yardstick for «none of these», never the answer.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from jaxfinger.gap.problem import Problem
from jaxfinger.gap.signatures import whitened
from jaxfinger.model import Finger

SMOOTHED = 15  # samples over which an angle or a tension is averaged before its reversals are looked for


@dataclass(frozen=True)
class SmoothPart:
    """What smooth laws explain of one channel's column in one experiment."""

    experiment: str
    channel: str
    column: int
    energy: float  # of the residual above noise: drop of the sum of squares, less its expectation under noise
    rows: int
    by_variable: dict[str, float]  # the same, for the features of one variable alone


def features(problem: Problem, experiment: str, channel: str, column: int) -> dict[str, list[np.ndarray]]:
    """Features (B, T) by the variable that they depend on."""
    stack = problem.stacks[experiment]
    x = stack.batch.x
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
        out["q"] += [np.cos(k * np.arccos(u)) for k in range(1, 7)]
        out["qd"] += [_unit(qd[i]) ** p for p in (1, 2, 3)] + [np.exp(-np.abs(qd[i]) / 0.1)]
        out["direction"] += [direction[i] * u**p for p in range(3)]
        travelled = since_reversal(_calm(q[i]))
        for length in (0.02, 0.1):
            out["distance since reversal"] += [
                np.exp(-np.abs(travelled) / length) * s
                for s in (1.0, direction[i], np.tanh(travelled / (0.1 * length)))
            ]
    for k in taut:
        if f[k].any():
            u = f[k] / max(f[k].max(), 1e-9)
            out["tension"] += [u, u**2, np.sqrt(np.maximum(u, 0))] + [u * _unit(q[i]) for i in own]
            pulled = since_reversal(_calm(f[k]))
            out["distance since reversal"] += [np.exp(-np.abs(pulled) / 1.0) * np.tanh(pulled / 0.1)]
    for i in range(finger.m):
        if i not in own:
            out["other joints"] += [_unit(q[i]), _unit(q[i]) ** 2] + [_unit(q[i]) * _unit(q[j]) for j in own]
        else:
            out["other joints"] += [_unit(q[i]) * _unit(q[j]) for j in own if j > i]
    span = max(float(time.max()), 1e-9)
    out["time"] += [(time / span) ** p for p in (1, 2)] + [np.exp(-time / s) for s in (1.0, 5.0)]
    out["time"] += [np.asarray(x.session_time) / max(float(np.asarray(x.session_time).max()), 1e-9)]
    return out


def concerned(finger: Finger, channel: str, column: int) -> tuple[list[int], list[int]]:
    """Joints and tendons that bear on a column: a joint and what crosses it, a tendon and what it crosses, or all."""
    if channel == "joint_torque":
        return [column], [k for k in range(finger.n) if finger.crosses[k][column]]
    if channel == "tendon_excursion":
        return [i for i in range(finger.m) if finger.crosses[column][i]], [column]
    return list(range(finger.m)), list(range(finger.n))


def smooth_parts(problem: Problem, residual: np.ndarray) -> list[SmoothPart]:
    """Column by column, largest energy first."""
    found = []
    for e, rows in problem.rows.items():
        mine = residual[rows.start : rows.start + rows.size]
        for number, c in enumerate(problem.stacks[e].experiment.channels):
            for column in np.unique(rows.column[rows.channel == number]):
                pick = np.flatnonzero((rows.channel == number) & (rows.column == column))
                if len(pick) < 50:
                    continue
                by = {}
                blocks = []
                for variable, members in features(problem, e, c, int(column)).items():
                    if members:
                        raw = np.zeros((len(members), problem.stacks[e].batch.y[c].shape[0], *members[0].shape))
                        raw[:, column] = np.stack(members)
                        white = whitened(raw, problem, rows, pick, c)
                        blocks.append(white)
                        by[variable] = _energy(white, mine[pick])
                found.append(SmoothPart(e, c, int(column), _energy(np.concatenate(blocks), mine[pick]), len(pick), by))
    return sorted(found, key=lambda x: -x.energy)


def _energy(features: np.ndarray, r: np.ndarray) -> float:
    """Energy of the residual in the span of the features, less its expectation. Nearly collinear features are left out:
    their differences are narrow, and would single out samples."""
    scale = np.linalg.norm(features, axis=1, keepdims=True)
    U, s, _ = np.linalg.svd((features / np.maximum(scale, 1e-300)).T, full_matrices=False)
    kept = s > 0.1 * s[0]
    b = U[:, kept].T @ r
    return float(b @ b - kept.sum())


def _unit(u: np.ndarray) -> np.ndarray:
    """Onto [−1, 1]."""
    low, high = float(u.min()), float(u.max())
    return np.zeros_like(u) if high - low < 1e-9 else np.clip(2 * (u - low) / (high - low) - 1, -1, 1)


def _calm(u: np.ndarray) -> np.ndarray:
    """Without the noise of single samples: the residual has its share of a reading's noise, and a whitened feature that
    turned with it would look like a law.
    """
    return uniform_filter1d(u, SMOOTHED, axis=-1, mode="nearest")


def since_reversal(u: np.ndarray) -> np.ndarray:
    """Signed distance along the last axis since the last turning point."""
    step = np.diff(u, axis=-1, prepend=u[..., :1])
    threshold = 0.02 * max(float(np.ptp(u)), 1e-12)
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
