"""The energy that smooth laws could explain depends neither on the units nor on the scale of the machine."""

from dataclasses import replace

import numpy as np

from jaxfinger.gap.smooth_laws import features, measured_columns


def slower_and_stronger(problem):
    """The same motion at half the speed, with ten times the tension."""
    stacks = {}
    for e, stack in problem.stacks.items():
        x = stack.batch.x
        x = replace(
            x,
            time=2.0 * x.time,
            session_time=2.0 * x.session_time,
            qd=x.qd / 2.0,
            qdd=x.qdd / 4.0,
            tension=10.0 * x.tension,
        )
        stacks[e] = replace(stack, batch=replace(stack.batch, x=x))
    scales = problem.scales
    scales = replace(scales, speed=scales.speed / 2.0, tension=10.0 * scales.tension, trial=2.0 * scales.trial)
    return replace(problem, stacks=stacks, scales=scales)


def test_features_are_the_same_at_another_scale(planted):
    other = slower_and_stronger(planted)
    for e, c, column, _ in measured_columns(planted):
        ours, theirs = (features(p, e, c, column) for p in (planted, other))
        assert ours.keys() == theirs.keys()
        for variable, members in ours.items():
            np.testing.assert_allclose(np.array(theirs[variable]), np.array(members), atol=1e-9, err_msg=variable)
