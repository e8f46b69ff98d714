"""Scores of verdicts made by hand, against known figures."""

import json
from io import StringIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from jaxfinger.errors import UserError
from jaxfinger.sealed.figures import reliability_diagram
from jaxfinger.sealed.score import bootstrap, brier, closed_share, score_cases, score_folder, wilson
from jaxfinger.sealed.tables import render
from jaxfinger.sealed.truth import NONE, UNLISTED, Diagnosis, Truth, read_diagnosis, read_truth

STRETCH, CREEP = ("tendon_stretch", ("T3",)), ("tendon_creep", ("T3",))
STRETCH_T1 = ("tendon_stretch", ("T1",))
ROTATION = ("force_sensor_rotation", ("fingertip",))


def said(status, named=(), sets=(), values=None, **probability):
    p = {STRETCH: 0.0, CREEP: 0.0, STRETCH_T1: 0.0, NONE: 0.0, UNLISTED: 0.0}
    for key, value in probability.items():
        p[{"stretch": STRETCH, "creep": CREEP, "t1": STRETCH_T1, "none": NONE, "unlisted": UNLISTED}[key]] = value
    return Diagnosis(status, tuple(named), tuple(tuple(s) for s in sets), p, seconds=10.0, values=values or {})


UNKNOWN = ("stick-slip", ("fingertip",))


def truth(name, kind, listed=(), others=(), matters=None, known=None, severity=5.0, specimen="planar"):
    matters = listed if matters is None else matters
    return Truth(name, kind, (*listed, *others), listed, matters, known or {}, severity, severity, specimen)


LISTED = truth("a", "listed", (STRETCH,), known={STRETCH: {"compliance": 2e-5}})
DOUBLE = truth("b", "double", (STRETCH, CREEP), severity=10.0)
SOUND = truth("c", "none", severity=None)
STRANGE = truth("d", "unlisted", (), (UNKNOWN,), specimen="chain")
MANY = truth("e", "several", (STRETCH, CREEP, STRETCH_T1), (UNKNOWN,), matters=(STRETCH, CREEP))


def test_every_figure_of_a_set_made_by_hand():
    pairs = [
        (LISTED, said("explained", [STRETCH], stretch=0.9, creep=0.1)),  # right
        (LISTED, said("ambiguous", [CREEP], [[CREEP, STRETCH]], stretch=0.4, creep=0.6)),  # wrong, but covered
        (LISTED, said("explained", [STRETCH_T1], t1=1.0)),  # wrong site
        (
            LISTED,
            said("ambiguous", [STRETCH], [[STRETCH, CREEP, STRETCH_T1, ("payload", ("MCP",))]], stretch=1.0),
        ),  # The set is too large.
        (SOUND, said("no_gap", none=1.0)),
        (SOUND, said("explained", [CREEP], creep=0.7, none=0.3)),  # false alarm
        (STRANGE, said("unexplained", unlisted=0.8, creep=0.2)),
        (DOUBLE, said("explained", [CREEP, STRETCH], creep=0.5, stretch=0.5)),
        (DOUBLE, said("explained", [CREEP], creep=1.0)),
    ]
    s = score_cases(pairs)
    value = {name: f.value for name, f in s.figures.items()}
    assert value["cause"] == pytest.approx(2 / 4)
    assert value["covered"] == pytest.approx(2 / 4)
    assert value["false alarm"] == pytest.approx(1 / 2)
    assert value["open set"] == 1.0
    assert value["double, one right"] == 1.0
    assert value["double, both right"] == pytest.approx(1 / 2)
    assert value["false gap"] == pytest.approx(1 / 2)
    expected = [0.02, 0.72, 2.0, 0.0, 0.0, 0.98, 0.08, 0.5, 1.0]
    assert value["Brier"] == pytest.approx(np.mean(expected))
    assert value["probability on the truth"] == pytest.approx(np.mean([0.9, 0.4, 0, 1, 1, 0.3, 0.8, 0.5, 0.5]))
    assert value["set size"] == pytest.approx(np.mean([1, 2, 1, 4, 1, 1, 1]))
    assert value["seconds"] == 10.0
    assert s.by_effect["tendon_stretch"]["cause"].count == 4
    assert s.by_severity["5"]["open set"].value == 1.0
    assert ("tendon_stretch (T3)", "tendon_stretch (T1)", 1) in s.confusions
    assert ("none", "tendon_creep (T3)", 1) in s.confusions
    assert len(s.missed) == 4
    json.dumps(s.to_json())


