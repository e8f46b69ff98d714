"""Joints that turn on and on: sound within their limits, and beyond them told from degrees and from counts."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import Session
from jaxfinger.data.checks.finger import check_finger
from jaxfinger.data.checks.session import check_session
from jaxfinger.data.findings import Report


def _turning(session: Session, turns: float, limits_deg: tuple[float, float] | None = None) -> Session:
    """The session with a first joint that turns on in one trial, within these limits where they are given."""
    trial = session["01-ID.2-MCP"]
    q = trial.q.copy()
    q[:, 0] = 2.0 * np.pi * turns * (trial.time / trial.time[-1]) ** 2
    limits = session.finger.limits.copy()
    if limits_deg is not None:
        limits[0] = np.radians(limits_deg)
    finger = replace(session.finger, limits=limits)
    return replace(session, finger=finger, trials={**session.trials, trial.name: replace(trial, q=q)})


def _said_of_angles(session: Session) -> list[str]:
    report = Report()
    check_session(session, report)
    said = [str(finding) for finding in report if finding.severity != "note"]
    return [text for text in said if "limits" in text or "/q:" in text]


def test_a_joint_that_turns_on_within_its_limits_is_sound_and_others_have_its_mend(session):
    assert _said_of_angles(_turning(session, 5.5, (-360.0, 2160.0))) == []
    for turns, other, upper in ((5.5, "convert deg to rad", 2160), (90.0, "convert counts to rad", 32040)):
        (said,) = _said_of_angles(_turning(session, turns, (-180.0, 180.0)))
        assert f"{other} " in said
        assert f"if the joint turns on, write `limits_deg = [0, {upper}]` in the finger's file" in said
        assert _said_of_angles(_turning(session, turns, (0.0, upper))) == []


@pytest.mark.parametrize(("scale", "mend"), [(4096.0, "convert counts to rad (`scale`"), (60.0, "convert deg to rad")])
def test_whole_numbers_are_no_angle_that_turns_on(session, scale, mend):
    trial = session["01-ID.2-MCP"]
    counts = replace(session, trials={trial.name: replace(trial, q=np.round(scale * trial.q))})
    (said,) = [text for text in _said_of_angles(counts) if "column MCP" in text]
    assert mend in said
    assert "turns on" not in said


def test_limits_in_degrees_are_never_taken_for_several_turns(session):
    """Neither those that are whole degrees, nor those that were converted."""
    for limit in (*range(7, 361), *np.degrees([0.5, 1.4, 1.6, 2.9])):
        finger = replace(session.finger, limits=np.array([[-0.3, 1.6], [0.0, limit]]))
        report = Report()
        check_finger(finger, report)
        (said,) = [str(finding) for finding in report if "limits" in finding.place]
        assert "joint PIP reaches" in said
        assert "convert degrees to rad, or write `limits_deg`" in said


@pytest.mark.parametrize("between", [True, False])
def test_the_angle_between_links_is_told_from_other_angles_beyond_their_limits(session, between):
    """It is half a turn where the finger is straight."""
    trial = session["01-ID.2-MCP"]
    q = np.pi - trial.q if between else -1.5 - trial.q
    (said, *_) = _said_of_angles(replace(session, trials={trial.name: replace(trial, q=q)}))
    assert ("write scale = -1.0 and offset = 180.0" in said) == between
