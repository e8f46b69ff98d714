"""Directions and holds derived from the motion: against the commands that made it."""

from dataclasses import replace

import numpy as np

from jaxfinger.data import decimate_trial, directions, find_holds, joint_directions, tendon_directions


def test_direction_of_a_noisy_triangle_with_stops():
    time = np.arange(12_000) / 1000
    rng = np.random.default_rng(0)
    path = np.interp(time, [0, 1, 4, 6, 9, 12], [0, 0, 1, 1, 0, 0])
    x = np.column_stack([path, 0 * path]) + 2e-4 * rng.standard_normal((len(time), 2))
    found = directions(time, x, 10.0, 0.004)
    truth = np.where(time < 1, 0, np.where(time < 6, 1, -1))  # stops keep the direction
    near = np.min(np.abs(time[:, None] - np.array([1, 4, 6])), axis=1) < 0.1
    np.testing.assert_array_equal(found[~near, 0], truth[~near])
    assert not found[:, 1].any()
    assert found.dtype == np.int8


def test_unmeasured_columns_have_no_direction():
    time = np.arange(1000) / 100
    x = np.column_stack([np.full(1000, np.nan), np.sin(time)])
    found = directions(time, x, 5.0, 0.01)
    assert not found[:, 0].any()
    assert set(np.unique(found[500:, 1])) == {-1, 1}


def test_the_files_channels_win(session):
    trial = session["02-ID.3-static-PIP"]
    assert joint_directions(trial) is trial.joint_direction
    assert find_holds(trial) is trial.hold


def test_derived_directions_agree_with_the_command(session):
    trial = session["02-ID.3-static-PIP"]
    derived = joint_directions(replace(trial, joint_direction=None))
    late = trial.hold > 0
    # A filter without phase sees the next ramp one sample before it starts.
    assert np.mean(derived[late] == trial.joint_direction[late]) > 0.99


def test_held_joints_have_no_direction_and_the_pulled_tendon_has(session):
    trial = session["04-ID.4-T1-MCP"]
    assert not joint_directions(trial).any()
    found = tendon_directions(trial)
    rising = (trial.hold == 1) | (trial.hold == 2)
    falling = trial.hold >= 3
    assert (found[rising, 0] == 1).all()
    assert (found[falling, 0] == -1).all()
    assert not found[:, 1:].any()
    assert tendon_directions(session["03-ID.3-dynamic-MCP"]) is None


def test_derived_holds_lie_inside_the_true_ones(session):
    for name in ("02-ID.3-static-PIP", "04-ID.4-T1-MCP"):
        trial = session[name]
        found = find_holds(replace(trial, hold=None))
        assert found.max() == 4
        for index in range(5):
            inside = trial.hold[found == index]
            assert len(inside) > 20
            # The rest before the first hold belongs to it.
            assert np.mean(inside == index) > 0.9 or (index == 0 and set(inside) == {-1, 0})
    assert (find_holds(session["07-VD.3"]) == -1).all()


def test_decimated_trial_keeps_holds_apart(session):
    trial = session["04-ID.4-T1-MCP"]
    slow = decimate_trial(trial, 25.0)
    assert slow.q.shape == (len(slow.time), 2)
    assert 220 <= len(slow.time) <= 240
    for index, level in enumerate([2.0, 6.0, 10.0, 6.0, 2.0]):
        np.testing.assert_allclose(slow.tendon_force[slow.hold == index, 0], level)
    assert np.isnan(slow.tendon_excursion[:, 1]).all()
