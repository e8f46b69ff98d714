"""Changes since an earlier fit: each is the change of nominal parameters, and none of these is without one."""

from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest

from jaxfinger.effects import CHANGED, changes
from jaxfinger.experiments import predict
from jaxfinger.gap.parts import altered_by
from jaxfinger.gap.signatures import changes_of
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.nominal import GROUP_OF_TERM, nominal_model
from jaxfinger.identify.parameters import describe, ravel, with_flat
from jaxfinger.identify.recipe import ModelRecipe
from jaxfinger.synthetic import simulate
from tests.effects.motion import MODEL, MOTIONS, SCALES
from tests.identify.conftest import SHORT_RECIPE

KINDS = changes(MODEL.joint_torque.elastic.shape[1] - 1, MODEL.joint_torque.friction.shape[1] - 1, 4)


def with_effect(effect):
    return eqx.tree_at(lambda m: m.effects, MODEL, (effect,), is_leaf=lambda v: isinstance(v, tuple))


def test_every_term_of_a_recipe_may_have_changed():
    """Otherwise another cause would be named in its place."""
    assert set(GROUP_OF_TERM.values()) <= {kind.GROUP for kind in CHANGED.values()}


def test_a_law_of_one_constant_has_one_change():
    """Two copies would share its probability."""
    constants = changes(0, 0, 4)
    of_one = [c for c in constants.values() if c.GROUP in ("elastic", "friction")]
    assert {c.ID for c in of_one} == {"changed_pretension", "changed_friction_level"}


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("last", [False, True], ids=["first site", "last site"])
def test_a_change_is_that_of_the_parameters_which_it_names(name, last):
    """Both predict the same."""
    kind, parameters = KINDS[name], describe(MODEL)
    site = kind.sites(MODEL.finger)[-1 if last else 0]
    sizes = {n: 0.1 * (k + 1) * unit for k, (n, unit) in enumerate(kind.sizes(SCALES, site).items())}
    effect, flat = kind.at(MODEL.finger, site, **sizes), np.array(ravel(MODEL))
    altered = altered_by(effect, parameters)
    for i, name in zip(altered, sizes, strict=False):
        flat[i] += sizes[name]
        assert set(site) == {parameters[i].joint, parameters[i].tendon} - {None}
    moved = with_flat(MODEL, flat)
    for x, nominal in MOTIONS:
        expected, found = (predict(m, x, tuple(nominal)) for m in (moved, with_effect(effect)))
        for channel in nominal:
            np.testing.assert_allclose(found[channel], expected[channel], rtol=1e-9, atol=1e-12, err_msg=channel)


def test_changes_have_the_degrees_of_the_fit():
    """With a constant torque in the place of elasticity, no power of the angle may have changed."""
    terms = ("joint_offset", "joint_coulomb", "joint_damping")
    session, recipe = simulate(SHORT_RECIPE), Recipe(model=ModelRecipe(terms=terms))
    fit = Fit.before(session, recipe, nominal_model(session, recipe))
    fit = replace(fit, covariance=np.eye(len(fit.covariance)))
    found = {name for name, c in changes_of(fit).items() if c.GROUP == "elastic"}
    assert found == {"changed_pretension"}
