"""Exchanged columns of two tendons are reported, by each of the three tests alone."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bad_input import complaints
from jaxfinger.data import Trial

RATE, TIME = 100.0, np.arange(0.0, 9.0, 0.01)


def exchanged(session):
    """Session with the columns of both active tendons exchanged."""

    def other(trial: Trial) -> Trial:
        return replace(trial, tendon_excursion=trial.tendon_excursion[:, [1, 0, 2]])

    return replace(session, trials={t.name: other(t) for t in session})


def turning(joint: int, arms, noise=2e-5) -> Trial:
    """ID.2 trial of one joint. `arms` are the tendons' moment arms at it, m."""
    rng = np.random.default_rng(joint)
    q = 0.4 + 1e-4 * rng.standard_normal((len(TIME), 2))
    q[:, joint] += 0.4 * np.sin(2.0 * np.pi * 0.2 * TIME)
    l = q[:, [joint]] * np.array([*arms, np.nan]) + noise * rng.standard_normal((len(TIME), 3))
    force = np.array([2.0, 2.0, np.nan]) + 0.02 * rng.standard_normal((len(TIME), 3))
    return Trial(f"ID.2-{joint}", "ID.2", TIME, q, force, l, joint=("MCP", "PIP")[joint])


def pulled(tendon: int, stiffness=5e4) -> Trial:
    """ID.4 trial of one tendon that stretches. `stiffness` is in N/m."""
    rng = np.random.default_rng(10 + tendon)
    q = 0.4 + 1e-5 * rng.standard_normal((len(TIME), 2))
    force = 2.0 + 0.02 * rng.standard_normal((len(TIME), 3))
    force[:, tendon] += 5.0 + 5.0 * np.sin(2.0 * np.pi * 0.05 * TIME)
    l = 1e-6 * rng.standard_normal((len(TIME), 3))
    l[:, tendon] += force[:, tendon] / stiffness
    torque = np.column_stack([-0.005 * force[:, tendon], np.full(len(TIME), np.nan)])
    return Trial(f"ID.4-{tendon}", "ID.4", TIME, q, force, l, torque, joint="MCP", tendon=("T1", "T2")[tendon])


def of(session, *trials, known=None):
    """Session with only these trials and the session's finger, with `known` as its known excursions."""
    finger = replace(session.finger, excursion=known, excursion_std=None)
    return replace(session, finger=finger, trials={t.name: t for t in trials})


@pytest.mark.parametrize("evidence", ["crossing", "description", "stretch"])
def test_columns_that_were_taken_for_one_another_are_named(session, evidence):
    known = np.array([[[0.008], [0.005]], [[-0.007], [0.0]], [[np.nan], [np.nan]]])
    sound, words = {
        "crossing": (of(session, turning(1, (0.005, 0.0))), "T2, which does not cross it, is pulled in by 4.99 mm"),
        "description": (of(session, turning(0, (0.008, -0.007)), known=known), "ID.2 shows -7 and 8 mm a radian"),
        "stretch": (of(session, pulled(0), pulled(1)), "where T1 is pulled (ID.4), T2 gives way alone"),
    }[evidence]
    assert not any("look exchanged" in text for text in complaints(sound))
    (found,) = (text for text in complaints(exchanged(sound)) if "look exchanged" in text)
    assert "columns T1 and T2 of tendon_excursion" in found
    assert words in found


def test_what_has_other_reasons_is_not_named(session):
    """Three innocent sessions: a coupling between joints, CAD that is a tenth off, and tendons that do not stretch."""
    known = np.array([[[0.008], [0.005]], [[0.007], [0.0]], [[np.nan], [np.nan]]])
    rigid = (pulled(0, np.inf), pulled(1, np.inf))
    for odd in (
        of(session, turning(1, (0.005, 0.004))),
        of(session, turning(0, (0.0072, 0.0077)), known=known),
        of(session, *rigid),
    ):
        assert not any("look exchanged" in text for text in complaints(odd))
