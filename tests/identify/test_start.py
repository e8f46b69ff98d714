"""Tendon friction from a thirtieth of the usual to nearly all of the tension is found across dead zones."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import Fit, Recipe, identify
from jaxfinger.identify.parameters import describe
from jaxfinger.identify.plausible import name_bounded
from jaxfinger.identify.recipe import ModelRecipe
from jaxfinger.identify.start import bounded_losses
from jaxfinger.model import TendonFriction
from jaxfinger.synthetic import ModelPlant, paper_finger, polynomial_finger, recipe_from, simulate, true_model

TENSIONS = [4.0, 8.0, 12.0, 16.0]  # N
RECIPE = recipe_from(
    {
        "specimen": {"kind": "polynomial"},
        "trials": {
            "rate": 100.0,
            "experiments": ["ID.4"],
            "id4": {
                "repeats": 2,
                "postures": [[50, 30, 30], [25, 60, 50]],
                "tensions": TENSIONS,
                "move": 0.2,
                "dwell": 0.4,
            },
        },
        "sensors": {"clock_jitter": 0.0},
    }
)


@pytest.mark.parametrize(
    ("a0", "a1"),
    [
        pytest.param(0.2 / 30, 0.2 / 30, id="a thirtieth"),
        pytest.param(6.0, 0.2, id="thirty times", marks=pytest.mark.long),
        pytest.param(10.0, 0.2, id="all of half the tensions", marks=pytest.mark.long),
        pytest.param(0.0, 0.9, id="nine tenths", marks=pytest.mark.long),
        pytest.param(-4.0, 0.9, id="above 4 N alone"),
    ],
)
def test_what_is_lost_is_found(a0, a1):
    """Cases range about 0.2 + 0.2 f. The loss is compared, since a few tensions may not determine both a₀ and a₁."""
    true = true_model(polynomial_finger(paper_finger()))
    n = true.finger.n

    def rubbing(constant, proportional):
        friction = TendonFriction(jnp.full(n, constant), jnp.full(n, proportional))
        return eqx.tree_at(lambda m: m.tendon_friction, true, friction)

    def lost(model):
        f = jnp.tile(jnp.asarray(TENSIONS), (n, 1))
        return np.asarray(jnp.clip(model.tendon_friction.loss(f), 0.0, f))[np.array(model.finger.active)]

    session = simulate(RECIPE, seed=1, plant=ModelPlant(rubbing(a0, a1)))
    fit = identify(session, stages=("ID.4",), start=Fit.before(session, Recipe(), rubbing(0.0, 0.0)))
    assert fit.stages[-1].status == "fitted"
    assert fit.stages[-1].chi2_per_row < 1.5
    np.testing.assert_allclose(lost(fit.model), lost(rubbing(a0, a1)), atol=0.03)  # N


def test_a_start_and_another_recipe_are_refused():
    session = simulate(RECIPE, seed=1)
    start = Fit.before(session, Recipe(), true_model(polynomial_finger(paper_finger())))
    with pytest.raises(UserError, match="a fit to start from brings its own recipe; leave out `recipe` or `start`"):
        identify(session, Recipe(model=ModelRecipe(elastic_degree=3)), start=start)


def test_friction_that_ends_at_a_bound_is_a_contradiction_or_none_and_no_lack_of_tensions():
    """Nothing depends on it there. Torques that are too large for the tensions, or go against them, lead there."""
    model = true_model(polynomial_finger(paper_finger()))
    n, parameters = model.finger.n, describe(model)
    constant, proportional = np.full(n, 0.2), np.full(n, 0.1)
    constant[:3], proportional[:3] = (12.0, -12.0, 0.0), (-5.0, 3.0, 0.0)  # from 8 N on: nothing, all, nothing
    friction = TendonFriction(jnp.asarray(constant), jnp.asarray(proportional))
    model = eqx.tree_at(lambda m: m.tendon_friction, model, friction)
    free = np.flatnonzero([p.group == "tendon_friction" for p in parameters])
    highest = np.where(np.arange(n) == 2, 0.0, max(TENSIONS))  # the third is never pulled
    ends = bounded_losses(model, free, parameters, highest)
    first, second, *_ = model.finger.tendon_names
    assert ends == {first: "none", second: "all"}
    none, everything = name_bounded(ends)
    assert none.startswith(f"the fit loses none of the tension of {first}, so friction there has no interval (± ?)")
    assert everything.startswith(f"the fit loses all of the tension of {second}, so")
    assert all("check sign, units and columns of tendon_force" in text for text in (none, everything))
    assert not name_bounded({})
