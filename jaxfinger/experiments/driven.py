"""Reduction of trials in which a motor or tendons drive the joints (ID.3-dynamic, VD.3).

A torque sample is valid where the joint and its tendons slide, since only then the direction of friction is known.
Beside the reversals of a joint that slides before and after, it is known but for their time (`Reversals`). For
a fit both sides of (1) pass the same low-pass; for a prediction of every sample they do not.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import binary_opening, minimum_filter1d
from scipy.special import ndtri

from jaxfinger.data import (
    directions,
    directions_from_turning_points,
    filter_std,
    filtered_noise_std,
    low_pass,
    smooth_rate,
    without_spikes,
)
from jaxfinger.data.signals.motion import from_the_start, quick_cutoff, rest_speed, speed_noise, stretches_of
from jaxfinger.data.signals.noise import STD_PER_MAD
from jaxfinger.data.signals.quantiles import medians, quantiles
from jaxfinger.experiments.reduction import Joints, PreparedTrial, Reversals, Row, joints, row
from jaxfinger.experiments.shrink import shrink
from jaxfinger.experiments.table import highest_cutoff

NONE_VALID = (
    "nowhere do a joint and its tendons slide for long enough that the direction of their friction is known, with "
    "tensions that are clear of its dead zone"
)

# A joint or tendon slides for certain above these speeds; below, it may stick and its friction is unknown. The noise of
# a speed is a median (`data.signals.motion.speed_noise`), two thirds of a standard deviation.
MIN_SPEED_SHARE = 0.05  # of the motion's speed, for a joint that tendons drive and that may stick and slip
MIN_SPEED_TO_NOISE = 3.0  # two standard deviations, for a joint that a motor moves; the share above where that is less
MIN_TENDON_SPEED_TO_NOISE = 2.5  # 1.7 standard deviations, for a tendon, and half of that in the quicker filter
MIN_REST = 1.5  # times how long a reversal looks like a rest (`rests`): half as long again, since accelerations change
# A slip between two stops is shorter than the slow filter, which then loses speed against the quick one.
MAX_LOST_SPEED_SHARE = 0.5  # of a joint's speed that the slow filter may lose; stick and slip lose 1 to 3 times it
MIN_SLIP_TO_NOISE = 15.0  # ten standard deviations: a smaller loss is not a slip
ROUNDING_SHARE = 1e-6  # of the motion's speed: a loss by rounding, of a joint at rest in a simulated file
CLEAR_WIDTHS = 2.3  # widths of the filter left out on either side of unknown friction: 1 % of a jump remains beyond
# Widths left out after a joint that no motor moves seems to break away. It may do so suddenly, and at t widths after a
# step of speed the filter shows the share Φ(t) of it: MIN_SPEED_SHARE of it shows so many widths before the step.
BREAKAWAY_WIDTHS = -float(ndtri(MIN_SPEED_SHARE))
# Travel over which friction reverses, in median residuals of the encoder: 1.5 of its standard deviations. A longer
# travel suits compliant contacts, a shorter one stiff contacts (benchmarks/reversals.py).
REVERSAL_TRAVEL = 2.2
# Largest change of a low-passed direction by one standard deviation of a reversal's time. A reversal is a step of 2, of
# which a delay of d widths of the filter changes up to 2 d/√(2π): 0.5 is that of d = 0.63, linear in d to 2 %.
MAX_CHANGE_AT_REVERSAL = 0.5
ACCELERATION_WINDOW = 0.1  # s, at the protocol's pace, over which q̈ is averaged where it does not exceed its noise
# Degrees of freedom of the variance of q̈'s noise in that window W = 1/f_c: 2 W (∫S df)²/∫S² df, with the spectrum
# S = f⁴ exp(−ln 2 (f/f_c)²) that an encoder's white noise has behind the low-pass.
ACCELERATION_DOF = 4.0
# Largest noise of q̈, in units of that from white encoder noise: an encoder's grid and vibration cause up to eight
# (datasets/emps), and more than ten is motion.
MAX_ACCELERATION_NOISE = 10.0


def reduce(r: PreparedTrial) -> Row:
    """Reduce a trial: torque is valid where joints and tendons slide, excursion wherever the filter reads samples."""
    j = joints(r, sharp=not r.reduced)
    # Reversals are taken from the slow filter: noise of q̇ moves the time of a reversal.
    slow = j.qd if r.reduced else smooth_rate(r.trial.time, r.trial.q, r.experiment.cutoff_at(r.step))
    joint = joint_directions(r, j, slow)
    rates = None if r.experiment.slack else tendon_rates(r)
    tendon = tendon_directions(r, rates)
    clear = CLEAR_WIDTHS * filter_std(r.experiment.cutoff)
    slides = sliding(r, j, slow, joint, rates)
    valid = {
        "joint_torque": clear_of_unknown(r, slides, clear),
        "tendon_excursion": _apart(np.ones((len(slow), 1), bool), clear, r.step),
    }
    reversals, joint = beside_reversals(r, j, slow, joint, slides, clear)

    qdd, tension, y = less_noise(r, j) if r.reduced or r.experiment.slack else j.qdd, r.tension(), r.y
    if r.reduced:
        # All other terms pass the low-pass of q̈.
        joint, tendon = from_the_start(joint), from_the_start(tendon)
        joint, tendon, tension = (low_pass(r.trial.time, a, j.cutoff) for a in (joint, tendon, tension))
        y = {c: low_pass(r.trial.time, values, j.cutoff) for c, values in y.items()}
    counting = {c: r.mean(valid[c].astype(float)) > 1.0 - 1e-9 for c in y}  # all samples of the block
    return row(
        r,
        r.mean(j.q),
        (j.qd, qdd),
        r.taut(r.mean(tension)),
        counting,
        j.noise,
        directions=(joint, tendon),
        blur=filter_std(j.cutoff),
        y=y,
        reversals=reversals,
    )


def less_noise(r: PreparedTrial, j: Joints) -> Float[np.ndarray, "N m"]:
    """q̈, rad/s², or its running mean where it does not exceed its noise (`shrink`).

    Noise of q̈ biases a fit to less inertia (errors in variables), and adds a spurious torque to a prediction.
    """
    most = MAX_ACCELERATION_NOISE * STD_PER_MAD * j.noise * filtered_noise_std(j.cutoff, r.step, 2)
    return shrink(j.qdd, round(ACCELERATION_WINDOW * r.experiment.pace / r.step), ACCELERATION_DOF, most)


def joint_directions(r: PreparedTrial, j: Joints, slow: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
    """Directions of the joints: the protocol's, else those of the filtered motion.

    For a fit they reverse where the motion back is certain, but for `beside_reversals`, since other samples near a
    reversal are left out. For a prediction they reverse where the motion back began.
    """
    if r.trial.joint_direction is not None:
        return r.trial.joint_direction.astype(float)
    sure = directions(slow, rest_speed(slow, r.quick_rates))
    return sure if r.reduced else directions_from_turning_points(sure, j.q, REVERSAL_TRAVEL * j.noise)


def beside_reversals(
    r: PreparedTrial,
    j: Joints,
    slow: Float[np.ndarray, "N m"],
    direction: Float[np.ndarray, "N m"],
    slides: Bool[np.ndarray, "N m"],
    clear: float,
) -> tuple[Reversals | None, Float[np.ndarray, "N m"]]:
    """Reversals of the joints that a motor moves, which slide before and after, so that their time alone is uncertain.

    One standard deviation of that time is the time in which the joint travels by `REVERSAL_TRAVEL`, and a sample.
    `slides`, `clear`: as of `sliding`. Also returns the directions, which reverse there at the turning point.
    """
    if not (r.reversals and r.experiment.slack):  # Tendons may hold a joint where it turns back.
        return None, direction
    # The filter of a fit would move the turning point between two speeds towards the slower one.
    q = low_pass(r.trial.time, r.trial.q, r.experiment.cutoff_at(r.step, sharp=True))
    travel = REVERSAL_TRAVEL * medians(np.abs(r.trial.q - q))
    sure = directions(slow, rest_speed(slow, r.quick_rates))
    at_once, later = (directions_from_turning_points(sure, q, d) for d in (0.0 * travel, travel))
    earlier = -directions_from_turning_points(-from_the_start(sure)[::-1], q[::-1], travel)[::-1]  # back in time
    earlier, later = (np.concatenate(x) for x in ((earlier[1:], earlier[-1:]), (later[:1], later[:-1])))
    changes = [r.motorised * (moved - at_once) for moved in (earlier, later)]
    changes = np.stack([low_pass(r.trial.time, change, j.cutoff) for change in changes])
    unclear = np.any(np.abs(changes) > MAX_CHANGE_AT_REVERSAL, axis=0)  # as where the joint rests
    turns = np.zeros_like(slides)
    for i in np.flatnonzero(r.motorised):
        for begin, end in stretches_of(~slides[:, i]):
            within = begin > 0 and end < len(slides) and not unclear[begin:end, i].any()
            turns[begin:end, i] = within and at_once[begin - 1, i] * at_once[end, i] < 0.0
    either, known = (r.mean(_apart(a, clear, r.step).astype(float)) > 1.0 - 1e-9 for a in (slides | turns, slides))
    beside = either & ~known & r.blocks_are_sound("joint_torque")
    found = Reversals(beside.T, np.stack([r.mean(change).T for change in changes]))
    return found, np.where(turns, at_once, direction)


def tendon_rates(r: PreparedTrial) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n"]] | None:
    """Tendon speeds, m/s, in a slow filter and in a quicker one; None where excursions were not measured."""
    if r.trial.tendon_excursion is None:
        return None
    excursion = without_spikes(np.nan_to_num(r.trial.tendon_excursion))
    cutoff = min(r.experiment.cutoff / 2.0, highest_cutoff(r.step))
    slow, quick = (smooth_rate(r.trial.time, excursion, c) for c in (cutoff, quick_cutoff(cutoff, r.step)))
    return slow, quick


def tendon_directions(r: PreparedTrial, rates) -> Float[np.ndarray, "N n"]:
    """Directions of the tendons: the protocol's, else those of the measured excursions; 0 for slack tendons."""
    if r.experiment.slack:
        return np.zeros((len(r.trial.time), r.finger.n))
    if r.trial.tendon_direction is not None:
        return r.trial.tendon_direction.astype(float)
    if rates is None:
        return np.zeros((len(r.trial.time), r.finger.n))
    slow, quick = rates
    # The direction is needed, too, where sliding is not certain: it holds on down to a tenth of that speed.
    noise, speed = speed_noise(slow, quick), quantiles(np.abs(slow), 0.95)
    return directions(slow, np.minimum(0.1 * MIN_TENDON_SPEED_TO_NOISE * noise, 0.1 * speed))


