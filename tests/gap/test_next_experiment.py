"""The suggested trial, once it is run, settles the verdict; and its expected evidence is what a refit would find."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap import Status, diagnose
from jaxfinger.gap.next_experiment import DECISIVE, _short_list, expected_evidence
from jaxfinger.gap.problem import imagined
from jaxfinger.gap.result import Key
from jaxfinger.synthetic import recipe_from

from .conftest import TABLE, session_with

TRUTH = ("passive_tendon", ("PIP", "DIP"), {"kappa": 0.01, "rho": 1.0, "phi": 0.0})
WITHOUT = tuple(sorted(set(CATALOGUE) - {"passive_tendon", "elastic_hardening", "joint_stop"}))
USUAL = [25, 30, 45]  # MCP, PIP, DIP, degrees


def of_one_joint(*postures):
    """A session in which only the PIP moves and the other joints rest, so that its coupling to them is ambiguous."""
    trials = TABLE["trials"]
    there = {k: trials[k] | {"postures": list(postures)} for k in ("id3_static", "id3_dynamic")}
    session = session_with(TRUTH, recipe=recipe_from(TABLE | {"trials": trials | there}))
    return replace(session, trials={name: t for name, t in session.trials.items() if t.joint == "PIP"})


@pytest.fixture(scope="module")
def ambiguous():
    return diagnose(of_one_joint(USUAL), without=WITHOUT)


@pytest.mark.long
def test_the_suggestion_once_run_settles_the_verdict(ambiguous):
    assert ambiguous.status is Status.AMBIGUOUS
    assert set(ambiguous.ambiguous_sets[0]) == {Key(*TRUTH[:2]), Key("passive_tendon", ("MCP", "PIP"))}
    suggestion = ambiguous.next_experiment
    assert suggestion.separates == ("passive_tendon",)
    assert suggestion.evidence > DECISIVE
    at = {p.joint: float(np.degrees(p.low)) for p in suggestion.postures if not p.moves}
    assert max(abs(at["MCP"] - USUAL[0]), abs(at["DIP"] - USUAL[2])) > 5.0  # away from all recorded postures
    settled = diagnose(of_one_joint(USUAL, [at["MCP"], USUAL[1], at["DIP"]]), without=WITHOUT)
    assert settled.status is Status.EXPLAINED
    assert settled.named == (Key(*TRUTH[:2]),)


@pytest.mark.long
def test_a_shape_that_no_trial_tells_is_said_to_be_open(ambiguous):
    """With the DIP in one posture only φ + ρ q_DIP can be estimated, neither ρ nor φ alone."""
    best = {v.name: v for v in ambiguous.candidates[0].values}
    assert best["rho"].std > 0.5
    assert best["phi"].std > 0.5


def test_an_experiment_that_is_missing_is_imagined_with_the_motion_of_another(planted):
    problem = planted
    lacking = replace(problem, stacks={e: s for e, s in problem.stacks.items() if e != "ID.3-dynamic"})
    lists = list(_short_list(lacking, {"ID.3-dynamic"}))
    assert all(set(stacks) == {"ID.3-dynamic"} for stacks in lists)
    fastest = []
    for stacks in lists:
        there = imagined(lacking, stacks)
        rows, x = there.rows["ID.3-dynamic"], stacks["ID.3-dynamic"].batch.x
        moved = [problem.nominal.finger.joint_names.index(problem.session[t].joint) for t in there.trial_names]
        # Only the torque of the moved joint counts.
        np.testing.assert_array_equal(rows.column, np.array(moved)[rows.trial])
        assert rows.size > 300
        assert np.isfinite(there.J).all()
        assert np.abs(there.J).max(axis=0).min() == 0.0  # moment arms do not show, since the tendons are slack
        assert not np.asarray(x.tension).any()
        fastest.append(float(np.abs(np.asarray(x.qd)).max()))
    assert max(fastest) > 3.9 * min(fastest)


def test_expected_evidence_is_what_a_refit_to_file_and_trial_leaves():
    rng = np.random.default_rng(0)
    file, trial, delta = rng.standard_normal((40, 5)), rng.standard_normal((12, 5)), rng.standard_normal(12)
    A, b = np.vstack([file, trial]), np.concatenate([np.zeros(40), delta])
    left = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
    found = expected_evidence(delta, trial.T, file.T @ file)
    assert found == pytest.approx(0.5 * left @ left, rel=1e-9)


def test_what_can_be_imitated_without_contradicting_the_file_tells_nothing():
    trial = np.random.default_rng(1).standard_normal((12, 3))
    assert expected_evidence(trial @ [1.0, -2.0, 0.5], trial.T, np.zeros((3, 3))) == pytest.approx(0.0, abs=1e-9)
    assert expected_evidence(trial @ [1.0, -2.0, 0.5], trial.T, 1e6 * np.eye(3)) > 1.0
