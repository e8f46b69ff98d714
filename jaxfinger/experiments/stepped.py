"""Reduction of trials in which a motor steps a joint from hold to hold (ID.3-static).

A hold is valid where the direction of its approach is known, which gives the direction of friction. Before the first
motion it is unknown.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.data import directions, find_holds, smooth_rate
from jaxfinger.data.signals.motion import rest_speed
from jaxfinger.experiments.driven import sliding
from jaxfinger.experiments.reduction import PreparedTrial, Row, joints, row, runs_of_holds

NONE_VALID = "there is no hold whose direction of approach is known, and no motion in which the joint slides"
# s at the protocol's pace, left out on either side of samples where a joint may stick. It is short, since no measured
# channel is filtered.
CLEAR_TIME = 0.01


def reduce(r: PreparedTrial) -> Row:
    """Reduce a trial: valid are holds of known approach, and motion in which the joint slides."""
    j = joints(r, sharp=True)
    hold = find_holds(r.trial, r.experiment.pace)
    slow = smooth_rate(r.trial.time, r.trial.q, r.experiment.cutoff_at(r.step))
    if r.trial.joint_direction is not None:
        joint = r.trial.joint_direction.astype(float)
    else:
        joint = directions(slow, rest_speed(slow, r.quick_rates))
        for samples in runs_of_holds(hold):  # a zero-phase filter shows the next step before it starts
            joint[samples] = joint[samples[len(samples) // 2]]
    moves = (hold < 0)[:, None]  # nothing moves in a hold
    j = replace(j, qd=j.qd * moves, qdd=j.qdd * moves)
    slides = sliding(r, j, slow, joint, None, CLEAR_TIME * r.experiment.pace)
    at = r.whole(hold)
    known = r.mean(slides.astype(float)) > 1.0 - 1e-9  # all samples of the block
    approached = np.abs(r.mean(joint)) > 1.0 - 1e-9
    counting = dict.fromkeys(r.y, ((at >= 0)[:, None] & approached) | known)
    q = _at_rest(r.mean(r.trial.q), at)
    nothing = np.zeros((len(joint), r.finger.n))
    tension = r.taut(r.mean(r.tension()))
    return row(r, q, (j.qd, j.qdd), tension, counting, j.noise, directions=(joint, nothing), hold=at)


def _at_rest(q: Float[np.ndarray, "M m"], hold: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M m"]:
    """Replace the angles of each hold by their mean, since changes within a hold are the encoder's noise."""
    out = q.copy()
    for samples in runs_of_holds(hold):
        out[samples] = q[samples].mean(axis=0)
    return out
