"""VD.3 in the joint refinement: derivatives through sticking and sliding, and what motion ahead tells of a damping."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import identify, refine
from jaxfinger.identify.linearise import residuals_of, tangent
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.sensitivity import sensitivity
from jaxfinger.identify.shooting import AHEAD, shooting
from jaxfinger.identify.stages import sources_of
from jaxfinger.model import simulate, simulated_ahead
from jaxfinger.synthetic import recipe_from
from jaxfinger.synthetic import simulate as simulated

from .conftest import RECIPE


def recorded(seed: int, noise: float):
    """A session with motion under tension whose load cells have that noise, N."""
    trials = RECIPE["trials"] | {
        "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic", "ID.4", "VD.3"],
        "vd3": {"motions": 2, "duration": 2.0, "rate": 500.0},
    }
    sensors = RECIPE["sensors"] | {"tendon_force": {"std": noise, "resolution": noise}}
    return simulated(recipe_from(RECIPE | {"trials": trials, "sensors": sensors}), seed=seed)


@pytest.fixture(scope="module")
def staged(short):
    return identify(short)


def values(fit):
    return np.asarray(ravel(fit.model))


def test_a_prediction_is_the_simulation_from_its_start(short, staged):
    x = shooting(short).stack.batch.x
    b, k = 1, 7
    time = np.linspace(0.0, float(x.horizon[b, k]), x.tension_ahead.shape[0])
    q, _ = simulate(
        staged.model, jnp.asarray(time), x.tension_ahead[:, :, b, k].T, x.q[:, b, k], x.qd[:, b, k], substeps=1
    )
    np.testing.assert_allclose(simulated_ahead(staged.model, x)[:, b, k], q[:, -1], atol=1e-12)


def test_derivatives_agree_with_differences_where_nothing_begins_to_stick(short, staged):
    shots = shooting(short)
    parameters, reads = describe(staged.model), {AHEAD: ("q",)}
    source = sources_of({AHEAD: shots.stack}, reads, {(AHEAD, "q"): shots.noise(staged.model)}, parameters)[AHEAD]
    free = Free.at(staged.model, source.positions)
    slopes = tangent(staged.model, free, source.batch, ("q",)).slopes["q"]
    at, seen = np.asarray(free.get(staged.model)), np.asarray(source.batch.mask["q"]) > 0
    for k in range(0, at.size, 9):
        h = 1e-6 * max(abs(at[k]), 1e-6) * np.eye(at.size)[k]
        up, down = (
            residuals_of(free.set(staged.model, jnp.asarray(x)), source.batch, ("q",))["q"] for x in (at + h, at - h)
        )
        error = np.abs((up - down) / (2.0 * h[k]) - slopes[k])[seen] / max(np.abs(slopes[k][seen]).max(), 1e-30)
        assert np.quantile(error, 0.9) < 1e-5, parameters[source.positions[k]].name


def beside_the_truth(fit, truth):
    """How many standard deviations every estimate that has one is off."""
    seen = fit.estimated[(fit.std[fit.estimated] > 0) & np.isfinite(fit.std[fit.estimated])]
    return (values(fit) - truth)[seen] / fit.std[seen]


@pytest.mark.long
def test_motion_ahead_is_read_beside_the_other_trials_and_narrows_intervals(short, staged):
    joint, both = refine(short, staged), refine(short, staged, ahead=True)
    assert both.stages[-1].name == AHEAD
    assert both.stages[-1].status == "fitted"
    assert both.stages[-1].trials == tuple(t.name for t in short if t.experiment == "VD.3")
    ratio = both.std[joint.estimated] / np.where(joint.std > 0.0, joint.std, 1.0)[joint.estimated]
    assert np.nanmedian(ratio) < 0.99


@pytest.mark.long
@pytest.mark.parametrize(("seed", "noise"), [(0, 1e-4), (0, 0.03), (1, 0.03), (2, 0.03)])
def test_intervals_hold_also_where_load_cells_are_noisy(truth, seed, noise):
    """Noise bends predictions: where a fit takes them as they are, single estimates are 11 standard deviations off."""
    session = recorded(seed, noise)
    z = beside_the_truth(refine(session, identify(session), ahead=True), truth)
    assert np.sqrt(np.mean(z**2)) < 1.3
    assert np.abs(z).max() < 4.0


def test_what_reads_no_motion_ahead_refuses_a_fit_that_did(short, staged):
    fit = replace(staged, stages=(*staged.stages, replace(staged.stages[-1], name=AHEAD)))
    with pytest.raises(UserError, match="was refined with --ahead; give one without it"):
        sensitivity(fit, short)


def test_what_cannot_be_refined_ahead_is_refused(short, staged):
    with pytest.raises(UserError, match=r"has no VD\.3 trial that tendons drive"):
        refine(short.select("ID.2", "ID.4"), staged, ahead=True)
    (trial, *_) = (t for t in short if t.experiment == "VD.3")
    cut = replace(trial, **{c: getattr(trial, c)[:40] for c in ("time", "q", "tendon_force", "tendon_excursion")})
    with pytest.raises(UserError, match=f"trial {trial.name} is shorter than 0.1 s"):
        refine(replace(short, trials={cut.name: cut}), staged, ahead=True)
