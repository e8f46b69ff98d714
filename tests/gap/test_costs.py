"""Costs of sets of causes, and the probabilities that follow from them."""

import numpy as np
import pytest

from jaxfinger.gap.costs import Costs
from jaxfinger.gap.formula import Parameters

SITES = {"tendon_stretch": ("T1", "T2", "T3"), "joint_stribeck": ("MCP", "PIP"), "joint_damping": ("MCP", "PIP")}
EXCURSION, TORQUE = np.eye(2)  # columns
ACTS = {"tendon_stretch": EXCURSION, "joint_stribeck": TORQUE, "joint_damping": EXCURSION + TORQUE}
EXPLAINABLE = {(e, (s,)): ACTS[e] for e, sites in SITES.items() for s in sites}
COSTS = Costs(Parameters(), 100.0 * (EXCURSION + TORQUE), EXPLAINABLE)
STRETCH, FURTHER, STRIBECK = ("tendon_stretch", ("T1",)), ("tendon_stretch", ("T2",)), ("joint_stribeck", ("MCP",))


def test_one_cause_at_a_further_site_costs_less_than_another_cause():
    assert COSTS.of([STRETCH, FURTHER]) < COSTS.of([STRETCH, STRIBECK])
    assert COSTS.of([STRETCH, FURTHER]) > COSTS.of([STRETCH]) > COSTS.of([]) == 0.0


def test_what_is_unexplained_raises_the_cost_of_causes_that_act_there():
    loud = Costs(Parameters(), 100.0 * EXCURSION + 2000.0 * TORQUE, EXPLAINABLE)
    assert loud.of([STRETCH]) == COSTS.of([STRETCH])
    assert loud.of([STRIBECK]) > COSTS.of([STRIBECK])


def test_a_term_that_the_recipe_leaves_out_is_no_rarity():
    assert COSTS.odds([("joint_damping", ("MCP",))]) < COSTS.odds([STRIBECK])


def test_probabilities_are_shares_of_evidence_beyond_what_each_set_costs():
    sets = {frozenset(): 0.0, frozenset({STRETCH}): COSTS.of([STRETCH]), frozenset({STRIBECK}): -1e6}
    w = COSTS.probabilities(sets)
    assert list(w.values()) == pytest.approx([0.5, 0.5, 0.0])
    assert COSTS.probabilities({k: s + 321.0 for k, s in sets.items()}) == pytest.approx(w)
