"""Cases repeat bit for bit from their seeds, and keep their truth in another tree."""

import json

import numpy as np
import pytest

from jaxfinger.data import check_file, read_session
from jaxfinger.sealed import cases
from jaxfinger.sealed.cases import SPLITS, CaseSpec, case_specs, make_case, make_cases
from jaxfinger.sealed.departures import LISTED, UNLISTED
from tests.sealed.conftest import short


@pytest.fixture
def quick(monkeypatch):
    """Short sessions, so that a case takes seconds."""
    whole = cases.with_trajectories
    monkeypatch.setattr(
        cases, "with_trajectories", lambda nominal, plans, rng: whole(nominal, short(plans, nominal, rng), rng)
    )


SPEC = CaseSpec("double", "planar", ("tendon_stretch", "torque_sensor_scale"), (10.0, 5.0))


@pytest.mark.long
def test_a_case_repeats_bit_for_bit_and_keeps_its_truth_apart(quick, tmp_path):
    first = make_case(3, "develop", SPEC, tmp_path / "a", tmp_path / "a-truth")
    second = make_case(3, "develop", SPEC, tmp_path / "b", tmp_path / "b-truth")
    for file in ("fit.h5", "fresh.h5"):
        one, two = read_session(first / file), read_session(second / file)
        assert list(one.trials) == list(two.trials)
        for trial in one:
            for channel in ("time", "q", "tendon_force", "tendon_excursion", "joint_torque", "fingertip_force"):
                np.testing.assert_array_equal(getattr(trial, channel), getattr(two[trial.name], channel))
        assert not [f for f in check_file(first / file) if f.severity == "error"]
        content = (first / file).read_bytes()
        assert not any(word.encode() in content for word in (*SPEC.effects, "severity", "linear", "toe_hardening"))
    assert sorted(p.name for p in first.iterdir()) == ["fit.h5", "fresh.h5"]
    truth = json.loads((tmp_path / "a-truth" / "case-003.json").read_text())
    assert truth == json.loads((tmp_path / "b-truth" / "case-003.json").read_text())
    assert [e["effect"] for e in truth["effects"]] == list(SPEC.effects)
    for e in truth["effects"]:
        assert e["reached"] == pytest.approx(e["severity"], rel=0.11)
    for row in truth["fresh"]:
        assert row["before"] >= row["after"] == row["noise"]
    assert max(r["gap"] / r["noise"] for r in truth["fresh"]) > 0.2

    stamp = (first / "fit.h5").stat().st_mtime_ns
    (first / "fit.h5").touch()
    done = []
    make_cases("develop", 3, tmp_path / "a", tmp_path / "a-truth", only=[3], progress=lambda *a: done.append(a))
    assert done == [(1, 1, "case-003")]
    assert (first / "fit.h5").stat().st_mtime_ns != stamp  # `touch` has changed it; the file is the old one.
    assert json.loads((tmp_path / "a-truth" / "case-003.json").read_text()) == truth


@pytest.mark.long
def test_fresh_trials_repeat_nothing_of_the_session(quick, tmp_path):
    folder = make_case(1, "fresh", CaseSpec("none", "n-plus-one"), tmp_path / "c", tmp_path / "t")
    fit, fresh = read_session(folder / "fit.h5"), read_session(folder / "fresh.h5")
    motions = [t.motion for t in fresh]
    assert len(set(motions)) == len(motions)
    assert not set(motions) & {t.motion for t in fit}
    held = {t.experiment: t for t in fit if t.experiment == "VD.2"}["VD.2"]
    other = {t.experiment: t for t in fresh if t.experiment == "VD.2"}["VD.2"]
    assert np.abs(held.q[0] - other.q[0]).max() > 0.02
    np.testing.assert_array_equal(fit.finger.mass, fresh.finger.mass)


def test_the_splits_are_disjoint_and_a_longer_run_adds_to_a_shorter():
    assert len(set(SPLITS.values())) == len(SPLITS)
    assert case_specs("develop", 40) == case_specs("develop", 200)[:40]
    assert case_specs("develop", 40) != case_specs("fresh", 40)


def test_the_mix_holds_every_effect_every_kind_and_every_specimen():
    specs = case_specs("fresh", 400)
    named = {e for s in specs for e in s.effects}
    assert named == {*LISTED, *UNLISTED}
    share = {kind: sum(s.kind == kind for s in specs) / 400 for kind in ("none", "listed", "unlisted", "double")}
    assert 0.1 <= share["none"] <= 0.25
    assert share["listed"] >= 0.5
    assert share["unlisted"] >= 0.1
    assert share["double"] == pytest.approx(0.1)
    assert {s.specimen for s in specs} == {"planar", "abducting", "chain", "n-plus-one", "human-like"}
    assert {x for s in specs if s.kind == "listed" for x in s.severities} == {2.0, 5.0, 10.0}
    assert len({s.effects[0] for s in specs[:100] if s.kind == "listed"}) == len(LISTED)
    assert len(UNLISTED) >= 6


def test_several_causes_come_by_threes_to_fives_every_other_time_with_an_unlisted_one():
    specs = case_specs("fresh", 40, "several")
    for i, spec in enumerate(specs):
        listed = [e for e in spec.effects if e in LISTED]
        assert 3 <= len(set(listed)) == len(listed) <= 5
        assert len(spec.effects) - len(listed) == i % 2
        assert max(spec.severities[: len(listed)]) <= 2 * min(spec.severities[: len(listed)])
    assert specs != case_specs("develop", 40, "several")


@pytest.mark.long
def test_foreign_cases_have_forms_and_protocols_that_no_other_split_has(quick, tmp_path):
    kinds = LISTED.values()
    assert all(not set(k.foreign) & set(k.forms) for k in kinds)
    specs = case_specs("foreign", 60)
    assert all(LISTED[e].foreign for s in specs if s.kind in ("listed", "double") for e in s.effects)
    spec = CaseSpec("listed", "planar", ("tendon_stretch",), (10.0,))
    folder = make_case(1, "foreign", spec, tmp_path / "c", tmp_path / "t")
    (effect,) = json.loads((tmp_path / "t" / "case-001.json").read_text())["effects"]
    assert effect["form"] in LISTED["tendon_stretch"].foreign
    assert effect["known"] == {}
    session = read_session(folder / "fit.h5")
    assert {round(1 / np.median(np.diff(t.time))) for t in session} == {200}
    sweeps = [t for t in session if t.experiment == "ID.3-dynamic"]
    for trial in sweeps:
        assert trial.joint is None
        assert np.isfinite(trial.joint_torque).all()
        assert (np.ptp(trial.q, axis=0) > 0.5).all()
