"""A diagnosis from end to end: the planted cause is found, and all that is written says so."""

import json
from dataclasses import replace
from importlib import import_module

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from jaxfinger.effects import CATALOGUE, CatalogueEffect, amplitude
from jaxfinger.errors import UserError
from jaxfinger.gap import as_gap_json, diagnose, fit_with, write
from jaxfinger.gap.diagnose import _closing
from jaxfinger.gap.shrinkage import Shrinkage
from jaxfinger.gap.signatures import whitened
from jaxfinger.gap.where import where
from jaxfinger.identify import load_fit
from jaxfinger.identify.noise import whiten
from jaxfinger.report.diagnosis_page import summary, write_page

from .conftest import RIVALS, TRUTH, WITHOUT, session_with


@pytest.fixture(scope="module")
def gap(diagnosis):
    return json.loads(json.dumps(as_gap_json(diagnosis), allow_nan=False))


def test_the_planted_cause_and_its_site_are_named(gap):
    assert gap["verdict"]["status"] == "explained"
    (first, *_) = gap["verdict"]["effects"]
    assert (first["effect"], tuple(first["site"])) == TRUTH
    best = gap["candidates"][0]
    assert (best["effect"], tuple(best["site"])) == TRUTH
    assert best["probability"] > 0.8
    x0 = best["parameters"]["x0"]
    assert x0["units"] == "rad"
    assert x0["value"] == pytest.approx(0.1, rel=0.2)
    assert best["parameters"]["a"]["value"] == pytest.approx(1.0, abs=0.15)


def test_a_first_look_names_and_closes_what_the_whole_one_does(gap):
    """From half the samples, with no fit but the refits."""
    session = session_with((*TRUTH, {"a": 1.0, "x0": 0.1}))
    look = as_gap_json(diagnose(session, without=WITHOUT, quick=True))
    assert look["verdict"]["effects"] == gap["verdict"]["effects"]
    assert look["verdict"]["status"] == "explained"
    ours, theirs = (g["candidates"][0]["parameters"] for g in (look, gap))
    for name in ours:
        std = np.hypot(ours[name]["std"], theirs[name]["std"])
        assert ours[name]["value"] == pytest.approx(theirs[name]["value"], abs=3.0 * std)
    lines = {(x["experiment"], x["channel"]): x["closed"] for x in gap["gap"] if x["before"] > 1.5 * x["noise"]}
    assert lines
    for x in look["gap"]:
        if (x["experiment"], x["channel"]) in lines:
            assert x["closed"] == pytest.approx(lines[x["experiment"], x["channel"]], abs=0.05)


def test_two_effects_are_both_named_and_keep_their_sizes():
    relaxation = "elastic_relaxation", ("MCP",)
    session = session_with((*TRUTH, {"a": 1.0, "x0": 0.1}), (*relaxation, {"stiffness": 0.1, "T": 1.0}))
    found = diagnose(session, without=WITHOUT)
    assert found.verdict.status == "explained"
    assert set(found.verdict.effects) == {TRUTH, relaxation}
    gains = {c.key: c.held_out for c in found.search.candidates}
    # What each explains beside the other: of the smaller, a hundredth of the gap or less.
    assert [gains[k] for k in found.search.chosen.keys] == pytest.approx(found.search.shares, rel=0.2)
    at = {tuple(x["site"]): x["parameters"] for x in as_gap_json(found)["candidates"][:2]}
    assert at["PIP",]["x0"]["value"] == pytest.approx(0.1, rel=0.2)
    assert at["MCP",]["stiffness"]["value"] == pytest.approx(0.1, rel=0.2)
    assert at["MCP",]["T"]["value"] == pytest.approx(1.0, rel=0.3)


