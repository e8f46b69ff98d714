"""From recordings to arrays that a fit can take: derivatives, directions, block means, padded stacks of trials."""

import math
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from jaxfinger.data import (
    TENSION_TRAVEL,
    Predictions,
    Session,
    Trial,
    bridged,
    find_holds,
    longest_spike,
    low_pass,
    outlier_mask,
    shrink,
    smooth,
    width,
    without_spikes,
)
from jaxfinger.data.schema import NEEDS_JOINT
from jaxfinger.errors import UserError
from jaxfinger.experiments.table import (
    ABOVE_NOISE,
    AT_REST,
    BREAKAWAY,
    CLEAR,
    CLEAR_STEP,
    COMPLIANCE,
    EXPERIMENTS,
    LOST,
    MIN_DRIVEN_SPEED,
    MIN_JOINT_SPEED,
    MIN_TENDON_SPEED,
    QUICK,
    ROUNDING,
    SLACK,
    STILL,
    Experiment,
)
from jaxfinger.model import Motion

PARTS = 6  # of a hold, whose means say how well its own is known; longer than an encoder's noise is correlated
LONG = 10_000  # samples of a trial from which on its filters, which let go of the interpreter, are worth a thread


class Batch(eqx.Module):
    """All trials of one experiment, reduced, padded to one length: B trials of T samples."""

    x: Motion  # (…, B, T)
    y: dict[str, Float[Array, "columns B T"]]  # measured channels, zero where they do not count
    mask: dict[str, Float[Array, "columns B T"]]  # 1 where a sample counts


@dataclass(frozen=True)
class Stack:
    """A batch with the names of its trials, on the host."""

    experiment: Experiment
    batch: Batch
    trials: tuple[str, ...]
    motions: tuple[str | None, ...]  # trials with the same motion repeat one another
    holds: Int[np.ndarray, "B T"]  # index of the static hold, −1 between holds
    dt: float  # s

    def samples_of_holds(self, trial: int, counts: np.ndarray) -> list[np.ndarray]:
        """Which samples of each static hold of a trial count, hold by hold; `counts`: (T,), not zero where one does."""
        return _runs(np.where(counts, self.holds[trial], -1))


def prepare(
    session: Session,
    names: list[str] | None = None,
    reduced: bool = True,
    minus: Predictions | None = None,
    coarse: int = 1,
) -> dict[str, Stack]:
    """One stack an experiment, of the named trials (default all), averaged to the experiment's rate unless told.

    `coarse`: averaged over so many times as long.
    With `minus` the channels are measurement minus prediction, and what is not predicted does not count.
    """
    stacks = {}
    for spec in EXPERIMENTS.values():
        chosen = [t for t in session if t.experiment == spec.name and (names is None or t.name in names)]
        trials = [t for t in chosen if len(t.time) > 1]
        long = any(len(t.time) > LONG for t in trials)
        with ThreadPoolExecutor(None if long else 1) as pool:
            rows = list(pool.map(lambda t, spec=spec: _reduce(spec, t, session, reduced, minus, coarse), trials))
        if rows:
            stacks[spec.name] = _stack(spec, trials, rows, reduced)
    return stacks


@dataclass(frozen=True)
class _Row:
    """One trial, reduced: NumPy arrays with time last."""

    motion: dict[str, np.ndarray]
    y: dict[str, np.ndarray]
    mask: dict[str, np.ndarray]
    hold: np.ndarray
    dt: float


