"""Shares of a gap on held-out trials, and their intervals."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.gap.budget import Budget, Cell, _solved, held_out_gains
from jaxfinger.gap.folds import FOLDS, fold_of_row


def test_a_cause_explains_trials_that_it_has_not_seen_and_luck_does_not(planted):
    rng = np.random.default_rng(0)
    problem, fold = planted, fold_of_row(planted)
    assert set(fold) == set(range(FOLDS))
    z, noise = rng.standard_normal((2, problem.r.size))
    r = noise + 2.0 * z
    problem = replace(problem, r=r)
    lucky = np.where(fold == 0, r, 0.0)  # explains one third of the session wholly, and nothing of the others
    half = z + rng.standard_normal(r.size)
    cause, luck, imitator, together = held_out_gains(problem, [z[None], lucky[None], half[None], np.stack([z, lucky])])
    assert cause == pytest.approx(1.0, abs=0.02)
    assert luck == pytest.approx(0.0, abs=0.02)
    assert imitator == pytest.approx(0.5, abs=0.03)  # cos² of the angle to the cause
    assert together < cause


def test_a_refit_is_sound_where_trials_do_not_show_a_column_or_tell_it_from_others():
    rng = np.random.default_rng(0)
    J = 1e7 * rng.standard_normal((2000, 4))  # so sensitive that the prior of the folds is less than rounding
    J[:, 2], J[:, 3] = J[:, 0], 0.0
    r = J[:, 0] - J[:, 1] + rng.standard_normal(2000)
    X = np.column_stack([r, J])
    x = _solved(X.T @ X, np.zeros((5, 5)), np.eye(5)[0], [1, 2, 3, 4])
    assert x[4] == 0.0
    assert np.abs(x[1:4]).max() < 2.0
    _, (left,), *_ = np.linalg.lstsq(J[:, :2], r)
    assert np.sum((X @ x) ** 2) == pytest.approx(left, rel=1e-3)


CHANNELS = (("ID.4", "joint_torque"), ("ID.4", "tendon_excursion"))


def made(cells: list[tuple[int, int]], left: np.ndarray, open_columns: set[int]) -> Budget:
    """A budget of one cause, with the gap of each (trial, column) before it and the share of it that it leaves."""
    before = 200.0 + 20.0 * np.random.default_rng(0).standard_normal(len(cells))
    after = 50.0 + left * (before - 50.0)
    rows = [Cell(trial, column, trial % FOLDS, 50) for trial, column in cells]
    return Budget(rows, before, after, before[None], frozenset(open_columns), CHANNELS)


def test_intervals_are_the_same_whether_or_not_a_trial_lacks_another_channel():
    cells = [(trial, column) for trial in range(6) for column in (0, 1)]
    left = 0.2 + 0.1 * np.random.default_rng(1).random(12)
    whole, less = (made(cells[:k], left[:k], {0}) for k in (12, 11))  # the last trial without its excursion
    for mine, theirs in zip(whole.overall, less.overall, strict=True):
        np.testing.assert_allclose(mine, theirs)


def test_a_joint_whose_noise_is_small_does_not_hide_another_joint_of_its_channel():
    """The cause closes joint 0, a hundred times the noise, and nothing of joint 1, three times the noise."""
    cells = [Cell(trial, column, trial % FOLDS, 50) for trial in range(6) for column in (0, 1)]
    before = np.tile([50.0 * 100.0**2, 50.0 * 3.0**2], 6)
    after = np.tile([50.0, 50.0 * 3.0**2], 6)
    budget = Budget(cells, before, after, before[None], frozenset({0, 1}), (CHANNELS[0], CHANNELS[0]))
    share, ends, left, _ = budget.overall
    assert share == pytest.approx([0.5])
    assert left == pytest.approx(0.5)
    np.testing.assert_allclose(ends, [[0.5, 0.5]], atol=1e-12)
    assert budget.of([0, 1])[1] == pytest.approx(0.5)


def test_channels_that_disagree_do_not_widen_the_interval_of_their_mean():
    """Two trials of twelve show the channel that the cause closes: no draw may lack it."""
    cells = [(trial, 0) for trial in range(12)] + [(0, 1), (1, 1)]
    share, ends, left, _ = made(cells, np.repeat([1.0, 0.0], (12, 2)), {0, 1}).overall
    assert share == pytest.approx([0.5])
    assert left == pytest.approx(0.5)
    np.testing.assert_allclose(ends, [[0.5, 0.5]], atol=1e-12)


def test_a_channel_of_one_trial_has_an_interval_from_the_parts_of_that_trial():
    cells = [Cell(0, 0, fold, 50) for fold in range(FOLDS)]
    before, after = np.full(FOLDS, 200.0), np.array([50.0, 60.0, 90.0])
    budget = Budget(cells, before, after, before[None], frozenset({0}), CHANNELS)
    (share,), ((low, high),) = budget.overall.of_causes, budget.overall.of_causes_ci95
    assert low < share - 0.05
    assert high > share + 0.05


def test_without_causes_all_of_a_gap_is_left_however_small_it_is():
    cells = [Cell(trial, 0, trial % FOLDS, 50) for trial in range(6)]
    before = np.full(6, 51.0)  # 2 % above the noise, below the least gap that shares are relative to
    budget = Budget(cells, before, before, np.empty((0, 6)), frozenset({0}), CHANNELS)
    assert (budget.overall.left, budget.overall.left_ci95) == (1.0, (1.0, 1.0))
    assert budget.of([0])[1] == 1.0
