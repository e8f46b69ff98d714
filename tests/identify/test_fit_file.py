"""The file of a fit is read back exactly; a bad file is refused in one sentence."""

import json
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxfinger.errors import UserError
from jaxfinger.identify import Fit, Recipe, StageReport, load_fit, save_fit
from jaxfinger.identify.noise import Noise
from jaxfinger.identify.parameters import ravel, with_flat
from jaxfinger.identify.recipe import ModelRecipe
from jaxfinger.model import Finger, Model
from jaxfinger.synthetic import paper_finger


@pytest.fixture
def fit() -> Fit:
    rng = np.random.default_rng(0)
    model = Model.zeros(Finger.from_description(paper_finger().description), cross=True, elastic_degree=3)
    model = with_flat(model, jnp.asarray(rng.standard_normal(ravel(model).size)))
    P = ravel(model).size
    root = np.zeros((P, 5))
    root[70:90] = rng.standard_normal((20, 5))
    covariance = root @ root.T
    covariance[75, 75] = np.inf
    noise = {("ID.2", "tendon_excursion"): Noise(*(rng.random((5, *s)) for s in ((), (), (3,))), source="repeats")}
    stages = (
        StageReport("ID.2", "fitted", trials=("a", "b"), rows=100, chi2_per_row=1.02, warnings=("one",)),
        StageReport("ID.4", "skipped", "the session has no ID.4 trial"),
    )
    recipe = Recipe(name="mine", model=ModelRecipe(cross_terms=True, elastic_degree=3))
    return Fit(
        model, covariance, np.arange(70, 90), recipe, noise, stages, "finger", "a.h5", "00ff", "now", {"jax": "1"}
    )


def test_reads_what_it_wrote(fit, tmp_path):
    save_fit(fit, tmp_path / "fit.json")
    read = load_fit(tmp_path / "fit.json")
    assert eqx.tree_equal(read.model, fit.model)
    assert jax.tree.structure(read.model) == jax.tree.structure(fit.model)
    np.testing.assert_array_equal(read.covariance, fit.covariance)
    np.testing.assert_array_equal(read.estimated, fit.estimated)
    assert read.table() == fit.table()
    for a, b in zip(read.stages, fit.stages, strict=True):
        np.testing.assert_equal(vars(a), vars(b))
    np.testing.assert_equal({k: vars(v) for k, v in read.noise.items()}, {k: vars(v) for k, v in fit.noise.items()})
    for name in ("recipe", "specimen", "data", "data_hash", "created", "versions"):
        assert getattr(read, name) == getattr(fit, name)


def test_is_strict_json_that_a_person_can_read(fit, tmp_path):
    path = tmp_path / "fit.json"
    save_fit(fit, path)
    content = json.loads(path.read_text(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert content["schema"] == "jaxfinger-fit/2"
    assert "excursion T1 PIP^4" in content["covariance"]["names"]


def test_keeps_the_file_that_is_there(fit, tmp_path):
    path = tmp_path / "fit.json"
    save_fit(fit, path)
    before = path.read_bytes()
    with pytest.raises(UserError, match="exists already"):
        save_fit(replace(fit, specimen="other"), path)
    assert path.read_bytes() == before
    save_fit(replace(fit, specimen="other"), path, overwrite=True)
    assert load_fit(path).specimen == "other"


def test_bad_files_get_one_sentence(tmp_path):
    path = tmp_path / "fit.json"
    with pytest.raises(UserError, match="cannot be read"):
        load_fit(path)
    for text, reason in (("\x00\x01", "is not a fit"), ("[1]", "schema None"), ('{"schema": "x"}', "schema 'x'")):
        path.write_text(text)
        with pytest.raises(UserError, match=reason):
            load_fit(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="is not a fit"):
        load_fit(path)


def test_a_damaged_fit_is_never_read(fit, tmp_path):
    path = tmp_path / "fit.json"
    save_fit(fit, path)
    content = json.loads(path.read_text())
    for key in content:
        path.write_text(json.dumps({k: v for k, v in content.items() if k != key}))
        with pytest.raises(UserError):
            load_fit(path)
    for key, value in (
        ("joint_torque", {**content["joint_torque"], "damping": [1.0]}),
        ("finger", {**content["finger"], "mass": [None, 1.0, 1.0]}),
        ("estimated", ["no such parameter"]),
        ("recipe", {"unknown": 1}),
        ("covariance", {"names": ["mass MCP"], "matrix": [1.0, 2.0]}),
        ("noise", 3),
    ):
        path.write_text(json.dumps({**content, key: value}))
        with pytest.raises(UserError, match=str(path)):
            load_fit(path)