def _reduce(
    spec: Experiment, trial: Trial, session: Session, reduced: bool, minus: Predictions | None, coarse: int
) -> _Row:
    m, n = session.finger.m, session.finger.n
    N = len(trial.time)
    trial = _despiked(trial)
    step = float(np.median(np.diff(trial.time)))
    block = max(1, round(coarse / (spec.rate * step))) if reduced else 1
    holds = find_holds(trial) if spec.samples == "holds" else np.full(N, -1)

    # Where the measured channel is not low-passed, q̇ and q̈ must not lose what is in it.
    cutoff = spec.cutoff_at(step, sharp=spec.stepped or not reduced)
    filtered, qd, qdd = smooth(trial.time, trial.q, cutoff)
    noise = np.median(np.abs(trial.q - filtered), axis=0)
    # When a joint turns back shows best in the slower filter: there noise of q̇ is noise in time.
    slow = spec.held or (reduced and not spec.stepped)
    turning = qd if slow else smooth(trial.time, trial.q, spec.cutoff_at(step))[1]
    # Otherwise averaged over the same blocks as what it predicts, and not filtered where that is not.
    q = trial.q if spec.samples == "holds" or (spec.samples == "all" and reduced) else filtered
    if spec.samples == "holds":
        # At holds and in fixtures nothing moves.
        moves = (holds < 0)[:, None] & spec.stepped
        qd, qdd = qd * moves, qdd * moves
    joint_direction = (
        np.zeros((N, m)) if spec.held else _direction(trial.joint_direction, turning, STILL, on_time=not reduced)
    )
    tension = np.zeros((N, n)) if trial.tendon_force is None else np.nan_to_num(trial.tendon_force)
    if spec.held and not reduced:
        # As smooth as the blocks of a fit: what slips at a noise peak would stay there until the next step.
        tension = uniform_filter1d(tension, max(1, round(1.0 / (spec.rate * step))), axis=0, mode="nearest")
    tendon_direction, rates = np.zeros((N, n)), None
    if not spec.slack and spec.samples == "sliding":
        rates = _rates(trial, spec, step)
        slow_rate = np.zeros((N, n)) if rates is None else rates[0]
        tendon_direction = _direction(trial.tendon_direction, slow_rate, 0.1 * MIN_TENDON_SPEED)
    motorised = np.zeros((N, m))
    if "joint_torque" in spec.channels and spec.name in NEEDS_JOINT:
        motorised[:, [session.finger.joint_names.index(name) for name in trial.motorised(session.finger)]] = 1.0

    y, mask = _measured(spec, trial, session, minus)
    slides = np.zeros((N, m))
    if spec.samples == "sliding" or spec.stepped:
        slides = _sliding(spec, trial, session, step, qd, turning, joint_direction, rates, motorised)
    if spec.samples == "sliding" and (reduced or spec.slack):
        # Noise of q̈ would tell a fit of less inertia (errors in variables), and a prediction that stands beside a
        # measured torque of one that is not there: where q̈ does not rise above it, its mean over a tenth of a second
        # takes its place.
        qdd = shrink(qdd, round(0.1 / step))
    if reduced and spec.samples == "sliding":
        # q̈ is low-passed, so all else is too.
        joint_direction, tendon_direction, tension = (
            low_pass(trial.time, a, cutoff) for a in (joint_direction, tendon_direction, tension)
        )
        y = {c: low_pass(trial.time, values, cutoff) for c, values in y.items()}
    M = N // block
    ones = np.ones(block)

    def mean(a):
        # A product is ten times as fast as `mean` along an axis in the middle.
        return ones @ a[: M * block].reshape(M, block, math.prod(a.shape[1:])) / block

    tension_mean = mean(tension)
    slack = np.percentile(tension_mean, 95, axis=0) < SLACK
    tension_mean[:, slack | spec.slack] = 0.0
    hold = _whole(holds, M, block)
    q_mean = mean(q)
    if spec.held:
        tension_mean = _in_steps(tension_mean, hold, slack=True)
        q_mean = _in_fixture(q_mean, hold)
    elif spec.stepped:
        q_mean = _at_rest(q_mean, hold)
    start = trial.session_start if trial.session_start is not None else 0.0
    time = mean(trial.time)[:, 0]
    motion = {
        "time": time,
        "q": q_mean.T,
        "qd": mean(qd).T,
        "qdd": mean(qdd).T,
        "tension": tension_mean.T,
        "joint_direction": mean(joint_direction).T,
        "tendon_direction": mean(tendon_direction).T,
        "session_time": time + start,
        "motorised": mean(motorised).T,
    }
    motion["jitter"] = np.repeat(AT_REST * (1.0 if reduced else 2.0) * noise[:, None], M, axis=1)
    if reduced:
        motion["blur"] = np.full(M, width(cutoff) if spec.samples == "sliding" else 0.0)
    # Joints that are held have no inertia: ramps of the tension count as well as holds.
    between = _goes_on(tension_mean, hold)[:, None] if spec.held else mean(slides) > 1.0 - 1e-9
    taut = tension[: M * block].reshape(M, block, n).min(axis=1) > SLACK
    y_mean, mask_mean = {}, {}
    for c in y:
        counts = (mean(mask[c]) > 0.5) & _counting(spec, c, hold, between, taut)
        mask_mean[c] = counts.astype(float).T
        y_mean[c] = mean(y[c]).T * mask_mean[c]  # of all samples, as everything else that the model reads
    return _Row(motion, y_mean, mask_mean, hold, block * step)


