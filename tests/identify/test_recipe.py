"""Recipes: shipped ones are read by name, mistakes are named with their line."""

import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import Recipe, read_recipe


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


def test_a_name_that_is_nearly_a_shipped_one():
    with pytest.raises(
        UserError, match=r"human-lik: does not exist \(did you mean 'human-like'\?\); .*emps-no-coulomb, human-like"
    ):
        read_recipe("human-lik")