def test_several_causes_are_scored_by_those_that_matter_and_those_that_are_named():
    pairs = [
        (MANY, said("partly", [STRETCH, CREEP], stretch=0.9, creep=0.9, t1=0.2, unlisted=0.8)),  # all that matters
        (MANY, said("partly", [STRETCH, STRETCH_T1], stretch=0.9, t1=0.9)),  # one that matters, one that does not
        (MANY, said("explained", [STRETCH, ("payload", ("MCP",))], stretch=1.0)),  # one that is not there
    ]
    value = {name: f.value for name, f in score_cases(pairs).figures.items()}
    assert value["several, named, of those that matter"] == pytest.approx(4 / 6)
    assert value["several, at work, of those named"] == pytest.approx(5 / 6)
    assert value["several, all right"] == pytest.approx(1 / 3)
    assert value["several, called explained that is not"] == pytest.approx(1 / 3)
    assert brier(MANY, pairs[0][1]) == pytest.approx(0.1**2 + 0.1**2 + 0.8**2 + 0.2**2)


def test_values_count_where_the_form_is_the_catalogues_own_and_the_cause_is_named():
    close = {STRETCH: {"compliance": (2.1e-5, 1e-6), "toe": (0.1, 0.1)}}
    far = {STRETCH: {"compliance": (3e-5, 1e-6)}}
    pairs = [
        (LISTED, said("explained", [STRETCH], values=close)),
        (LISTED, said("explained", [STRETCH], values=far)),
        (LISTED, said("explained", [CREEP], values=far)),
    ]
    figure = score_cases(pairs).figures["values inside 95 % intervals"]
    assert (figure.value, figure.count) == (0.5, 2)


def test_a_failed_diagnosis_counts_as_wrong(tmp_path):
    failed = read_diagnosis(tmp_path)
    s = score_cases([(LISTED, failed), (SOUND, failed), (STRANGE, failed)])
    assert s.failed == 3
    assert s.figures["cause"].value == 0.0
    assert s.figures["open set"].value == 0.0
    assert s.figures["false alarm"].value == 0.0  # It named nothing.
    assert len(s.missed) == 3


def test_brier_of_a_truth_that_is_no_candidate():
    outside = truth("e", "listed", (("payload", ("MCP",)),))
    assert brier(outside, said("explained", [CREEP], creep=1.0)) == pytest.approx(2.0)


def test_wilson_against_published_values():
    """Newcombe (1998), Table I, method 3: 81 of 263, 15 of 148, 0 of 20, 1 of 29."""
    for hits, count, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        figure = wilson(hits, count)
        assert figure.low == pytest.approx(low, abs=5e-5)
        assert figure.high == pytest.approx(high, abs=5e-5)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_holds_its_share(pair):
    f = wilson(*pair)
    assert 0.0 <= f.low <= f.value + 1e-12
    assert f.value - 1e-12 <= f.high <= 1.0


def test_closed_is_a_share_of_what_the_true_effect_closes():
    ceiling = [
        {"experiment": "ID.4", "channel": "tendon_excursion", "before": 5.0, "after": 3.0, "noise": 1.0},
        {"experiment": "VD.3", "channel": "q", "before": 9.0, "after": 0.0, "noise": 1.0},
    ]
    row = {"experiment": "ID.4", "channel": "tendon_excursion", "before": 5.0, "after": np.sqrt(17.0)}
    assert closed_share([row], ceiling) == pytest.approx((25 - 17) / (25 - 9))
    assert closed_share([row | {"after": 3.0}], ceiling) == pytest.approx(1.0)
    assert closed_share([row | {"after": 6.0}], ceiling) < 0
    ours = row | {"before": 7.0}  # of another nominal model
    assert closed_share([ours], ceiling) == pytest.approx((49 - 17) / (49 - 9))
    assert closed_share([ours], [ceiling[0] | {"gap": 4.0}]) == pytest.approx((49 - 17) / (25 - 9))
    assert np.isnan(closed_share([], ceiling))
    refitted = row | {"best": np.sqrt(15.0)}  # A refit with the true effect takes the place of the law.
    assert closed_share([refitted], ceiling) == pytest.approx((25 - 17) / (25 - 15))
    assert closed_share([refitted], ceiling, by_law=True) == pytest.approx((25 - 17) / (25 - 9))
    assert np.isnan(closed_share([row | {"best": 4.9999}], ceiling))


