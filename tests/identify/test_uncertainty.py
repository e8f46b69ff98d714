"""Bootstrap and sandwich from compressed trials, against refits by SciPy and against Laplace's covariance."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.errors import UserError
from jaxfinger.identify import (
    StageReport,
    bootstrap,
    compress,
    fit_many,
    identifiability,
    refit,
    robust,
    sandwich,
    sensitivity,
)
from jaxfinger.identify.uncertainty import draw_weights


def sensitivity_to_trials(session, fit):
    return sensitivity(fit, session, "trials")


def fit_again(session, fit):
    return fit_many([session], fit, session)


@pytest.fixture(scope="module")
def compressed(session, staged):
    return compress(session, staged)


def by_scipy(compressed, weights):
    """Staged refit by SciPy: one least-squares problem for each stage, on the stacked rows of its trials."""
    grams, reads = np.asarray(compressed.grams.H), np.asarray(compressed.grams.reads)
    z, start = np.zeros(compressed.sizes[0]), compressed.sizes[0]
    for row, size in zip(reads, compressed.sizes[1:], strict=True):
        blocks = []
        for H, w in zip(grams, row * np.append(weights, 1.0), strict=True):
            values, vectors = np.linalg.eigh(H)
            blocks.append(np.sqrt(w * np.maximum(values, 0))[:, None] * vectors.T)
        A = np.concatenate(blocks)
        own, given = A[:, start : start + size], A[:, -1] + A[:, :start] @ z
        found = scipy.optimize.least_squares(
            lambda x, own=own, given=given: own @ x + given, np.zeros(size), jac=lambda x, own=own: own, method="lm"
        )
        z, start = np.concatenate([z, found.x]), start + size
    return compressed.theta + compressed.basis @ z


def test_all_trials_as_they_are_give_the_fit_back(compressed, staged):
    theta, failed = refit(compressed, np.ones((1, len(compressed.trials))))
    free = staged.estimated
    assert not failed.any()
    assert np.abs((theta[0] - compressed.theta)[free] / staged.std[free]).max() < 0.02


def test_refits_agree_with_scipy(compressed, staged):
    weights = draw_weights(compressed.strata, 3, np.random.default_rng(0))
    theta, failed = refit(compressed, weights)
    free = staged.estimated
    assert not failed.any()
    for got, w in zip(theta, weights, strict=True):
        expected = by_scipy(compressed, w)
        assert np.abs((got - expected)[free] / staged.std[free]).max() < 1e-5
        np.testing.assert_allclose(got[free], expected[free], rtol=1e-6, atol=1e-6 * staged.std[free].max())


def test_map_and_vmap_agree(compressed):
    weights = draw_weights(compressed.strata, 4, np.random.default_rng(1))
    np.testing.assert_allclose(
        refit(compressed, weights, batching="vmap")[0], refit(compressed, weights, batching="map")[0], rtol=1e-9
    )


def test_members_that_fail_are_named_and_spoil_nothing(compressed):
    weights = draw_weights(compressed.strata, 4, np.random.default_rng(2))
    sound, _ = refit(compressed, weights)
    weights[1, [s[0] == "ID.2" and s[1] == "MCP" for s in compressed.strata]] = 0.0
    weights[2] = np.nan
    theta, failed = refit(compressed, weights)
    np.testing.assert_array_equal(failed, [False, True, True, False])
    assert np.isnan(theta[1:3]).all()
    np.testing.assert_array_equal(theta[[0, 3]], sound[[0, 3]])


@given(sizes=st.lists(st.integers(1, 6), min_size=1, max_size=4), seed=st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_weights_leave_every_stratum_its_share(sizes, seed):
    strata = tuple((k,) for k, n in enumerate(sizes) for _ in range(n))
    weights = draw_weights(strata, 5, np.random.default_rng(seed))
    ends = np.cumsum([0, *sizes])
    for a, b in pairwise(ends):
        np.testing.assert_allclose(weights[:, a:b].sum(axis=1), b - a)


def test_bootstrap_variance_of_a_mean_is_unbiased():
    """For n trials of one number each the variance of the weighted mean is s²/n, not (n − 1)/n of it."""
    x = np.array([1.0, 2.0, 4.0])
    means = draw_weights((("a",),) * 3, 200_000, np.random.default_rng(0)) @ x / 3
    np.testing.assert_allclose(means.var(), x.var(ddof=1) / 3, rtol=0.02)


def test_bootstrap_and_sandwich_agree_with_laplace(session, staged, compressed):
    """Where the noise model is right they differ by chance alone, some 40 % with four trials in a stratum."""
    samples = bootstrap(session, staged, 500, compressed=compressed)
    assert not samples.failed.any()
    free = staged.estimated
    for covariance in (samples.covariance, sandwich(session, staged, compressed)):
        ratio = np.sqrt(np.diag(covariance))[free] / staged.std[free]
        assert 0.5 < np.median(ratio) < 1.3
        assert np.sqrt(np.mean(ratio**2)) < 1.5
    low, high = samples.interval(0.95)
    assert np.mean((low[free] < compressed.theta[free]) & (compressed.theta[free] < high[free])) > 0.9


def test_robust_covariance_is_never_narrower(session, staged):
    wide = robust(session, staged)
    assert np.all(wide.std >= staged.std * (1 - 1e-12))
    assert np.linalg.eigvalsh(wide.covariance).min() > -1e-12 * wide.covariance.max()


@pytest.mark.parametrize("of", [bootstrap, sensitivity_to_trials, fit_again], ids=lambda f: f.__name__)
def test_a_fit_of_a_diagnosis_is_refused(session, staged, of):
    """Its trials have other weights than those of a fit of stages, so that no refit of these is one of it."""
    diagnosed = replace(staged, stages=(*staged.stages, StageReport("all trials", "fitted")))
    with pytest.raises(UserError, match="is one of a diagnosis; give one that `identify` or `fit joint` wrote"):
        of(session, diagnosed)


def test_the_session_sees_every_parameter(session, staged, compressed):
    found = identifiability(session, staged, compressed)
    assert len(found) == staged.estimated.size
    assert {d.status for d in found} <= {"seen", "weak"}
    assert found[-1].singular_value == 1.0
