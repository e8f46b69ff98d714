"""A motor steps a joint from hold to hold (ID.3-static): friction is known at holds whose approach was seen.

Before the first motion a direction is unknown, and so is friction: a hold there tells nothing of it.
"""

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.data import directions, find_holds, smooth
from jaxfinger.data.motion import rest_speed
from jaxfinger.experiments.driven import sliding
from jaxfinger.experiments.reduction import PreparedTrial, Row, joints, row, stretches

NOTHING = "there is no hold whose direction of approach is known, and no motion in which the joint slides"
# s, at the protocol's pace, kept clear on either side of where a joint may stick: no measured channel is filtered, so
# none spreads.
CLEAR = 0.01


def reduce(r: PreparedTrial) -> Row:
    """Holds that were approached count, and motion in which the joint slides."""
    j = joints(r, sharp=True)
    hold = find_holds(r.trial, r.spec.pace)
    slow = smooth(r.trial.time, r.trial.q, r.spec.cutoff_at(r.step))[1]
    if r.trial.joint_direction is not None:
        joint = r.trial.joint_direction.astype(float)
    else:
        joint = directions(slow, rest_speed(slow, r.quick_rates))
        for samples in stretches(hold):  # a filter without phase sees the next step before it starts
            joint[samples] = joint[samples[len(samples) // 2]]
    moves = (hold < 0)[:, None]  # at a hold nothing does
    qd, qdd = j.qd * moves, j.qdd * moves
    slides = sliding(r, qd, slow, joint, None, CLEAR * r.spec.pace)
    at = r.whole(hold)
    known = r.mean(slides.astype(float)) > 1.0 - 1e-9
    approached = np.abs(r.mean(joint)) > 1.0 - 1e-9
    counting = dict.fromkeys(r.y, ((at >= 0)[:, None] & approached) | known)
    q = _at_rest(r.mean(r.trial.q), at)
    nothing = np.zeros((len(joint), r.finger.n))
    tension = r.taut(r.mean(r.tension()))
    return row(r, q, (qd, qdd), tension, counting, j.noise, directions=(joint, nothing), hold=at)


def _at_rest(q: Float[np.ndarray, "M m"], hold: Int[np.ndarray, " M"]) -> Float[np.ndarray, "M m"]:
    """At a hold its mean: what moves there is the encoder's noise, which neither f(q) nor friction follows."""
    out = q.copy()
    for samples in stretches(hold):
        out[samples] = q[samples].mean(axis=0)
    return out
