"""Memory operators against loops that integrate the differential equations of their docstrings in small steps."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d
from scipy.special import exp1

from jaxfinger.data import filter_std, low_pass, smooth
from jaxfinger.effects import CATALOGUE
from jaxfinger.effects.presliding import dahl
from jaxfinger.effects.sensors import read_later
from jaxfinger.model import excursion, joint_tension, memories
from jaxfinger.model.dynamics import terms
from jaxfinger.model.rigid_body import inverse_dynamics
from tests.effects.motion import MODEL, motion, with_effects

FINGER = MODEL.finger
X = motion()
TIME = np.asarray(X.time)
FINE = 400  # steps of the loop between two samples


def state(effect):
    return memories(with_effects(effect), X)[0]


def fine(values):
    """Time and values interpolated linearly, `FINE` steps per sample."""
    t = np.linspace(TIME[0], TIME[-1], FINE * (TIME.size - 1) + 1)
    return t, np.interp(t, TIME, np.asarray(values))


def test_dahl_friction_builds_up_over_its_angle():
    _, q = fine(X.q[1])
    z = np.zeros(q.size)
    for t in range(1, q.size):
        dq = q[t] - q[t - 1]
        z[t] = z[t - 1] + (dq - abs(dq) * z[t - 1]) / 0.06
    found = state(CATALOGUE["joint_presliding"].at(FINGER, (FINGER.joint_names[1],), x0=0.06))
    # Between samples the operator sees a straight line: a reversal inside a step is seen at its end.
    np.testing.assert_allclose(found, z[::FINE], atol=2e-3)


def test_dahl_friction_of_the_power_a_half_is_that_of_many_springs_that_slip_one_after_the_other():
    """Maxwell slip: parallel springs of one stiffness that slip at evenly spread travels up to `strongest`."""
    strongest, x = 0.02, np.linspace(0.0, 0.05, 101)
    strengths = strongest * (np.arange(20_000) + 0.5) / 20_000
    expected = [np.sum(np.clip(-strengths + dx, -strengths, strengths)) / np.sum(strengths) for dx in x]
    found = dahl(jnp.full(x.shape, -1.0), jnp.asarray(x) / (strongest / np.sqrt(2.0)), jnp.asarray(0.5))
    np.testing.assert_allclose(found, expected, atol=1e-4)


@pytest.mark.parametrize("delta", [1.0, 0.5])
def test_dahl_friction_does_not_depend_on_the_step_and_stays_where_nothing_moves(delta):
    length, delta = jnp.asarray(0.01), jnp.asarray(delta)
    z = jnp.asarray(0.3)
    for _ in range(10):
        z = dahl(z, -1e-3 / length, delta)
    np.testing.assert_allclose(z, dahl(jnp.asarray(0.3), -1e-2 / length, delta), atol=1e-12)
    assert dahl(z, jnp.asarray(0.0), delta) == z
    for built_up in (-1.0, 0.3, 1.0):
        slope = jax.grad(lambda length, z: dahl(z, 2e-3 / length, delta))(length, jnp.asarray(built_up))
        assert np.isfinite(slope)


RECORDED = 1000.0  # Hz
CUTOFF = 10.0


@pytest.mark.parametrize(
    ("name", "site", "values", "leaf"),
    [
        ("joint_presliding", FINGER.joint_names[1], {"x0": 0.006}, 0),
        ("tendon_friction_presliding", "T1", {"x0": 6e-5}, 0),
        ("tendon_backlash", "T1", {"width": 1e-4}, 1),
    ],
)
def test_a_sharp_memory_is_what_the_low_pass_and_the_mean_leave_of_it(name, site, values, leaf):
    """The memory at 50 Hz of angles below 10 Hz equals the memory at 1 kHz, filtered and averaged."""
    effect = CATALOGUE[name].at(FINGER, (site,), **values)
    x = motion(int(RECORDED), RECORDED)

    def memory(x):
        return np.asarray(jax.tree.leaves(memories(with_effects(effect), x))[leaf])

    truth = memory(x)
    expected = low_pass(np.asarray(x.time), truth, CUTOFF).reshape(-1, 20).mean(axis=1)

    def block(a):
        return jnp.asarray(np.asarray(a).reshape(*a.shape[:-1], -1, 20).mean(axis=-1))

    q, qd, qdd = smooth(np.asarray(x.time), np.asarray(x.q).T, CUTOFF)
    seen = jax.tree.map(block, replace(x, q=jnp.asarray(q.T), qd=jnp.asarray(qd.T), qdd=jnp.asarray(qdd.T)))
    at_samples, shown = memory(seen), memory(replace(seen, blur=jnp.full_like(seen.time, filter_std(CUTOFF))))
    inner = slice(5, -5)
    error, before = (np.abs(z - expected)[inner].max() / np.ptp(truth) for z in (shown, at_samples))
    assert error < 0.02
    assert error < 0.1 * before


def test_an_axis_without_tendons_has_a_memory_too():
    effect = CATALOGUE["joint_presliding"].at(FINGER, (FINGER.joint_names[1],), x0=0.006)
    x = replace(X, blur=jnp.full_like(X.time, filter_std(CUTOFF)))
    bare = replace(x, tension=x.tension[:0], tendon_direction=x.tendon_direction[:0])
    np.testing.assert_array_equal(*(memories(with_effects(effect), y)[0] for y in (x, bare)))


def test_noise_of_an_encoder_at_rest_does_not_undo_friction():
    """A joint goes forward, rests, and goes back. Its friction stays built up until it goes back."""
    rng, std = np.random.default_rng(0), 2e-4
    q = np.concatenate([np.linspace(0, 0.3, 50), np.full(400, 0.3), np.linspace(0.3, 0, 50)])
    noisy = X.q[:, :1] + (q + rng.normal(0, std, q.size))[None]
    time = jnp.arange(q.size, dtype=float) / 250.0
    x = jax.tree.map(lambda a: jnp.repeat(a[..., :1], q.size, axis=-1), X)
    x = replace(x, time=time, q=noisy)
    effect = CATALOGUE["joint_presliding"].at(FINGER, (FINGER.joint_names[1],), x0=0.002)
    expected = memories(with_effects(effect), replace(x, q=X.q[:, :1] + jnp.asarray(q)[None]))[0]
    naive = memories(with_effects(effect), x)[0]
    shown = memories(with_effects(effect), replace(x, jitter=jnp.full_like(noisy, 8 * std)))[0]
    resting = slice(55, 445)
    assert np.abs(naive - expected)[resting].max() > 0.5
    np.testing.assert_allclose(shown[resting], expected[resting], atol=1e-3)
    np.testing.assert_allclose(shown[-1], expected[-1], atol=0.1)


def test_a_tendon_that_does_not_stretch_keeps_the_nominal_friction_at_held_joints():
    x = motion(held=True)
    k = FINGER.tendon_names.index("T1")
    nominal = np.asarray(joint_tension(MODEL, x))
    kind = CATALOGUE["tendon_friction_presliding"]
    stiff, stretching = (
        np.asarray(joint_tension(with_effects(kind.at(FINGER, ("T1",), a=1.0, f0=1.0, stretches=s)), x))
        for s in (0.0, 1.0)
    )
    np.testing.assert_array_equal(stiff, nominal)
    assert np.abs(stretching - nominal)[k].max() > 0.01


@given(st.lists(st.floats(-0.2, 0.2), min_size=1, max_size=20), st.floats(-1, 1), st.sampled_from([1.0, 0.5]))
@settings(max_examples=40, deadline=None)
def test_dahl_state_stays_within_the_friction(steps, z, delta):
    for dx in steps:
        z = float(dahl(jnp.asarray(z), jnp.asarray(dx / 0.05), jnp.asarray(delta)))
        assert -1 - 1e-12 <= z <= 1 + 1e-12


def test_play_keeps_the_dead_zone():
    effect = CATALOGUE["tendon_backlash"].at(FINGER, ("T1",), width=3e-4, a=1.0)
    k = FINGER.tendon_names.index("T1")
    l = np.asarray(MODEL.moment_arm.excursion(X.q))[k]
    p = [l[0]]
    for value in l[1:]:
        behind = p[-1]
        if value - behind > 1.5e-4:
            behind = value - 1.5e-4
        elif behind - value > 1.5e-4:
            behind = value + 1.5e-4
        p.append(behind)
    np.testing.assert_allclose(np.asarray(excursion(with_effects(effect), X))[k], p, atol=1e-15)


def test_maxwell_branch_relaxes():
    _, q = fine(X.q[0])
    dt = (TIME[1] - TIME[0]) / FINE
    z = np.zeros(q.size)
    for t in range(1, q.size):
        z[t] = z[t - 1] + (q[t] - q[t - 1]) - dt * z[t - 1] / 0.3
    found = state(CATALOGUE["elastic_relaxation"].at(FINGER, (FINGER.joint_names[0],), T=0.3)).mean(axis=0)
    np.testing.assert_allclose(found, z[::FINE], atol=2e-3 * np.ptp(z))


def test_kelvin_voigt_creeps_to_the_tension():
    k = FINGER.tendon_names.index("T2")
    found = state(CATALOGUE["tendon_creep"].at(FINGER, ("T2",), T=0.5)).mean(axis=0)
    f, dt = np.asarray(X.tension)[k], (TIME[1] - TIME[0]) / FINE
    y = [0.0]
    for held in np.concatenate([[f[0]], f[1:]])[1:]:  # The operator holds tension over a sample.
        creeping = y[-1]
        for _ in range(FINE):
            creeping += dt * (held - creeping) / 0.5
        y.append(creeping)
    # At the first sample there is no step yet.
    np.testing.assert_allclose(found, y, atol=1e-3 * np.ptp(f))


def test_a_wide_spectrum_creeps_with_the_logarithm_of_time():
    """The step response of a spectrum that is constant in log T over two decades, from the exponential integral."""
    effect = CATALOGUE["tendon_creep"].at(FINGER, ("T2",), T=2.0, decades=2.0)
    t, step = jnp.geomspace(0.1, 20.0, 40), jnp.ones(())
    memory = jnp.stack(
        [effect.next_memory(effect.initial_memory((0.0, step)), (jnp.zeros(()), step), (x, step)) for x in t]
    )
    exact = 1.0 - (exp1(t / 20.0) - exp1(t / 0.2)) / np.log(100.0)
    np.testing.assert_allclose(memory.mean(axis=1), exact, atol=0.01)
    after = np.interp([0.7, 2.0, 5.7], t, memory.mean(axis=1))
    assert after[1] - after[0] == pytest.approx(after[2] - after[1], rel=0.2)  # as much in every factor of time


def test_tendon_presliding_follows_its_excursion():
    k = FINGER.tendon_names.index("T2")
    l = np.asarray(MODEL.moment_arm.excursion(X.q))[k]
    _, path = fine(l)
    z = np.zeros(path.size)
    for t in range(1, path.size):
        dl = path[t] - path[t - 1]
        z[t] = z[t - 1] + (dl - abs(dl) * z[t - 1]) / 1e-3
    found = state(CATALOGUE["tendon_friction_presliding"].at(FINGER, ("T2",), x0=1e-3))
    np.testing.assert_allclose(found, z[::FINE], atol=5e-3)


@pytest.mark.parametrize(("name", "values"), [
    ("moment_arm_coupling", {"A": 4e-4, "B": -2e-4, "D": 3e-4, "joint_a": 0.0, "joint_b": 2.0}),
    ("moment_arm_bowstring", {"b": 0.02}),
])  # fmt: skip
def test_moment_arms_are_derivatives_of_the_excursion(name, values):
    """C = ∂l/∂q at constant tension, from virtual work."""
    effect = CATALOGUE[name].at(FINGER, ("T1",), **values)
    model = with_effects(effect)

    def length(q, sample):
        x = jax.tree.map(lambda a: a[..., sample : sample + 1], X)
        x = type(x)(x.time, q[:, None], *(getattr(x, n) for n in (
            "qd", "qdd", "tension", "joint_direction", "tendon_direction", "session_time", "motorised")))  # fmt: skip
        return excursion(model, x)[:, 0]

    C = terms(model, X, memories(model, X)).C
    for sample in (3, 20, 41):
        np.testing.assert_allclose(C[..., sample], jax.jacfwd(length)(X.q[:, sample], sample), atol=1e-13)


def test_a_delayed_channel_is_the_signal_a_while_ago():
    """Of a quarter of a sample, and of several; at the ends the signal goes on as its own reflection."""
    for delay in (2.5e-3, 35e-3):
        effect = CATALOGUE["channel_delay"].at(FINGER, ("tendon_excursion",), delay=delay)
        read = effect.reading("tendon_excursion", X, jnp.asarray(np.sin(2 * np.pi * TIME))[None])
        late = np.sin(2 * np.pi * (TIME - delay))
        np.testing.assert_allclose(read[0, 8:-8], late[8:-8], atol=1e-3)
        np.testing.assert_allclose(read[0], late, atol=0.5 * (2 * np.pi * delay) ** 2 + 2e-3)


@pytest.mark.parametrize("width", [0.0, 1.0])
@pytest.mark.parametrize("samples", [0.1, 0.43, 0.5, 2.5])
def test_a_delay_leaves_the_spectrum_of_noise(width, samples):
    """Of unfiltered and of filtered noise: at each frequency, since whitening raises those that a filter lowered.

    Cubic interpolation half-way between samples leaves 73 % of the variance of white noise; y + delay ẏ adds to it.
    """
    rng, time = np.random.default_rng(0), np.arange(4000) / 50.0
    noise = gaussian_filter1d(rng.normal(size=time.size), width) if width else rng.normal(size=time.size)
    moved = np.asarray(read_later(jnp.asarray(noise), jnp.asarray(time), jnp.asarray(samples / 50.0)))
    bands = [
        np.add.reduceat(np.abs(np.fft.rfft(x * np.hanning(time.size))) ** 2, [0, 500, 1000, 1500])
        for x in (moved, noise)
    ]
    np.testing.assert_allclose(bands[0], bands[1], rtol=0.01)


def test_a_delay_does_not_depend_on_the_padding_of_a_trial():
    """A padded sample repeats the last one, and time stands still there."""
    signal = gaussian_filter1d(np.random.default_rng(1).normal(size=TIME.size), 1.0)
    y, time = jnp.asarray(signal), jnp.asarray(TIME)
    padded = [jnp.concatenate([a, jnp.full(40, a[-1])]) for a in (y, time)]
    for by in (-7e-3, 4e-3):
        alone, within = (read_later(*x, jnp.asarray(by)) for x in ((y, time), padded))
        np.testing.assert_allclose(within[: TIME.size], alone, atol=5e-4)


def test_a_delayed_angle_delays_its_speed_and_acceleration():
    effect = CATALOGUE["channel_delay"].at(FINGER, ("q",), delay=5e-3)
    x = effect.true_motion(X)
    for name in ("q", "qd", "qdd"):
        expected = read_later(getattr(X, name), X.time, jnp.asarray(5e-3))
        np.testing.assert_allclose(getattr(x, name), expected)
    np.testing.assert_array_equal(x.tension, X.tension)


def test_an_eccentric_encoder_shows_other_speeds_and_accelerations_too():
    """Of the true angle q − A sin q − B cos q, by its derivatives."""
    A, B = 0.05, -0.03
    effect = CATALOGUE["encoder_eccentricity"].at(FINGER, (FINGER.joint_names[1],), A=A, B=B)
    x, (q, qd, qdd) = effect.true_motion(X), (np.asarray(a)[1] for a in (X.q, X.qd, X.qdd))
    slope, bend = 1 - A * np.cos(q) + B * np.sin(q), A * np.sin(q) + B * np.cos(q)
    np.testing.assert_allclose(x.q[1], q - A * np.sin(q) - B * np.cos(q), rtol=1e-12)
    np.testing.assert_allclose(x.qd[1], slope * qd, rtol=1e-12)
    np.testing.assert_allclose(x.qdd[1], slope * qdd + bend * qd**2, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(x.qd[0], X.qd[0])


@pytest.mark.parametrize("channel", ["tendon_force", "joint_torque", "tendon_excursion"])
def test_a_delay_shows_nothing_where_all_is_at_rest(channel):
    """At holds, though their first and last samples would be read in the steps between them."""
    effect = CATALOGUE["channel_delay"].at(FINGER, (channel,), delay=5e-3)
    steps = jnp.asarray(np.repeat([[0.0, 1.0, 3.0]], 20, axis=1))
    still = replace(X, qd=jnp.zeros_like(X.qd), motorised=jnp.ones_like(X.motorised))
    np.testing.assert_array_equal(effect.true_motion(replace(still, held=True)).tension, X.tension)
    y = jnp.broadcast_to(jnp.resize(steps, (TIME.size,)), (FINGER.m, TIME.size))
    for x in (replace(still, held=True), *([still] if channel == "joint_torque" else [])):
        np.testing.assert_array_equal(effect.reading(channel, x, y), y)


def test_payload_is_a_body_screwed_to_a_link():
    """Composite mass, centre of mass and inertia (parallel axes) of a small body at p on the link."""
    i, m, p = 1, 2e-3, np.array([0.012, 0.003, -0.004])
    place = {"x": p[0], "y": p[1], "z": p[2]}
    effect = CATALOGUE["payload"].at(FINGER, (FINGER.joint_names[i],), mass=m, **place)
    M, c = float(FINGER.mass[i]), np.asarray(FINGER.com[i])
    com = (M * c + m * p) / (M + m)

    def point(mass, at):
        return mass * (at @ at * np.eye(3) - np.outer(at, at))

    composite = eqx.tree_at(
        lambda f: (f.mass, f.com, f.gyration),
        FINGER,
        (
            FINGER.mass.at[i].set(M + m),
            FINGER.com.at[i].set(com),
            FINGER.gyration.at[i].set((FINGER.inertia[i] + point(M, c - com) + point(m, p - com)) / (M + m)),
        ),
    )
    found = inverse_dynamics(effect.finger(FINGER), X.q, X.qd, X.qdd)
    bare = inverse_dynamics(FINGER, X.q, X.qd, X.qdd)
    np.testing.assert_allclose(found, inverse_dynamics(composite, X.q, X.qd, X.qdd), atol=1e-12)
    half = effect.at(FINGER, effect.site, mass=0.5 * m, **place)
    linear = inverse_dynamics(half.finger(FINGER), X.q, X.qd, X.qdd)
    np.testing.assert_allclose(linear, 0.5 * (found + bare), atol=1e-12)


def test_mass_that_is_moved_within_a_link_leaves_its_mass_as_it_is_and_a_body():
    i, m, p = 1, 2e-3, np.array([0.012, 0.0, -0.004])
    effect = CATALOGUE["payload"].at(FINGER, (FINGER.joint_names[i],), mass=m, x=p[0], y=p[1], z=p[2], moved=1.0)
    moved = effect.finger(FINGER)
    M, c = float(FINGER.mass[i]), np.asarray(FINGER.com[i])
    np.testing.assert_allclose(moved.mass, FINGER.mass, rtol=1e-14)
    np.testing.assert_allclose(moved.com[i], ((M - m) * c + m * p) / M, atol=1e-15)
    about_it = np.linalg.eigvalsh(np.asarray(moved.inertia[i]))
    assert about_it[0] > 0.0
    assert about_it[2] <= about_it[0] + about_it[1] + 1e-15  # the triangle inequality of moments of inertia


@pytest.mark.parametrize("onset", [0.0, 5.0])
@pytest.mark.parametrize("behind", [0.0, 1.0])
def test_crosstalk_adds_to_the_neighbour_before_or_past_its_friction(behind, onset):
    names = FINGER.tendon_names
    effect = CATALOGUE["tendon_crosstalk"].at(FINGER, (names[0], names[1]), epsilon=0.1, behind=behind, onset=onset)
    found, bare = (joint_tension(m, X) for m in (with_effects(effect), MODEL))
    np.testing.assert_allclose(found[1:], bare[1:], atol=1e-15)
    drag = 0.1 * np.maximum(np.stack([X.tension[1], bare[1]]) - onset, 0.0)
    f = X.tension.at[0].add((1.0 - behind) * drag[0])
    entered = joint_tension(MODEL, eqx.tree_at(lambda x: x.tension, X, f))
    np.testing.assert_allclose(found[0], entered[0] + behind * drag[1], atol=1e-12)
