"""Shares of a gap on held-out trials, and their intervals."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.gap.budget import Budget, held_out_gains
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


def test_intervals_are_the_same_whether_or_not_a_trial_lacks_another_channel():
    """A bootstrap draws trials within an experiment, whatever channels a trial has."""
    rng = np.random.default_rng(0)
    cells = [(trial, column) for trial in range(6) for column in (0, 1)]
    n = np.full(12, 50.0)
    before, after = n * (4.0 + rng.standard_normal(12)), n * (1.5 + 0.2 * rng.standard_normal(12))
    channels = (("ID.4", "joint_torque"), ("ID.4", "tendon_excursion"))
    whole = Budget(cells, n, before, after, before[None], frozenset({0}), channels)
    kept = np.flatnonzero(np.arange(12) != 11)  # the last trial without its excursion
    less = Budget(cells[:-1], n[kept], before[kept], after[kept], before[None, kept], frozenset({0}), channels)
    for mine, theirs in zip(whole.overall(), less.overall(), strict=True):
        np.testing.assert_allclose(mine, theirs)
