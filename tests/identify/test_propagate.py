"""Errors of other parameters in a stage's covariance."""

import numpy as np
import pytest

from jaxfinger.identify.propagate import depends


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_an_estimate_depends_on_another_parameter_whatever_its_unit(unit):
    """The first of two estimates shares rows with the other parameter, the second does not."""
    rng = np.random.default_rng(0)
    J, other = np.zeros((40, 2)), np.zeros((40, 1))
    J[:20, 0], J[20:, 1], other[:20, 0] = rng.standard_normal((3, 20))
    other *= unit
    J[:, 1] += 1e-12 * J[:, 0]  # as of rounding
    inverse = np.linalg.inv(J.T @ J)
    np.testing.assert_array_equal(depends(inverse, J.T @ other, np.diag(other.T @ other)), [True, False])


def test_nothing_depends_on_a_parameter_that_the_trials_do_not_show():
    inverse = np.eye(2)
    np.testing.assert_array_equal(depends(inverse, np.zeros((2, 1)), np.zeros(1)), [False, False])
    np.testing.assert_array_equal(depends(inverse, np.zeros((2, 0)), np.zeros(0)), [False, False])
