"""The search fits those offers exactly that may win, wherever their shapes lie, and in whatever order it finds them."""

from dataclasses import replace

import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.diagnose import search_for_causes
from jaxfinger.gap.exact import amplitudes_of, as_variant, fit_set
from jaxfinger.gap.problem import build
from jaxfinger.gap.sets import MAX_SCORE_GAP, MIN_SWAP_GAIN
from jaxfinger.identify import Recipe

from .conftest import TRUTH, session_with

STOP = ("joint_stop", ("PIP",))

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def found():
    """The search for a stiff stop half-way between two places of the grid."""
    problem = build(session_with((*STOP, {"stiffness": 0.05, "place": 0.79, "end": 1.0})), Recipe())
    return search_for_causes(problem, {"joint_stop": CATALOGUE["joint_stop"]})


def test_an_offer_is_ranked_by_what_its_exact_fit_may_bring(found):
    search, state = found
    assert state.keys == (STOP,)
    screened = search.screen(search.baseline.start)
    best = search.best_offers(screened)[0]
    exact = search.net_evidence(state)
    assert exact - MAX_SCORE_GAP < best.net < exact + 0.5 * (exact - search.net_evidence(search.baseline.null))
    assert screened.net.max() < exact - 3.0 * MAX_SCORE_GAP  # the best place of the grid, as it is


def test_neighbours_differ_by_one_step_of_one_shape(found):
    search, _ = found
    for offer in search.table.offers:
        ((_, place), *fixed) = offer.variants[0].shape
        for other in search.table.neighbours(offer):
            ((_, beside), *same) = other.variants[0].shape
            assert offer.keys == other.keys
            assert fixed == same
            assert 0.0 < abs(place - beside) < 0.08


def test_what_could_replace_a_cause_is_another(found):
    search, state = found
    offers = search.best_offers(search.screen(state, 0), most=1, other_than=STOP)
    assert offers
    assert all(x.offer.keys != (STOP,) for x in offers)


@pytest.mark.parametrize(
    ("of_null", "of_start", "expected"), [(1.0, 2.0, "start"), (1.0, -1.0, "null"), (-1.0, -2.0, None)]
)
def test_a_search_begins_at_the_null_too_where_it_finds_nothing_from_least_squares(
    found, monkeypatch, of_null, of_start, expected
):
    search, state = found
    null, start = search.baseline.null, replace(search.baseline.start)
    monkeypatch.setattr(search, "baseline", replace(search.baseline, start=start))

    def with_net(gain):
        score = null.score + search.costs.of(state.keys) + gain
        return replace(
            state, linear_fit=replace(state.linear_fit, evidence=state.linear_fit.evidence._replace(score=score))
        )

    ends = {"null": with_net(of_null), "start": with_net(of_start), None: null}
    monkeypatch.setattr(search, "_found_from", lambda s: ends["start" if s is start else "null"])
    assert search.run() is ends[expected]


def test_a_form_that_was_chosen_before_the_other_causes_is_chosen_again(monkeypatch):
    """Friction builds up after a reversal by one of two laws, and the search came by the wrong one."""
    presliding, stop = (*TRUTH, {"a": 1.0, "x0": 0.1, "delta": 1.0}), (*STOP, {"stiffness": 0.05, "place": 0.75})
    problem = build(session_with(presliding, stop), Recipe())
    search, state = search_for_causes(problem, {k: CATALOGUE[k] for k in (TRUTH[0], STOP[0])})
    assert set(state.keys) == {TRUTH, STOP}

    law, scales = TRUTH[0], problem.scales

    def with_delta(delta):
        variants = [as_variant(e, scales) for e in state.effects]
        variants = [v.with_shape(delta=delta) if law == v.effect.ID else v for v in variants]
        starts = [amplitudes_of(e) for e in state.effects]
        return fit_set(search.baseline, state.problem, variants, starts, state.linear_fit.weights)

    wrong = with_delta(0.5)
    assert wrong.score < with_delta(1.0).score - MIN_SWAP_GAIN
    found = iter([wrong])
    monkeypatch.setattr(search, "_better", lambda _: next(found, None))
    assert [e.delta for e in search.run().effects if law == e.ID] == [1.0]
