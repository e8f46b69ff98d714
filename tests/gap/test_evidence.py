"""The closed form of the evidence against marginal likelihoods computed the slow way."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from jaxfinger.effects import CATALOGUE, Scales, nominal_terms
from jaxfinger.gap.diagnose import UNSEEN, _with_prior
from jaxfinger.gap.evidence import SCALES, Projector, evidence
from jaxfinger.gap.signatures import Variant
from jaxfinger.model import Finger
from jaxfinger.synthetic import paper_finger

SPECIMEN = Scales.of(Finger.from_description(paper_finger().description))

ROWS, NOMINAL = 40, 4


@pytest.fixture
def problem():
    rng = np.random.default_rng(1)
    J = rng.standard_normal((ROWS, NOMINAL))
    r = J @ rng.standard_normal(NOMINAL) + rng.standard_normal(ROWS)
    direction = rng.standard_normal(ROWS)
    return SimpleNamespace(J=J, r=r, direction=direction, root=np.zeros((0, NOMINAL)), offset=np.zeros(0))


def complement(problem):
    """Orthonormal basis of what the nominal parameters cannot imitate."""
    u, _, _ = np.linalg.svd(problem.J)
    return u[:, NOMINAL:]


def test_projection_removes_the_nominal_parameters_and_nothing_else(problem):
    projector, U = Projector(problem), complement(problem)
    np.testing.assert_allclose(projector(problem.J.T), 0, atol=1e-12)
    np.testing.assert_allclose(projector.residual(problem), U @ U.T @ problem.r, atol=1e-12)


def test_prior_rows_weigh_like_measurements(problem):
    """With a prior the projected residual's length is the minimum of the penalised least squares."""
    root, offset = np.eye(NOMINAL)[:2] * 3.0, np.array([0.4, -1.0])
    with_prior = SimpleNamespace(J=problem.J, r=problem.r, root=root, offset=offset)
    rt = Projector(with_prior).residual(with_prior)
    A, b = np.vstack([problem.J, root]), np.concatenate([problem.r, -offset])
    residual = b - A @ np.linalg.lstsq(A, b, rcond=None)[0]
    assert rt @ rt == pytest.approx(residual @ residual)


def test_a_term_left_out_has_whatever_size_it_was(problem):
    """Ten thousand plausible sizes, as on a rig's heavy axis: it counts for nearly all that it explains."""
    problem.r = problem.r + 30.0 * problem.direction
    Z, projector = 1e-4 * problem.direction[None], Projector(problem)
    rt = projector.residual(problem)
    term, effect = (
        evidence(Variant(kind, ("MCP",), (), scales=SPECIMEN), Z, projector(Z), rt)
        for kind in (nominal_terms(2, 2)["joint_damping"], CATALOGUE["drive_inertia"])
    )
    assert term.explained > 100.0
    assert term.log_bf > 0.9 * 0.5 * term.explained
    assert effect.log_bf < 5.0


def test_evidence_of_signed_amplitudes_is_the_gaussian_marginal_likelihood(problem):
    variant = Variant(CATALOGUE["gravity_tilt"], ("base",), (), scales=SPECIMEN)
    Z = np.random.default_rng(2).standard_normal((3, ROWS))
    projector, U = Projector(problem), complement(problem)
    found = evidence(variant, Z, projector(Z), projector.residual(problem))
    r, S = U.T @ problem.r, U.T @ Z.T
    none = multivariate_normal(np.zeros(len(r))).logpdf(r)
    marginal = [multivariate_normal(cov=np.eye(len(r)) + s**2 * S @ S.T).logpdf(r) - none for s in SCALES]
    expected = logsumexp(marginal) - np.log(len(SCALES))
    assert found.log_bf == pytest.approx(expected)
    np.testing.assert_allclose(found.amplitudes, np.linalg.lstsq(S, r, rcond=None)[0], rtol=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_evidence_of_a_one_sided_amplitude_is_the_half_normal_marginal_likelihood(problem, sign):
    variant = Variant(CATALOGUE["tendon_creep"], ("T1",), (("T", 1.5),), scales=SPECIMEN)
    rng = np.random.default_rng(3)
    z = rng.standard_normal(ROWS)
    problem.r = problem.r + sign * 0.6 * z
    projector, U = Projector(problem), complement(problem)
    found = evidence(variant, z[None], projector(z[None]), projector.residual(problem))
    r, u = U.T @ problem.r, U.T @ z

    def marginal(s):
        likelihood = lambda a: np.exp(a * (u @ r) - 0.5 * a * a * (u @ u))  # noqa: E731
        prior = lambda a: 2 * np.exp(-0.5 * (a / s) ** 2) / (s * np.sqrt(2 * np.pi))  # noqa: E731
        return quad(lambda a: likelihood(a) * prior(a), 0, 10 * s, epsabs=0, points=[0.6] if s > 0.1 else None)[0]

    assert found.log_bf == pytest.approx(np.log(np.mean([marginal(s) for s in SCALES])), abs=1e-4)
    assert (found.log_bf > 0) == (sign > 0)
    assert (found.explained > 0) == (sign > 0)


def test_what_the_nominal_parameters_imitate_is_no_evidence(problem):
    variant = Variant(CATALOGUE["gravity_tilt"], ("base",), (), scales=SPECIMEN)
    Z = (problem.J[:, :3] @ np.random.default_rng(4).standard_normal((3, 3))).T
    projector = Projector(problem)
    found = evidence(variant, Z, projector(Z), projector.residual(problem))
    assert found.absorbed == pytest.approx(1.0)
    assert abs(found.log_bf) < 1e-6


def test_a_share_counts_as_one_at_most(problem):
    """Three times a friction is no evidence that it builds up: what the whole of it explains is."""
    variant = Variant(CATALOGUE["joint_presliding"], ("PIP",), (("x0", 0.03),), scales=SPECIMEN)
    Z, projector = np.random.default_rng(3).standard_normal((1, ROWS)), Projector(problem)
    Zt = projector(Z)
    rt = projector.residual(problem)
    rt = rt + (3.0 - Zt[0] @ rt / (Zt[0] @ Zt[0])) * Zt[0]
    found = evidence(variant, Z, Zt, rt)
    assert found.amplitudes == pytest.approx([1.0])
    assert found.explained == pytest.approx(rt @ rt - np.sum((rt - Zt[0]) ** 2))
    assert found.log_bf < 0.5 * found.explained


def test_an_amplitude_that_no_trial_shows_is_said_to_be_nothing_within_its_prior():
    """A lag of a channel that does not move came back as a month."""
    assert _with_prior(3.0, 0.1, 1e-3) == pytest.approx((3e-3, 1e-4), rel=1e-3)
    value, std = _with_prior(2.7e9, 1e10, 1e-3)
    assert abs(value) < 1e-6
    assert std == pytest.approx(UNSEEN * 1e-3)
