"""Joints that a motor or tendons drive (ID.3-dynamic, VD.3): torque counts where they slide, so that friction is known.

Both sides of (1) go through one low-pass before a fit; a prediction of every sample does without.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import minimum_filter1d

from jaxfinger.data import (
    directions,
    directions_from_turning_points,
    filter_std,
    filtered_noise_std,
    low_pass,
    smooth,
    without_spikes,
)
from jaxfinger.data.motion import quick_cutoff, rest_speed, speed_noise
from jaxfinger.experiments.reduction import Joints, PreparedTrial, Row, joints, row
from jaxfinger.experiments.shrink import shrink

NOTHING = "nowhere do a joint and its tendons slide for long enough that the direction of their friction is known"

# Speeds are compared with their own noise (`data.motion`).
FREE = 0.05  # of the motion's speed: a slower joint that tendons drive may stick and slip, its friction unknown
DRIVEN = 3.0  # times the noise, or FREE if that is less: likewise a joint that a motor moves, which does not stick
TENDON = 2.5  # times the noise: likewise a tendon
LOST = 0.5  # of a joint's speed: what the slower filter may lose of it; stick and slip lose 1 to 3 times it
ABOVE_NOISE = 15.0  # times the noise: what it loses must be more to be a slip
ROUNDING = 1e-6  # of the motion's speed: what it loses of a joint that stands still in a simulated file
CLEAR = 2.3  # widths of the filter kept clear on either side of where friction is not known: 1 % of a jump is left
BREAKAWAY = 4.5  # widths kept clear after a joint that no motor moves has broken away: it does so at once
# Times the median loss: 1.5 standard deviations of the encoder, the way over which friction turns. Longer ways serve
# contacts that give, shorter ones those that do not (benchmarks/reversals.py).
ENCODER = 2.2
CALM = 0.1  # s, at the protocol's pace: over which q̈ is averaged where it does not rise above its noise
# Times what white noise of the encoder's size would leave in q̈: a grid's lines and vibration leave up to eight times as
# much (datasets/emps), and what is more than that is motion.
COLOURED = 10.0


def reduce(r: PreparedTrial) -> Row:
    """What slides counts for torque, everything for excursion."""
    j = joints(r, sharp=not r.reduced)
    # When a joint turns back shows best in the slower filter: there noise of q̇ is noise in time.
    slow = j.qd if r.reduced else smooth(r.trial.time, r.trial.q, r.spec.cutoff_at(r.step))[1]
    joint = joint_directions(r, j, slow)
    rates = None if r.spec.slack else tendon_rates(r)
    tendon = tendon_directions(r, rates)
    slides = sliding(r, j.qd, slow, joint, rates, CLEAR * filter_std(r.spec.cutoff))

    qdd, tension, y = j.qdd, r.tension(), r.y
    if r.reduced or r.spec.slack:
        # Noise of q̈ would tell a fit of less inertia (errors in variables), and a prediction that stands beside a
        # measured torque of one that is not there: where q̈ does not rise above it, its mean takes its place.
        most = COLOURED * 1.4826 * j.noise * filtered_noise_std(j.cutoff, r.step, 2)
        qdd = shrink(qdd, round(CALM * r.spec.pace / r.step), most)
    if r.reduced:
        # q̈ is low-passed, so all else is too.
        joint, tendon, tension = (low_pass(r.trial.time, a, j.cutoff) for a in (joint, tendon, tension))
        y = {c: low_pass(r.trial.time, values, j.cutoff) for c, values in y.items()}
    known = r.mean(slides.astype(float)) > 1.0 - 1e-9
    counting = {c: known if c == "joint_torque" else np.ones((len(known), 1), bool) for c in y}
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
    )


def joint_directions(r: PreparedTrial, j: Joints, slow: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
    """The protocol's directions, else those of the filtered motion: for a fit they turn where a motion back is sure
    (samples beside do not count), for a prediction where it began.
    """
    if r.trial.joint_direction is not None:
        return r.trial.joint_direction.astype(float)
    sure = directions(slow, rest_speed(slow, r.quick_rates))
    return sure if r.reduced else directions_from_turning_points(sure, j.q, ENCODER * j.noise)


def tendon_rates(r: PreparedTrial) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n"]] | None:
    """Tendon speeds, m/s, in a slow filter and in a quicker one; none where excursions were not measured."""
    if r.trial.tendon_excursion is None:
        return None
    excursion = without_spikes(np.nan_to_num(r.trial.tendon_excursion))
    cutoff = min(r.spec.cutoff / 2.0, 0.2 / r.step)
    slow, quick = (smooth(r.trial.time, excursion, c)[1] for c in (cutoff, quick_cutoff(cutoff, r.step)))
    return slow, quick


def tendon_directions(r: PreparedTrial, rates) -> Float[np.ndarray, "N n"]:
    """The protocol's, else those of the measured excursions; 0 of tendons that are slack."""
    if r.spec.slack:
        return np.zeros((len(r.trial.time), r.finger.n))
    if r.trial.tendon_direction is not None:
        return r.trial.tendon_direction.astype(float)
    if rates is None:
        return np.zeros((len(r.trial.time), r.finger.n))
    slow, quick = rates
    least = np.minimum(0.1 * TENDON * speed_noise(slow, quick), 0.1 * np.percentile(np.abs(slow), 95, axis=0))
    return directions(slow, least)


