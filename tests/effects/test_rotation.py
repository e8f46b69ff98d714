"""Gravity and the fingertip's force turn as rigid vectors do, however far."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxfinger.effects import CATALOGUE
from jaxfinger.effects.rotation import turned
from tests.effects.motion import MODEL, MOTIONS

TURNS = [(0.0, 0.0, 0.0), (1e-9, 0.0, 0.0), (0.1, -0.2, 0.05), (0.9, 0.8, -1.7), (np.pi, 0.0, 0.0)]


@pytest.mark.parametrize("by", TURNS)
def test_vectors_turn_as_scipy_turns_them(by):
    v = np.random.default_rng(0).standard_normal((3, 5))
    np.testing.assert_allclose(
        turned(jnp.asarray(v), jnp.asarray(by)), Rotation.from_rotvec(by).apply(v.T).T, atol=1e-14
    )


def test_no_rotation_has_the_derivative_of_the_cross_product():
    v = jnp.array([0.3, -2.0, 9.0])
    slope = jax.jacfwd(lambda by: turned(v, by))(jnp.zeros(3))
    np.testing.assert_allclose(slope, np.cross(np.eye(3), v).T, atol=1e-15)


@pytest.mark.parametrize("by", TURNS)
def test_a_tilted_mounting_turns_gravity(by):
    finger, kind = MODEL.finger, CATALOGUE["gravity_tilt"]
    tilted = kind.at(finger, kind.sites(finger)[0], **dict(zip("xyz", by, strict=True))).finger(finger)
    np.testing.assert_allclose(tilted.gravity, Rotation.from_rotvec(by).apply(np.array(finger.gravity)), atol=1e-14)


@pytest.mark.parametrize("by", TURNS)
def test_a_turned_force_sensor_reads_a_turned_force(by):
    finger, kind = MODEL.finger, CATALOGUE["force_sensor_rotation"]
    effect, force = (
        kind.at(finger, kind.sites(finger)[0], **dict(zip("xyz", by, strict=True))),
        np.array([0.1, -2.0, 0.7]),
    )
    read = effect.reading("fingertip_force", MOTIONS[0][0], jnp.asarray(force))
    np.testing.assert_allclose(read, Rotation.from_rotvec(by).apply(force), atol=1e-14)
