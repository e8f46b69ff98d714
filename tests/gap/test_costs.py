"""Costs of sets of causes, and the probabilities that follow from them."""

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest

from benchmarks.formula import CLIP, Record
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


def test_a_cost_does_not_depend_on_the_order_of_its_causes():
    """To the last bit: sets have another order in every process."""
    unlike = {key: share * np.sqrt(2.0 + k) for k, (key, share) in enumerate(EXPLAINABLE.items())}
    costs = Costs(Parameters(), np.array([np.pi, np.e]), unlike)
    assert len({costs.of(keys) for keys in permutations(unlike, 5)}) == len(
        {frozenset(k) for k in combinations(unlike, 5)}
    )


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


BOTH, WITHOUT_STRETCH, WITHOUT_STRIBECK = (frozenset(s) for s in ({STRETCH, STRIBECK}, {STRIBECK}, {STRETCH}))
COUNTS = Counts(np.array([10, 10]), np.array([100, 100]), np.array([0, 1]), np.ones(2, bool))


def genuine(left: dict[frozenset, tuple[float, float]], gain: float = 50.0, counts: Counts = COUNTS) -> dict:
    """Probabilities that causes imitate nothing.

    Sets leave the energies `left` beyond noise in the two columns, and every cause brings the log evidence `gain`.
    """
    nothing, noise = np.zeros(2), Parameters().variance_floor * counts.K
    evidence = {
        keys: Evidence(noise + np.array(e), np.full(2, 100.0), nothing, gain * len(keys)) for keys, e in left.items()
    }
    best = max(evidence, key=len)
    return genuine_probabilities(COSTS, counts, evidence, best, unlisted(counts, evidence[best], Parameters()))


def test_a_cause_imitates_what_is_unlisted_by_what_stays_in_its_channels():
    """What is left in other channels counts for nothing, and neither does noise."""
    left = {BOTH: (0.0, 3000.0), WITHOUT_STRETCH: (5000.0, 3000.0), WITHOUT_STRIBECK: (0.0, 4000.0)}
    of, p = genuine(left), Parameters()
    assert of[STRETCH] == 1.0
    U = 5.0 * np.log(302.0 / p.variance_floor)
    assert of[STRIBECK] == pytest.approx(1.0 / (1.0 + p.imitator_odds * 0.75 * U / 50.0))
    nothing = {BOTH: (0.0, 0.0), WITHOUT_STRETCH: (5000.0, 0.0), WITHOUT_STRIBECK: (0.0, 4000.0)}
    assert genuine(nothing)[STRIBECK] == 1.0


def test_what_stays_in_another_column_of_the_channel_counts_as_much():
    """A base that yields lengthens all tendons: a stretch explains one of them and leaves the others."""
    beside = {BOTH: (0.0, 3000.0), WITHOUT_STRETCH: (1000.0, 3000.0), WITHOUT_STRIBECK: (0.0, 9000.0)}
    assert genuine(beside)[STRETCH] == 1.0
    assert genuine(beside, counts=replace(COUNTS, channel=np.zeros(2, int)))[STRETCH] < 0.5


def test_a_cause_that_brings_much_more_evidence_than_is_left_is_at_work():
    left = {BOTH: (0.0, 3000.0), WITHOUT_STRETCH: (5000.0, 3000.0), WITHOUT_STRIBECK: (0.0, 9000.0)}
    assert genuine(left, gain=10.0)[STRIBECK] < 0.5 < 0.9 < genuine(left, gain=1000.0)[STRIBECK]
    assert genuine(left, gain=-1.0)[STRIBECK] < 0.02


def test_what_one_effect_imitates_another_seldom_imitates_too():
    """Both leave as much as they bring; a second site of one effect makes the other no likelier to be at work."""
    alone, p = {frozenset({STRETCH}): (3000.0, 3000.0), frozenset(): (6000.0, 6000.0)}, Parameters()
    beside = {BOTH: (3000.0, 3000.0), WITHOUT_STRETCH: (6000.0, 3000.0), WITHOUT_STRIBECK: (3000.0, 6000.0)}
    three = frozenset({STRETCH, FURTHER, STRIBECK})
    further = {three: (3000.0, 3000.0)} | {three - {key}: (6000.0, 6000.0) for key in three}
    x = 0.5 * 5.0 * np.log(302.0 / p.variance_floor) / 50.0  # odds of each
    imitates = p.imitator_odds * x * (1.0 + x) / (1.0 + p.imitator_odds * ((1.0 + x) ** 2 - 1.0))
    assert genuine(alone)[STRETCH] == pytest.approx(1.0 / (1.0 + p.imitator_odds * x))
    assert genuine(beside)[STRETCH] == pytest.approx(1.0 - imitates) == genuine(beside)[STRIBECK]
    assert genuine(further)[STRIBECK] == pytest.approx(1.0 - imitates)
    assert genuine(further)[STRETCH] == genuine(further)[FURTHER] == pytest.approx(1.0 - imitates)


def test_the_log_score_of_a_record_is_that_of_its_probabilities():
    """A cause that is worth its cost is as likely as not; the others and «unlisted» are unlikely, and rightly so."""
    counts, none, p = (
        Counts(np.array([10, 10]), np.array([100, 100]), np.array([0, 1]), np.ones(2, bool)),
        np.zeros(2),
        Parameters(),
    )
    noise, outside = p.variance_floor * counts.K, np.full(2, 100.0)
    evidence = {frozenset(): Evidence(noise + 5000.0 * EXCURSION, outside, none, 0.0)}
    record = Record("case", counts, evidence, frozenset(), EXPLAINABLE, frozenset({STRETCH}), p)
    cost = record.costs(p).of([STRETCH])
    evidence[frozenset({STRETCH})] = Evidence(noise, outside, none, cost + 1e-6)
    unlikely = [CLIP] * (len(EXPLAINABLE) - 1) + [1.0 / (1.0 + np.exp(p.unlisted_slope * p.unlisted_threshold))]
    assert record.log_score(p) == pytest.approx(np.log(0.5) + np.log1p(-np.array(unlikely)).sum(), abs=1e-5)
