"""Predictions behind the low-pass of a fit."""

import jax.numpy as jnp
import numpy as np

from jaxfinger.experiments.predict import predict
from jaxfinger.model import Motion, external_torque
from jaxfinger.synthetic import paper_finger, polynomial_finger, true_model

MODEL = true_model(polynomial_finger(paper_finger()))
SPEED = np.array([1.5, -1.0, 0.7])[:, None]  # rad/s
ACCELERATION = np.array([3.0, 2.0, -4.0])[:, None]  # rad/s²


def motion(t, blur=None) -> Motion:
    """Constant accelerations, and what a Gaussian low-pass of standard deviation `blur` makes of the angles."""
    q = 0.6 + SPEED * t + 0.5 * ACCELERATION * (t**2 + (0.0 if blur is None else blur**2))
    qd, qdd, none = SPEED + ACCELERATION * t, ACCELERATION + 0.0 * t, np.zeros((MODEL.finger.n, *np.shape(t)))
    arrays = (t, q, qd, qdd, none, 0.0 * q, none, t, 0.0 * q)
    width, block = (None, None) if blur is None else (jnp.full((1, t.size), a) for a in (blur, t[1] - t[0]))
    return Motion(*(jnp.asarray(a)[..., None, :] for a in arrays), blur=width, block=block)


def test_terms_that_are_not_linear_pass_the_low_pass_as_the_measured_torque_does():
    """The reference is the torque at many instants, averaged with the low-pass's weights."""
    std, step = 0.05, 1e-4
    at = np.arange(-6.0, 6.0, 0.01) * std
    weight = np.exp(-0.5 * (at / std) ** 2) / np.exp(-0.5 * (at / std) ** 2).sum()
    true = np.asarray(external_torque(MODEL, motion(at)))[:, 0] @ weight
    x = motion(np.arange(3) * step, std)  # blocks are short beside the low-pass
    found = np.asarray(predict(MODEL, x, ("joint_torque",))["joint_torque"])[:, 0, 0]
    plain = np.asarray(external_torque(MODEL, x))[:, 0, 0]
    assert np.abs(found - true).max() < 0.05 * np.abs(plain - true).max()