def test_a_fit_with_the_effect_that_is_known_to_be_there_is_that_of_the_diagnosis(diagnosis):
    session = session_with((*TRUTH, {"a": 1.0, "x0": 0.1}))
    known = fit_with(session, [TRUTH])
    for ours, theirs in zip(known.model.effects, diagnosis.augmented.model.effects, strict=True):
        assert ours.values() == pytest.approx(theirs.values(), rel=1e-3)
    with pytest.raises(UserError, match="joint_presliding is not at T1; it has MCP, PIP, DIP"):
        fit_with(session, [("joint_presliding", ("T1",))])
    with pytest.raises(UserError, match=r"joint_coulomb is a term of the recipe.s own model"):
        fit_with(session, [("joint_coulomb", ("PIP",))])
    with pytest.raises(UserError, match=r"no trial shows force_sensor_rotation at fingertip; record VD\.2"):
        fit_with(session, [("force_sensor_rotation", ("fingertip",))])
    with pytest.raises(UserError, match="no effect stiction"):
        fit_with(session, [("stiction", ("PIP",))])


def test_the_gap_lies_at_the_joint_and_closes_on_held_out_trials(gap):
    assert gap["where"][0]["channel"] == "joint_torque"
    assert gap["where"][0]["site"] == "PIP"
    line = max(gap["gap"], key=lambda x: x["before"] / x["noise"])
    assert line["channel"] == "joint_torque"
    assert line["closed"] > 0.9
    assert line["after"] < line["before"]


def test_gap_json_is_to_the_letter(gap, diagnosis):
    assert set(gap) == {
        "schema", "data", "specimen", "verdict", "where", "candidates", "none", "unlisted", "ambiguous_sets",
        "next_experiment", "gap",
    }  # fmt: skip
    assert gap["schema"] == "jaxfinger-gap/1"
    assert set(gap["verdict"]) == {"status", "effects", "summary"}
    for place in gap["where"]:
        assert set(place) == {"experiment", "trial", "channel", "site", "region", "share"}
        assert set(place["region"]) == {"variable", "low", "high"}
        assert place["region"]["low"] <= place["region"]["high"]
    shares = [p["share"] for p in gap["where"]]
    assert shares == sorted(shares, reverse=True)
    assert 0 < sum(shares) <= 1 + 1e-9
    for c in gap["candidates"]:
        assert set(c) == {"effect", "site", "probability", "parameters", "held_out_gain"}
        for p in c["parameters"].values():
            assert set(p) == {"value", "std", "units"}
    probabilities = [c["probability"] for c in gap["candidates"]]
    assert probabilities == sorted(probabilities, reverse=True)
    assert sum(probabilities) + gap["none"] + gap["unlisted"] == pytest.approx(1.0, abs=1e-9)
    for line in gap["gap"]:
        assert set(line) == {"experiment", "channel", "units", "noise", "before", "after", "closed", "closed_ci95"}
        assert line["units"] == {"joint_torque": "N m", "tendon_excursion": "m"}[line["channel"]]
        squares = {k: line[k] ** 2 for k in ("noise", "before", "after")}
        if line["before"] > 1.2 * line["noise"]:
            closed = 1 - (squares["after"] - squares["noise"]) / (squares["before"] - squares["noise"])
            assert line["closed"] == pytest.approx(np.clip(closed, -1, 1), abs=1e-9)
            assert line["closed_ci95"][0] <= line["closed"] <= line["closed_ci95"][1]


def test_written_fits_carry_the_effect(diagnosis, tmp_path):
    write(diagnosis, tmp_path / "out")
    nominal, augmented = (load_fit(tmp_path / "out" / f"{n}.json") for n in ("nominal", "augmented"))
    assert not nominal.model.effects
    assert TRUTH[0] == augmented.model.effects[0].ID
    assert augmented.model.effects[0].site == TRUTH[1]
    before = (tmp_path / "out" / "gap.json").read_bytes()
    with pytest.raises(UserError, match="not overwritten"):
        write(diagnosis, tmp_path / "out")
    assert (tmp_path / "out" / "gap.json").read_bytes() == before


def test_page_and_screen(diagnosis, gap, tmp_path):
    path = tmp_path / "report.html"
    write_page(diagnosis, path)
    text = path.read_text(encoding="utf-8")
    assert text.count("<svg") == 2
    assert "src=" not in text.replace("xlink:href", "")
    assert "<script" not in text
    assert "<link" not in text
    assert gap["verdict"]["summary"] in text
    with pytest.raises(UserError, match="not overwritten"):
        write_page(diagnosis, path)
    screen = summary(diagnosis).splitlines()
    assert len(screen) <= 45
    assert any("joint_presliding · PIP" in line for line in screen)


