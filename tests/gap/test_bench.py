"""Machines of other benches: no finger, no tendons, motions alone."""

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap import Status, diagnose

from .pendulum import pendulum


def without_all_but(*effects: str) -> tuple[str, ...]:
    return tuple(sorted(set(CATALOGUE) - set(effects)))


def test_a_cause_that_acts_at_reversals_alone_has_a_share_of_the_gap():
    """It shows outside of the smooth features, whose evidence alone finds no channel with a gap."""
    found = diagnose(pendulum(stribeck=0.5), without=without_all_but("joint_stribeck", "joint_backlash"), quick=True)
    (cause,), (size,), (closure,) = found.budget, found.relevance, found.closures
    assert (found.status, cause.effect) == (Status.EXPLAINED, "joint_stribeck")
    assert closure.closed > 0.5
    assert cause.share > 0.5
    assert 0.5 * size.gap**2 < closure.before**2 - closure.noise**2 < 2.0 * size.gap**2
