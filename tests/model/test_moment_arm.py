"""C is the derivative of f, whatever the polynomial."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.model import MomentArm


@given(m=st.integers(1, 4), degree=st.integers(1, 6), cross=st.booleans(), seed=st.integers(0, 2**31))
@settings(max_examples=10, deadline=None)
def test_coupling_is_the_derivative_of_excursion(m, degree, cross, seed):
    rng = np.random.default_rng(seed)
    zeros = MomentArm.zeros(3, m, degree, cross)
    arm = MomentArm(jnp.asarray(rng.standard_normal(zeros.coefficients.shape)), zeros.exponents)
    q = rng.uniform(-1, 1, (m, 2))
    C, h = np.asarray(arm.coupling(q)), 1e-5
    for i in range(m):
        step = h * np.eye(m)[i][:, None]
        difference = (np.asarray(arm.excursion(q + step)) - np.asarray(arm.excursion(q - step))) / (2 * h)
        np.testing.assert_allclose(C[:, i], difference, atol=1e-7)
    assert not np.any(arm.excursion(np.zeros(m)))
    assert C.shape == (3, m, 2)


def test_cross_terms_couple_every_pair_of_joints():
    arm = MomentArm.zeros(1, 3, 2, cross=True)
    pairs = {tuple(i for i, p in enumerate(e) if p) for e in arm.exponents if sum(map(bool, e)) == 2}
    assert pairs == {(0, 1), (0, 2), (1, 2)}
    assert len(arm.exponents) == 3 * 2 + 3 * 3
