"""A recording that is gone on with, and an armed finger that a recorder finds."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import parse_plan, parse_rig
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.contract import Kind, State
from jaxfinger.rig.session import log_path
from jaxfinger.rig.simulated.examples import rig_toml
from jaxfinger.rig.simulated.plant import default_truth
from tests.rig.conftest import serious, slot


def test_resume_goes_on_where_the_session_was_interrupted(rig, record, tmp_path):
    machine = SimulatedRig(rig)
    first = record(machine, lambda m: m.inject("nan", slot(m, "external_torque")))
    assert first.log is not None
    with pytest.raises(UserError, match="exists already"):
        record(SimulatedRig(rig))
    second = record(SimulatedRig(rig), resume=True)
    assert second.cause == ""
    session = read_session(second.session)
    assert list(session.trials) == ["01-ID.2-DIP", "02-ID.4-T3-MCP", "02-ID.4-T3-MCP-2"]
    assert [t.complete for t in session] == [True, False, True]
    starts = [t.session_start for t in session]
    assert starts == sorted(starts)
    assert serious(second.session) == []
    assert not log_path(second.session).exists()
    with pytest.raises(UserError, match="no interrupted recording"):
        record(SimulatedRig(rig), resume=True)


def test_resume_with_another_plan_is_refused(rig, record, short):
    record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    other = parse_plan(short.text.replace("passes = 1", "passes = 2"), rig)
    with pytest.raises(UserError, match="another plan"):
        record(SimulatedRig(rig), plan=other, resume=True)


def test_resume_does_not_overwrite_a_file_that_is_no_session(rig, record):
    outcome = record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    outcome.session.write_bytes(b"damaged")
    with pytest.raises(UserError, match="or is damaged; move it away, then resume"):
        record(SimulatedRig(rig), resume=True)
    assert outcome.session.read_bytes() == b"damaged"
    outcome.session.unlink()
    assert record(SimulatedRig(rig), resume=True).cause == ""


def test_resume_with_another_rig_file_is_refused(rig, record):
    """The log keeps one description of its channels: samples of others would be read as if they were those."""
    record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    for old, new, says in (
        ("scale = 1.0", "scale = 1.1", "list of channels"),
        ('of = "T1"\nslot = 0', 'of = "T1"\nslot = 59', "list of channels"),
        ("mass = ", "mass = 1", "finger"),
        ('specimen = "', 'specimen = "another ', "specimen"),
        ("[limits]", "[fingertip_sensor]\nrotation = [0, -1, 0, 1, 0, 0, 0, 0, 1]\n\n[limits]", "fingertip sensor"),
    ):
        assert old in rig.text
        other = parse_rig(rig.text.replace(old, new, 1), "other.toml")
        with pytest.raises(UserError, match=rf"another rig file than other\.toml: its {says} differs"):
            record(SimulatedRig(other), resume=True)


def test_resume_with_other_limits_goes_on(record):
    """Also where CAD knows the excursion of some tendons alone: it is NaN for the others, which equals nothing."""
    finger = default_truth().finger
    known = np.full((finger.n, finger.m, 1), np.nan)
    known[0] = np.where(finger.crosses[0], 0.008, 0.0)[:, None]
    rig = parse_rig(rig_toml(finger=replace(finger, excursion=known)))
    record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    tighter = parse_rig(rig.text.replace("temperature_max = 70.0", "temperature_max = 60.0"))
    assert record(SimulatedRig(tighter), resume=True).cause == ""


def test_a_latched_controller_is_reset_before_a_resumed_run(rig, record):
    machine = SimulatedRig(rig)
    record(machine, lambda m: m.inject("spike", slot(m, "tension", "T3")))
    assert machine.controller.state is State.TRIPPED
    machine.controller.faults.clear()
    again = SimulatedRig(rig, machine.controller)
    assert record(again, resume=True).cause == ""


def test_the_recorder_may_die_and_the_ring_fills_the_trial(rig, record, short, tmp_path):
    """A log that ends within a trial gets the samples that the controller's ring still holds."""
    machine = SimulatedRig(rig)
    lengths = []

    class Died(BaseException):
        pass

    def die(m):
        lengths.append(m.controller.seq)
        raise Died

    with pytest.raises(Died):
        record(machine, die, at=("02-ID.4-T3-MCP", "waiting"))
    path = log_path(tmp_path / "session.h5")
    for _ in range(700):
        machine.controller.cycle()
    again = SimulatedRig(rig, machine.controller)
    tripped, polled, poll, beat = machine.controller.trip_seq, [], again.poll, again.beat

    def noted():
        if (block := poll()) is not None:
            polled.append(int(block.seq[-1]))
        return block

    def refused_before_the_watch():
        """The finger may still be armed: a heartbeat before these samples are read would keep it so."""
        assert polled[-1] >= tripped
        beat()

    again.poll, again.beat = noted, refused_before_the_watch
    outcome = record(again, resume=True)
    assert outcome.cause == ""
    assert not path.exists()
    session = read_session(outcome.session)
    cut = session["02-ID.4-T3-MCP"]
    assert not cut.complete
    np.testing.assert_allclose(np.diff(cut.time), 1e-3, atol=1e-9)  # no gap where the recorder died


def test_a_killed_trial_gets_no_sample_of_another_recording(rig, record, short, tmp_path):
    """Somebody records on the same controller before the first session is resumed."""
    machine = SimulatedRig(rig)

    class Died(BaseException):
        pass

    def die(m):
        raise Died

    with pytest.raises(Died):
        record(machine, die, at=("02-ID.4-T3-MCP", "waiting"))
    other = parse_plan(short.text.replace('"T3"', '"T1"').replace("[3.0, 6.0]", "[6.0, 9.0]"), rig)
    record(SimulatedRig(rig, machine.controller), plan=other, output=tmp_path / "other.h5")
    outcome = record(SimulatedRig(rig, machine.controller), resume=True)
    cut = read_session(outcome.session)["02-ID.4-T3-MCP"]
    assert not cut.complete
    assert cut.tendon_force[:, 0].max() < 4.0  # T1 has its pretension of 2 N at most, and in the other session 9 N.


def test_a_simulated_session_is_not_resumed_on_a_rig(rig, record, short):
    record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    other = parse_rig(rig.text.replace('name = "example"', 'name = "bench"'))
    with pytest.raises(UserError, match="its rig or backend differs"):
        record(SimulatedRig(other), resume=True)


def test_a_finger_found_armed_is_released_before_it_is_armed_again(rig, record):
    """The host may be far behind: the release is over when samples that follow it say so, not earlier ones."""
    machine = SimulatedRig(rig)
    for _ in range(300):
        machine.controller.cycle()
    machine.controller._obey(Kind.ARM, 0, 0.0, 0.0, [])
    machine.controller.cycle()
    release = machine.release

    def late():
        machine._pause(1.5)
        return release()

    machine.release = late
    outcome = record(machine)
    assert (outcome.cause, len(outcome.complete)) == ("", 2)
