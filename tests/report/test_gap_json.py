"""`gap.json` follows its schema, and its numbers agree with its sentences."""

import json
from dataclasses import replace

import jsonschema
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import load_fit
from jaxfinger.report.gap_json import as_gap_json, text, write

from .fabricated import every, explained
from .gap_schema import SCHEMA

ALL = every()


@pytest.mark.parametrize("name", ALL)
def test_it_follows_the_schema(name):
    jsonschema.validate(json.loads(text(ALL[name])), SCHEMA)


@pytest.mark.parametrize("name", ALL)
def test_numbers_and_words_agree(name):
    gap = as_gap_json(ALL[name])
    status, named = gap["verdict"]["status"], gap["verdict"]["effects"]
    chance = {(c["effect"], *c["site"]): c["probability"] for c in gap["candidates"]}
    assert (gap["against"] is None) == (name != "against")
    assert bool(named) == (status in ("explained", "partly", "ambiguous"))
    for c in named:
        assert chance[c["effect"], *c["site"]] >= 0.5
    if status == "no_gap":
        assert gap["none"] >= 0.5
        assert gap["unlisted"] < 0.5
    if status in ("partly", "unexplained"):
        assert gap["unlisted"] >= 0.5 or gap["ambiguous_sets"]
        stays_open = any(x["after"] > 1.3 * x["noise"] for x in gap["gap"])  # though little of the whole is left
        assert gap["unexplained"]["share"] > 0.1 or stays_open


def test_a_probability_that_rounding_lifts_over_one_is_one():
    d = explained()
    d = replace(d, none=-1e-15, candidates=(replace(d.candidates[0], probability=1.0 + 1e-14), *d.candidates[1:]))
    jsonschema.validate(json.loads(text(d)), SCHEMA)


def test_one_cause_at_many_sites_is_one_line_and_every_site_is_named():
    gap = as_gap_json(ALL["coupled"])
    (line,) = gap["budget"]
    assert line["site"] == ["T1", "T2", "T3", "T4", "T5"]
    assert line["parameters"]["A T4"]["value"] == pytest.approx(4e-3)
    assert [e["site"] for e in gap["verdict"]["effects"]] == [["T1"], ["T2"], ["T3"], ["T4"], ["T5"]]


def test_a_schema_of_the_test_is_strict():
    """A file that breaks the schema is refused."""
    gap = as_gap_json(explained())
    for wrong in (gap | {"extra": 1}, gap | {"none": 1.2}, gap | {"budget": [{"effect": "x"}]}, gap | {"data": None}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, SCHEMA)


def test_files_are_written_whole_and_not_over_others(tmp_path):
    write(explained(), tmp_path / "out")
    assert json.loads((tmp_path / "out" / "gap.json").read_text(encoding="utf-8")) == as_gap_json(explained())
    assert load_fit(tmp_path / "out" / "augmented.json").model.effects[0].ID == "tendon_stretch"
    with pytest.raises(UserError, match=r"gap\.json"):
        write(explained(), tmp_path / "out")
