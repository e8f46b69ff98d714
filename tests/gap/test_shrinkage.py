"""What a fold chooses and refits, and the interval of how far a gap closes."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE, Scales
from jaxfinger.gap.augment import augmented_fit, without_shapes
from jaxfinger.gap.diagnose import _rivals
from jaxfinger.gap.refine import within_bounds
from jaxfinger.gap.shrinkage import _choice, _line, shrinkage
from jaxfinger.model import Finger
from jaxfinger.synthetic import nominal_model, paper_finger, polynomial_finger


@pytest.fixture(scope="module")
def finger() -> Finger:
    return nominal_model(polynomial_finger(paper_finger())).finger


@pytest.mark.parametrize("effect", sorted(CATALOGUE))
def test_bounds_hold_every_number_and_leave_a_plausible_effect_alone(effect, finger):
    kind = CATALOGUE[effect]
    site = kind.sites(finger)[0]
    scales = Scales.of(finger)
    shape, sizes = kind.shapes(finger, site, scales)[0], kind.sizes(scales, site)
    plausible = kind.at(finger, site, **shape, **sizes)
    for name, value in within_bounds(plausible, scales).values().items():
        assert value == pytest.approx(plausible.values()[name])
    far = kind.at(finger, site, **shape, **{n: -size for n, size in sizes.items()})
    for name, p in kind.amplitudes().items():
        assert (within_bounds(far, scales).values()[name] < 0.0) == p.signed


def test_a_length_that_a_linear_step_turned_negative_comes_back(finger):
    kind = CATALOGUE["joint_presliding"]
    effect = kind.at(finger, ("PIP",), a=1.0, x0=-0.3)
    scales = Scales.of(finger)
    least = min(kind.worth_trying(scales, ("PIP",))["x0"])
    assert 0.0 < within_bounds(effect, scales).values()["x0"] <= least


def test_a_fold_sees_what_the_nominal_parameters_became_to_imitate_a_cause(diagnosis):
    """As masses that moved away from CAD to look like a tilt: of that gap, only the prior knows."""
    rng = np.random.default_rng(5)
    noise, moved = rng.standard_normal(5000), np.array([2.0, 0.0, 0.0])
    J, root = rng.standard_normal((noise.size, 3)), np.array([[10.0, 0.0, 0.0]])
    cause = J @ moved
    problem = replace(diagnosis.problem, r=noise, J=J, root=root, offset=root @ moved)
    at = {c.key: c.evidence for c in diagnosis.search.candidates}
    tilt, luck = (at["elastic_relaxation", (site,)] for site in ("MCP", "PIP"))
    # the signature of what was moved: the trials alone say nothing of it, but its size follows from the prior
    lucky = noise + (noise.size / 60.0) ** 0.5 * rng.standard_normal(noise.size)  # explains about 60 of the noise
    rivals = [(tilt, cause[None]), (luck, lucky[None])]
    training = rng.random(cause.size) < 0.7
    assert _choice(problem, rivals, training) == tilt.variant.key
    at_cad = replace(problem, offset=np.zeros_like(problem.offset))
    assert _choice(at_cad, rivals, training) == luck.variant.key


def test_a_shape_that_a_linear_step_leads_astray_is_held(diagnosis):
    """A Jacobian that belittles a length a thousand times sends it to its bounds; amplitudes alone still close."""
    problem, (key,) = diagnosis.problem, diagnosis.verdict.effects
    augmented = augmented_fit(problem, diagnosis.search.chosen)
    fit, J = augmented.fit, augmented.J
    shape = ~np.isin(fit.estimated, without_shapes(fit.model, fit.estimated))
    assert shape.sum() == 1
    rivals = _rivals(problem, diagnosis.search)
    good, astray = (
        shrinkage(problem, augmented._replace(J=jacobian), rivals, {key}, forward=False)
        for jacobian in (J, np.where(shape, 1e-3 * J, J))
    )
    for line, other in zip(good, astray, strict=True):
        if line.resolvable:
            assert line.closed > 0.9
            assert other.closed == pytest.approx(line.closed, abs=0.05)


def test_trials_without_a_gap_say_nothing_of_how_far_it_closes():
    """Two tendons of ten show it: a draw of the bootstrap that has neither would say that nothing closes."""
    rng = np.random.default_rng(1)
    noise = 1.0 + 0.02 * rng.standard_normal((20, 2))
    before = np.where(np.arange(20) < 2, 400.0, 1.0) * noise[:, 0]
    after = np.where(np.arange(20) < 2, 5.0, 1.0) * noise[:, 1]
    rows = np.stack([before, after, np.ones(20), np.full(20, 100.0)], axis=1)
    line = _line("ID.4", "tendon_excursion", "m", rows)
    assert line.closed == pytest.approx(1 - 4.0 / 399.0, abs=2e-3)
    assert 0.95 < line.closed_ci95[0] <= line.closed <= line.closed_ci95[1] <= 1.0
    nothing = _line("ID.4", "tendon_excursion", "m", rows[2:])
    assert (nothing.closed, nothing.closed_ci95, nothing.resolvable) == (0.0, (0.0, 0.0), False)
