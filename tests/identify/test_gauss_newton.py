"""`VisibleGaussNewton` as an optimistix solver: test problems against Dogleg, jit, vmap and differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import scipy.optimize

from jaxfinger.identify.gauss_newton import COST_ROUNDING, Outcome, VisibleGaussNewton
from jaxfinger.identify.linearise import robust_residuals

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


def bent(y, a):
    """Rows with kinks, some of them curved, and constant rows, which make up most of the cost."""
    A, c, bend, rest = a
    x = A @ y
    return jnp.where(bend > 0.3, jnp.maximum(x, -0.8 * x) + 0.3 * bend * x**2, x) - c, rest


def test_it_ends_where_rounding_hides_what_steps_do_to_the_cost():
    """Searches on random problems of many scales all end.

    Where one ends by rounding, SciPy lowers the cost of the rows that depend on parameters by no more than rounding
    hides.
    """
    solver, rng, rounded = VisibleGaussNewton(atol=1e-6, kink=0.1), np.random.default_rng(0), 0

    @jax.jit
    def found(start, *a):
        return optx.least_squares(bent, solver, start, a, throw=False, max_steps=60)

    bare = jax.jit(lambda y, *rows: bent(y, (*rows, None))[0])
    slopes = jax.jit(jax.jacfwd(lambda y, *rows: bare(y, *rows)))
    for _ in range(100):
        unit = 10.0 ** rng.uniform(-6, 6, 4)
        A, c = rng.standard_normal((12, 4)) / unit, rng.standard_normal(12) * 10.0 ** rng.uniform(-3, 2)
        bend, rest = rng.uniform(0.0, 0.9, 12), np.full(40, 10.0 ** rng.uniform(3, 4))
        start, rows = jnp.asarray(unit * rng.standard_normal(4)), tuple(map(jnp.asarray, (A, c, bend)))
        there = found(start, *rows, jnp.asarray(rest))
        assert there.stats["outcome"] != Outcome.running
        if there.stats["outcome"] == Outcome.rounded:
            rounded += 1
            further = scipy.optimize.least_squares(bare, there.value, slopes, args=rows, x_scale="jac")
            cost = 0.5 * float(jnp.sum(bare(there.value, *rows) ** 2))
            assert cost - further.cost <= COST_ROUNDING * 0.5 * np.sum(rest**2)
    assert rounded > 10


@pytest.mark.parametrize("outliers", [0.0, 0.1, 0.4])
def test_a_robust_fit_takes_few_steps_however_many_rows_are_outliers(outliers):
    """It ends at SciPy's optimum of Huber's cost, from the plain fit and from zero."""
    rng, limit = np.random.default_rng(1), 1.5
    A, truth = rng.standard_normal((400, 6)) * 10.0 ** np.arange(-3, 3), 10.0 ** -np.arange(-3.0, 3.0)
    y = A @ truth + rng.standard_normal(400) + 40.0 * (rng.random(400) < outliers) * rng.exponential(size=400)
    prior = jnp.full(2, 9.0)  # beyond the limit, and no row of Huber's cost

    def rows(theta, _):
        return robust_residuals(jnp.asarray(y - A @ theta), limit), prior * (1.0 + 1e-3 * theta[:2])

    @jax.jit
    def solved(start):
        options = {"linear_beyond": (jnp.asarray(limit), jnp.inf)}
        return optx.least_squares(rows, SOLVER, start, None, options, max_steps=60, throw=False)

    def flat(theta):
        return np.concatenate([np.asarray(a) for a in rows(jnp.asarray(theta), None)])

    expected = scipy.optimize.least_squares(flat, truth, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15).x
    std = np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    for start, most in ((np.linalg.lstsq(A, y, rcond=None)[0], 8), (np.zeros(6), 14)):
        found = solved(jnp.asarray(start))
        assert found.result == optx.RESULTS.successful
        assert found.stats["linearisations"] <= most
        np.testing.assert_allclose((found.value - expected) / std, 0.0, atol=1e-4)