def _counting(spec: Experiment, channel: str, hold: np.ndarray, between: np.ndarray, taut: np.ndarray) -> np.ndarray:
    """(M, columns or 1): which blocks of a channel count, where it is measured. `between`: where friction is known,
    which does not decide how far a taut tendon is pulled in.
    """
    if spec.samples == "holds":
        return (hold >= 0)[:, None] | between | (taut if channel == "tendon_excursion" else False)
    return between if spec.samples == "sliding" and channel == "joint_torque" else np.ones((len(hold), 1), bool)


def _despiked(trial: Trial) -> Trial:
    """The channels that drive the model; a predicted one keeps its spikes, which then do not count."""
    tension = None if trial.tendon_force is None else without_spikes(trial.tendon_force)
    return replace(trial, q=without_spikes(trial.q), tendon_force=tension)


def _measured(spec, trial, session, minus: Predictions | None):
    """The channels to be predicted, spikes bridged, and which samples of them are measured and no spike."""
    N, m = trial.q.shape
    width = {"tendon_excursion": session.finger.n, "joint_torque": m, "fingertip_force": 3}
    y, mask = {}, {}
    for c in spec.channels:
        values = getattr(trial, c)
        if values is None and c == "joint_torque" and spec.samples == "sliding":
            values = np.zeros((N, m))  # nothing acts from outside on the free finger
        if values is None:
            values = np.full((N, width[c]), np.nan)
        if minus is not None:
            values = values - _predicted(minus.get(trial.name, {}), c, trial, values)
        measured = np.isfinite(values).all(axis=0)
        counts = np.zeros(values.shape)
        if measured.any():
            spikes = outlier_mask(values[:, measured], longest=longest_spike(float(np.median(np.diff(trial.time)))))
            counts[:, measured] = ~spikes
            values = values.copy()
            values[:, measured] = bridged(values[:, measured], spikes)
        y[c], mask[c] = np.nan_to_num(values), counts
    return y, mask


def _predicted(prediction: Mapping[str, np.ndarray], channel: str, trial: Trial, like: np.ndarray) -> np.ndarray:
    """A predicted channel at the trial's times, NaN where there is none."""
    if channel not in prediction:
        return np.full(like.shape, np.nan)
    columns = prediction[channel].T
    return np.stack([np.interp(trial.time, prediction.get("time", trial.time), a) for a in columns], axis=1)


def _direction(commanded: np.ndarray | None, rate: np.ndarray, still: float, on_time: bool = False) -> np.ndarray:
    """The protocol's directions, else the sign of the filtered rate: 0 before the first motion, the last in a stop.

    It turns where a motion back is sure; `on_time` where that motion began.
    """
    if commanded is not None:
        return commanded.astype(float)
    moves = np.abs(rate) > np.minimum(still, 0.1 * np.percentile(np.abs(rate), 95, axis=0))
    known = np.maximum.accumulate(np.where(moves, np.arange(len(rate))[:, None], -1), axis=0)
    sure = np.where(known < 0, 0.0, np.sign(np.take_along_axis(rate, np.maximum(known, 0), axis=0)))
    for direction, sign in zip(sure.T, np.sign(rate).T, strict=True) if on_time else ():
        turns = np.flatnonzero((np.diff(direction) != 0) & (direction[:-1] != 0)) + 1
        for last, turn in pairwise([0, *turns]):
            began = last + np.flatnonzero(sign[last:turn] == direction[turn - 1])[-1] + 1
            direction[began:turn] = direction[turn]
    return sure