def sliding(
    r: PreparedTrial,
    j: Joints,
    slow: Float[np.ndarray, "N m"],
    direction: Float[np.ndarray, "N m"],
    rates: tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n"]] | None,
) -> Bool[np.ndarray, "N m"]:
    """Whether a joint and every taut tendon across it slide, so that the directions of friction are known.

    `j`, `slow`: motion in the fit's filter, and joint speeds, rad/s, in a slower one. `rates`: speeds of the tendons,
    None where all are slack or unmeasured.
    """
    qd = j.qd
    lost, fast = np.abs(r.quick_rates - slow), quantiles(np.abs(qd), 0.95)
    noise = medians(lost)
    least = MIN_SPEED_SHARE * fast
    least = np.where(r.motorised, np.minimum(MIN_SPEED_TO_NOISE * noise, least), least)
    slides = (np.abs(qd) > least) & (np.sign(qd) == np.sign(direction))
    slides[1:] &= np.sign(qd[1:]) == np.sign(qd[:-1])  # a quick reversal may have no slow sample
    slides &= ~(r.motorised & rests(j, ~slides, r.step))
    if rates is not None and r.trial.tendon_force is not None:
        known = _friction_known(r, *rates)
        for i in range(r.finger.m):
            slides[:, i] &= known[:, r.finger.crosses[:, i] & r.finger.active].all(axis=1)
    if not r.experiment.stepped:
        # A slip of one joint between two stops disturbs every joint.
        pace = quantiles(np.abs(slow), 0.95)
        most = np.maximum(MAX_LOST_SPEED_SHARE * pace, MIN_SLIP_TO_NOISE * noise)
        slides &= np.all(lost <= most + ROUNDING_SHARE * pace.max(initial=0.0), axis=1)[:, None]
    return slides


