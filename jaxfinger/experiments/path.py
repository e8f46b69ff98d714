"""Joints along a path, by a hand or a motor (ID.2, VD.1): the tendons' excursions follow their angles."""

import numpy as np

from jaxfinger.data import directions
from jaxfinger.data.motion import rest_speed
from jaxfinger.experiments.reduction import PreparedTrial, Row, joints, row

NOTHING = "no sample is measured"


def reduce(r: PreparedTrial) -> Row:
    """Every sample counts where it is measured."""
    j = joints(r, sharp=not r.reduced)
    # Averaged over the same blocks as what it predicts, and not filtered where that is not.
    q = r.mean(r.trial.q if r.reduced else j.q)
    joint = r.trial.joint_direction
    joint = directions(j.qd, rest_speed(j.qd, r.quick_rates)) if joint is None else joint.astype(float)
    tension = r.taut(r.mean(r.tension()))
    everywhere = {c: np.ones((len(q), 1), bool) for c in r.y}
    return row(
        r, q, (j.qd, j.qdd), tension, everywhere, j.noise, directions=(joint, np.zeros((len(joint), r.finger.n)))
    )
