"""Probabilities of candidates whose refits are given."""

from types import SimpleNamespace

import pytest

from jaxfinger.gap.search import _judge


def candidate(name, log_evidence):
    key = name, ("site",)
    seen = SimpleNamespace(variant=SimpleNamespace(key=key), log_bf=log_evidence - 1.0, absorbed=0.0)
    refit = SimpleNamespace(keys=(key,), variants=(seen.variant,), log_evidence=log_evidence)
    return key, seen, refit


@pytest.mark.parametrize(("behind", "together"), [(2.0, True), (30.0, False)])
def test_the_effect_that_is_named_is_the_most_probable(behind, together):
    """A rival of more parameters that leaves less, but has less evidence, is no likelier for it."""
    first, seen, refit = candidate("offset", 60.0)
    rival, seen_too, wider = candidate("rotation", 60.0 - behind)
    refit.chi2, wider.chi2 = 110.0, 100.0  # the sums of squares are no part of it
    found = _judge(SimpleNamespace(), [seen_too, seen], {rival: wider, first: refit}, {}, refit, (1.0,), 1000.0, [])
    assert [c.key for c in found.candidates] == [first, rival]
    assert found.rival_sets == ([[first, rival]] if together else [])
    odds = found.candidates[1].probability / found.candidates[0].probability
    assert odds == pytest.approx((1.0 + 2.0 * behind / 25.0) ** -12.5)