def test_reliability_of_a_calibrated_forecaster():
    rng = np.random.default_rng(0)
    pairs = []
    for _ in range(3000):
        p = rng.uniform()
        true = LISTED if rng.uniform() < p else truth("x", "listed", (CREEP,))
        pairs.append((true, said("explained", [STRETCH], stretch=p, creep=1 - p)))
    for row in score_cases(pairs).reliability:
        assert row["said"] == pytest.approx(row["came true"], abs=0.05)


def test_a_folder_with_truth_beside_the_data_or_apart(tmp_path):
    practice = {
        "effects": [
            {
                "effect": "tendon_stretch",
                "listed": True,
                "site": ["T3"],
                "form": "linear",
                "severity": "mid",
                "parameters": {},
            }
        ],
        "fresh": [],
    }
    gap = {
        "verdict": {"status": "explained", "effects": [{"effect": "tendon_stretch", "site": ["T3"]}]},
        "none": 0.1,
        "unlisted": 0.0,
        "candidates": [{"effect": "tendon_stretch", "site": ["T3"], "probability": 0.9}],
        "ambiguous_sets": [],
        "budget": [{"effect": "tendon_stretch", "site": ["T3"], "parameters": {"f0": {"value": 1.0, "std": 0.1}}}],
    }
    for name in ("case-01", "case-02", "case-03"):
        (tmp_path / "cases" / name).mkdir(parents=True)
        (tmp_path / "cases" / name / "fit.h5").touch()
    for name in ("case-01", "case-02"):
        (tmp_path / "d" / name).mkdir(parents=True)
        (tmp_path / "d" / name / "gap.json").write_text(json.dumps(gap))
    (tmp_path / "cases" / "case-01" / "truth.json").write_text(json.dumps(practice))
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "case-02.json").write_text(json.dumps({"kind": "none", "effects": []}))
    scores = score_folder(tmp_path / "cases", tmp_path / "d", tmp_path / "t")
    assert scores.cases == 2  # The third has no diagnosis.
    assert scores.figures["cause"].value == 1.0
    assert scores.figures["false alarm"].value == 1.0
    assert scores.by_severity["mid"]["cause"].count == 1
    picture = reliability_diagram(scores.reliability, tmp_path / "r.svg")
    assert "<svg" in picture.read_text()
    console = Console(width=140, record=True, file=StringIO())
    console.print(render(scores))
    text = console.export_text()
    assert "100 %" in text
    assert "tendon_stretch (T3)" in text


def test_what_is_missing_is_said_in_one_sentence(tmp_path):
    with pytest.raises(UserError, match=r"no truth for this case.*--truth"):
        read_truth(tmp_path / "case-01", tmp_path / "t")
    (tmp_path / "gap.json").write_text("{}")
    with pytest.raises(UserError, match=r"gap\.json.*missing"):
        read_diagnosis(tmp_path)
    (tmp_path / "gap.json").write_text("{")
    with pytest.raises(UserError, match="cannot be read as JSON"):
        read_diagnosis(tmp_path)


@pytest.mark.parametrize(("reached", "kind", "at_work"), [(1e-9, "none", NONE), (0.5, "listed", ROTATION)])
def test_an_effect_that_leaves_no_trace_is_not_at_work(tmp_path, reached, kind, at_work):
    rotation = {"effect": ROTATION[0], "site": ROTATION[1], "listed": True, "severity": 10.0, "reached": reached}
    (tmp_path / "truth.json").write_text(json.dumps({"kind": "listed", "effects": [rotation]}))
    truth = read_truth(tmp_path, None)
    assert truth.kind == kind
    assert truth.at_work == {at_work}


def test_a_case_with_hardly_anything_to_close_moves_the_mean_and_not_the_median():
    shares = [0.9, 1.0, 1.1, 0.95, 1.05]
    assert bootstrap([*shares, -1000.0]).value < -100.0
    median = bootstrap([*shares, -1000.0], of=np.median)
    assert median.value == pytest.approx(0.975)
    assert median.low <= median.value <= median.high
