"""What a trial moves and holds fits its experiment."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bad_input import complaints


@pytest.mark.parametrize("experiment", ["ID.2", "ID.3-dynamic"])
def test_an_angle_against_the_base_is_said(session, experiment):
    """Joint angles are against the link before; a camera or an inertial sensor gives their sums."""

    def summed(trial, q):
        return replace(trial, q=q) if trial.experiment == experiment and trial.joint == "MCP" else trial

    against_base = replace(session, trials={t.name: summed(t, np.cumsum(t.q, axis=1)) for t in session})
    words = "joint PIP turns as far as MCP at every sample, as an angle against the base does"
    assert any(words in text for text in complaints(against_base))
    assert not any("though ID.2 holds it" in text for text in complaints(against_base))
    # A fixture that yields, or joints that are coupled by another ratio, are no such angles.
    yielding = {t.name: summed(t, t.q + 0.5 * t.q[:, :1] * [0.0, 1.0]) for t in session}
    assert not any(words in text for text in complaints(replace(session, trials=yielding)))


def test_where_several_joints_move_and_the_torque_is_missing_no_joint_is_asked_for(session):
    """The trial needs its torque; naming one of the joints would hide that of the others."""
    name = "08-ID.3-dynamic"
    moved = replace(session.trials[name], joint_torque=None)
    said = [text for text in complaints(replace(session, trials={**session.trials, name: moved})) if name in text]
    assert any("is missing, and it is what ID.3-dynamic measures" in text for text in said)
    assert not any("has no attribute `joint`" in text for text in said)
    still = replace(moved, q=0.0 * moved.q + 0.1)
    said = complaints(replace(session, trials={**session.trials, name: still}))
    assert any(name in text and "has no attribute `joint`" in text for text in said)


def test_a_motion_by_hand_that_is_labelled_a_driven_one_is_said(session):
    """Tendons at constant tension drive nothing, whatever the noise of their sensors, or a passive tendon's."""
    words = "07-VD.3/tendon_force: no tension changes by a tenth of its size while joints move"
    trial = session["07-VD.3"]
    by_hand = replace(trial, tendon_force=session["01-ID.2-MCP"].tendon_force)
    slack = replace(trial, tendon_force=0.0 * trial.tendon_force)
    assert not any(words in text for text in complaints(session))
    assert any(words in text for text in complaints(replace(session, trials={trial.name: by_hand})))
    assert not any(words in text for text in complaints(replace(session, trials={trial.name: slack})))
