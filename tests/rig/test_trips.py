"""The state machines against plain loops, for any partition of a stream into blocks."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.rig.trips import FULL_COUNT, LEAK, Drift, LeakyCount, RunLength

streams = st.lists(st.booleans(), min_size=1, max_size=80)
cuts = st.lists(st.integers(1, 79), max_size=10)


def pieces(length: int, at: list[int]):
    return list(pairwise([0, *sorted({c for c in at if c < length}), length]))


def fills(bad: list[bool], need: int) -> list[tuple[int, int]]:
    """Return the bad samples at which the count is full, each with the sample at which its bad samples began."""
    level, since, found = 0.0, 0, []
    for k, wrong in enumerate(bad):
        since = k if wrong and level == 0.0 else since
        level = min(level + 1.0, need) if wrong else max(level - LEAK, 0.0)
        if wrong and level >= need:
            found.append((k, since))
    return found


@settings(deadline=None)
@given(streams, cuts, st.sampled_from([FULL_COUNT, 1, 7]))
def test_a_count_fills_at_the_same_sample_however_it_is_cut(bad, at, need):
    expected = fills(bad, need)
    count = LeakyCount(2, need)  # the other column is never bad
    both = np.stack([np.zeros(len(bad), bool), np.array(bad)], 1)
    hits = [
        (a + row, since)
        for a, b in pieces(len(bad), at)
        for column, row, since in count(both[a:b], np.arange(a, b))
        if column == 1
    ]
    assert hits[:1] == expected[:1]
    assert set(hits) <= set(expected)


@pytest.mark.parametrize(
    ("pattern", "trips_at"),
    [("111", 2), ("110110", 4), ("10101010", 6), ("100100100100100", 12), ("11", None), ("1000010000" * 50, None)],
)
def test_what_is_bad_every_other_time_trips_and_one_odd_sample_does_not(pattern, trips_at):
    found = fills([c == "1" for c in pattern], FULL_COUNT)
    hits = LeakyCount(1)(np.array([[c == "1"] for c in pattern]), np.arange(len(pattern)))
    assert [h[1] for h in hits] == [k for k, _ in found[:1]]
    assert (hits[0][1] if hits else None) == trips_at


def test_a_count_that_was_full_for_long_drains_as_one_that_just_filled():
    count = LeakyCount(1)
    count(np.ones((500, 1), bool), np.arange(500))
    count(np.zeros((12, 1), bool), np.arange(500, 512))
    assert count(np.ones((2, 1), bool), np.arange(512, 514)) == []
    assert [h[1:] for h in count(np.ones((1, 1), bool), np.arange(514, 515))] == [(0, 512)]


@settings(deadline=None)
@given(streams, cuts)
def test_runs_against_a_loop(true, at):
    expected, length = [], 0
    for yes in true:
        length = length + 1 if yes else 0
        expected.append(length)
    run = RunLength(1)
    found = np.concatenate([run(np.array(true[a:b])[:, None])[:, 0] for a, b in pieces(len(true), at)])
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("drift", "found"), [(0.9e-3, False), (-0.9e-3, False), (3e-3, True), (-0.99, True), (1e3, True)]
)
def test_a_clock_within_its_rate_is_followed_for_ever_and_any_other_is_left_behind(drift, found):
    clock = Drift(1e-3)
    away = [abs(clock(drift * t, drift * t, 0.05)) for t in np.arange(0, 400, 0.05)]
    assert (max(away) > 0.1) == found


def test_a_clock_is_only_known_within_an_interval():
    clock = Drift(1e-3)
    assert clock(0.0, 0.2, 0.0) == 0.0
    assert clock(-0.1, 0.15, 1.0) == 0.0
    assert clock(0.4, 0.5, 1.0) == pytest.approx(0.3)
    assert clock(-0.9, -0.5, 1.0) == pytest.approx(-0.601)
