"""Whole sessions are reproducible, follow the format and take any plant; mistakes in recipes are named."""

from pathlib import Path

import numpy as np
import pytest

from jaxfinger.data import EXPERIMENT_NAMES, check_file, read_session, write_session
from jaxfinger.errors import UserError
from jaxfinger.synthetic import (
    clean_session,
    measure,
    paper_finger,
    read_session_recipe,
    recipe_from,
    session_plan,
    simulate,
    simulate_many,
)
from tests.data.conftest import ONE_JOINT

QUICK_TRIALS = {
    "rate": 50.0,
    "experiments": [e for e in EXPERIMENT_NAMES if e != "VD.3"],
    "id2": {"stroke_time": 1.0, "strokes": 2},
    "vd1": {"motions": 1, "duration": 4.0},
}
SHIPPED = Path(__file__).parents[2] / "datasets" / "paper-finger"
CHANNELS = ("time", "q", "tendon_force", "tendon_excursion", "joint_torque", "fingertip_force")


def _same(one, other):
    return all(
        np.array_equal(getattr(a, c), getattr(b, c), equal_nan=True)
        for a, b in zip(one, other, strict=True)
        for c in CHANNELS
        if getattr(a, c) is not None
    )


def _errors(path):
    return [f for f in check_file(path) if f.severity == "error"]


@pytest.fixture(scope="module")
def clean():
    return clean_session(recipe_from({"trials": QUICK_TRIALS}))


def test_a_seed_makes_a_session(clean):
    assert _same(measure(clean, 3), measure(clean, 3))
    assert not _same(measure(clean, 3), measure(clean, 4))
    assert _same(next(simulate_many(clean.recipe, [3])), measure(clean, 3))


def test_repeats_differ_by_noise_alone(clean):
    session = measure(clean, 0)
    first, second = list(session.select("ID.3-dynamic"))[:2]
    assert first.motion == second.motion
    difference = (first.joint_torque - second.joint_torque)[:, 0]
    assert difference.std() == pytest.approx(np.sqrt(2) * 3e-4, rel=0.15)
    assert abs(difference.mean()) < 1e-4


def test_noise_is_independent_from_trial_to_trial(clean):
    a, b = (t.q[:200, 2] - t.q[:200, 2].mean() for t in list(measure(clean, 0).select("ID.2"))[:2])
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.4


@pytest.mark.parametrize(
    "specimen",
    [
        {"kind": "paper", "passive_tendon": True},
        pytest.param({"kind": "polynomial"}, marks=pytest.mark.long),
        pytest.param({"kind": "random", "seed": 7, "joints": 4, "layout": "abduction"}, marks=pytest.mark.long),
        {"kind": "random", "seed": 8, "joints": 1, "tendons": "fewest"},
    ],
    ids=lambda s: f"{s['kind']}-{s.get('joints', 3)}",
)
def test_sessions_follow_the_format(specimen, tmp_path):
    session = simulate(recipe_from({"specimen": specimen, "trials": QUICK_TRIALS, "cad": {"mass": 0.01}}), seed=1)
    path = tmp_path / "session.h5"
    write_session(session, path)
    assert not _errors(path)
    assert _same(read_session(path), session)


def test_driven_session_follows_the_format(tmp_path):
    recipe = recipe_from({"trials": {"experiments": ["VD.3"], "vd3": {"motions": 2, "duration": 1.5}}})
    steps = []
    session = simulate(recipe, seed=1, progress=lambda *step: steps.append(step))
    write_session(session, tmp_path / "session.h5")
    assert not _errors(tmp_path / "session.h5")
    assert [s[:2] for s in steps] == [(0, 2), (1, 2)]
    trial = session["01-VD.3-a"]
    assert np.ptp(trial.q, axis=0).min() > 0.05
    assert trial.joint_torque is None


def test_spikes_reach_the_session():
    recipe = recipe_from({"trials": QUICK_TRIALS | {"experiments": ["ID.3-static"]}, "sensors": {"outliers": 0.02}})
    force = next(iter(simulate(recipe))).tendon_force[:, :4]
    assert (np.abs(force) > 0.27).mean() == pytest.approx(0.02, abs=0.008)


def test_any_model_can_stand_in_for_the_finger():
    """A plant that predicts prescribed channels is recorded by the same rig."""

    class Rope:
        depends_on_session_time = False

        def prescribed(self, plan):
            return {
                "q": plan.q,
                "tendon_force": plan.tension,
                "tendon_excursion": 0.01 * np.repeat(plan.q[:1], 5, axis=0),
            }

        def driven(self, plan):
            pytest.fail("no trial of this recipe is driven")

    recipe = recipe_from({"trials": QUICK_TRIALS | {"experiments": ["VD.1"]}})
    trial = next(iter(simulate(recipe, plant=Rope())))
    l = trial.tendon_excursion[:, 0] - 0.01 * trial.q[:, 0]
    assert (l - l.mean()).std() == pytest.approx(1e-5, rel=0.2)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"sensor": {}}, r"recipe: sensor: is unknown \(did you mean 'sensors'\?\)"),
        ({"sensors": {"q": {"stdd": 1}}}, r"sensors\.q\.stdd: is unknown \(did you mean 'std'\?\)"),
        ({"trials": {"rate": "fast"}}, r"trials\.rate: must be a number, not 'fast'"),
        ({"trials": {"rate": 0}}, "trials.rate: is 0; it must be above 0"),
        ({"trials": {"id4": {"tensions": []}}}, "trials.id4.tensions: is empty"),
        ({"trials": {"id4": {"tensions": [3, -1]}}}, r"trials\.id4\.tensions\[1\]: is -1; it must be above 0"),
        ({"trials": {"experiments": ["ID.9"]}}, r"experiments\[0\]: is 'ID\.9' .*; choose one of ID\.2, "),
        ({"specimen": {"kind": "cadaver"}}, r"specimen\.kind: is 'cadaver'; choose one of paper, "),
        ({"sensors": {"outliers": 2}}, "outside 0 to 1"),
        ({"seed": 1.5}, "seed: must be a whole number, not 1.5"),
        ({"specimen": {"passive_tendon": 1}}, "passive_tendon: must be true or false, not 1"),
    ],
)
def test_mistakes_in_a_recipe_are_named(table, said):
    with pytest.raises(UserError, match=said):
        recipe_from(table)


