"""The search fits those offers exactly that may win, wherever their shapes lie."""

import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.diagnose import search_for_causes
from jaxfinger.gap.problem import build
from jaxfinger.gap.sets import MAX_SCORE_GAP
from jaxfinger.identify import Recipe

from .conftest import session_with

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
    screened = search.screen(search.baseline.null)
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
