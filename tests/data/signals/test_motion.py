"""Directions and holds derived from the motion: against the commands that made it."""

from dataclasses import replace

import numpy as np

from jaxfinger.data import directions, directions_from_turning_points, find_holds


def test_a_direction_is_kept_through_a_stop_and_unknown_before_the_first_motion():
    rate = np.array([0.1, 0.0, 1.0, 0.2, -0.1, -2.0, 0.1])[:, None]
    np.testing.assert_array_equal(directions(rate, np.array([0.5]))[:, 0], [0, 0, 1, 1, 1, -1, -1])


def test_a_turn_is_put_where_the_motion_back_began():
    x = np.array([0.0, 1.0, 2.0, 3.0, 2.5, 2.0, 1.0, 0.0])[:, None]
    sure = np.array([0, 1, 1, 1, 1, 1, 1, -1])[:, None].astype(float)
    found = directions_from_turning_points(sure, x, np.array([1.0]))
    np.testing.assert_allclose(found[:, 0], [0, 1, 1, 1, 0, -1, -1, -1])
    at_once = directions_from_turning_points(sure, x, np.array([0.0]))
    np.testing.assert_allclose(at_once[:, 0], [0, 1, 1, 1, -1, -1, -1, -1])


def test_the_files_holds_win(session):
    trial = session["02-ID.3-static-PIP"]
    assert find_holds(trial) is trial.hold


def test_derived_holds_lie_inside_the_true_ones(session):
    for name in ("02-ID.3-static-PIP", "04-ID.4-T1-MCP"):
        trial = session[name]
        found = find_holds(replace(trial, hold=None))
        assert found.max() == 4
        for index in range(5):
            inside = trial.hold[found == index]
            assert len(inside) > 20
            # The rest before the first hold is derived as part of that hold.
            assert np.mean(inside == index) > 0.9 or (index == 0 and set(inside) == {-1, 0})
    assert (find_holds(session["07-VD.3"]) == -1).all()


def test_rounding_moves_no_sample_out_of_a_hold(session):
    """At 240 Hz, too, a filter's length is a whole number of samples."""
    exact = replace(session["02-ID.3-static-PIP"], hold=None)
    count = np.arange(len(exact.time))
    found, rounded = (find_holds(replace(exact, time=time)) for time in (count / 240.0, np.round(count / 240.0, 7)))
    assert found.max() > 0
    np.testing.assert_array_equal(rounded, found)


def test_a_column_that_never_turns_keeps_its_direction():
    x = np.linspace(0.0, 1.0, 50)[:, None] * [1.0, 0.0]
    sure = np.tile([1.0, 0.0], (50, 1))
    np.testing.assert_array_equal(directions_from_turning_points(sure, x, np.array([0.01, 0.01])), sure)


def test_no_direction_is_more_than_one_wherever_a_joint_wanders():
    """This holds also where the joint, after a sure change of direction, goes back beyond its turning point."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        x = np.cumsum(rng.normal(size=(400, 2)), axis=0)
        sure = np.sign(np.repeat(rng.normal(size=(20, 2)), 20, axis=0))
        assert np.abs(directions_from_turning_points(sure, x, np.array([0.01, 1.0]))).max() <= 1.0