FINGER = (
    ONE_JOINT[ONE_JOINT.index("[finger]") :]
    .replace("mass = 0.02\n", "mass = 0.02\nmass_std = 0.001\n")
    .replace("4e-6]]\n", "4e-6]]\nrotor_inertia = 1e-5\n")
    .replace('"T1"\n', '"T1"\nexcursion = { MCP = [0.008, 1e-3] }\n')
    .replace('"T2"\n', '"T2"\nexcursion = { MCP = [-0.007] }\n')
)
TERMS = """
[terms.joints.MCP]
elastic = [-0.01, 0.03]
friction = [0.002]
damping = 1e-4
[terms.tendons.T1]
constant = 0.1
proportional = 0.2
"""


def test_a_finger_file_is_a_recipe(tmp_path):
    """A finger in the form of mappings and rig files serves as the recipe itself, or is named by one."""
    quick = '[trials]\nexperiments = ["ID.2", "ID.3-static", "ID.4"]\nrate = 50.0\n'
    (tmp_path / "finger.toml").write_text(FINGER)
    (tmp_path / "recipe.toml").write_text(f'finger = "finger.toml"\n{quick}{TERMS}')
    (tmp_path / "whole.toml").write_text(FINGER + TERMS + quick)
    session, whole = (simulate(read_session_recipe(tmp_path / f"{name}.toml")) for name in ("recipe", "whole"))
    assert _same(session, whole)
    assert session.finger.rotor_inertia == [1e-5]
    assert session.finger.mass_std == [0.001]
    first = next(iter(session.select("ID.2")))
    pulled = np.polynomial.polynomial.polyval(first.q[:, 0], [0.0, 0.008, 1e-3])
    assert np.ptp(first.tendon_excursion[:, 0] - pulled) < 2e-4
    still = next(iter(session.select("ID.3-static")))
    held = still.hold >= 0
    # moment of the weight about y is −m g c cos q; the spring's torque and friction in the direction of motion resist
    torque = -0.02 * 9.81 * 0.02 * np.cos(still.q[:, 0]) - 0.01 + 0.03 * still.q[:, 0]
    torque += 0.002 * still.joint_direction[:, 0]
    np.testing.assert_allclose(still.joint_torque[held, 0], torque[held], atol=2e-3)
    bare = simulate(read_session_recipe(tmp_path / "finger.toml"))  # no terms, every experiment
    assert {t.experiment for t in bare} == set(EXPERIMENT_NAMES)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("mass = 0.02", "mas = 0.02", r"line 9: finger\.joints\[0\]\.mas: is unknown \(did you mean 'mass'\?\)"),
        ("com = [", 'com = "', "line 11: is not valid TOML"),
        ("excursion = { MCP = [-0.007] }", "", "line 1: finger: says no `excursion` of tendon T2"),
        ("joints.MCP]", "joints.MCPP]", r"line 23: terms\.joints\.MCPP: is 'MCPP' \(did you mean 'MCP'\?\)"),
        ("[finger]", '[specimen]\nkind = "random"\n[finger]', "line 1: specimen: says which finger, as `finger` does"),
    ],
)
def test_mistakes_in_a_finger_to_simulate_are_named(tmp_path, old, new, said):
    (tmp_path / "finger.toml").write_text((FINGER + TERMS).replace(old, new))
    with pytest.raises(UserError, match=rf"finger\.toml, {said}"):
        read_session_recipe(tmp_path / "finger.toml")


def test_a_finger_without_tendons_is_simulated(tmp_path):
    (tmp_path / "arm.toml").write_text(FINGER.split("[[finger.tendons]]")[0])
    session = simulate(read_session_recipe(tmp_path / "arm.toml"))
    assert {t.experiment for t in session} == {"ID.3-static", "ID.3-dynamic"}


def test_too_many_joints():
    with pytest.raises(UserError, match="choose 1 to 7"):
        simulate(recipe_from({"specimen": {"kind": "random", "joints": 8}}))


@pytest.mark.parametrize(
    ("text", "said"),
    [(None, "cannot be read"), ("a = ", "line 1: is not valid TOML"), ("\n[trial]", "line 2: trial: is unknown")],
)
def test_files_that_are_no_recipe(tmp_path, text, said):
    path = tmp_path / "recipe.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=rf"recipe\.toml.*{said}"):
        read_session_recipe(path)


def test_shipped_session_is_the_shipped_recipe():
    recipe = read_session_recipe(SHIPPED / "recipe.toml")
    session = read_session(SHIPPED / "session.h5")
    assert not _errors(SHIPPED / "session.h5")
    assert list(session.trials) == [p.name for p in session_plan(paper_finger().description, recipe.trials)]
    assert (SHIPPED / "session.h5").stat().st_size < 1.9e6
    assert {t.experiment for t in session} == set(EXPERIMENT_NAMES)
