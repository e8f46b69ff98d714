"""Programs on disk: found again by whatever led to them, and by nothing else."""

import os
import subprocess
import sys
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from jaxfinger import programs
from jaxfinger.effects import CATALOGUE
from jaxfinger.model import Model
from jaxfinger.programs import Program, kept
from jaxfinger.synthetic import paper_finger, polynomial_finger, true_model


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("JAXFINGER_PROGRAMS", str(tmp_path / "programs"))
    return tmp_path / "programs"


@pytest.fixture
def traced():
    """Arguments with which a function was traced, since a program that is loaded is not."""
    return []


@pytest.fixture
def scaled(traced):
    def program():
        """The function as a new process has it."""

        def scaled(channel, values):
            traced.append(channel)
            return {"scaled": {"torque": 2.0, "angle": 3.0}[channel] * values["x"], "none": ()}

        return Program(scaled, dict)

    return program


def test_a_later_process_loads_the_program(folder, scaled, traced):
    for x in (np.arange(3.0), np.ones(3), jnp.ones(3)):
        found = scaled()("torque", {"x": x})
        assert found["none"] == ()
        np.testing.assert_array_equal(found["scaled"], 2.0 * x)
    assert len(traced) == 1


def test_an_argument_that_is_ignored_may_have_any_shape(folder):
    def doubled(x, ignored):
        return 2.0 * x

    for count in (2, 3):
        np.testing.assert_array_equal(Program(doubled, dict)(np.ones(4), np.ones(count)), 2.0)


def test_named_arguments_are_taken_as_by_any_function(folder, scaled):
    np.testing.assert_array_equal(scaled()("torque", values={"x": np.ones(3)})["scaled"], 2.0)


def test_another_constant_shape_type_or_structure_is_another_program(folder, scaled, traced):
    for channel, values in (
        ("torque", {"x": np.ones(3)}),
        ("angle", {"x": np.ones(3)}),
        ("torque", {"x": np.ones(4)}),
        ("torque", {"x": np.ones(3, np.float32)}),
        ("torque", {"x": np.ones(3), "y": np.ones(3)}),
    ):
        found = scaled()(channel, values)["scaled"]
        np.testing.assert_array_equal(found, (2.0 if channel == "torque" else 3.0) * values["x"])
    assert len(traced) == 5


def test_without_a_folder_nothing_is_kept(monkeypatch, scaled, traced):
    monkeypatch.delenv("JAXFINGER_PROGRAMS", raising=False)
    for _ in range(2):
        scaled()("torque", {"x": np.ones(3)})
    assert len(traced) == 2


def test_a_damaged_file_is_made_again(folder, scaled, traced):
    scaled()("torque", {"x": np.ones(3)})
    for file in folder.iterdir():
        file.write_bytes(file.read_bytes()[:20])
    np.testing.assert_array_equal(scaled()("torque", {"x": np.ones(3)})["scaled"], 2.0)
    scaled()("torque", {"x": np.ones(3)})
    assert len(traced) == 2


def test_what_nobody_has_used_for_a_month_is_removed(folder, scaled):
    scaled()("torque", {"x": np.ones(3)})
    before = set(folder.iterdir())
    for file in before:
        os.utime(file, (0.0, 0.0))
    scaled()("torque", {"x": np.ones(3)})  # reads its files, so that they are new
    old = folder / "of older code"
    old.write_bytes(b"")
    os.utime(old, (0.0, 0.0))
    programs._remove_unused.cache_clear()  # as in a new process
    scaled()("angle", {"x": np.ones(3)})
    assert not old.exists()
    assert before < set(folder.iterdir())


def test_jax_keeps_no_copy_of_a_program(tmp_path):
    env = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAXFINGER_PROGRAMS": str(tmp_path / "programs"),
    }
    subprocess.run([sys.executable, "-c", LAPACK], check=True, capture_output=True, env=env)
    assert len(list((tmp_path / "programs").iterdir())) == 2
    assert not list(tmp_path.glob("*kept_values*"))


def test_other_libraries_or_options_lead_to_other_programs(folder, scaled, traced, monkeypatch):
    scaled()("torque", {"x": np.ones(3)})
    monkeypatch.setattr(programs, "_surroundings", lambda: b"another processor")
    scaled()("torque", {"x": np.ones(3)})
    assert len(traced) == 2
    here = programs._surroundings
    monkeypatch.undo()
    assert here() != programs._surroundings()
    monkeypatch.setenv("XLA_FLAGS", "--xla_llvm_disable_expensive_passes=true")
    assert programs._surroundings.__wrapped__() != programs._surroundings()


def test_results_of_constants_are_kept(folder):
    asked = []

    def sites(kind, names):
        asked.append(kind)
        return frozenset(names)

    for kind, names in (
        (Model, ("a", "b")),
        (Model, ("a", "b")),
        (Model, ("c",)),
        (Users, ("a", "b")),
        (Users, ("a", "b")),
    ):
        assert kept(sites)(kind, names) == set(names)
    assert asked == [Model, Model, Users, Users]


class Users(NamedTuple):
    """A class whose code the key does not hold."""

    x: Float[Array, "N"]


def test_what_has_a_users_code_is_traced_in_each_process(folder, traced):
    for _ in range(2):

        def doubled(values: Users):
            traced.append(values)
            return 2.0 * values.x

        np.testing.assert_array_equal(Program(doubled, dict)(Users(jnp.ones(3))), 2.0)
    assert len(traced) == 2


LAPACK = """
import jax.numpy as jnp
import numpy as np
from jaxfinger.compilation import quick_jit

def values(A):
    print("traced")
    return jnp.linalg.svd(A, compute_uv=False)

print(np.asarray(quick_jit(values)(np.eye(3))))
"""


def test_a_process_that_traces_nothing_can_call_lapack(folder):
    """JAX readies LAPACK where it traces a call of it, and crashes where it calls it before."""
    said = [
        subprocess.run([sys.executable, "-c", LAPACK], capture_output=True, text=True, check=True).stdout.splitlines()
        for _ in range(2)
    ]
    assert said == [["traced", "[1. 1. 1.]"], ["[1. 1. 1.]"]]


def test_models_go_in_and_come_out(folder, traced):
    """Fingers of other names and limits share a program, whose results have their own names."""
    model = true_model(polynomial_finger(paper_finger()))
    effect = CATALOGUE["tendon_stretch"].at(model.finger, ("T1",), compliance=2e-5)
    model = replace(model, effects=(effect,))

    def moved(model: Model, q) -> tuple[Model, Array]:
        traced.append(model)
        return eqx.tree_at(lambda m: m.finger.mass, model, 2.0 * model.finger.mass), model.moment_arm.excursion(q)

    other = replace(model, finger=replace(model.finger, joint_names=("a", "b", "c")))
    q = jnp.asarray(np.random.default_rng(0).uniform(0.0, 1.0, (3, 4)))
    for m in (model, other, model, other):
        out, excursion = Program(moved, dict)(m, q)
        assert out.finger.joint_names == m.finger.joint_names
        np.testing.assert_array_equal(out.finger.mass, 2.0 * m.finger.mass)
        np.testing.assert_allclose(excursion, m.moment_arm.excursion(q), rtol=1e-12)
    assert len(traced) == 2
    lowered = [f for f in folder.iterdir() if f.stat().st_size > 2000]
    assert len(lowered) == 1
