"""The verdict: of the posterior, and on held-out trials."""

from dataclasses import replace

import pytest

from jaxfinger.gap.posterior import Posterior
from jaxfinger.gap.result import Closure, Status
from jaxfinger.gap.verdict import confirmed

NOTHING = Posterior({}, {}, 0.9, 0.1, (), ())
LINE = Closure("ID.3-dynamic", "joint_torque", "N m", 0.3, 0.6, 0.3, 1.0, (0.9, 1.0), True)
WORSE = replace(LINE, after=0.9, closed=-1.0, closed_ci95=(-1.0, -0.5))


@pytest.mark.parametrize(
    ("line", "status"),
    [
        (LINE, Status.NO_GAP),
        (WORSE, Status.UNEXPLAINED),
        (replace(WORSE, closed_ci95=(-1.0, 0.1)), Status.NO_GAP),
        (replace(WORSE, before=0.31, after=0.35), Status.NO_GAP),
    ],
    ids=["better", "worse", "perhaps worse", "worse within the noise"],
)
def test_a_retuned_simulator_without_a_gap_predicts_unseen_trials_no_worse(line, status):
    assert confirmed(Status.NO_GAP, NOTHING, (line,), (), {}) is status