def test_a_noise_that_nothing_shows_is_said_to_be_unknown(diagnosis, tmp_path):
    """Without repeats nobody knows how far two runs of VD.3 fall apart."""
    first, *rest = diagnosis.shrinkage
    lone = replace(diagnosis, shrinkage=[replace(first, noise=0.0), *rest])
    write_page(lone, tmp_path / "report.html")
    assert "unknown" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert any(first.channel in line and "unknown" in line for line in summary(lone).splitlines())


def test_signatures_are_whitened_as_the_residuals_are(diagnosis):
    problem = diagnosis.problem
    rng = np.random.default_rng(0)
    for e, channel in (("ID.3-dynamic", "joint_torque"), ("ID.2", "tendon_excursion")):
        rows, stack = problem.rows[e], problem.stacks[e]
        raw = rng.standard_normal((1, *stack.batch.y[channel].shape))
        pick = np.arange(rows.size)
        mine = whitened(raw, problem, rows, pick, channel)[0]
        filters = jnp.asarray(problem.noise[e, channel].coefficients)
        white = whiten(jnp.asarray(raw[0]), stack.batch.mask[channel], filters, channel == "tendon_excursion")
        reference = np.asarray(white)[rows.column, rows.trial, rows.time]
        np.testing.assert_allclose(mine, reference, rtol=1e-6, atol=1e-6 * np.abs(reference).max())


def test_where_finds_a_planted_gap(diagnosis):
    """White noise everywhere, and five deviations more in the upper angles of one trial."""
    problem = diagnosis.problem
    rows = problem.rows["ID.3-dynamic"]
    r = np.random.default_rng(1).standard_normal(problem.r.size)
    trial, column = int(rows.trial[-1]), int(rows.column[rows.trial == rows.trial[-1]][0])
    mine = (rows.trial == trial) & (rows.column == column)
    q = np.asarray(problem.stacks["ID.3-dynamic"].batch.x.q)[column, trial, rows.time]
    threshold = np.quantile(q[mine], 2 / 3)
    r[rows.start : rows.start + rows.size][mine & (q > threshold)] += 5.0
    (place, *rest) = where(replace(problem, r=r))
    assert not rest
    assert place.trial == problem.stacks["ID.3-dynamic"].trials[trial]
    assert place.site == problem.nominal.finger.joint_names[column]
    assert place.variable == "q"
    assert place.low == pytest.approx(threshold, abs=0.05)
    assert place.share > 0.9


def test_no_place_stands_out_of_white_noise(diagnosis):
    problem = diagnosis.problem
    assert where(replace(problem, r=np.random.default_rng(2).standard_normal(problem.r.size))) == []


def test_progress_is_told(diagnosis, messages):
    assert len(messages) > 5
    assert any("refitting" in m for m in messages)


def test_nothing_is_named_where_nothing_is():
    found = diagnose(session_with(), without=WITHOUT)
    gap = as_gap_json(found)
    assert gap["verdict"]["status"] == "no_gap"
    assert gap["verdict"]["effects"] == []
    assert gap["none"] > 0.8
    total = sum(c["probability"] for c in gap["candidates"])
    assert total + gap["none"] + gap["unlisted"] == pytest.approx(1.0, abs=1e-9)
    assert "No gap beyond the noise" in summary(found)


def test_a_cause_that_held_out_trials_do_not_know_is_not_named(monkeypatch):
    def none_of_it(problem, members):
        alone = float(problem.r @ problem.r)
        return alone, np.full(len(members), alone)

    monkeypatch.setattr("jaxfinger.gap.search.held_out_energies", none_of_it)
    found = diagnose(session_with((*TRUTH, {"a": 1.0, "x0": 0.1})), without=WITHOUT)
    assert not found.verdict.effects
    assert found.verdict.status == "unexplained"  # it is large: some smooth law sees it
    monkeypatch.setattr("jaxfinger.gap.search.ALONE", np.inf)
    found = diagnose(session_with((*TRUTH, {"a": 1.0, "x0": 0.1})), without=WITHOUT)
    assert found.verdict.status == "no_gap"
    assert "explains 0 % of what it fitted on trials that its fit has not seen" in found.verdict.summary


