"""Programs compiled for a common shape agree with the plain equations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxfinger.effects import CATALOGUE
from jaxfinger.experiments import SAMPLES, TRIALS, blocks, in_rows, padded_size, predict, prepare, shapes
from jaxfinger.identify.fit_with_noise import first_noise
from jaxfinger.identify.linearise import (
    _tangent,
    linearise,
    residuals_by_tangent,
    residuals_of,
    robust_residuals,
    tangent,
    white_rows,
)
from jaxfinger.identify.parameters import Free, describe
from jaxfinger.identify.solve import Tangents
from jaxfinger.identify.sources import residuals_each, sources_of

EXPERIMENT, CHANNELS = "ID.4", ("joint_torque", "tendon_excursion")


@given(st.integers(1, 10**6), st.sampled_from([2, 8, 256, 512]))
def test_a_stack_has_room_and_less_than_as_much_again(size, least):
    room = padded_size(size, least)
    assert size <= room < max(least + 1, 2 * size)
    assert padded_size(room, least) == room


def test_blocks_hold_every_trial_once_and_count_no_other(stack):
    """All blocks have one shape, whatever the number of trials."""
    batch = jax.tree.map(lambda a: np.concatenate([a, a, a], axis=-2), stack.batch)
    parts, (B, T) = [block.batch for block in blocks(batch)], batch.x.time.shape
    assert len(parts) > 1
    assert B % TRIALS
    assert {part.x.time.shape for part in parts} == {(TRIALS, padded_size(T, SAMPLES))}
    for c in CHANNELS:
        mask, y = (np.concatenate([getattr(p, name)[c] for p in parts], axis=1) for name in ("mask", "y"))
        np.testing.assert_array_equal(mask[:, :B, :T], batch.mask[c])
        np.testing.assert_array_equal(y[:, :B, :T], batch.y[c])
        assert mask.sum() == np.sum(batch.mask[c])


@pytest.mark.parametrize("count", [1, 3, 17])
def test_rows_hold_every_sample_once_and_in_order(stack, count):
    some = jax.tree.map(lambda a: a[..., :1, :7].repeat(count, axis=-2), stack.batch)
    rows, (B, T) = in_rows(some), some.x.time.shape
    assert rows.x.time.shape == (TRIALS, -(-B * T // TRIALS))
    for c in CHANNELS:
        whole = rows.y[c].reshape(len(rows.y[c]), -1)[:, : B * T]
        np.testing.assert_array_equal(whole.reshape(some.y[c].shape), some.y[c])
        assert rows.mask[c].sum() == some.mask[c].sum()


@pytest.fixture(scope="module")
def stack(short):
    return prepare(short, [t.name for t in short if t.experiment == EXPERIMENT])[EXPERIMENT]


EFFECTS = (("tendon_stretch", {"compliance": 2e-5}), ("tendon_friction_presliding", {"a": 0.5}))


@pytest.mark.long
@pytest.mark.parametrize("effects", [(), EFFECTS], ids=["nominal", "with effects"])
def test_the_common_shape_changes_no_derivative(stack, short_truth, effects):
    """Derivatives computed part by part are exact, too."""
    members = tuple(CATALOGUE[e].at(short_truth.model.finger, ("T1",), **values) for e, values in effects)
    model = eqx.tree_at(lambda m: m.effects, short_truth.model, members, is_leaf=lambda v: isinstance(v, tuple))
    parameters = describe(model)
    noise = {(EXPERIMENT, c): first_noise(stack, c, stack.batch.y[c]) for c in CHANNELS}
    source = sources_of({EXPERIMENT: stack}, {EXPERIMENT: CHANNELS}, noise, parameters)[EXPERIMENT]
    of_effects = [i for i, p in enumerate(parameters) if p.group == "effects"]
    free = Free.at(model, np.union1d(source.positions, of_effects).astype(int))

    def white(theta):
        return white_rows(free.set(model, theta), stack.batch, source.filters)[1]

    theta = jnp.asarray(free.get(model))
    r, J = map(np.asarray, jax.jit(lambda theta: (white(theta), jax.jacfwd(white)(theta)))(theta))
    limit = 0.5 * float(np.abs(r).max())  # some rows lie beyond it
    found = linearise(model, free, stack.batch, source.filters, limit)
    np.testing.assert_allclose(found.white, r, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.jacobian, J, rtol=1e-7, atol=1e-7 * np.abs(J).max())
    s, J_s = jax.jvp(lambda r: robust_residuals(r, limit), (jnp.asarray(r),), (jnp.ones_like(r),))
    assert np.any(np.asarray(J_s) < 1.0)
    whole = np.concatenate([J * np.asarray(J_s)[..., None], np.asarray(s)[..., None]], axis=-1)
    expected = np.einsum("brp,brq->bpq", whole, whole)
    scale = np.sqrt(np.einsum("bpp->bp", expected)).max(axis=0)
    seen = scale > 1e-10 * scale.max()  # f(q) of held joints contributes rounding alone
    assert seen.sum() > 20
    gram = np.einsum("bkp,bkq->bpq", found.factor, found.factor)
    gram, expected = ((x / (scale + 1e-300) / (scale + 1e-300)[:, None])[:, seen][:, :, seen] for x in (gram, expected))
    np.testing.assert_allclose(gram, expected, atol=1e-9)


def test_the_common_shape_changes_no_residual(stack, short_truth):
    """The program of residuals and that of derivatives agree with the prediction."""
    model = short_truth.model
    noise = {(EXPERIMENT, c): first_noise(stack, c, stack.batch.y[c]) for c in CHANNELS}
    source = sources_of({EXPERIMENT: stack}, {EXPERIMENT: CHANNELS}, noise, describe(model))[EXPERIMENT]
    predicted = predict(model, stack.batch.x, CHANNELS)
    alone = residuals_of(model, stack.batch, CHANNELS)
    beside = residuals_by_tangent(model, Free.at(model, source.positions), source.batch, CHANNELS)
    for c in CHANNELS:
        np.testing.assert_allclose(alone[c], stack.batch.y[c] - predicted[c], atol=1e-12)
        np.testing.assert_allclose(beside[c], stack.batch.y[c] - predicted[c], atol=1e-12)


def test_derivatives_by_some_parts_are_those_of_all_of_them(stack, short_truth):
    model, some = short_truth.model, ("tendon_friction",)
    positions = [i for i, p in enumerate(describe(model)) if p.group in ("elastic", "moment_arm", "tendon_friction")]
    free = Free.at(model, np.array(positions))
    whole, part = (tangent(model, free, stack.batch, CHANNELS, parts) for parts in (None, some))
    mine = np.repeat([p in some for p in free.parts], [e.size for e in free.entries])
    for c in CHANNELS:
        np.testing.assert_array_equal(part.residuals[c], whole.residuals[c])
        np.testing.assert_array_equal(part.slopes[c], np.where(mine[:, None, None, None], whole.slopes[c], 0.0))
    assert whole.slopes["joint_torque"][mine].any()
    assert whole.slopes["joint_torque"][~mine].any()


def test_a_trial_that_is_cut_keeps_its_residuals(short, short_truth, monkeypatch):
    monkeypatch.setattr(shapes, "PIECE", SAMPLES)
    moving = prepare(short, [t.name for t in short if t.experiment == "ID.3-dynamic"])["ID.3-dynamic"].batch
    assert moving.x.time.shape[1] > SAMPLES
    found = residuals_of(short_truth.model, moving, ("joint_torque",))["joint_torque"]
    predicted = predict(short_truth.model, moving.x, ("joint_torque",))["joint_torque"]
    np.testing.assert_allclose(found, moving.y["joint_torque"] - predicted, atol=1e-12)


def test_an_experiment_that_shows_no_effect_is_predicted_without(stack, short_truth):
    effect = CATALOGUE["tendon_stretch"].at(short_truth.model.finger, ("T1",), compliance=2e-5)
    model = eqx.tree_at(lambda m: m.effects, short_truth.model, (effect,), is_leaf=lambda v: isinstance(v, tuple))
    noise = {(EXPERIMENT, c): first_noise(stack, c, stack.batch.y[c]) for c in CHANNELS}
    plain = describe(short_truth.model)
    source = sources_of({EXPERIMENT: stack}, {EXPERIMENT: CHANNELS}, noise, plain)[EXPERIMENT]
    silent = residuals_each(model, {EXPERIMENT: source._replace(effects=False)})[EXPERIMENT]
    nominal, shown = (residuals_each(m, {EXPERIMENT: source})[EXPERIMENT] for m in (short_truth.model, model))
    for c in CHANNELS:
        np.testing.assert_array_equal(silent[c], nominal[c])
    assert np.abs(shown["tendon_excursion"] - nominal["tendon_excursion"]).max() > 5e-5


def test_no_program_that_runs_beside_another_calls_lapack(short, short_truth):
    """Two programs that do can deadlock."""
    model, parameters = short_truth.model, describe(short_truth.model)
    stacks = prepare(short)
    reads = {e: stack.experiment.channels for e, stack in stacks.items()}
    assert "fingertip_force" in reads["VD.2"]
    noise = {(e, c): first_noise(stacks[e], c, stacks[e].batch.y[c]) for e in reads for c in reads[e]}
    for source in sources_of(stacks, reads, noise, parameters).values():
        free = Free.at(model, source.positions)
        program = _tangent.lower(
            model, free, blocks(source.batch)[0].batch, tuple(source.filters), jnp.ones(len(set(free.parts)), bool)
        )
        assert "lapack" not in program.as_text()


@pytest.mark.parametrize("limit", [0.0, 3.0])
def test_what_is_affine_moves_along_its_tangent_exactly(short, short_truth, limit):
    """Residuals, white rows and factors equal those of a new linearisation."""
    (name, channel), rng = ("ID.2", "tendon_excursion"), np.random.default_rng(0)
    trials = prepare(short, [t.name for t in short if t.experiment == name])[name]
    noise = {(name, channel): first_noise(trials, channel, trials.batch.y[channel])}
    parameters = describe(short_truth.model)
    source = sources_of({name: trials}, {name: (channel,)}, noise, parameters)[name]
    source = source._replace(weights=rng.uniform(0.0, 2.0, len(trials.trials)))
    free = Free.at(short_truth.model, source.positions)
    start = np.asarray(free.get(short_truth.model))
    there = free.set(short_truth.model, jnp.asarray(start * rng.uniform(0.9, 1.1, start.size)))
    tangents = Tangents()
    first = tangents.at(name, short_truth.model, source, limit, affine=True)
    moved = tangents.at(name, there, source, limit, affine=True)
    anew = Tangents().at(name, there, source, limit, affine=True)
    assert np.abs(moved.white - first.white).max() > 1.0
    np.testing.assert_allclose(moved.residuals[channel], anew.residuals[channel], atol=1e-12)
    np.testing.assert_allclose(moved.white, anew.white, atol=1e-7)
    found, expected = (np.einsum("bkp,bkq->bpq", lin.factor, lin.factor) for lin in (moved, anew))
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10 * expected.max())
