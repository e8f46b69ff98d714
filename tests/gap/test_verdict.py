"""The verdict: of the posterior, and on held-out trials."""

from dataclasses import replace

import pytest

from jaxfinger.gap.posterior import Posterior, ambiguous_sets
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


def test_an_ambiguous_set_holds_the_cause_that_the_search_has_found():
    """Rivals take its place (`Search.likeliest`), also where three others are likelier than it."""
    a, b, c, found = (("tendon_stretch", (t,)) for t in ("T1", "T2", "T3", "T4"))
    w = {frozenset({a}): 0.5, frozenset({b}): 0.3, frozenset({c}): 0.15, frozenset({found}): 0.05}
    (members,) = ambiguous_sets(w, (found,), {})
    assert members == (a, b, found)
    (members,) = ambiguous_sets(w, (a,), {})
    assert members == (a, b, c)