def clear_of_unknown(r: PreparedTrial, slides: Bool[np.ndarray, "N m"], clear: float) -> Bool[np.ndarray, "N m"]:
    """Samples that slide, as do all that the filter reads. `clear`: s, left out on either side of those that do not."""
    # The filter spreads the jump of friction at a reversal, and reads samples of unknown friction before a slide.
    apart = _apart(slides, clear, r.step)
    # The window reaches back only: a start may be sudden, which the filter shows too early, and a stop is gradual.
    half = round(0.5 * BREAKAWAY_WIDTHS * filter_std(r.experiment.cutoff) / r.step)
    return np.where(r.motorised, apart, minimum_filter1d(apart, 2 * half + 1, axis=0, origin=half))


def _apart(valid: Bool[np.ndarray, "N k"], clear: float, step: float) -> Bool[np.ndarray, "N k"]:
    """Samples with valid ones alone within `clear`, s, on either side.

    Beyond the ends of a recording none is valid: the filter reads extrapolated samples there, and their noise.
    """
    return minimum_filter1d(valid, 2 * round(clear / step) + 1, axis=0, mode="constant", cval=False)


def rests(j: Joints, slow: Bool[np.ndarray, "N m"], step: float) -> Bool[np.ndarray, "N m"]:
    """Whether a joint rests, up to the instant at which it starts and from that at which it stops.

    The filter shows a motion before it starts. With σ its width, z = t/σ, and φ and Φ the standard normal density and
    distribution, a start at t = 0 with the acceleration a becomes q̇ = a σ (φ(z) + z Φ(z)) and q̈ = a Φ(z). Their ratio
    rises, and is σ √(2/π) at the start itself. At a reversal it is below that for 2 √(2/π) σ; only what lasts longer is
    a rest. `slow`: samples whose speed is within its noise.
    """
    start = np.sqrt(2.0 / np.pi) * filter_std(j.cutoff)
    length = round(MIN_REST * 2.0 * start / step) + 1
    return binary_opening(slow | (np.abs(j.qd) <= start * np.abs(j.qdd)), np.ones((length, 1)))


def _friction_known(r: PreparedTrial, slow, quick) -> Bool[np.ndarray, "N n"]:
    """Whether a tendon is slack, or slides for certain: faster than it stretches, and in both filters."""
    tension, cutoff = r.tension(), min(r.experiment.cutoff / 2.0, highest_cutoff(r.step))
    stretches = r.sizes.compliance * np.abs(smooth_rate(r.trial.time, tension, cutoff))
    measured = np.isfinite(np.asarray(r.trial.tendon_excursion)).all(axis=0)
    least = MIN_TENDON_SPEED_TO_NOISE * speed_noise(slow, quick)
    moves = (np.abs(slow) > least + stretches) & (np.sign(slow) * quick > 0.5 * least)
    return (tension <= r.sizes.slack) | (moves & measured)
