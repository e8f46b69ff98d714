"""One short session with one effect in it, and the problem that its diagnosis starts from."""

import equinox as eqx
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap.problem import build
from jaxfinger.identify import Recipe
from jaxfinger.synthetic import ModelPlant, paper_finger, polynomial_finger, recipe_from, simulate, true_model

TABLE = {
    "specimen": {"kind": "polynomial"},
    "cad": {"mass": 0.01, "com": 2e-4},
    "trials": {
        "rate": 100.0,
        "experiments": ["ID.2", "ID.3-static", "ID.3-dynamic"],
        "id2": {"repeats": 2, "postures": [[25, 35, 40]], "stroke_time": 2.0, "strokes": 2},
        "id3_static": {"repeats": 2, "postures": [[25, 30, 45]], "move": 0.4, "dwell": 0.4},
        "id3_dynamic": {"repeats": 2, "postures": [[25, 30, 45]], "cycles": 1},
    },
    "sensors": {"clock_jitter": 0.0},
}
RECIPE = recipe_from(TABLE)
RIVALS = ("joint_presliding", "joint_stribeck", "elastic_relaxation", "tendon_backlash", "tendon_stretch")
WITHOUT = tuple(sorted(set(CATALOGUE) - set(RIVALS)))
TRUTH = ("joint_presliding", ("PIP",))
PLANTED = (*TRUTH, {"a": 1.0, "x0": 0.1})


def session_with(*effects, seed=3, recipe=RECIPE):
    model = true_model(polynomial_finger(paper_finger()))
    members = tuple(
        (CATALOGUE[e] if isinstance(e, str) else e).at(model.finger, site, **values) for e, site, values in effects
    )
    model = eqx.tree_at(lambda m: m.effects, model, members, is_leaf=lambda v: isinstance(v, tuple))
    return simulate(recipe, seed=seed, plant=ModelPlant(model))


@pytest.fixture(scope="session")
def planted():
    """The problem of a session with the one effect."""
    return build(session_with(PLANTED), Recipe())
