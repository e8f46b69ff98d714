"""Recipes: shipped ones are read by name, mistakes are named with their line."""

import re
import tomllib
from dataclasses import fields, replace
from pathlib import Path

import pytest

from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.gap import diagnose
from jaxfinger.identify import Recipe, identify, read_recipe
from jaxfinger.identify.recipe import TERMS, FitRecipe, ModelRecipe, ValidationRecipe
from tests.model.fingers import description


@pytest.mark.parametrize("name", ["paper", "human-like.toml", "emps"])
def test_shipped_recipes_are_read_by_name(name):
    assert isinstance(read_recipe(name), Recipe)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[modle]", "line 1: modle: is unknown (did you mean 'model'?)"),
        ("\n[model]\nterms = ['joint_elastc']", "line 3: model.terms[0]: is 'joint_elastc' (did you mean 'joint_el"),
        ("[model]\nterms = ['joint_elastic', 'joint_offset']", "line 2: model.terms: has joint_offset beside"),
        ("[model]\nelastic_degree = 12", "line 2: model.elastic_degree: is 12, which is outside 0 to 9"),
        ("[fit]\nfree_inertia = 'no'", "line 2: fit.free_inertia: must be true or false, not 'no'"),
        ("[fit]\nstages = ['ID.3-statik']", "did you mean 'ID.3-static'?"),
    ],
)
def test_mistakes_are_named_with_their_line(tmp_path, text, says):
    (tmp_path / "my.toml").write_text(text)
    with pytest.raises(UserError) as refused:
        read_recipe(tmp_path / "my.toml")
    assert str(refused.value).startswith(f"{tmp_path / 'my.toml'}, line ")
    assert says in str(refused.value)


def test_the_recipe_on_the_page_is_the_default_and_every_term_is_told(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "how-to-choose.md").read_text(encoding="utf-8")
    ((block),) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "mine.toml").write_text(block)
    assert read_recipe(tmp_path / "mine.toml") == Recipe() == read_recipe({})
    keys = [set(tomllib.loads(block)[table]) for table in ("model", "fit", "validation")]
    assert keys == [{f.name for f in fields(x)} for x in (ModelRecipe, FitRecipe, ValidationRecipe)]
    assert sorted(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == sorted(TERMS)


def test_a_recipe_that_was_made_in_python_has_the_checks_of_a_file():
    session, recipe = Session("none", description(1, 0, prismatic=False)), Recipe(name="mine")
    for part, value, says in (
        ("model", {"terms": ("joint_elastc",)}, "model.terms[0]: is 'joint_elastc' (did you mean 'joint_elastic'?)"),
        ("model", {"elastic_degree": -1}, "model.elastic_degree: is -1, which is outside 0 to 9"),
        ("fit", {"huber": -3.0}, "fit.huber: is -3; it must be at least 0"),
    ):
        odd = replace(recipe, **{part: replace(getattr(recipe, part), **value)})
        for run in (identify, diagnose):
            with pytest.raises(UserError, match=re.escape(f"recipe 'mine': {says}")):
                run(session, odd)
        with pytest.raises(UserError, match=re.escape(f"the recipe: {says}")) as raised:
            read_recipe({part: value})
        assert raised.value.__suppress_context__  # The sentence stands alone in a notebook.


def test_a_name_that_is_nearly_a_shipped_one():
    with pytest.raises(
        UserError, match=r"human-lik: does not exist \(did you mean 'human-like'\?\); .*emps-no-coulomb, human-like"
    ):
        read_recipe("human-lik")
