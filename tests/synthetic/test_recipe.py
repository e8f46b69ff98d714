"""Mutated recipes of the simulator and of fits are read, or refused with the line."""

from pathlib import Path

from hypothesis import given, settings

from jaxfinger.identify import read_recipe
from jaxfinger.synthetic import read_session_recipe
from tests.mutations import assert_read_or_refused, mutated

ROOT = Path(__file__).parents[2]


@settings(max_examples=60, deadline=None)
@given(mutated((ROOT / "datasets" / "paper-finger" / "recipe.toml").read_text()))
def test_a_mutated_recipe_of_the_simulator(tmp_path_factory, text):
    assert_read_or_refused(lambda text: read_session_recipe(written(tmp_path_factory, text)), text)


@settings(max_examples=60, deadline=None)
@given(mutated((ROOT / "fits" / "human-like.toml").read_text()))
def test_a_mutated_recipe_of_a_fit(tmp_path_factory, text):
    assert_read_or_refused(lambda text: read_recipe(written(tmp_path_factory, text)), text)


def written(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "mutated.toml"
    path.write_text(text, encoding="utf-8")
    return path
