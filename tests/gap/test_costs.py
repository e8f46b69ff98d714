"""Costs of sets of causes, and the probabilities that follow from them."""

import numpy as np
import pytest

from jaxfinger.gap.columns import Counts
from jaxfinger.gap.costs import Costs
from jaxfinger.gap.formula import Evidence, Parameters, unlisted
from jaxfinger.gap.posterior import genuine_probabilities

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


def test_what_leaves_more_than_it_explains_where_it_acts_only_imitates_something_unlisted():
    """Noise and what is left in other columns count for nothing."""
    counts, nothing = Counts(np.array([10, 10]), np.array([100, 100])), np.zeros(2)

    def left(excursion: float, torque: float) -> Evidence:
        return Evidence(10.0 + np.array([excursion, torque]), np.full(2, 100.0), nothing, 0.0)

    def of(evidence: dict) -> dict:
        best = max(evidence, key=len)
        return genuine_probabilities(COSTS, counts, evidence, best, unlisted(counts, evidence[best], Parameters()))

    both, less = frozenset({STRETCH, STRIBECK}), {STRETCH: frozenset({STRIBECK}), STRIBECK: frozenset({STRETCH})}
    imitates = {both: left(0.0, 3000.0), less[STRETCH]: left(5000.0, 3000.0), less[STRIBECK]: left(0.0, 4000.0)}
    assert of(imitates)[STRETCH] == 1.0
    assert of(imitates)[STRIBECK] == pytest.approx(0.25, abs=0.01)
    noise = {both: left(0.0, 5.0), less[STRETCH]: left(5000.0, 5.0), less[STRIBECK]: left(0.0, 4000.0)}
    assert of(noise)[STRIBECK] == pytest.approx(1.0)
