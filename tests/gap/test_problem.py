"""The regression problem of a diagnosis, and exact fits of sets of causes in it."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.augment import as_refitted, augmented_fit, nominal_fit
from jaxfinger.gap.exact import MIN_SCORE_GAIN, Baseline, fit_at_nominal, fit_set, refit_from_plain
from jaxfinger.gap.formula import Parameters, Weights
from jaxfinger.gap.problem import build, moved
from jaxfinger.gap.projector import orthonormalise
from jaxfinger.gap.signatures import Signatures, Variant
from jaxfinger.gap.where import where
from jaxfinger.identify import Recipe
from jaxfinger.identify.parameters import describe, ravel
from jaxfinger.identify.recipe import ModelRecipe
from jaxfinger.synthetic import SpecimenPlant, recipe_from, simulate, study_finger, true_model

GAIN = 0.2


def plain(baseline):
    return Weights.plain(baseline.columns)


@pytest.fixture(scope="module")
def specimen():
    return study_finger()


def recorded(specimen, repeats=2):
    recipe = recipe_from(
        {
            "specimen": {"kind": "random", "joints": 1},
            "trials": {
                "experiments": ["ID.2", "ID.3-static", "ID.4", "VD.3"],
                "rate": 200.0,
                "id2": {"strokes": 2, "stroke_time": 3.0},
                "id3_static": {"step": 20.0},
                "vd3": {"repeats": repeats, "motions": 2, "duration": 8.0, "centre": 0.4, "amplitude": 0.3},
            },
        }
    )
    return simulate(recipe, seed=0, plant=SpecimenPlant(specimen))


@pytest.fixture(scope="module")
def session(specimen):
    return recorded(specimen)


@pytest.fixture(scope="module")
def problem(session):
    return build(session, Recipe())


@pytest.fixture(scope="module")
def scaled(session):
    """The same session recorded with a torque sensor whose gain is off by a fifth."""
    return build(with_gain(session, GAIN), Recipe())


def with_gain(session, gain):
    scaled = (t if t.joint_torque is None else replace(t, joint_torque=(1.0 + gain) * t.joint_torque) for t in session)
    return replace(session, trials={t.name: t for t in scaled})


@pytest.mark.long
@pytest.mark.parametrize("missing", [(), ("ID.3-static",)])
def test_damping_without_its_own_experiment_is_fitted_where_else_it_shows(specimen, missing):
    """The stages fit it on the moves between holds; without ID.3-static the diagnosis fits it on the free motion."""
    session = recorded(specimen, repeats=4)
    trials = {t.name: t for t in session if t.experiment not in missing}
    problem = build(replace(session, trials=trials), Recipe())
    damping = [i for i, p in enumerate(describe(problem.nominal)) if p.group == "damping"]
    assert bool(set(damping) & set(problem.fit.estimated)) == (not missing)
    assert set(damping) <= set(problem.free)
    fit, truth = nominal_fit(problem).fit, np.asarray(ravel(true_model(specimen)))
    error = np.asarray(ravel(fit.model))[damping] - truth[damping]
    assert np.all(np.abs(error) < 4.0 * fit.std[damping])
    assert np.all(truth[damping] > 3.0 * fit.std[damping])  # The trials do determine it.


def test_a_rotor_moves_within_the_uncertainty_that_the_description_states(session):
    """As masses do: else a mass, or a cause, would make up for what is known to be uncertain. The finger has none."""
    finger = replace(session.finger, rotor_inertia=np.array([1e-4]), rotor_inertia_std=np.array([1e-4]))
    fit = nominal_fit(build(replace(session, finger=finger), Recipe())).fit
    (rotor,) = [i for i, p in enumerate(describe(fit.model)) if p.group == "rotor_inertia"]
    assert fit.std[rotor] < 2e-5
    assert abs(np.asarray(ravel(fit.model))[rotor]) < 4.0 * fit.std[rotor]


def test_a_problem_moves_along_its_own_jacobian(problem):
    """For steps of a thousandth of a standard deviation, exact residuals change as the Jacobian says."""
    step = 1e-3 / np.linalg.norm(np.vstack([problem.J, problem.root]), axis=0)
    there = moved(problem, step)
    np.testing.assert_allclose(there.r - problem.r, -problem.J @ step, atol=1e-6)
    np.testing.assert_allclose(there.offset - problem.offset, problem.root @ step, atol=1e-12)


def planted(problem, **values):
    """The problem with a pre-sliding in its residuals, its baseline, and the variant to fit."""
    kind, site = CATALOGUE["joint_presliding"], (problem.nominal.finger.joint_names[0],)
    effect = kind.at(problem.nominal.finger, site, **values)
    there = replace(problem, r=problem.r + Signatures(problem).white_changes([effect])[0])
    return (
        there,
        Baseline.of(there, Parameters()),
        Variant(kind, site, tuple((n, values[n]) for n in ("x0", "delta")), scales=there.scales),
    )


@pytest.mark.parametrize(("share", "start"), [(0.5, 1.0), (3.0, 0.5)])
def test_a_share_is_at_most_one_and_leaves_that_bound_where_it_is_less(problem, share, start):
    """The residuals hold a friction whose planted share builds up over 20 mrad."""
    there, baseline, variant = planted(problem, a=share, x0=0.02, delta=1.0)
    found = fit_at_nominal(
        baseline, there, [variant.with_shape(x0=0.016).at(there.nominal.finger, {"a": start})], plain(baseline)
    )
    assert float(found.effects[0].a) == pytest.approx(min(share, 1.0), abs=0.1 if share < 1.0 else 0.0)


@pytest.mark.parametrize("start", [(1.0, 0.014), (0.3, 0.04)])
def test_a_length_is_found_while_the_share_stays_at_its_upper_bound(problem, start):
    """Trials determine little more than the product of share and length; both starts lead to the same optimum."""
    there, baseline, variant = planted(problem, a=1.0, x0=0.02, delta=0.5)
    a, x0 = start
    found = fit_at_nominal(
        baseline, there, [variant.with_shape(x0=x0).at(there.nominal.finger, {"a": a})], plain(baseline)
    )
    assert float(found.effects[0].x0) == pytest.approx(0.02, abs=0.003)
    assert found.effects[0].delta == 0.5


def test_an_amplitude_that_changes_nothing_keeps_a_size(session):
    """An amplitude of warm-up scales the Coulomb friction, which this model has none of."""
    terms = tuple(t for t in ModelRecipe().terms if t != "joint_coulomb")
    problem = build(session, Recipe(model=ModelRecipe(terms=terms)))
    baseline = Baseline.of(problem, Parameters())
    kind, site = CATALOGUE["joint_friction_warmup"], problem.nominal.finger.joint_names[:1]
    effect = kind.at(problem.nominal.finger, site, a=0.3, d=1e-4, T=100.0, by=0.0)
    beside = CATALOGUE["joint_torque_friction"].at(problem.nominal.finger, site, mu=0.1)
    found = fit_at_nominal(baseline, problem, [beside, effect], plain(baseline))
    assert np.isfinite(found.score)
    assert abs(float(found.effects[1].a)) <= 0.3


@pytest.mark.parametrize(("scores", "kept"), [((-704.9, -705.3), 1), ((-704.9, -704.8), 1), ((-704.9, -706.0), 0)])
def test_the_later_of_two_rounds_of_one_score_is_kept(problem, monkeypatch, scores, kept):
    """Both scores are of optima of linearisations. The later round starts there, so that its values are nearer to it.

    In a column that the null leaves unexplained the first round has low weights, which shrink amplitudes.
    """
    baseline = Baseline.of(problem, Parameters())
    fit = baseline.null.linear_fit
    fits = [replace(fit, evidence=fit.evidence._replace(score=score)) for score in scores]
    rounds = [replace(baseline.null, linear_fit=fit) for fit in fits]
    left = iter(rounds)
    monkeypatch.setattr("jaxfinger.gap.exact.fit_at_nominal", lambda *_: next(left))
    monkeypatch.setattr("jaxfinger.gap.exact._with_nominal_refitted", lambda _, state, weights: state)
    assert fit_set(baseline, problem, [], [], plain(baseline)) is rounds[kept]


@pytest.mark.parametrize("gain", [0.02, 0.1])
def test_the_nominal_model_alone_is_fitted_as_well_as_with_causes(session, gain):
    """Otherwise any cause could name itself by the moves of the nominal model that it brings."""
    problem = build(with_gain(session, gain), Recipe())
    baseline = Baseline.of(problem, Parameters())
    assert baseline.unexplained.sum() > 20.0
    assert baseline.null.score >= baseline.start.score
    none = fit_set(baseline, problem, [], [], baseline.null.linear_fit.weights)
    assert none.score < baseline.null.score + MIN_SCORE_GAIN


def led(scaled):
    baseline = Baseline.of(scaled, Parameters())
    variant = Variant(CATALOGUE["torque_sensor_scale"], ("torque_sensor",), (), scales=scaled.scales)
    return baseline, refit_from_plain(baseline, fit_set(baseline, scaled, [variant], [{"gain": 0.05}], plain(baseline)))


@pytest.mark.long
def test_a_large_effect_is_judged_where_it_leads(scaled):
    """A sensor's gain multiplies the refitted torques, so that one linearisation errs; the optimum of the formula is at
    the exact fit all the same.
    """
    baseline, state = led(scaled)
    exact = augmented_fit(scaled, state)
    (effect,) = exact.fit.model.effects
    nominal = np.asarray(ravel(exact.fit.model))[scaled.free] - np.asarray(ravel(scaled.nominal))[scaled.free]
    there = fit_at_nominal(baseline, moved(scaled, nominal), [effect], plain(baseline))
    assert float(state.effects[0].gain) == pytest.approx(GAIN, abs=0.005)
    assert float(effect.gain) == pytest.approx(GAIN, abs=0.005)
    assert state.score - baseline.null.score > 0.95 * (there.score - baseline.null.score) > 100.0


@pytest.mark.long
def test_where_a_set_has_led_is_the_exact_fit(scaled):
    """Its parameters lie within the intervals of the exact fit, and its parts miss as much as the whole model does."""
    baseline, state = led(scaled)
    quick, exact = as_refitted(baseline, scaled, state), augmented_fit(scaled, state)
    np.testing.assert_array_equal(quick.fit.estimated, exact.fit.estimated)
    i, std = exact.fit.estimated, exact.fit.std[exact.fit.estimated]
    shift = np.asarray(ravel(quick.fit.model) - ravel(exact.fit.model))[i]
    assert np.all(np.abs(shift) < 0.3 * std)
    np.testing.assert_allclose(quick.fit.std[i], std, rtol=1.5 * GAIN)
    for key, residuals in exact.residuals_of(quick.fit.model).items():
        np.testing.assert_allclose(quick.residuals_of(quick.fit.model)[key], residuals, atol=1e-12)


def test_where_a_joint_is_held_it_is_no_variable(problem):
    """A fixture holds the joint of ID.4, so that only noise moves it. A gap at middle tension, which a trial passes
    twice, is found at middle tension and not at an angle.
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
    """Moment arms that no stage has fitted show in the other residuals, and are not taken for noise."""
    problem = build(session.with_trials([t.name for t in session if t.experiment != "ID.2"]), Recipe())
    for rows in problem.rows.values():
        r = problem.r[rows.start : rows.start + rows.size]
        column = np.unique(np.stack([rows.channel, rows.column]), axis=1, return_inverse=True)[1].ravel()
        count = np.bincount(column)
        energy = np.bincount(column, r**2) / count
        assert np.all((energy > 0.5) & (energy < 1.5) | (count <= 100))


