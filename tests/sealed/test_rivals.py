"""The ceiling: what no method could tell apart."""

import numpy as np
import pytest

from jaxfinger.sealed import rivals
from jaxfinger.sealed.departures import draw_at
from jaxfinger.sealed.rivals import distances
from jaxfinger.sealed.severity import COARSE, Session, calibrate


@pytest.fixture
def session(specimen, plans, sensors):
    return Session(specimen, plans, sensors)


def test_the_same_cause_is_no_distance_away_and_a_foreign_one_all_of_it(session, specimen, monkeypatch):
    monkeypatch.setattr(rivals, "LISTED", ["drive_inertia", "tendon_stretch"])
    drive = draw_at("drive_inertia", (("MCP",), (0,)), specimen.finger, np.random.default_rng(0), (1.0,))
    truth, _, _ = calibrate(session, drive, 5.0)
    left = session.left(session.trace([truth])[0])
    energy = 0.5 * float(left @ left) / COARSE[250.0]
    at = {(r.effect, r.site): r.distance for r in distances(session, left, ("unnamed", ()), seed=1)}
    assert at["drive_inertia", truth.site] == pytest.approx(0.0, abs=1e-6 * energy)
    assert at["tendon_stretch", ("T1",)] > 0.95 * energy
    assert ("drive_inertia", truth.site) not in {
        (r.effect, r.site) for r in distances(session, left, ("drive_inertia", truth.site), seed=1)
    }
