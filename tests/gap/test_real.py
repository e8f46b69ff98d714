"""A real servo axis whose friction is published (datasets/emps)."""

from dataclasses import replace
from pathlib import Path

import pytest

from jaxfinger.data import read_session
from jaxfinger.data.importing.by_mapping import import_file
from jaxfinger.gap import Status, diagnose
from jaxfinger.identify import read_recipe

ROOT = Path(__file__).parents[2]
PUBLISHED = {"joint_coulomb": 20.39, "joint_damping": 203.5}  # N, N s/m


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    file = tmp_path_factory.mktemp("emps") / "emps.h5"
    import_file([ROOT / "datasets/emps/DATA_EMPS.mat"], ROOT / "datasets/emps/emps.toml", file)
    return read_session(file)


@pytest.mark.long
@pytest.mark.parametrize("withheld", [("joint_coulomb",), ("joint_coulomb", "joint_damping")])
def test_what_is_withheld_is_named_with_its_published_value(axis, withheld):
    """Where both frictions are withheld, neither alone is worth its cost, since each hides the other.

    The axis has no spring that could relax.
    """
    full = read_recipe(ROOT / "fits/emps.toml")
    recipe = replace(full, model=replace(full.model, terms=tuple(t for t in full.model.terms if t not in withheld)))
    found = diagnose(axis, recipe)
    assert found.status is Status.EXPLAINED
    assert {k.effect for k in found.named} == set(withheld)
    assert "elastic_relaxation" not in {c.key.effect for c in found.candidates}
    for cause in found.budget:
        assert abs(cause.values[0].value - PUBLISHED[cause.effect]) < 1.96 * cause.values[0].std