@pytest.mark.parametrize("condition", [1e1, 1e6])
def test_orthonormal_columns_span_the_matrix_at_any_condition(condition):
    rng = np.random.default_rng(0)
    U, V = (np.linalg.qr(rng.standard_normal((n, 20)))[0] for n in (2000, 20))
    A = U * np.geomspace(1.0, 1.0 / condition, 20) @ V.T
    Q, T = orthonormalise(A)
    np.testing.assert_allclose(Q.T @ Q, np.eye(20), atol=1e-13)
    np.testing.assert_allclose(A @ T, Q, atol=1e-15 * condition)
    np.testing.assert_allclose(Q @ (Q.T @ U), U, atol=1e-15 * condition)


def test_a_column_that_is_the_sum_of_others_adds_no_direction():
    A = np.random.default_rng(0).standard_normal((200, 3)) @ np.array(
        [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]]
    )
    Q, _ = orthonormalise(A)
    assert Q.shape == (200, 2)
    np.testing.assert_allclose(Q @ (Q.T @ A), A, atol=1e-12)


def test_validation_trials_alone_determine_the_nominal_model():
    """No stage fits anything, and while moment arms are zero, no trial shows tendon friction."""
    trials = {
        "rate": 200.0,
        "experiments": ["VD.1", "VD.2", "VD.3"],
        "vd3": {"repeats": 2, "motions": 2, "duration": 8.0, "centre": 0.4, "amplitude": 0.3},
    }
    session = simulate(recipe_from({"specimen": {"kind": "polynomial"}, "trials": trials}), seed=1)
    problem = build(session, Recipe())
    parameters = describe(problem.nominal)
    assert {parameters[i].tendon for i in problem.free if parameters[i].group == "tendon_friction"} == {
        k for k, active in zip(session.finger.tendon_names, session.finger.active, strict=True) if active
    }
    for e, rows in problem.rows.items():
        for number, c in enumerate(problem.stacks[e].experiment.channels):
            white = problem.r[rows.start + np.flatnonzero(rows.channel == number)]
            assert np.sqrt(np.mean(white**2)) < 1.2, (e, c)


def test_a_torque_that_never_changes_is_not_judged(session):
    first = next(iter(session.select("ID.3-static")))
    dead = replace(first, joint_torque=np.zeros_like(first.joint_torque))
    problem = build(replace(session, trials=session.trials | {first.name: dead}), Recipe())
    stack = problem.stacks["ID.3-static"]
    counts = np.asarray(stack.batch.mask["joint_torque"]).any(axis=(0, 2))
    assert [name for name, counted in zip(stack.trials, counts, strict=True) if not counted] == [first.name]


def test_what_no_trial_shows_at_the_optimum_is_undetermined(problem):
    """A tendon's loss that is zero at every tension depends on neither of its two parameters."""
    parameters = [describe(problem.nominal)[i] for i in problem.free]
    to_dead = np.array([-100.0 if p.group == "tendon_friction" and "a0" in p.name else 0.0 for p in parameters])
    fit = nominal_fit(moved(problem, to_dead)).fit
    unseen = np.array([p.group == "tendon_friction" for p in parameters])
    assert unseen.any()
    np.testing.assert_array_equal(np.isinf(fit.std[problem.free]), unseen)
