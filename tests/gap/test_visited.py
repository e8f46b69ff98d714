"""Evidence of the sets that a search has visited."""

import numpy as np

from jaxfinger.gap.formula import Evidence
from jaxfinger.gap.sets import Visited, Weighed

A, B = ("tendon_stretch", ("T1",)), ("joint_stribeck", ("PIP",))


def evidence(score: float) -> Evidence:
    return Evidence(np.ones(2), np.ones(2), np.ones(2), score)


def test_of_one_way_the_highest_evidence_counts_and_a_better_way_replaces_a_rougher_one():
    visited = Visited()
    for score, weighed, counts in (
        (5.0, Weighed.SCREENED, 5.0),
        (9.0, Weighed.SCREENED, 9.0),
        (1.0, Weighed.LINEAR, 1.0),
        (7.0, Weighed.SCREENED, 1.0),
        (2.0, Weighed.LINEAR, 2.0),
        (-4.0, Weighed.EXACT, -4.0),
        (8.0, Weighed.LINEAR, -4.0),
        (-6.0, Weighed.EXACT, -4.0),
        (-3.0, Weighed.EXACT, -3.0),
    ):
        visited.add([A], evidence(score), weighed)
        assert visited.scores == {frozenset([A]): counts}
    visited.add([A, B], evidence(0.0), Weighed.SCREENED)
    assert len(visited.scores) == 2
