"""M, N, G, the fingertip and its Jacobian against Pinocchio, on random chains of revolute and prismatic joints."""

from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pinocchio as pin
import pytest

from jaxfinger.model import Finger, rigid_body
from tests.model.fingers import description, in_pinocchio

SAMPLES = 5


@jax.jit
def ours(finger, q, qd, qdd):
    return (
        rigid_body.inverse_dynamics(finger, q, qd, qdd),
        rigid_body.gravity_torque(finger, q),
        rigid_body.coriolis(finger, q, qd),
        rigid_body.mass_matrix(finger, q),
        *rigid_body.fingertip(finger, q),
    )


def theirs(chain, tip, q, qd, qdd):
    data = chain.createData()
    zero = np.zeros(chain.nv)
    torque = pin.rnea(chain, data, q, qd, qdd).copy()
    gravity = pin.rnea(chain, data, q, zero, zero).copy()
    bias = pin.rnea(chain, data, q, qd, zero).copy()
    upper = np.triu(pin.crba(chain, data, q))
    J = pin.computeFrameJacobian(chain, data, q, tip, pin.LOCAL_WORLD_ALIGNED)[:3].reshape(3, chain.nv).copy()
    pin.framesForwardKinematics(chain, data, q)
    return torque, gravity, bias - gravity, upper + np.triu(upper, 1).T, data.oMf[tip].translation.copy(), J


@pytest.mark.parametrize("m", [1, 2, 3, *(pytest.param(m, marks=pytest.mark.long) for m in (4, 5, 6)), 7])
def test_agrees_with_pinocchio(m):
    """The tolerance is 1e-10 of the size of each quantity."""
    d = description(seed=m, m=m)
    q, qd, qdd = np.random.default_rng(m).standard_normal((3, m, SAMPLES))
    got = ours(Finger.from_description(d), q, qd, qdd)
    expected = zip(*(theirs(*in_pinocchio(d), *s) for s in zip(q.T, qd.T, qdd.T, strict=True)), strict=True)
    for name, a, b in zip(("τ", "G", "N", "M", "tip", "J"), got, expected, strict=True):
        b = np.moveaxis(np.array(b), 0, -1)
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * max(1.0, np.abs(b).max()), err_msg=name)
    assert np.linalg.eigvalsh(np.moveaxis(got[3], -1, 0)).min() > 0


def test_a_heavier_link_is_denser():
    """Where a fit changes a mass, the inertia about the centre of mass changes in proportion."""
    d = description(3, 3)
    factor = np.array([0.5, 1.0, 3.0])
    finger = Finger.from_description(d)
    moved = eqx.tree_at(lambda f: f.mass, finger, finger.mass * factor)
    dense = replace(d, mass=d.mass * factor, inertia=d.inertia * factor[:, None, None])
    q, qd, qdd = np.random.default_rng(0).standard_normal((3, 3, SAMPLES))
    chain, _ = in_pinocchio(dense)
    expected = [pin.rnea(chain, chain.createData(), *s) for s in zip(q.T, qd.T, qdd.T, strict=True)]
    np.testing.assert_allclose(rigid_body.inverse_dynamics(moved, q, qd, qdd).T, expected, atol=1e-10)


def test_the_batch_is_any_number_of_last_axes():
    finger = Finger.from_description(description(3, 3))
    q, qd, qdd = np.random.default_rng(0).standard_normal((3, 3, 4, 5))
    inverse_dynamics = jax.jit(rigid_body.inverse_dynamics)
    whole = inverse_dynamics(finger, q, qd, qdd)
    one = inverse_dynamics(finger, q[:, 1, 2], qd[:, 1, 2], qdd[:, 1, 2])
    mapped = jax.vmap(inverse_dynamics, (None, 1, 1, 1), 1)(finger, q, qd, qdd)
    np.testing.assert_allclose(whole[:, 1, 2], one, rtol=1e-13)
    np.testing.assert_allclose(mapped, whole, rtol=1e-13)


@pytest.mark.parametrize("m", [3, rigid_body.CHAIN + 1])
def test_blocks_of_a_long_batch_join_seamlessly(m):
    finger = Finger.from_description(description(3, m))
    n = rigid_body.LONG + 17
    q, qd, qdd = np.random.default_rng(4).uniform(-1, 1, (3, m, 2, n))
    whole = rigid_body.inverse_dynamics(finger, q, qd, qdd)
    for k in (0, 1, n // 2, n - 1):
        one = rigid_body.inverse_dynamics(finger, q[..., k], qd[..., k], qdd[..., k])
        np.testing.assert_allclose(whole[..., k], one, rtol=1e-12, atol=1e-15)