def _rates(trial: Trial, spec: Experiment, step: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Tendon speeds, m/s, in a slow filter and in a quicker one; none where excursions were not measured."""
    if trial.tendon_excursion is None:
        return None
    excursion = without_spikes(np.nan_to_num(trial.tendon_excursion))
    slow, quick = (smooth(trial.time, excursion, c)[1] for c in (spec.cutoff / 2, _quicker(spec.cutoff / 2, step)))
    return slow, quick


def _sliding(
    spec: Experiment, trial: Trial, session: Session, step: float, qd, turning, direction, rates, motorised
) -> np.ndarray:
    """(N, m): 1 where a joint and every taut tendon across it slide, so that the directions of friction are known.

    `turning`: speeds in the slower filter; `rates`: of the tendons, none where all are slack or not measured.
    """
    fast = np.percentile(np.abs(qd), 95, axis=0)
    least = np.where(motorised, MIN_DRIVEN_SPEED, MIN_JOINT_SPEED)
    slides = (np.abs(qd) > np.minimum(least, 0.05 * fast)) & (np.sign(qd) == np.sign(direction))
    slides[1:] &= np.sign(qd[1:]) == np.sign(qd[:-1])  # a quick reversal has no slow sample
    if rates is not None and trial.tendon_force is not None:
        known = _friction_known(spec, trial, *rates)
        for i in range(session.finger.m):
            slides[:, i] &= known[:, session.finger.crosses[:, i] & session.finger.active].all(axis=1)
    if not spec.stepped:
        # A slip between two stops is too fast for the filter, and moves every joint.
        lost = np.abs(smooth(trial.time, trial.q, _quicker(spec.cutoff_at(step), step))[1] - turning)
        most = np.maximum(LOST * np.percentile(np.abs(turning), 95, axis=0), ABOVE_NOISE * np.median(lost, axis=0))
        slides &= np.all(lost <= most + ROUNDING, axis=1)[:, None]
    # The filter spreads the jump of friction at a reversal, and friction before it slides is not known.
    clear = minimum_filter1d(
        slides.astype(float), 2 * round((CLEAR_STEP if spec.stepped else CLEAR) / step) + 1, axis=0
    )
    # Reaches back only: a free joint that breaks away does so at once, and takes the others with it.
    half = round(0.5 * BREAKAWAY / step)
    return np.where(motorised, clear, minimum_filter1d(clear, 2 * half + 1, axis=0, origin=half))


def _friction_known(spec: Experiment, trial: Trial, slow: np.ndarray, quick: np.ndarray) -> np.ndarray:
    """(N, n): where a tendon is slack, or slides for certain: faster than it stretches, and in a quicker filter too."""
    tension = np.nan_to_num(np.asarray(trial.tendon_force))
    stretches = COMPLIANCE * np.abs(smooth(trial.time, tension, spec.cutoff / 2)[1])
    measured = np.isfinite(np.asarray(trial.tendon_excursion)).all(axis=0)
    moves = (np.abs(slow) > MIN_TENDON_SPEED + stretches) & (np.sign(slow) * quick > 0.5 * MIN_TENDON_SPEED)
    return (tension <= SLACK) | (moves & measured)


def _quicker(cutoff: float, step: float) -> float:
    """Hz, of a filter that still sees a joint or tendon stand still between two slips."""
    return min(QUICK * cutoff, 0.4 / step)


def _in_fixture(q: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """(N, m): the mean of all holds, and of what they differ by, the share that is not the noise of their means (James
    and Stein's estimator).

    A fixture may yield. Noise of the angle would look like a law of it, and near a singular posture a contact force
    amplifies it a thousandfold.
    """
    runs = _runs(hold)
    if len(runs) < 3:
        return _in_steps(q, hold)
    means = np.stack([q[run].mean(axis=0) for run in runs])
    parts = [np.stack([x.mean(axis=0) for x in np.array_split(q[run], PARTS)]) for run in runs if len(run) >= PARTS]
    noise = np.mean([x.var(axis=0, ddof=1) / PARTS for x in parts], axis=0) if parts else np.zeros(q.shape[1])
    spread = means.var(axis=0, ddof=1)
    share = 1.0 - np.minimum(noise / np.where(spread > 0.0, spread, 1.0), 1.0)
    return means.mean(axis=0) + share * (_in_steps(q, hold) - means.mean(axis=0))


def _in_steps(values: np.ndarray, hold: np.ndarray, slack: bool = False) -> np.ndarray:
    """(N, k): at a hold its mean, and between holds nothing beyond the two means; before and after all as in the first
    and last, or down to nothing where it is `slack` there.

    A held tendon keeps the highest tension that it has seen, so a running maximum over noise would drift upwards. What
    lies beyond the two means by more than four standard deviations is a real overshoot, and stays but for those four.
    """
    runs = _runs(hold)
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
    out = kept + np.sign(beyond) * np.maximum(np.abs(beyond) - 4.0 * noise, 0.0)
    for mean, run in zip(means[1:], runs, strict=False):
        out[run] = mean
    return out


def _goes_on(tension: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """(N,): between which holds every tendon goes on as it went before.

    Where it turns back, or leaves slack, it sticks and then slips within one block, whose mean tension does not tell
    when.
    """
    out = np.zeros(len(hold), bool)
    runs = _runs(hold)
    steps = np.diff([tension[run].mean(axis=0) for run in runs], axis=0)
    ways = np.where(np.abs(steps) > TENSION_TRAVEL, np.sign(steps), 0.0)
    for k in range(1, len(ways)):
        if np.all((ways[k] == ways[k - 1]) | (ways[k] == 0)):
            out[runs[k][-1] + 1 : runs[k + 1][0]] = True
    return out


def _at_rest(q: np.ndarray, hold: np.ndarray) -> np.ndarray:
    """(N, m): at a hold its mean: what moves there is the encoder's noise, which neither f(q) nor friction follows."""
    out = q.copy()
    for run in _runs(hold):
        out[run] = q[run].mean(axis=0)
    return out


def _runs(hold: np.ndarray) -> list[np.ndarray]:
    """The samples of each hold, hold by hold in the order of time."""
    return [np.flatnonzero(hold == k) for k in dict.fromkeys(hold[hold >= 0].tolist())]


def _whole(holds: np.ndarray, M: int, block: int) -> np.ndarray:
    """Hold of each block, −1 where it is not wholly within one."""
    blocks = holds[: M * block].reshape(M, block)
    return np.where((blocks == blocks[:, :1]).all(axis=1), blocks[:, 0], -1)


def _stack(spec: Experiment, trials: list[Trial], rows: list[_Row], reduced: bool) -> Stack:
    steps = {round(r.dt, 6) for r in rows}
    if reduced and max(steps) > 1.5 * min(steps):
        raise UserError(
            f"the {spec.name} trials are sampled at different rates ({min(steps):g} s and {max(steps):g} s a sample "
            f"after reduction): resample trial {trials[int(np.argmax([r.dt for r in rows]))].name} to at least "
            f"{spec.rate:g} Hz"
        )
    T = max(r.motion["time"].size for r in rows)
    T = -(-T // 64) * 64  # few distinct lengths, few compilations

    def pad(arrays, constant=False):
        out = np.zeros((*arrays[0].shape[:-1], len(arrays), T))
        for b, a in enumerate(arrays):
            out[..., b, : a.shape[-1]] = a
            if not constant:
                out[..., b, a.shape[-1] :] = a[..., -1:]
        return jax.device_put(out)

    x = Motion(**{k: pad([r.motion[k] for r in rows]) for k in rows[0].motion}, held=spec.held)
    y = {c: pad([r.y[c] for r in rows], constant=True) for c in spec.channels}
    mask = {c: pad([r.mask[c] for r in rows], constant=True) for c in spec.channels}
    return Stack(
        spec,
        Batch(x, y, mask),
        tuple(t.name for t in trials),
        tuple(t.motion for t in trials),
        np.stack([np.pad(r.hold, (0, T - r.hold.size), constant_values=-1) for r in rows]),
        float(np.median([r.dt for r in rows])),
    )
