"""A fixture holds the joints while a tendon is pulled (ID.4, VD.2), in steps or in ramps.

A tendon slips past its loss only, and keeps the tension that it has at the joints until it does (from slack on:
`tendon_friction.held`). Holds count, and motion of which the model knows where it slips: a step that goes on as the one
before, and ramps so slow that they hardly change within a block.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import uniform_filter1d
from scipy.optimize import isotonic_regression

from jaxfinger.data import find_holds
from jaxfinger.data.motion import RAMP_BLOCKS, slow_ramps, stretches_of
from jaxfinger.experiments.reduction import PreparedTrial, Row, joints, row, stretches
from jaxfinger.experiments.shrink import shrink

NOTHING = "no tendon is pulled from slack in holds, or in ramps slow enough to tell its friction"
PARTS = 6  # of a hold, whose means say how well its own is known; longer than an encoder's noise is correlated
OVERSHOOT = 4.0  # standard deviations: tension beyond that of both holds by more was really there
FEW = 3  # holds from which on their spread tells whether a fixture yields


def reduce(r: PreparedTrial) -> Row:
    """Holds and ramps count from slack on; the excursion of a tendon counts wherever it is taut."""
    j = joints(r, sharp=not r.reduced)
    hold = r.whole(find_holds(r.trial, r.spec.pace))
    tension = measured = r.tension()
    if not r.reduced:
        # As smooth as the blocks of a fit: what slips at a noise peak would stay there until the next step.
        tension = uniform_filter1d(tension, max(1, round(1.0 / (r.spec.rate * r.step))), axis=0, mode="nearest")
    pulled = r.taut(r.mean(tension))
    ramps = slow_ramps(pulled, hold, round(RAMP_BLOCKS / (r.spec.rate * r.step * r.size)), r.sizes.travel)
    pulled = _in_steps(_in_ramps(pulled, ramps, r.sizes.travel), np.where(ramps, -2, hold), slack=True)
    counts = (hold >= 0) | _goes_on(pulled, hold, r.sizes.travel)
    taut = r.lowest(measured) > r.sizes.slack
    known = ((counts | ramps) & _from_slack(r, pulled))[:, None]
    counting = {c: counts[:, None] | taut if c == "tendon_excursion" else known for c in r.y}
    still = np.zeros_like(j.qd)
    return row(r, _in_fixture(r.mean(r.trial.q), hold), (still, still), pulled, counting, j.noise, hold=hold)


def _from_slack(r: PreparedTrial, tension: Float[np.ndarray, "M n"]) -> Bool[np.ndarray, " M"]:
    """Where what friction has taken before the trial's first sample no longer matters: a recording that starts with a
    taut tendon counts from that tendon's first change on, or from where the protocol says how it was approached.
    """
    known = np.abs(tension - tension[0]) > r.sizes.travel
    if r.trial.tendon_direction is not None:
        known |= r.mean(r.trial.tendon_direction.astype(float)) != 0.0
    known |= tension[0] <= r.sizes.slack
    return np.asarray(np.all(np.logical_or.accumulate(known, axis=0), axis=1))


def _in_ramps(tension: Float[np.ndarray, "M n"], ramps: Bool[np.ndarray, " M"], travel: float):
    """Tension that only rises or only falls between two turning points: a held tendon keeps the highest that it has
    seen, so a running maximum over noise would drift upwards.
    """
    out = tension.copy()
    for begin, end in stretches_of(ramps):
        for k in range(tension.shape[1]):
            turns = [begin, *(begin + t for t in _turning_points(tension[begin:end, k], travel)), end]
            for a, b in pairwise(turns):
                part = tension[a:b, k]
                if b - a > 1:
                    out[a:b, k] = isotonic_regression(part, increasing=bool(part[-1] >= part[0])).x
    return out


def _turning_points(x: Float[np.ndarray, " M"], least: float) -> list[int]:
    """Where x turns back by more than `least`."""
    turns, way, low, high = [], 0, 0, 0
    for i, value in enumerate(x):
        low, high = (i if value < x[low] else low), (i if value > x[high] else high)
        if way >= 0 and x[high] - value > least:
            turns, way, low = ([*turns, high] if way else turns), -1, i
        elif way <= 0 and value - x[low] > least:
            turns, way, high = ([*turns, low] if way else turns), 1, i
    return [t for t in turns if t > 0]


def _in_fixture(q: Float[np.ndarray, "M m"], hold: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M m"]:
    """The mean of all holds, and of what they differ by, the share that is not the noise of their means (James and
    Stein's estimator); without holds likewise of every second's angles.

    A fixture may yield. Noise of the angle would look like a law of it, and near a singular posture a contact force
    amplifies it a thousandfold.
    """
    runs = stretches(hold)
    if not runs:
        return shrink(q, RAMP_BLOCKS)
    if len(runs) < FEW:
        return _in_steps(q, hold)
    means = np.stack([q[run].mean(axis=0) for run in runs])
    parts = [np.stack([x.mean(axis=0) for x in np.array_split(q[run], PARTS)]) for run in runs if len(run) >= PARTS]
    noise = np.mean([x.var(axis=0, ddof=1) / PARTS for x in parts], axis=0) if parts else np.zeros(q.shape[1])
    spread = means.var(axis=0, ddof=1)
    share = 1.0 - np.minimum(noise / np.where(spread > 0.0, spread, 1.0), 1.0)
    return means.mean(axis=0) + share * (_in_steps(q, hold) - means.mean(axis=0))


def _in_steps(values: Float[np.ndarray, "M k"], hold: Int[np.ndarray, " M"], slack: bool = False):
    """At a hold its mean, and between holds nothing beyond the two means; before and after all as in the first and
    last, or down to nothing where it is `slack` there. Samples of a ramp, marked by −2, stay as they are.

    What lies beyond the two means by more than four standard deviations is a real overshoot, and stays but for those
    four.
    """
    runs = stretches(hold)
    if not runs:
        return values
    out, at = values.copy(), np.arange(len(values))
    means = [values[run].mean(axis=0) for run in runs]
    ends = [0.0 * means[0]] * 2 if slack else [means[0], means[-1]]
    means = np.stack([ends[0], *means, ends[1]])
    noise = np.sqrt(np.mean([values[run].var(axis=0) for run in runs], axis=0))
    before = np.searchsorted([run[-1] for run in runs], at)
    after = np.minimum(np.searchsorted([run[0] for run in runs], at, side="right") + 1, len(means) - 1)
    kept = np.clip(out, np.minimum(means[before], means[after]), np.maximum(means[before], means[after]))
    beyond = out - kept
    out = kept + np.sign(beyond) * np.maximum(np.abs(beyond) - OVERSHOOT * noise, 0.0)
    for mean, run in zip(means[1:], runs, strict=False):
        out[run] = mean
    out[hold == -2] = values[hold == -2]
    return out


def _goes_on(tension: Float[np.ndarray, "M n"], hold: Int[np.ndarray, " M"], travel: float) -> Bool[np.ndarray, " M"]:
    """Between which holds every tendon goes on as it went before.

    Where it turns back, or leaves slack, it sticks and then slips within one block, whose mean tension does not tell
    when.
    """
    out = np.zeros(len(hold), bool)
    runs = stretches(hold)
    steps = np.diff([tension[run].mean(axis=0) for run in runs], axis=0)
    ways = np.where(np.abs(steps) > travel, np.sign(steps), 0.0)
    for k in range(1, len(ways)):
        if np.all((ways[k] == ways[k - 1]) | (ways[k] == 0)):
            out[runs[k][-1] + 1 : runs[k + 1][0]] = True
    return out
