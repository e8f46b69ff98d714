"""What a signature explains of trials that its amplitude has not seen."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.gap.held_out import FOLDS, KEPT, fold_of_row, held_out_energies


def test_a_cause_explains_trials_that_it_has_not_seen_and_luck_does_not(diagnosis):
    rng = np.random.default_rng(0)
    problem, fold = diagnosis.problem, fold_of_row(diagnosis.problem)
    assert set(fold) == set(range(FOLDS))
    z, noise = rng.standard_normal((2, problem.r.size))
    r = noise + 2.0 * z
    problem = replace(problem, r=r)
    lucky = np.where(fold == 0, r, 0.0)  # with it, a third of the session is explained to nothing
    half = z + rng.standard_normal(r.size)
    alone, left = held_out_energies(problem, [z[None], lucky[None], half[None], np.stack([z, lucky])])
    cause, luck, imitator, together = (alone - left) / (alone - noise @ noise)
    assert cause == pytest.approx(1.0, abs=0.02)
    assert luck == pytest.approx(0.0, abs=0.02)
    assert imitator == pytest.approx(0.5, abs=0.03)  # cos² of the angle to the cause
    assert together < cause


def test_held_out_energies_are_those_of_refits_without_each_fold(diagnosis):
    problem, fold = diagnosis.problem, fold_of_row(diagnosis.problem)
    Z = np.random.default_rng(1).standard_normal((2, problem.r.size)) + 1e-3 * problem.J[:, :2].T
    alone, (left,) = held_out_energies(problem, [Z])
    size = np.linalg.norm(problem.J, axis=0)
    kept = KEPT * np.diag(size)
    expected = np.zeros(2)
    for i, columns in enumerate((problem.J, np.column_stack([problem.J, Z.T]))):
        free = np.pad(np.vstack([problem.root, kept]), ((0, 0), (0, columns.shape[1] - size.size)))
        b = np.concatenate([-problem.offset, np.zeros(size.size)])
        for k in range(FOLDS):
            A = np.vstack([columns[fold != k], free])
            unit = np.where(np.linalg.norm(A, axis=0) > 0, np.linalg.norm(A, axis=0), 1.0)
            x = np.linalg.lstsq(A / unit, np.concatenate([problem.r[fold != k], b]), rcond=None)[0] / unit
            expected[i] += np.sum((problem.r[fold == k] - columns[fold == k] @ x) ** 2)
    assert (alone, left) == pytest.approx(tuple(expected), rel=1e-8)


def test_the_effect_at_work_closes_its_gap_on_held_out_trials(diagnosis):
    (named,) = diagnosis.verdict.effects
    gains = {c.key: c.held_out for c in diagnosis.search.candidates}
    assert gains[named] > 0.9
    assert gains[named] == max(gains.values())
