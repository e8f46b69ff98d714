"""Columns that are copies of another column of their channel are reported; computed ones and held joints are not."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bad_input import complaints
from jaxfinger.data.checks.copies import check_copied_columns, check_copied_trials
from jaxfinger.data.findings import Report
from tests.data.checks.test_columns import TIME, of, pulled, turning


@pytest.mark.parametrize(
    ("channel", "columns", "names"),
    [("tendon_force", [0, 0, 2], "T1, T2"), ("tendon_force", [0, 0, 0], "T1, T2, T3")],
)
@pytest.mark.parametrize("every", [1, 10])
def test_columns_that_are_copies_of_another_are_said(session, channel, columns, names, every):
    trial = pulled(1)
    thin = {c: getattr(trial, c)[::every] for c in ("time", "q", "tendon_force", "tendon_excursion", "joint_torque")}
    trial = replace(trial, **thin)
    copied = replace(trial, **{channel: getattr(trial, channel)[:, columns]})
    words = (
        f"/trials/ID.4-1/{channel}: columns {names} hold the same numbers at every sample, noise included, as no two"
    )
    assert len([text for text in complaints(of(session, copied)) if words in text]) == 1
    assert not any("same numbers" in text for text in complaints(of(session, trial)))


def test_one_angle_may_stand_for_all_joints_that_are_held(session):
    trial = pulled(1)
    held = replace(trial, q=trial.q[:, [0, 0]])
    assert not any("same numbers" in text for text in complaints(of(session, held)))
    moved = replace(trial, q=300.0 * (trial.q - trial.q.mean(axis=0))[:, [0, 0]])
    assert any("columns MCP, PIP hold the same numbers" in text for text in complaints(of(session, moved)))


def copies(session, trial, force) -> list[str]:
    """Findings about copies where tendons T1 and T2 of a trial have this tension."""
    report = Report()
    alike = np.column_stack([force, force, np.full(len(force), np.nan)])
    check_copied_columns(of(session, replace(trial, tendon_force=alike)), report)
    return [str(finding) for finding in report if "same numbers" in finding.message]


def test_computed_columns_and_sensors_that_rest_are_no_copies(session):
    """Symmetric tendons of a simulation without noise show the same numbers, and so do slack ones."""
    trial = turning(0, (0.008, 0.01))
    long = replace(trial, time=0.01 * np.arange(9 * len(TIME)), q=np.tile(trial.q, (9, 1)), tendon_excursion=None,
                   tendon_force=None)  # fmt: skip
    noisy = np.tile(trial.tendon_force[:, 0], 9)
    swing = 5.0 + 4.0 * np.sin(2.0 * np.pi * 0.2 * long.time) + 0.1 * np.sin(2.0 * np.pi * 3.0 * long.time)
    single = (2.0 + 1e-5 * noisy).astype(np.float32).astype(float)
    rest = np.zeros(len(noisy))
    rest[100:105] = 0.1
    for x in (swing, np.round(swing, 1), single, 0.0 * noisy, np.nan * noisy, rest):
        assert not copies(session, long, x)
    assert copies(session, long, noisy)


def test_tensions_of_a_controller_may_swing_alike(session):
    trial = pulled(0)
    assert copies(session, trial, trial.tendon_force[:, 1])
    driven = replace(trial, experiment="VD.3", joint=None, tendon=None, joint_torque=None)
    assert not copies(session, driven, trial.tendon_force[:, 1])


def test_one_recording_given_as_two_experiments_is_said(session):
    trial = session["03-ID.3-dynamic-MCP"]
    static = replace(trial, name="a", experiment="ID.3-static")
    report = Report()
    check_copied_trials(replace(session, trials={"a": static, trial.name: trial}), report)
    assert [str(finding) for finding in report] == [
        "warning: /trials/03-ID.3-dynamic-MCP: is the same recording as trial a, sample for sample, which is "
        "ID.3-static; give each its own part of the recording"
    ]