def sliding(
    r: PreparedTrial,
    qd: Float[np.ndarray, "N m"],
    slow: Float[np.ndarray, "N m"],
    direction: Float[np.ndarray, "N m"],
    rates: tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n"]] | None,
    clear: float,
) -> Bool[np.ndarray, "N m"]:
    """Where a joint and every taut tendon across it slide, so that the directions of friction are known.

    `slow`: speeds in the slower filter; `rates`: of the tendons, none where all are slack or not measured; `clear`: s,
    kept clear on either side of where they are not.
    """
    lost, fast = np.abs(r.quick_rates - slow), np.percentile(np.abs(qd), 95, axis=0)
    noise = np.median(lost, axis=0)
    least = np.where(r.motorised, np.minimum(DRIVEN * noise, FREE * fast), FREE * fast)
    slides = (np.abs(qd) > least) & (np.sign(qd) == np.sign(direction))
    slides[1:] &= np.sign(qd[1:]) == np.sign(qd[:-1])  # a quick reversal has no slow sample
    if rates is not None and r.trial.tendon_force is not None:
        known = _friction_known(r, *rates)
        for i in range(r.finger.m):
            slides[:, i] &= known[:, r.finger.crosses[:, i] & r.finger.active].all(axis=1)
    if not r.spec.stepped:
        # A slip between two stops is too fast for the filter, and moves every joint.
        pace = np.percentile(np.abs(slow), 95, axis=0)
        most = np.maximum(LOST * pace, ABOVE_NOISE * noise) + ROUNDING * pace.max(initial=0.0)
        slides &= np.all(lost <= most, axis=1)[:, None]
    # The filter spreads the jump of friction at a reversal, and friction before it slides is not known; nor is what
    # lies before a recording and after it, on whose image the filter leans.
    apart = minimum_filter1d(slides, 2 * round(clear / r.step) + 1, axis=0, mode="constant", cval=False)
    # Reaches back only: a free joint that breaks away does so at once, and takes the others with it.
    half = round(0.5 * BREAKAWAY * filter_std(r.spec.cutoff) / r.step)
    return np.where(r.motorised, apart, minimum_filter1d(apart, 2 * half + 1, axis=0, origin=half))


def _friction_known(r: PreparedTrial, slow, quick) -> Bool[np.ndarray, "N n"]:
    """Where a tendon is slack, or slides for certain: faster than it stretches, and in a quicker filter too."""
    tension, cutoff = r.tension(), min(r.spec.cutoff / 2.0, 0.2 / r.step)
    stretches = r.sizes.compliance * np.abs(smooth(r.trial.time, tension, cutoff)[1])
    measured = np.isfinite(np.asarray(r.trial.tendon_excursion)).all(axis=0)
    least = TENDON * speed_noise(slow, quick)
    moves = (np.abs(slow) > least + stretches) & (np.sign(slow) * quick > 0.5 * least)
    return (tension <= r.sizes.slack) | (moves & measured)
