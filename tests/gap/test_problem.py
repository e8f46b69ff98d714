"""The gap is what the nominal model misses, not what nobody recorded; and it is linear only nearby."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.augment import as_refitted, augmented_fit, nominal_fit
from jaxfinger.gap.evidence import Projector
from jaxfinger.gap.problem import build, moved
from jaxfinger.gap.refine import refine, relinearised
from jaxfinger.gap.signatures import Signatures, Variant
from jaxfinger.gap.where import where
from jaxfinger.identify import Recipe
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.synthetic import SpecimenPlant, nominal_model, recipe_from, simulate, study_finger

GAIN = 0.2


@pytest.fixture(scope="module")
def specimen():
    return study_finger()


@pytest.fixture(scope="module")
def session(specimen):
    recipe = recipe_from(
        {
            "specimen": {"kind": "random", "joints": 1},
            "trials": {
                "experiments": ["ID.2", "ID.3-static", "ID.4", "VD.3"],
                "rate": 200.0,
                "id2": {"strokes": 2, "stroke_time": 3.0},
                "id3_static": {"step": 20.0},
                "vd3": {"repeats": 2, "motions": 2, "duration": 8.0, "centre": 0.4, "amplitude": 0.3},
            },
        }
    )
    return simulate(recipe, seed=0, plant=SpecimenPlant(specimen))


@pytest.fixture(scope="module")
def problem(session):
    return build(session, Recipe())


@pytest.fixture(scope="module")
def scaled(session):
    """The same session from a torque sensor whose gain is far off."""
    trials = {
        t.name: t if t.joint_torque is None else replace(t, joint_torque=(1.0 + GAIN) * t.joint_torque) for t in session
    }
    return build(replace(session, trials=trials), Recipe())


@pytest.mark.parametrize("missing", [(), ("ID.3-static",)])
def test_damping_without_its_own_experiment_is_fitted_where_else_it_shows(session, specimen, missing):
    """By the stages on the moves between holds; without them, by the diagnosis on the free motion."""
    trials = {t.name: t for t in session if t.experiment not in missing}
    problem = build(replace(session, trials=trials), Recipe())
    damping = [i for i, p in enumerate(describe(problem.nominal)) if p.group == "damping"]
    assert bool(set(damping) & set(problem.fit.estimated)) == (not missing)
    assert set(damping) <= set(problem.free)
    fit, truth = nominal_fit(problem).fit, np.asarray(ravel(nominal_model(specimen)))
    error = np.asarray(ravel(fit.model))[damping] - truth[damping]
    assert np.all(np.abs(error) < 4.0 * fit.std[damping])
    assert np.all(truth[damping] > 3.0 * fit.std[damping])  # it shows clearly


def test_a_problem_moves_along_its_own_jacobian(problem):
    """A thousandth of a standard deviation in every parameter: exact residuals move as the linear ones say."""
    step = 1e-3 / np.linalg.norm(np.vstack([problem.J, problem.root]), axis=0)
    there = moved(problem, step)
    np.testing.assert_allclose(there.r - problem.r, -problem.J @ step, atol=1e-6)
    np.testing.assert_allclose(there.offset - problem.offset, problem.root @ step, atol=1e-12)


@pytest.mark.parametrize(("share", "start"), [(0.5, 1.0), (3.0, 0.5), (3.0, 2.0)])
def test_a_share_is_at_most_one_and_leaves_that_bound_where_it_is_less(problem, share, start):
    """Residuals of a friction of which so much builds up over 20 mrad."""
    kind, site = CATALOGUE["joint_presliding"], (problem.nominal.finger.joint_names[0],)
    effect = kind.at(problem.nominal.finger, site, a=share, x0=0.02)
    there = replace(problem, r=problem.r + Signatures(problem).of([effect])[0])
    rt = Projector(there).residual(there, there.r)
    found = refine(there, [Variant(kind, site, (("x0", 0.016),), scales=there.scales)], [{"a": start}], float(rt @ rt))
    if share < 1.0:
        assert abs(found.effects[0].a - share) < 4.0 * found.std[0]["a"] < 1.0
    else:
        assert found.effects[0].a == 1.0


@pytest.mark.parametrize("start", [(1.0, 0.014), (1.0, 0.03), (0.3, 0.04)])
def test_a_length_is_found_while_the_share_stays_at_its_most(problem, start):
    """Which trials tell of a friction and its length is nearly their product: from any start the same optimum."""
    kind, site = CATALOGUE["joint_presliding"], (problem.nominal.finger.joint_names[0],)
    effect = kind.at(problem.nominal.finger, site, a=1.0, x0=0.02, delta=0.5)
    there = replace(problem, r=problem.r + Signatures(problem).of([effect])[0])
    rt = Projector(there).residual(there, there.r)
    a, x0 = start
    found = refine(
        there, [Variant(kind, site, (("x0", x0), ("delta", 0.5)), scales=there.scales)], [{"a": a}], float(rt @ rt)
    )
    assert abs(float(found.effects[0].x0) - 0.02) < 4.0 * found.std[0]["x0"] < 0.004
    assert found.effects[0].delta == 0.5


def test_a_large_effect_is_judged_by_what_it_leaves_exactly(scaled):
    """A sensor's gain multiplies the torques refitted with it: where it leads, an exact fit finds no better."""
    variant = Variant(CATALOGUE["torque_sensor_scale"], ("torque_sensor",), (), scales=scaled.scales)
    projector = Projector(scaled)
    null = float(np.sum(projector.residual(scaled) ** 2))
    linear = refine(scaled, [variant], [{"gain": 0.05}], null, projector)
    there, near = relinearised(scaled, linear, null)
    exact = float(np.sum(augmented_fit(scaled, near).r ** 2))
    assert linear.chi2 > 2.0 * exact  # twenty per cent are too much for one linearisation
    assert near.chi2 == pytest.approx(exact, abs=3.0)
    assert exact < 1.1 * scaled.r.size
    assert near.effects[0].values()["gain"] == pytest.approx(GAIN, abs=4.0 * near.std[0]["gain"])
    left = Projector(there).residual(there, there.r - near.change)
    assert float(left @ left) == pytest.approx(near.chi2, abs=0.1)  # what the search for further effects starts from


