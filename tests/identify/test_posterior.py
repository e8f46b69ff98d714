"""NUTS agrees with Laplace's covariance where the posterior is Gaussian, as for excursions."""

import jax
import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import refine
from jaxfinger.identify.posterior import sampled_posterior


@pytest.mark.long
def test_nuts_agrees_with_laplace_where_the_model_is_linear(session, staged):
    slow = session.select("ID.2")
    fit = refine(slow, staged)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # blackjax promotes
        found = sampled_posterior(slow, fit, draws=400, warmup=200)
    assert found.trusted
    seen = np.flatnonzero(np.isfinite(fit.std) & (fit.std > 0))
    ratio = np.sqrt(np.diag(found.samples.covariance))[seen] / fit.std[seen]
    # 400 draws give a standard deviation to a few per cent.
    np.testing.assert_allclose(ratio, 1.0, atol=0.2)
    assert abs(np.median(ratio) - 1) < 0.06


def test_a_staged_fit_has_no_posterior(session, staged):
    with pytest.raises(UserError, match="refine it first"):
        sampled_posterior(session, staged)
