"""The solver of every fit as an optimistix solver: test problems beside Dogleg, jit, vmap and differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxfinger.identify.gauss_newton import VisibleGaussNewton

SOLVER = VisibleGaussNewton(atol=1e-9)


def rosenbrock(y, a):
    return 10.0 * (y[1:] - y[:-1] ** 2), a - y[:-1]


def powell(y, _):
    a, b, c, d = y
    return a + 10.0 * b, 5.0**0.5 * (c - d), (b - 2.0 * c) ** 2, 10.0**0.5 * (a - d) ** 2


PROBLEMS = {"Rosenbrock": (rosenbrock, (-1.2, 1.0), 1.0), "Powell": (powell, (3.0, -1.0, 0.0, 1.0), 0.0)}


@pytest.mark.parametrize("name", PROBLEMS)
def test_it_ends_where_dogleg_does(name):
    fn, start, end = PROBLEMS[name]
    ours, theirs = (
        optx.least_squares(fn, s, jnp.array(start), 1.0, throw=False) for s in (SOLVER, optx.Dogleg(1e-8, 1e-8))
    )
    assert ours.result == optx.RESULTS.successful
    assert ours.stats["num_steps"] <= theirs.stats["num_steps"] + 5
    np.testing.assert_allclose(ours.value, end, atol=1e-4)


def test_it_batches_and_differentiates():
    def solved(a):
        return optx.least_squares(rosenbrock, SOLVER, jnp.zeros(2), a).value

    np.testing.assert_allclose(jax.vmap(solved)(jnp.array([1.0, 2.0])), [[1.0, 1.0], [2.0, 4.0]], rtol=1e-7)
    np.testing.assert_allclose(jax.jacfwd(solved)(2.0), [1.0, 4.0], rtol=1e-6)


def test_an_optimum_on_a_bound_is_found():
    found = optx.least_squares(rosenbrock, SOLVER, jnp.zeros(2), 1.0, {"upper": jnp.array([0.5, 5.0])})
    np.testing.assert_allclose(found.value, [0.5, 0.25], rtol=1e-7)
