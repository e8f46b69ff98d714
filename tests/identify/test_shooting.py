"""VD.3 in the joint refinement: derivatives through sticking and sliding, accuracy of estimates and intervals."""

import importlib
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from jaxfinger.errors import UserError
from jaxfinger.experiments import prepare
from jaxfinger.identify import identify, refine
from jaxfinger.identify.ahead import ahead
from jaxfinger.identify.fit_with_noise import first_noise
from jaxfinger.identify.linearise import residuals_of, tangent
from jaxfinger.identify.parameters import Free, describe, ravel
from jaxfinger.identify.sensitivity import sensitivity
from jaxfinger.identify.shooting import AHEAD, shooting
from jaxfinger.identify.sources import sources_of
from jaxfinger.identify.starts import starts
from jaxfinger.model import Motion, external_torque, simulate, simulated_ahead
from jaxfinger.synthetic import recipe_from, specimen_of, true_model
from jaxfinger.synthetic import simulate as simulated

from .conftest import RECIPE


def recorded(seed: int, noise: float):
    """Session with motion under tension whose load cells have this noise, N."""
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


@pytest.mark.long
def test_a_prediction_is_the_simulation_from_its_start(short, staged):
    x = shooting(short).stack.batch.x
    b, k = 1, 7
    time = np.linspace(0.0, float(x.horizon[b, k]), x.tension_ahead.shape[0])
    q, _ = simulate(
        staged.model, jnp.asarray(time), x.tension_ahead[:, :, b, k].T, x.q[:, b, k], x.qd[:, b, k], substeps=1
    )
    np.testing.assert_allclose(simulated_ahead(staged.model, x)[:, b, k], q[:, -1], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("correlation_time", [0.03, 0.1])
def test_coloured_noise_of_load_cells_is_part_of_what_predictions_may_miss(correlation_time):
    """The true model misses nothing else. Slack tendons show the noise that no filter parts from the tension."""
    ratios = []
    for seed in range(3):
        trials = RECIPE["trials"] | {"experiments": ["ID.3-static", "VD.3"], "vd3": {"duration": 3.0, "rate": 500.0}}
        cell = {"std": 0.05, "resolution": 0.01, "coloured": 0.8, "correlation_time": correlation_time}
        recipe = recipe_from(RECIPE | {"trials": trials, "sensors": RECIPE["sensors"] | {"tendon_force": cell}})
        session = simulated(recipe, seed=seed)
        whole = prepare(session, [t.name for t in session if t.experiment == "VD.3"], reduced=False)["VD.3"]
        found = ahead(true_model(specimen_of(recipe.specimen)), session, whole)
        ratios.append([np.sqrt(np.nanmean(a.error**2)) / np.sqrt(np.mean(a.noise**2)) for a in found])
    assert (np.mean(ratios, axis=0) > 0.5).all()
    assert (np.mean(ratios, axis=0) < 1.5).all()


@pytest.mark.long
def test_a_step_of_the_simulation_costs_less_than_an_encoder(short, staged):
    """Steps a quarter as long change angles half a second ahead by less than an encoder's resolution."""
    rounds = recipe_from(RECIPE).sensors.q.resolution / np.sqrt(12.0)
    for m in shooting(short).trials:
        time, horizon = np.arange(0.0, m.time[-1] - 0.5, 0.1), 0.5
        coarse, fine = (
            simulated_ahead(staged.model, starts(m._replace(pace=pace), time, horizon)) for pace in (1.0, 0.25)
        )
        assert np.all(np.std(coarse - fine, axis=1) < rounds)


@pytest.mark.long
def test_sweeps_over_frictions_leave_less_than_an_encoder(short, staged, monkeypatch):
    """Eight times as many sweeps change angles 0.1 s ahead by less than an encoder's resolution."""
    rounds = recipe_from(RECIPE).sensors.q.resolution / np.sqrt(12.0)
    batch = shooting(short).stack.batch
    few = simulated_ahead(staged.model, batch.x)
    module = importlib.import_module("jaxfinger.model.simulate")
    monkeypatch.setattr(module, "SWEEPS", 8 * module.SWEEPS)
    change = np.where(batch.mask["q"] > 0, few - simulated_ahead(staged.model, batch.x), np.nan)
    assert np.nanmax(np.abs(change)) > 0.0
    assert np.all(np.nanstd(change, axis=(1, 2)) < rounds)


def beside_differences(model, shots, every):
    """Yield name, derivatives and difference quotients of the predicted angles, for each `every`-th parameter."""
    parameters, reads = describe(model), {AHEAD: ("q",)}
    noise = {(AHEAD, "q"): first_noise(shots.stack, "q", shots.stack.batch.y["q"])}
    source = sources_of({AHEAD: shots.stack}, reads, noise, parameters)[AHEAD]
    free = Free.at(model, source.positions)
    slopes = tangent(model, free, source.batch, ("q",)).slopes["q"]
    at = np.asarray(free.get(model))
    for k in range(0, at.size, every):
        h = 1e-6 * max(abs(at[k]), 1e-4) * np.eye(at.size)[k]
        up, down = (residuals_of(free.set(model, jnp.asarray(x)), source.batch, ("q",))["q"] for x in (at + h, at - h))
        yield parameters[source.positions[k]].name, slopes[k], (up - down) / (2.0 * h[k])


@pytest.mark.long
def test_derivatives_agree_with_differences_where_nothing_begins_to_stick(short, staged):
    shots = shooting(short)
    seen = np.asarray(shots.stack.batch.mask["q"]) > 0
    for name, slopes, differences in beside_differences(staged.model, shots, 9):
        error = np.abs(differences - slopes)[seen] / max(np.abs(slopes[seen]).max(), 1e-30)
        assert np.quantile(error, 0.9) < 1e-5, name


@pytest.mark.long
def test_derivatives_agree_with_differences_where_a_joint_at_rest_begins_to_slip(short, staged):
    """Tension rises until friction yields. Before, parameters change nothing; then they change the time of the slip."""
    shots = shooting(replace(short, trials={"rest": at_rest(short, staged.model)}))
    x = shots.stack.batch.x
    moved = np.abs(simulated_ahead(staged.model, x) - x.q)[0, 0]  # MCP, first trial
    begins = int(np.argmax(moved > 0.0))
    assert 0 < begins < moved.size - 1
    found = {name: (a[0, 0], b[0, 0]) for name, a, b in beside_differences(staged.model, shots, 5)}
    for name, (slopes, differences) in found.items():
        np.testing.assert_allclose([slopes[:begins], differences[:begins]], 0.0, atol=1e-12, err_msg=name)
        np.testing.assert_allclose(differences[begins], slopes[begins], rtol=1e-3, atol=1e-5, err_msg=name)
        np.testing.assert_allclose(differences, slopes, rtol=1e-5, atol=1e-5 * np.abs(slopes).max(), err_msg=name)
    assert found["friction torque MCP^0"][0][begins] > 1e-3  # more friction delays the slip


def at_rest(session, model):
    """Trial at rest while the tension of T3 rises from an equilibrium."""
    (trial, *_) = (t for t in session if t.experiment == "VD.3")
    time = np.arange(0.0, 2.0, 0.002)
    m, n = session.finger.m, session.finger.n
    q = np.tile(np.mean(trial.q, axis=0), (time.size, 1))

    def torque(f):
        still, slack = jnp.zeros((m, 1)), jnp.zeros((n, 1))
        zero = jnp.zeros(1)
        x = Motion(zero, jnp.asarray(q[:1].T), still, still, jnp.asarray(f)[:, None], still, slack, zero, still)
        return np.asarray(external_torque(model, x))[:, 0]

    active = np.flatnonzero(session.finger.active)
    low = np.where(session.finger.active, 1.0, 0.0)
    pulls = np.stack([torque(low) - torque(low + np.eye(n)[k]) for k in active], axis=1)
    more, short = scipy.optimize.nnls(pulls, torque(low))
    assert short < 1e-6
    tension = np.tile(low, (time.size, 1))
    tension[:, active] += more
    tension[:, session.finger.tendon_names.index("T3")] += 6.0 * time
    return replace(trial, name="rest", time=time, q=q, tendon_force=tension, tendon_excursion=None)


def beside_the_truth(fit, truth):
    """Errors of the determined estimates in their standard deviations."""
    seen = fit.estimated[(fit.std[fit.estimated] > 0) & np.isfinite(fit.std[fit.estimated])]
    return (values(fit) - truth)[seen] / fit.std[seen]


@pytest.fixture(scope="module")
def quiet():
    """A session with quiet load cells, and its staged fit."""
    session = recorded(0, 1e-4)
    return session, identify(session)


@pytest.mark.long
def test_motion_ahead_is_read_beside_the_other_trials_and_narrows_intervals(quiet):
    session, staged = quiet
    joint, both = refine(session, staged), refine(session, staged, ahead=True)
    assert both.stages[-1].name == AHEAD
    assert both.stages[-1].status == "fitted"
    assert both.stages[-1].trials == tuple(t.name for t in session if t.experiment == "VD.3")
    ratio = both.std[joint.estimated] / np.where(joint.std > 0.0, joint.std, 1.0)[joint.estimated]
    assert np.nanmedian(ratio) < 0.99


@pytest.mark.long
def test_motion_ahead_brings_the_loss_of_a_tendon_nearer_to_the_truth(quiet, truth):
    """T2 crosses all joints. Free motion determines parts of its friction that held joints do not."""
    session, staged = quiet
    fitted, names = refine(session, staged, ahead=True), [p.name for p in describe(staged.model)]
    for name in ("tendon friction T2 a0", "tendon friction T2 a1"):
        i = names.index(name)
        before, after = (abs(values(fit)[i] - truth[i]) for fit in (staged, fitted))
        assert after < 0.5 * before
        assert after < 1.96 * fitted.std[i]


@pytest.mark.long
def test_a_motion_that_no_fit_has_seen_is_predicted_better(quiet):
    """A fit of one motion reduces the squared errors of the other, relative to noise, at every horizon."""
    session, staged = quiet
    seen, unseen = (t.name for t in session if t.experiment == "VD.3")
    fitted = refine(session.with_trials([t.name for t in session if t.name != unseen]), staged, ahead=True)
    assert seen in fitted.stages[-1].trials
    stack = prepare(session, [unseen], reduced=False)["VD.3"]
    for before, after in zip(*(ahead(fit.model, session, stack) for fit in (staged, fitted)), strict=True):
        assert np.nanmean((after.error / before.noise) ** 2) < np.nanmean((before.error / before.noise) ** 2)


@pytest.mark.long
@pytest.mark.parametrize(("seed", "noise"), [(0, 1e-4), (0, 0.03), (1, 0.03), (2, 0.03)])
def test_intervals_hold_also_where_load_cells_are_noisy(truth, seed, noise):
    """Noise biases predictions. Without the correction single estimates are wrong by 11 standard deviations."""
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
