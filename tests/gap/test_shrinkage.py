"""What a fold's linear refit may not do: lead an effect beyond its bounds."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.refine import within_bounds
from jaxfinger.model import Finger
from jaxfinger.synthetic import nominal_model, paper_finger, polynomial_finger


@pytest.fixture(scope="module")
def finger() -> Finger:
    return nominal_model(polynomial_finger(paper_finger())).finger


@pytest.mark.parametrize("effect", sorted(CATALOGUE))
def test_bounds_hold_every_number_and_leave_a_plausible_effect_alone(effect, finger):
    kind = CATALOGUE[effect]
    site = kind.sites(finger)[0]
    shape = next(iter(kind.shapes(finger, site)))
    plausible = kind.at(finger, site, **shape, **{n: size for n, (_, size, _) in kind.AMPLITUDES.items()})
    for name, value in within_bounds(plausible).values().items():
        assert value == pytest.approx(plausible.values()[name])
    far = kind.at(finger, site, **shape, **{n: -size for n, (_, size, _) in kind.AMPLITUDES.items()})
    for name, (_, _, signed) in kind.AMPLITUDES.items():
        assert (within_bounds(far).values()[name] < 0.0) == signed


def test_a_length_that_a_linear_step_turned_negative_comes_back(finger):
    kind = CATALOGUE["joint_presliding"]
    effect = kind.at(finger, ("PIP",), a=1.0, x0=-0.3)
    assert 0.0 < within_bounds(effect).values()["x0"] <= min(kind.SHAPES["x0"][1])
    assert np.isfinite(jnp.asarray(within_bounds(effect).values()["x0"]))
