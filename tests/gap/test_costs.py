"""What sets of causes must explain, and the probabilities that follow."""

import pytest

from jaxfinger.gap.costs import Costs
from jaxfinger.gap.formula import Parameters

SITES = {"tendon_stretch": 5, "joint_stribeck": 3, "joint_damping": 3}
COSTS = Costs(Parameters(), 200.0, SITES)
STRETCH, FURTHER, STRIBECK = ("tendon_stretch", ("T1",)), ("tendon_stretch", ("T2",)), ("joint_stribeck", ("MCP",))


def test_one_cause_at_a_further_site_costs_less_than_another_cause():
    assert COSTS.of([STRETCH, FURTHER]) < COSTS.of([STRETCH, STRIBECK])
    assert COSTS.of([STRETCH, FURTHER]) > COSTS.of([STRETCH]) > COSTS.of([]) == 0.0


def test_a_term_that_the_recipe_leaves_out_is_no_rarity():
    assert COSTS.odds([("joint_damping", ("MCP",))]) < COSTS.odds([STRIBECK])


def test_probabilities_are_shares_of_evidence_beyond_what_each_set_costs():
    sets = {frozenset(): 0.0, frozenset({STRETCH}): COSTS.of([STRETCH]), frozenset({STRIBECK}): -1e6}
    w = COSTS.weights(sets)
    assert list(w.values()) == pytest.approx([0.5, 0.5, 0.0])
    assert COSTS.weights({k: s + 321.0 for k, s in sets.items()}) == pytest.approx(w)


def test_the_more_is_left_the_likelier_something_is_unlisted_and_the_less_the_more_the_causes_took():
    left = [COSTS.unlisted(x) for x in (0.0, 40.0, 60.0)]
    assert left[0] < 0.01 < left[1] < left[2]
    assert Costs(Parameters(), 2000.0, SITES).unlisted(60.0) < left[2]
