"""Tendon friction from a thirtieth of the usual to nearly all of the tension is found across dead zones."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import Fit, Recipe, identify
from jaxfinger.identify.recipe import ModelRecipe
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