def test_what_closes_nothing_of_a_plain_gap_is_no_explanation(monkeypatch):
    monkeypatch.setattr("jaxfinger.gap.shrinkage._choice", lambda *_: ("joint_magic", ("PIP",)))
    found = diagnose(session_with((*TRUTH, {"a": 1.0, "x0": 0.1})), without=WITHOUT)
    assert found.verdict.status == "unexplained"
    assert not found.verdict.effects
    says = "the nearest, joint_presliding at PIP, closes 0 % of the gap in joint_torque of ID.3-"
    assert says in found.verdict.summary
    gap = as_gap_json(found)
    assert gap["unlisted"] == pytest.approx(0.9)
    assert sum(c["probability"] for c in gap["candidates"]) + gap["none"] + gap["unlisted"] == pytest.approx(1.0)
    assert not gap["ambiguous_sets"]


def test_an_unknown_effect_to_leave_out_is_refused():
    with pytest.raises(UserError, match="no effect joint_magic"):
        diagnose(session_with(), without=("joint_magic",))


class SumOfAngles(CatalogueEffect):
    """A torque periodic in the sum of two angles."""

    ID = "sum_of_angles"
    PLACE = "joint pair"

    a: Float[Array, ""] = amplitude("N m", 0.02, "torque", signed=True)

    def torque(self, x, memory, h):
        i, j = self.index
        return h.at[i].add(self.a * jnp.sin(6.0 * (x.q[i] + x.q[j])))


@pytest.mark.parametrize("known", [RIVALS, ("tendon_backlash", "tendon_stretch")])
def test_a_law_that_nobody_listed_gets_a_proposal_in_closed_form(known, tmp_path):
    """Whether the catalogue has effects of that joint, which explain some of it, or none that explains any."""
    session = session_with((SumOfAngles, ("PIP", "DIP"), {"a": 3e-3}))
    found = diagnose(session, without=tuple(set(CATALOGUE) - set(known)))
    assert found.verdict.status == "unexplained"
    assert found.search.unlisted > 0.5
    assert found.proposal is not None
    assert found.proposal.site == "PIP"
    assert found.proposal.share > 0.5
    assert "A proposal, unproven" in found.verdict.summary
    gap = as_gap_json(found)
    total = sum(c["probability"] for c in gap["candidates"])
    assert total + gap["none"] + gap["unlisted"] == pytest.approx(1.0, abs=1e-9)
    assert gap["where"][0]["site"] == "PIP"
    write_page(found, tmp_path / "page.html")


def test_a_gap_with_a_second_cause_stays_open_and_is_said(monkeypatch):
    """One channel closes and another does not: the cause is named, and what it leaves too."""
    module = import_module("jaxfinger.gap.diagnose")  # the package names the function
    real = module.shrinkage

    def with_another(*arguments):
        (closing, *rest) = sorted(real(*arguments), key=lambda x: -x.before / x.noise)
        other = replace(closing, experiment="VD.3", after=closing.before, closed=0.0, closed_ci95=(0.0, 0.0))
        return [closing, *rest, replace(other, before=2 * other.before, after=2 * other.after)]

    monkeypatch.setattr(module, "shrinkage", with_another)
    found = diagnose(session_with((*TRUTH, {"a": 1.0, "x0": 0.1})), without=WITHOUT)
    assert found.verdict.effects == (TRUTH,)
    assert "joint_torque of VD.3 stays at" in found.verdict.summary


def test_how_far_a_gap_closes_is_not_said_where_no_channel_shows_it():
    line = Shrinkage("VD.3", "joint_torque", "N m", 1e-4, 1.03e-4, 1.01e-4, 0.0, (0.0, 0.0), resolvable=False)
    assert "cannot say how far" in _closing([line])
    assert "up to 80 %" in _closing([line, replace(line, before=3e-4, closed=0.8, resolvable=True)])
