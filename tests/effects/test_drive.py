"""Effects of a joint's drive against NumPy written from the formulas of their docstrings."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.effects.drive import NOMINAL_TEMPERATURE
from jaxfinger.model import external_torque, rigid_body, simulate
from tests.effects.motion import MODEL, motion, with_effects
from tests.model.test_simulate import DT, slider

FINGER = MODEL.finger
X, HELD = motion(), motion(held=True)
Q, QD, QDD, S = (np.asarray(a) for a in (X.q, X.qd, X.qdd, X.joint_direction))
F = np.asarray(MODEL.joint_torque.friction_magnitude(X.q))
I, J = 1, 2  # joints


def added(name, *sites, x=X, **values):
    """Change of the external torque by an effect, N m."""
    effect = CATALOGUE[name].at(FINGER, tuple(FINGER.joint_names[i] for i in sites), **values)
    model = with_effects(effect)
    return np.asarray(external_torque(model, model.true_motion(x)) - external_torque(MODEL, x))


def at(joint, values):
    """Torques with `values` at one joint and zeros at the others."""
    out = np.zeros_like(Q)
    out[joint] = values
    return out


def test_a_constant_torque_acts_everywhere_in_a_fixture_too():
    for x in (X, HELD):
        np.testing.assert_allclose(added("joint_offset", I, x=x, tau=0.004), at(I, 0.004), atol=1e-15)


def test_friction_by_direction_is_what_the_two_ways_differ_by():
    forwards, back = F[I] + 0.002, F[I] - 0.002
    expected = np.where(S[I] > 0, forwards + 0.001 * QD[I], -back + 0.001 * -QD[I]) - S[I] * F[I]
    found = added("joint_friction_asymmetric", I, coulomb=0.002, damping=0.001)
    np.testing.assert_allclose(found, at(I, expected), atol=1e-15)
    assert not added(
        "joint_friction_asymmetric", I, x=HELD, coulomb=0.002, damping=0.001
    ).any()  # The fixture carries it.


def test_a_drive_loses_a_share_of_the_torque_that_it_gives():
    """The torque τ solves τ − μ|τ| s = needed. The test finds it by trying both signs."""
    needed = np.asarray(external_torque(MODEL, X))[I]
    expected = []
    for u, s in zip(needed, S[I], strict=True):
        (tau,) = [t for t in (u / (1 - 0.3 * s), u / (1 + 0.3 * s)) if np.isclose(t - 0.3 * abs(t) * s, u)]
        expected.append(tau - u)
    found = added("joint_torque_friction", I, mu=0.3)
    np.testing.assert_allclose(found, at(I, expected), atol=1e-14)
    assert np.all(found[I] * S[I] >= 0.0)  # It resists the motion.
    assert not added("joint_torque_friction", I, x=HELD, mu=0.3).any()


def test_friction_falls_as_the_session_goes_on():
    cold = np.exp(-np.asarray(X.session_time) / 60.0)
    found = added("joint_friction_warmup", I, a=0.4, d=1e-3, T=60.0)
    np.testing.assert_allclose(found, at(I, cold * (0.4 * S[I] * F[I] + 1e-3 * QD[I])), atol=1e-15)


def test_friction_falls_with_the_temperature_of_the_joint():
    temperature = NOMINAL_TEMPERATURE + np.linspace(-15.0, 5.0, Q.size).reshape(Q.shape)
    x = replace(X, temperature=jnp.asarray(temperature))
    found = added("joint_friction_warmup", I, x=x, a=0.4, d=1e-3, by=1.0)
    cold = (NOMINAL_TEMPERATURE - temperature[I]) / 10.0
    np.testing.assert_allclose(found, at(I, cold * (0.4 * S[I] * F[I] + 1e-3 * QD[I])), atol=1e-15)
    assert not added("joint_friction_warmup", I, a=0.4, d=1e-3, by=1.0).any()  # No temperature was measured.


@pytest.mark.parametrize("ratio", [1.0, -1.0])
def test_a_motor_that_turns_with_two_joints_acts_on_both(ratio):
    speed, acceleration = QD[I] + ratio * QD[J], QDD[I] + ratio * QDD[J]
    way = np.sign(np.diff(Q[I] + ratio * Q[J], prepend=np.nan))
    way[0] = 0.0  # It has not moved yet.
    f = 0.003 * way + 2e-4 * speed + 1e-6 * acceleration
    found = added("joint_coupling", I, J, coulomb=0.003, damping=2e-4, inertia=1e-6, ratio=ratio)
    np.testing.assert_allclose(found, at(I, f) + at(J, ratio * f), atol=1e-15)


def test_a_coupled_motor_keeps_its_friction_through_a_stop_and_a_fixture_carries_it():
    stopped = replace(X, q=X.q.at[:, 20:].set(X.q[:, 20:21]), qd=X.qd.at[:, 20:].set(0.0))
    found = added("joint_coupling", I, J, x=stopped, coulomb=0.003)
    np.testing.assert_allclose(np.abs(found[I, 20:]), 0.003, atol=1e-15)
    assert np.ptp(found[I, 20:]) < 1e-15
    np.testing.assert_allclose(added("joint_coupling", I, J, x=HELD, coulomb=0.003), 0.0, atol=1e-15)


def test_the_inertia_of_a_coupled_motor_is_in_the_mass_matrix():
    effect = CATALOGUE["joint_coupling"].at(FINGER, (FINGER.joint_names[I], FINGER.joint_names[J]), inertia=1e-5)
    q = X.q[:, 7]
    M, more = (rigid_body.mass_matrix(f, q) for f in (FINGER, effect.finger(FINGER)))
    expected = np.zeros((3, 3))
    expected[np.ix_([I, J], [I, J])] = 1e-5
    np.testing.assert_allclose(more - M, expected, atol=1e-18)


def test_a_link_lags_behind_its_drive_by_the_dead_zone():
    width, p, link = 0.05, Q[I][0], []
    for q in Q[I]:
        p = min(max(p, q - width / 2), q + width / 2)
        link.append(p)
    expected = external_torque(MODEL, eqx.tree_at(lambda x: x.q, X, X.q.at[I].set(jnp.asarray(link))))
    found = added("joint_backlash", I, a=1.0, width=width)
    np.testing.assert_allclose(found, np.asarray(expected) - np.asarray(external_torque(MODEL, X)), atol=1e-13)
    assert np.abs(Q[I] - link).max() == pytest.approx(width / 2)
    assert not added("joint_backlash", I, x=HELD, a=1.0, width=width).any()


def pushed(push, **torque):
    """Speed after 2 s of 1 kg on a rail with 2 N of friction and 20 N s/m, m/s. `torque`: fields of `JointTorque`."""
    model = slider(2.0, 20.0)
    for name, value in torque.items():
        model = eqx.tree_at(lambda m, n=name: getattr(m.joint_torque, n), model, jnp.full(1, value))
    time = np.arange(2001) * DT
    tau = jnp.full((1, time.size), push)
    _, qd = run(model, time, np.zeros((1, time.size)), jnp.zeros(1), jnp.zeros(1), tau)
    return float(qd[0, -1])


run = eqx.filter_jit(simulate)


@pytest.mark.parametrize(("push", "torque", "force"), [
    (5.0, {"friction_by_direction": 0.5}, 2.5),
    (-5.0, {"friction_by_direction": 0.5}, -3.5),
    (2.4, {"friction_by_direction": 0.5}, 0.0),  # It sticks up to 2.5 N forwards and 1.5 N backwards.
    (-1.4, {"friction_by_direction": 0.5}, 0.0),
    (5.0, {"torque_friction": 0.2}, 2.0),
    (2.4, {"torque_friction": 0.2}, 0.0),
])  # fmt: skip
def test_real_drives_stick_and_slide(push, torque, force):
    np.testing.assert_allclose(pushed(push, **torque), force / 20.0, atol=1e-6)


def test_what_turns_with_two_joints_holds_both_until_they_pull_hard_enough():
    """Without other friction, joints stand still under less torque than the shared friction carries."""
    model = eqx.tree_at(lambda m: m.joint_torque, MODEL, MODEL.joint_torque.zeros(FINGER.m))
    model = eqx.tree_at(lambda m: m.finger.gravity, model, jnp.zeros(3))
    pair = (FINGER.joint_names[0], FINGER.joint_names[1])
    effect = CATALOGUE["joint_coupling"].at(FINGER, pair, coulomb=0.01)
    model = eqx.tree_at(lambda m: m.effects, model, (effect,), is_leaf=lambda v: isinstance(v, tuple))
    time, still = jnp.arange(50, dtype=float) * DT, jnp.zeros((FINGER.n, 50))
    tau = jnp.zeros((FINGER.m, 50)).at[:2].set(jnp.array([[0.005], [0.005]]))
    _, qd = run(model, time, still, jnp.zeros(FINGER.m), jnp.zeros(FINGER.m), tau)
    assert np.abs(qd).max() < 1e-3
    _, free = run(model, time, still, jnp.zeros(FINGER.m), jnp.zeros(FINGER.m), 4.0 * tau)
    assert np.abs(free).max() > 0.1
