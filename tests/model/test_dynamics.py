"""Equation (1): its terms add up, forward dynamics undoes inverse dynamics, jit, vmap and derivatives work."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest

from jaxfinger.model import Motion, dynamics, external_torque, fingertip_force, forward_dynamics, rigid_body
from tests.model.fingers import description, in_pinocchio, model


def motion(d, samples: int, seed: int = 0, held: bool = False) -> Motion:
    rng = np.random.default_rng(seed)
    q, qd, qdd = rng.uniform(-1, 1, (3, d.m, samples))
    zero, time = np.zeros_like(q), np.arange(samples) * 0.01
    tension = rng.uniform(1, 5, (d.n, samples))
    direction = rng.choice([-1.0, 1.0], (d.n, samples))
    arrays = (time, q, qd, qdd, tension, np.sign(qd), direction, time, zero)
    return Motion(*map(jnp.asarray, arrays), held)


@pytest.fixture(params=[1, 3], ids="{} joints".format)
def case(request):
    d = description(request.param, request.param, n=3)
    return d, model(d), motion(d, 6)


def test_equation_one_term_by_term(case):
    """The reference is the sum written out with NumPy and Pinocchio."""
    d, f, x = case
    f_ext = np.random.default_rng(1).standard_normal((3, 6))
    chain, tip = in_pinocchio(d)
    data = chain.createData()
    got = np.asarray(external_torque(f, x, jnp.asarray(f_ext)))
    elastic, friction = (np.asarray(a) for a in (f.joint_torque.elastic, f.joint_torque.friction))
    a0, a1 = (np.asarray(a) for a in (f.tendon_friction.constant, f.tendon_friction.proportional))
    for t in range(6):
        q, qd, qdd, tension = (np.asarray(a[:, t]) for a in (x.q, x.qd, x.qdd, x.tension))
        powers = q[:, None] ** np.arange(elastic.shape[1])
        h = (elastic * powers).sum(1) + np.asarray(f.joint_torque.damping) * qd
        h += np.sign(qd) * (friction * powers).sum(1)
        loss = np.clip(a0 + a1 * tension, 0, tension)
        C = np.asarray(f.moment_arm.coupling(x.q[:, t]))
        J = pin.computeFrameJacobian(chain, data, q, tip, pin.LOCAL_WORLD_ALIGNED)[:3]
        f_j = tension - np.asarray(x.tendon_direction[:, t]) * loss
        expected = pin.rnea(chain, data, q, qd, qdd) + h - C.T @ f_j - J.T @ f_ext[:, t]
        np.testing.assert_allclose(got[:, t], expected, atol=1e-10)


def test_forward_dynamics_undoes_inverse_dynamics(case):
    _, f, x = case
    tau = external_torque(f, x)
    qdd = jax.jit(jax.vmap(forward_dynamics, (None, -1, None, -1), -1))(f, x, (), tau)
    np.testing.assert_allclose(qdd, x.qdd, atol=1e-10)


def test_fingertip_force_is_the_least_squares_solution(case):
    _, f, x = case
    tau = np.asarray(external_torque(f, x))
    _, J = rigid_body.fingertip(f.finger, x.q)
    got = fingertip_force(f, x)
    for t in range(6):
        expected = np.linalg.lstsq(np.asarray(J[..., t]).T, tau[:, t], rcond=1e-8)[0]
        np.testing.assert_allclose(got[:, t], expected, atol=1e-5 * np.abs(expected).max())


def test_jit_and_vmap_change_nothing(case):
    _, f, x = case
    eager = external_torque(f, x)
    np.testing.assert_allclose(jax.jit(external_torque)(f, x), eager, rtol=1e-12, atol=1e-12)
    mapped = jax.jit(jax.vmap(external_torque, (None, -1), -1))(f, x)
    np.testing.assert_allclose(mapped, eager, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("held", [False, True])
def test_derivatives_agree_with_differences(held):
    """Derivatives by all parameters and the motion are compared along a random direction."""
    d = description(3, 3, n=3)
    at = (model(d), motion(d, 6, held=held))

    @jax.jit
    def prediction(at):
        return jnp.concatenate([external_torque(*at), dynamics.excursion(*at)])

    rng = np.random.default_rng(2)
    along = jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(jnp.shape(a))) * (1 + jnp.abs(a)), at)
    _, tangent = jax.jit(lambda at, v: jax.jvp(prediction, (at,), (v,)))(at, along)
    h = 1e-6
    ahead, behind = (jax.tree.map(lambda a, v, s=s: a + s * h * v, at, along) for s in (1, -1))
    difference = (prediction(ahead) - prediction(behind)) / (2 * h)
    np.testing.assert_allclose(tangent, difference, atol=1e-5 * float(jnp.abs(tangent).max()))


def test_gradients_of_the_fingertip_force_are_finite(case):
    _, f, x = case
    gradient = jax.jit(jax.grad(lambda f, x: jnp.sum(fingertip_force(f, x) ** 2)))(f, x)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
