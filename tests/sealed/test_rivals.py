"""Distances between causes that no method could tell apart."""

import json

import numpy as np
import pytest

from jaxfinger.sealed import rivals
from jaxfinger.sealed.departures import draw_at
from jaxfinger.sealed.rivals import add_rivals, distances
from jaxfinger.sealed.severity import COARSE, NoiseFreeSession, calibrate


@pytest.fixture
def session(specimen, plans, sensors):
    return NoiseFreeSession(specimen, plans, sensors, slack_counts=False)


@pytest.mark.long
def test_the_same_cause_is_no_distance_away_and_a_foreign_one_all_of_it(session, specimen, monkeypatch):
    monkeypatch.setattr(rivals, "LISTED", ["drive_inertia", "tendon_stretch"])
    drive = draw_at("drive_inertia", (("MCP",), (0,)), specimen.finger, np.random.default_rng(0), (1.0,))
    truth, _, _ = calibrate(session, drive, 5.0)
    left = session.refitted(session.trace([truth])[0])
    energy = 0.5 * float(left @ left) / COARSE[250.0]
    at = {(r.effect, r.site): r.distance for r in distances(session, left, ("unnamed", ()), seed=1, more=4)}
    assert at["drive_inertia", truth.site] == pytest.approx(0.0, abs=1e-6 * energy)
    assert at["tendon_stretch", ("T1",)] > 0.95 * energy
    assert ("drive_inertia", truth.site) not in {
        (r.effect, r.site) for r in distances(session, left, ("drive_inertia", truth.site), seed=1, draws=1, more=1)
    }


@pytest.mark.long
def test_an_effect_that_nobody_lists_has_listed_imitators(session, specimen, monkeypatch, tmp_path):
    """Sag at low tension resembles a stretch with a toe. A drive's inertia resembles neither."""
    monkeypatch.setattr(rivals, "LISTED", ["drive_inertia", "tendon_stretch"])
    effect = "sag of a tendon at low tension"
    sag = draw_at(effect, (("T1",), (0,)), specimen.finger, np.random.default_rng(0), (1.0,))
    truth, _, _ = calibrate(session, sag, 2.0)
    monkeypatch.setattr(rivals, "rebuild", lambda _: (session, [truth]))
    file = tmp_path / "case-001.json"
    file.write_text(json.dumps({"kind": "unlisted", "seed": [1, 1]}))
    near = add_rivals(file)
    written = json.loads(file.read_text())
    assert written["energy"] > 0
    assert [(r["effect"], r["site"]) for r in written["rivals"]] == [(r.effect, list(r.site)) for r in near]
    left = session.refitted(session.trace([truth])[0])
    all_of_them = distances(session, left, ("unnamed", ()), seed=1, more=8)
    assert (all_of_them[0].effect, all_of_them[0].site) == ("tendon_stretch", ("T1",))
    assert all_of_them[0].distance < 0.8 * written["energy"]
    assert all(r.distance > 0.95 * written["energy"] for r in all_of_them if r.effect == "drive_inertia")
