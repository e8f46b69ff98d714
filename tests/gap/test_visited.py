"""Evidence of the sets that a search has visited."""

import numpy as np

from jaxfinger.gap.formula import Evidence
from jaxfinger.gap.sets import Visited

A, B = ("tendon_stretch", ("T1",)), ("joint_stribeck", ("PIP",))


def evidence(score: float) -> Evidence:
    return Evidence(np.ones(2), np.ones(2), np.ones(2), score)


def test_settled_weights_replace_those_of_a_screen_and_the_best_of_them_counts():
    visited = Visited()
    visited.screen([A], evidence(5.0))
    visited.add([A], evidence(1.0))
    visited.add([A], evidence(2.0))
    visited.add([A], evidence(1.5))
    visited.screen([A], evidence(9.0))
    assert visited.scores == {frozenset([A]): 2.0}


def test_what_an_exact_fit_does_not_keep_of_a_promise_is_refuted():
    visited = Visited()
    for keys, promised, kept in (((A,), 3.0, 2.0), ((A, B), 7.0, -4.0)):
        visited.add(keys, evidence(promised))
        visited.add_exact(keys, evidence(kept))
    visited.add([B], evidence(8.0))  # of this set there is no exact fit
    visited.refute([frozenset([A, B]), frozenset([B])])
    assert visited.scores == {frozenset([A]): 3.0, frozenset([A, B]): -4.0, frozenset([B]): 8.0}
