"""Reduction of trials in which a fixture holds the joints while a tendon is pulled, in steps or ramps (ID.4, VD.2).

A held tendon slips only where its loss is exceeded, and otherwise keeps its tension at the joints
(`tendon_friction.held`, from slack on). Valid samples are holds, and changes in which the model knows where the tendon
slips: a step that goes on in one direction and in which it slips or sticks all through, and ramps so slow that the
tension hardly changes within a block.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import uniform_filter1d

from jaxfinger.data import find_holds, quantisation
from jaxfinger.data.signals.motion import RAMP_BLOCKS, slow_ramps, stretches_of
from jaxfinger.experiments.reduction import PreparedTrial, Row, joints, row, runs_of_holds
from jaxfinger.experiments.shrink import shrink

NONE_VALID = "no tendon is pulled from slack in holds, or in ramps slow enough to tell its friction"
HOLD_PARTS = 6  # of a hold, whose means give the noise of its mean; encoder noise is correlated over less than one part
MIN_OVERSHOOT = 4.0  # standard deviations of noise beyond both holds; tension beyond that is a real overshoot
MIN_HOLDS = 3  # to see from the spread of holds whether a fixture yields; two leave a single degree of freedom
# Of the change of load per newton of tension, relative to the quickest step: less is that of noise, or of a fixture
# that yields under a tendon that sticks.
MIN_SLIP_SHARE = 0.1
RAMP_SAMPLE = -2  # marks the samples of a ramp among the numbers of holds


def reduce(r: PreparedTrial) -> Row:
    """Reduce a trial: holds and ramps are valid once friction no longer depends on the past, excursions where taut."""
    j = joints(r, sharp=not r.reduced)
    hold = r.whole(find_holds(r.trial, r.experiment.pace))
    tension = measured = r.tension()
    if not r.reduced:
        # As smooth as the block means of a fit: a tendon that slips at a peak of noise would stay there.
        tension = uniform_filter1d(tension, max(1, round(1.0 / (r.experiment.rate * r.step))), axis=0, mode="nearest")
    pulled = r.taut(r.mean(tension))
    ramps = slow_ramps(pulled, hold, round(RAMP_BLOCKS / (r.experiment.rate * r.step * r.size)), r.sizes.travel)
    if ramps.any():
        pulled = _monotonic_ramps(pulled, ramps, r.sizes.travel)
    counts = (hold >= 0) | _continues(pulled, hold, r.sizes.travel, *_load(r))
    pulled = _clipped_between_holds(pulled, np.where(ramps, RAMP_SAMPLE, hold), slack=True)
    taut = r.lowest(measured) > r.sizes.slack
    known = ((counts | ramps) & _from_slack(r, pulled))[:, None]
    counting = {c: counts[:, None] | taut if c == "tendon_excursion" else known for c in r.y}
    still = np.zeros_like(j.qd)
    return row(r, _fixture_angles(r.mean(r.trial.q), hold), (still, still), pulled, counting, j.noise, hold=hold)


def _from_slack(r: PreparedTrial, tension: Float[np.ndarray, "M n"]) -> Bool[np.ndarray, " M"]:
    """Whether friction no longer depends on the time before the trial, block by block.

    A tendon that is taut at the first sample counts from its first change of tension on, or from where the protocol
    gives its direction.
    """
    known = np.abs(tension - tension[0]) > r.sizes.travel
    if r.trial.tendon_direction is not None:
        known |= r.mean(r.trial.tendon_direction.astype(float)) != 0.0
    known |= tension[0] <= r.sizes.slack
    return np.asarray(np.all(np.logical_or.accumulate(known, axis=0), axis=1))


def _monotonic_ramps(tension: Float[np.ndarray, "M n"], ramps: Bool[np.ndarray, " M"], travel: float):
    """Make the tension of ramps monotonic between turning points, by isotonic regression.

    A held tendon keeps the highest tension that it has seen, so that peaks of noise would add up.
    """
    from scipy.optimize import isotonic_regression  # slow to import, and few sessions have ramps

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
    """Indices where x reverses by more than `least`."""
    turns, way, low, high = [], 0, 0, 0
    for i, value in enumerate(x):
        low, high = (i if value < x[low] else low), (i if value > x[high] else high)
        if way >= 0 and x[high] - value > least:
            turns, way, low = ([*turns, high] if way else turns), -1, i
        elif way <= 0 and value - x[low] > least:
            turns, way, high = ([*turns, low] if way else turns), 1, i
    return [t for t in turns if t > 0]


def _fixture_angles(q: Float[np.ndarray, "M m"], hold: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M m"]:
    """Angles in a fixture that may yield: means of holds, shrunk towards their common mean (James and Stein).

    The share of their spread that the noise of a mean explains is removed. Otherwise noise of the angle would look like
    a law of it, and near a singular posture it would be amplified a thousandfold in a contact force. Without holds the
    local Wiener filter does the same (`shrink`).
    """
    runs = runs_of_holds(hold)
    if not runs:
        return shrink(q, RAMP_BLOCKS, dof=RAMP_BLOCKS)  # Means of blocks are independent but for their common mean.
    if len(runs) < MIN_HOLDS:
        return _clipped_between_holds(q, hold)
    means = np.stack([q[run].mean(axis=0) for run in runs])
    splits = [np.array_split(q[run], HOLD_PARTS) for run in runs if len(run) >= HOLD_PARTS]
    parts = [np.stack([x.mean(axis=0) for x in split]) for split in splits]
    noise = np.mean([x.var(axis=0, ddof=1) / HOLD_PARTS for x in parts], axis=0) if parts else np.zeros(q.shape[1])
    spread = means.var(axis=0, ddof=1)
    share = 1.0 - np.minimum(noise / np.where(spread > 0.0, spread, 1.0), 1.0)
    return means.mean(axis=0) + share * (_clipped_between_holds(q, hold) - means.mean(axis=0))


def _clipped_between_holds(values: Float[np.ndarray, "M k"], hold: Int[np.ndarray, " M"], slack: bool = False):
    """Replace holds by their means and clip samples between two holds to the range of both means.

    Before the first and after the last hold the range is that hold's mean; with `slack` it extends to zero. An
    overshoot beyond the range is kept, less `MIN_OVERSHOOT` standard deviations of noise. Samples of ramps are not
    changed.
    """
    runs = runs_of_holds(hold)
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
    out = kept + np.sign(beyond) * np.maximum(np.abs(beyond) - MIN_OVERSHOOT * noise, 0.0)
    for mean, run in zip(means[1:], runs, strict=False):
        out[run] = mean
    out[hold == RAMP_SAMPLE] = values[hold == RAMP_SAMPLE]
    return out


def _load(r: PreparedTrial) -> tuple[Float[np.ndarray, "M k"], Float[np.ndarray, " k"]]:
    """Measured torques of the joints, N m, or force at the fingertip, N, zero where there is none.

    Returns:
        The load block by block, and the error of each column's converter (`quantisation`).
    """
    load = next(getattr(r.trial, c) for c in r.y if c != "tendon_excursion")
    load = np.zeros((len(r.trial.time), 1)) if load is None else np.nan_to_num(load)
    return r.mean(load), np.array([quantisation(column)[0] for column in load.T])


def _continues(
    tension: Float[np.ndarray, "M n"],
    hold: Int[np.ndarray, " M"],
    travel: float,
    load: Float[np.ndarray, "M k"],
    error: Float[np.ndarray, " k"],
) -> Bool[np.ndarray, " M"]:
    """Whether a sample lies between holds in a step that every tendon takes in the direction of its last one.

    A tendon that turns back or leaves slack sticks first and then slips within one block, whose mean tension does not
    tell when. Once released it may stick for several steps. Within a step it sticks all through if the `load` after it
    is that before it, but for a sample's noise, and slips all through if it slipped in the one before, as the change of
    the load tells.

    The noise of the tension enters a step, and not the mean of a hold. Where its load exceeds the noise of the load,
    which includes the `error` of a converter, the step does not count: one noise stands for all samples of a channel.
    """
    out = np.zeros(len(hold), bool)
    runs = runs_of_holds(hold)
    if len(runs) < MIN_HOLDS:
        return out
    steps, changes = (np.diff([x[run].mean(axis=0) for run in runs], axis=0) for x in (tension, load))
    ways = np.where(np.abs(steps) > travel, np.sign(steps), 0.0)
    released = np.logical_or.accumulate((ways < 0.0).any(axis=1))
    per_newton = np.linalg.norm(changes, axis=1) / np.maximum(np.linalg.norm(steps, axis=1), travel)
    slipped = per_newton > MIN_SLIP_SHARE * per_newton.max()
    of_tension, of_load = (np.sqrt(np.mean([x[run].var(axis=0) for run in runs], axis=0)) for x in (tension, load))
    noise = per_newton * np.linalg.norm(of_tension * np.abs(ways), axis=1)
    load_noise = np.linalg.norm(np.hypot(of_load, error))
    quiet, sticks = noise <= load_noise, np.linalg.norm(changes, axis=1) <= load_noise
    for k in range(1, len(ways)):
        goes_on = np.all((ways[k] == ways[k - 1]) | (ways[k] == 0))
        if goes_on and quiet[k] and (sticks[k] or slipped[k - 1] or not released[k]):
            out[runs[k][-1] + 1 : runs[k + 1][0]] = True
    return out
