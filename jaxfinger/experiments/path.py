"""Reduction of trials in which a hand or a motor moves the joints along a path (ID.2, VD.1)."""

import numpy as np

from jaxfinger.data import directions
from jaxfinger.data.signals.motion import rest_speed
from jaxfinger.experiments.reduction import PreparedTrial, Row, joints, row

NONE_VALID = "no sample is measured"


def reduce(r: PreparedTrial) -> Row:
    """Reduce a trial: every measured sample is valid, since excursions follow the angles alone."""
    j = joints(r, sharp=not r.reduced)
    # In a fit the excursions are block means of unfiltered samples, so the angles are, too.
    q = r.mean(r.trial.q if r.reduced else j.q)
    joint = r.trial.joint_direction
    joint = directions(j.qd, rest_speed(j.qd, r.quick_rates)) if joint is None else joint.astype(float)
    tension = r.taut(r.mean(r.tension()))
    everywhere = {c: np.ones((len(q), 1), bool) for c in r.y}
    return row(
        r, q, (j.qd, j.qdd), tension, everywhere, j.noise, directions=(joint, np.zeros((len(joint), r.finger.n)))
    )