def test_where_a_refit_has_led_is_the_exact_fit(scaled):
    """To one squared deviation in all, intervals to the effect's size; its two parts miss what the model misses."""
    variant = Variant(CATALOGUE["torque_sensor_scale"], ("torque_sensor",), (), scales=scaled.scales)
    null = float(np.sum(Projector(scaled).residual(scaled) ** 2))
    led = relinearised(scaled, refine(scaled, [variant], [{"gain": 0.05}], null), null)
    quick, exact = as_refitted(*led), augmented_fit(scaled, led[1])
    np.testing.assert_array_equal(quick.fit.estimated, exact.fit.estimated)
    i, std = exact.fit.estimated, exact.fit.std[exact.fit.estimated]
    shift = np.asarray(ravel(quick.fit.model) - ravel(exact.fit.model))[i]
    assert float(np.sum(quick.r**2) - np.sum(exact.r**2)) < 1.0
    assert np.all(np.abs(shift) < 0.6 * std)
    np.testing.assert_allclose(quick.fit.std[i], std, rtol=GAIN)
    for key, missed in exact.missed(quick.fit.model).items():
        np.testing.assert_allclose(quick.missed(quick.fit.model)[key], missed, atol=1e-12)


def test_where_a_joint_is_held_it_is_no_variable(problem):
    """A fixture holds the joint of ID.4, so that only noise moves it: a gap at middle tension, which a trial passes
    twice, lies at middle tension.
    """
    rows = problem.rows["ID.4"]
    r = np.random.default_rng(1).standard_normal(problem.r.size)
    mine = (rows.trial == rows.trial[-1]) & (rows.channel == rows.channel[-1]) & (rows.column == rows.column[-1])
    tension = np.asarray(problem.stacks["ID.4"].batch.x.tension)[:, rows.trial[-1], rows.time].max(axis=0)
    low, high = np.quantile(tension[mine], (1 / 3, 2 / 3))
    r[rows.start : rows.start + rows.size][mine & (tension > low) & (tension < high)] += 5.0
    place = where(replace(problem, r=r))[0]
    assert (place.experiment, place.variable) == ("ID.4", "tendon_force")


def test_without_id2_the_other_experiments_show_the_moment_arms(session):
    """What ID.2 would have fitted is first in the residuals of the other experiments, and must not pass for noise."""
    problem = build(session.with_trials([t.name for t in session if t.experiment != "ID.2"]), Recipe())
    energy = np.bincount(problem.column_of_row, problem.r**2) / np.maximum(np.bincount(problem.column_of_row), 1)
    count = np.bincount(problem.column_of_row)
    assert np.all(energy[count > 100] < 1.5)
    assert np.all(energy[count > 100] > 0.5)
