"""Reduction of trials in which a motor steps a joint from hold to hold (ID.3-static).

A sample is valid in a hold whose direction of approach is known, which gives the direction of friction, and in motion
in which the joint slides. For a fit both sides of (1) pass the same low-pass; for a prediction they do not. Motion does
not count for a fit where noise of angles hides its inertia (`Sizes.crossing`): one noise stands for all samples.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from jaxfinger.data import directions, filter_std, find_holds, low_pass, smooth_rate
from jaxfinger.data.signals.motion import from_the_start, rest_speed
from jaxfinger.experiments.driven import CLEAR_WIDTHS, clear_of_unknown, less_noise, sliding
from jaxfinger.experiments.reduction import PreparedTrial, Row, joints, row, runs_of_holds

# Widths of the filter from the ends of a hold: beyond, 3e-5 of the motion beside the hold is left, and nothing moves.
FAR_WIDTHS = 4.0
NONE_VALID = "there is no hold whose direction of approach is known, and no motion in which the joint slides"


def reduce(r: PreparedTrial) -> Row:
    """Reduce a trial: valid are holds of known approach, and motion in which the joint slides."""
    j = joints(r, sharp=not r.reduced)
    hold = find_holds(r.trial, r.experiment.pace)
    slow = smooth_rate(r.trial.time, r.trial.q, r.experiment.cutoff_at(r.step))
    if r.trial.joint_direction is not None:
        joint = r.trial.joint_direction.astype(float)
    else:
        joint = directions(slow, rest_speed(slow, r.quick_rates))
        for samples in runs_of_holds(hold):  # a zero-phase filter shows the next step before it starts
            joint[samples] = joint[samples[len(samples) // 2]]
    clear = CLEAR_WIDTHS * filter_std(j.cutoff)
    slides = clear_of_unknown(r, sliding(r, j, slow, joint, None), clear)
    approached = _constant(joint, round(clear / r.step))
    at = r.whole(hold)
    known, led = (r.mean(a.astype(float)) > 1.0 - 1e-9 for a in (slides, approached))  # all samples of the block
    known &= not r.reduced or r.sizes.crossing >= r.experiment.cutoff
    counting = dict.fromkeys(r.y, ((at >= 0)[:, None] & led) | known)
    reach = round(FAR_WIDTHS * filter_std(j.cutoff) / r.step) if r.reduced else 0
    rests = minimum_filter1d(hold >= 0, 2 * reach + 1)[:, None]
    qd, qdd, y = np.where(rests, 0.0, j.qd), less_noise(r, j), r.y
    if r.reduced:
        # q̈ keeps its noise in holds, where it is zero, since one noise stands for all samples of a channel.
        joint, *filtered = (low_pass(r.trial.time, a, j.cutoff) for a in (from_the_start(joint), *y.values()))
        y = dict(zip(y, filtered, strict=True))
    else:
        qdd = np.where(rests, 0.0, qdd)
    return row(
        r,
        _at_rest(r.mean(j.q if r.reduced else r.trial.q), at),
        (qd, qdd),
        r.taut(r.mean(r.tension())),
        counting,
        j.noise,
        directions=(joint, np.zeros((len(joint), r.finger.n))),
        hold=at,
        blur=filter_std(j.cutoff) if r.reduced else 0.0,
        y=y,
    )


def _constant(direction: Float[np.ndarray, "N m"], reach: int) -> Bool[np.ndarray, "N m"]:
    """Whether a direction is known and does not change within `reach` samples on either side.

    Beyond the ends of a recording it is not known: the filter reads extrapolated samples there, and their noise.
    """
    least, most = (f(direction, 2 * reach + 1, axis=0, mode="constant") for f in (minimum_filter1d, maximum_filter1d))
    return (least == most) & (direction != 0.0)


def _at_rest(q: Float[np.ndarray, "M m"], hold: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M m"]:
    """Replace the angles of each hold by their mean, since changes within a hold are the encoder's noise."""
    out = q.copy()
    for samples in runs_of_holds(hold):
        out[samples] = q[samples].mean(axis=0)
    return out
