"""Sensitivities of the parameters against refits."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.experiments import prepare
from jaxfinger.identify import identify
from jaxfinger.identify.nominal import cad_prior, nominal_model
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.resample import plan_of
from jaxfinger.identify.sensitivity import sensitivity
from jaxfinger.identify.solve import solve
from jaxfinger.identify.sources import sources_of

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def one_of_each(session):
    """Every second trial, which is one of the two repeats of each motion."""
    return session.with_trials([t.name for t in list(session)[::2]])


@pytest.fixture(scope="module")
def fit(one_of_each):
    return identify(one_of_each)


@pytest.fixture(scope="module")
def found(fit, one_of_each):
    return sensitivity(fit, one_of_each, to="trials")["trials"]


def test_what_a_fit_is_without_a_trial_is_said_without_a_refit(fit, found, one_of_each):
    """Compared for the trial with the largest finite shift."""
    shifts = found.shifts(fit)
    k = int(np.argmax(np.abs(np.nan_to_num(shifts, posinf=0.0)).max(axis=1)))
    rest = identify(one_of_each.with_trials([t.name for t in one_of_each if t.name != found.names[k]]))
    moved = np.asarray(ravel(rest.model) - ravel(fit.model))[fit.estimated] / fit.std[fit.estimated]
    seen = np.isfinite(shifts[k])
    assert np.abs(moved[seen]).max() > 0.5
    np.testing.assert_allclose(shifts[k][seen], moved[seen], atol=0.15 * np.abs(moved[seen]).max())


def test_what_one_trial_alone_tells_of_is_unknown_without_it(one_of_each):
    """The only trial of ID.2 at a joint alone determines the moment arms there."""
    (trial,) = [t for t in one_of_each if t.experiment == "ID.2" and t.joint == "DIP"][:1]
    others = [t for t in one_of_each if t.experiment == "ID.2" and t.joint == "DIP" and t is not trial]
    session = one_of_each.with_trials([t.name for t in one_of_each if t not in others])
    alone = sensitivity(again := identify(session), session, to="trials")["trials"]
    shifts = alone.shifts(again)[alone.names.index(trial.name)]
    parameters = [describe(again.model)[i] for i in again.estimated]
    arms = np.array([p.group == "moment_arm" and p.joint == "DIP" for p in parameters])
    assert np.isinf(shifts[arms]).all()
    assert np.isfinite(shifts[~arms]).all()


def test_the_fit_of_other_trials_is_refused(fit, session):
    """Repeats of the same motions are other trials, too."""
    with pytest.raises(UserError, match="give the session that it was made from"):
        sensitivity(fit, session.with_trials([t.name for t in list(session)[1::2]]), to="trials")


def refit(fit, session, of=None, weight=None, gain=None):
    """Refit stage after stage from the fit to convergence, under its noise.

    `of`: the session as it was fitted, where the finger of `session` is another. `weight`: a trial and its weight.
    `gain`: a tendon and the factor on its excursions.
    """
    parameters, plan, stacks, model = describe(fit.model), plan_of(session, fit), prepare(session), fit.model
    given = np.setdiff1d(np.arange(len(parameters)), np.concatenate([free for _, free in plan]))
    own, was = (np.asarray(ravel(nominal_model(s, fit.recipe)))[given] for s in (session, of or session))
    model = Free.at(model, given).set(model, jnp.asarray(np.asarray(ravel(model))[given] + own - was))
    for reads, free in plan:
        sources = sources_of(stacks, reads, fit.noise, parameters)
        for e, source in sources.items():
            if weight and weight[0] in stacks[e].trials:
                weights = np.where(np.array(stacks[e].trials) == weight[0], weight[1], 1.0)
                sources[e] = source._replace(weights=weights)
            if gain and "tendon_excursion" in source.batch.y:
                scaled = source.batch.y["tendon_excursion"].at[gain[0]].multiply(gain[1])
                batch = eqx.tree_at(lambda b: b.y["tendon_excursion"], source.batch, scaled)
                sources[e] = source._replace(batch=batch)
        prior = cad_prior(session, fit.recipe, parameters, free)
        model, _ = solve(model, free, sources, prior, fit.recipe.fit.huber, tolerance=1e-9)
    return np.asarray(ravel(model))


def heavier(session, joint: int, mass: float):
    """Session whose link is heavier by `mass`, kg, with inertia in proportion."""
    f = session.finger
    masses = f.mass + mass * (np.arange(f.m) == joint)
    return replace(session, finger=replace(f, mass=masses, inertia=f.inertia * (masses / f.mass)[:, None, None]))


@pytest.mark.parametrize("kind", ["trials", "sensors", "cad"])
def test_derivatives_are_those_of_refits_under_the_same_noise(fit, one_of_each, kind):
    """Steps are so short that hardly a sample crosses Huber's limit, where the second derivative jumps."""
    session, finger = one_of_each, one_of_each.finger
    name, step, refitted = {
        "trials": ("01-ID.2-MCP-a", 1e-3, lambda h: refit(fit, session, weight=("01-ID.2-MCP-a", 1.0 + h))),
        "sensors": (f"excursion {finger.tendon_names[1]}", 1e-4, lambda h: refit(fit, session, gain=(1, 1.0 + h))),
        "cad": (f"mass {finger.joint_names[1]}", 1e-7, lambda h: refit(fit, heavier(session, 1, h), of=session)),
    }[kind]
    found = sensitivity(fit, session, to=kind)[kind]
    seen = fit.estimated[np.isfinite(fit.std[fit.estimated])]
    std = fit.std[seen]
    derivative = found.values[found.names.index(name)][seen] / std
    difference = (refitted(step) - refitted(-step))[seen] / (2.0 * step) / std
    assert np.linalg.norm(difference - derivative) < 1e-4 * np.linalg.norm(derivative)
