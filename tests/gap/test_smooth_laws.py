"""The features that bound what nobody knows."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.effects import Scales
from jaxfinger.gap.smooth_laws import features, measured_columns
from jaxfinger.model import Motion


def quicker_and_pulled_harder(problem, time: float, force: float):
    """The problem of a machine whose motions take `time` times as long, under `force` times the tensions."""

    def moved(x: Motion) -> Motion:
        return replace(
            x,
            time=x.time * time,
            session_time=x.session_time * time,
            qd=x.qd / time,
            qdd=x.qdd / time**2,
            tension=x.tension * force,
        )

    stacks = {e: replace(s, batch=replace(s.batch, x=moved(s.batch.x))) for e, s in problem.stacks.items()}
    return replace(problem, stacks=stacks, scales=Scales.of(problem.nominal.finger, [s.batch for s in stacks.values()]))


@pytest.mark.parametrize(("time", "force"), [(0.1, 1.0), (1.0, 50.0), (20.0, 1e-2)])
def test_they_are_those_of_the_same_laws_on_a_quicker_or_stronger_machine(planted, time, force):
    other = quicker_and_pulled_harder(planted, time, force)
    for e, c, k, _ in measured_columns(planted):
        mine, theirs = features(planted, e, c, k), features(other, e, c, k)
        for variable, members in mine.items():
            for a, b in zip(members, theirs[variable], strict=True):
                np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9, err_msg=f"{e} {c} {k} {variable}")
