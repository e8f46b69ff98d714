"""Held-out gain: the share that a signature explains of trials which its amplitude is not fitted to."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.gap.budget import held_out_gains
from jaxfinger.gap.folds import FOLDS, fold_of_row


def test_a_cause_explains_trials_that_it_has_not_seen_and_luck_does_not(planted):
    rng = np.random.default_rng(0)
    problem, fold = planted, fold_of_row(planted)
    assert set(fold) == set(range(FOLDS))
    z, noise = rng.standard_normal((2, problem.r.size))
    r = noise + 2.0 * z
    problem = replace(problem, r=r)
    lucky = np.where(fold == 0, r, 0.0)  # with it, a third of the session is explained to nothing
    half = z + rng.standard_normal(r.size)
    cause, luck, imitator, together = held_out_gains(problem, [z[None], lucky[None], half[None], np.stack([z, lucky])])
    assert cause == pytest.approx(1.0, abs=0.02)
    assert luck == pytest.approx(0.0, abs=0.02)
    assert imitator == pytest.approx(0.5, abs=0.03)  # cos² of the angle to the cause
    assert together < cause
