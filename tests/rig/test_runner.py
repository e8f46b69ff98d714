"""Sessions on the simulated rig: what they hold, and what the runner refuses to take for a measurement."""

import json
import re
from dataclasses import replace

import h5py
import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import parse_plan, parse_rig
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.contract import Flag, State
from jaxfinger.rig.operator import STOP_KEY
from jaxfinger.rig.runner import RELEASED
from jaxfinger.rig.session import log_path, run
from jaxfinger.rig.simulated.controller import Controller
from jaxfinger.rig.simulated.examples import rig_toml
from tests.rig.conftest import SHORT, Away, serious


def test_a_session_is_recorded_and_the_finger_released(simulated, record, tmp_path):
    outcome = record(simulated)
    assert outcome.cause == ""
    assert outcome.complete == ("01-ID.2-DIP", "02-ID.4-T3-MCP")
    assert not log_path(outcome.session).exists()
    assert serious(outcome.session) == []
    session = read_session(outcome.session)
    arms, friction = session
    assert (arms.experiment, arms.joint, arms.tendon, arms.complete) == ("ID.2", "DIP", None, True)
    np.testing.assert_allclose(np.diff(arms.time), 1e-3, atol=1e-9)
    assert np.ptp(arms.q[:, 2]) > 1.0
    assert arms.joint_torque is None
    assert (friction.experiment, friction.joint, friction.tendon) == ("ID.4", "MCP", "T3")
    assert friction.session_start > arms.session_start + arms.duration
    assert np.isnan(friction.joint_torque[:, 1:]).all()
    assert np.isnan(friction.tendon_excursion[:, [0, 1, 3]]).all()
    assert sorted(set(friction.hold.tolist())) == [-1, 0, 1, 2]
    for hold, level, direction in ((0, 3.0, 1), (1, 6.0, 1), (2, 3.0, -1)):
        at = friction.hold == hold
        assert friction.tendon_force[at, 2].mean() == pytest.approx(level, abs=0.02)
        assert np.all(friction.tendon_direction[at, 2] == direction)
        assert np.all(friction.joint_direction[at] == 0)
    assert simulated.controller.state in (State.RELEASING, State.IDLE)


def test_the_file_opens_in_old_tools_and_says_how_it_was_made(simulated, record):
    outcome = record(simulated)
    with h5py.File(outcome.session) as file:
        assert file.id.get_create_plist().get_version()[0] == 0  # superblock 0: HDF5 1.8 and MATLAB before R2021b
        assert file["rig"].attrs["rig_file"] == simulated.description.text
        assert file["rig/filters/channel"].shape[0] == len(simulated.description.channels)
        assert not file["rig/filters/enabled"][()].any()
        assert file["rig/gaps/seq"].shape == (0,)
        trial = file["trials/02-ID.4-T3-MCP"]
        watched = file["rig/watched/02-ID.4-T3-MCP"]
        assert watched["tension_setpoint T3"].shape == trial["time"].shape
        assert watched["tension_setpoint T3"][()].max() == 6.0
        assert watched["motor_temperature T1"].attrs["units"] == "degC"
        assert json.loads(trial.attrs["parameters"])["levels"] == [3.0, 6.0]
        assert trial.attrs["lost_samples"] == 0


def test_the_same_seed_gives_the_same_session(rig, record, tmp_path):
    sessions = []
    for name in "ab":
        sessions.append(read_session(record(SimulatedRig(rig), output=tmp_path / f"{name}.h5").session))
    for first, second in zip(*sessions, strict=True):
        np.testing.assert_array_equal(first.q, second.q)
        np.testing.assert_array_equal(first.tendon_force, second.tendon_force)


def test_a_trial_that_waits_too_long_keeps_no_sample_of_its_release(rig, record):
    """The simulated hand does not come as near to the stops as this share of the range asks for."""
    first = SHORT.split('[[trial]]\nexperiment = "ID.4"')[0]
    plan = parse_plan(first.replace("passes = 1", "share = 0.85\npasses = 1\ntimeout = 4.0"), rig)
    outcome = record(SimulatedRig(rig), plan=plan)
    assert "moving by hand took longer than 4 s: DIP went between -1.2° and 75.2° 0 times of 2; see" in outcome.cause
    (trial,) = read_session(outcome.session)
    assert trial.tendon_force[-1].max() > 1.0  # the pretension of 2 N, in place of the released 0 N


def test_samples_that_their_terminal_flags_are_left_out(rig, record):
    """One in ten trips nothing, and is no measurement."""
    machine = SimulatedRig(rig)
    controller, measure = machine.controller, machine.controller._measure
    at = controller.slots.tension[2]

    def flagged(fault):
        flags = measure(fault)
        if controller.seq % 10 == 0 and controller.setpoint[2] > 2.5:
            controller._values[at] = 12.0
            flags |= Flag.ANALOG
        return flags

    controller._measure = flagged
    outcome = record(machine)
    assert outcome.cause == ""
    assert read_session(outcome.session)["02-ID.4-T3-MCP"].tendon_force[:, 2].max() < 7.0


def test_a_short_move_is_not_judged_by_an_earlier_one(rig, record):
    """Steps of 5° come near the start of the long move that brought the joint there."""
    plan = parse_plan(
        '[plan]\nname = "steps"\noperator = "tester"\n'
        '[[trial]]\nexperiment = "ID.3-static"\njoint = "MCP"\nstep_deg = 5.0\nspeed_deg_s = 30.0\n',
        rig,
    )
    assert record(SimulatedRig(rig), plan=plan).cause == ""


def test_the_view_at_a_prompt_and_after_a_stop_shows_the_newest_samples(rig, short, tmp_path):
    """Hands are at an armed finger, and then it is stopped: an old tension on the screen would be a wrong one."""
    machine, views = SimulatedRig(rig), []
    person = Away(machine, "Hold DIP", late=0.2)
    person.stop_request = lambda: STOP_KEY if person.prompts and "Hold DIP" in person.prompts[-1] else ""
    outcome = run(short, machine, tmp_path / "s.h5", operator=person, observe=views.append)
    assert outcome.cause.endswith(RELEASED)
    at_prompt = [v for v in views if v.doing == "waiting for Enter" and int(v.block.state[-1]) == State.ARMED]
    before = [v for v in views if v.doing == "tensions settling"]
    assert int(at_prompt[-1].block.seq[-1]) >= int(before[-1].block.seq[-1])
    assert int(views[-1].block.state[-1]) == State.TRIPPED
    assert views[-1].block.x[-1, rig.index("tension", "T3")] < 1.0


def test_an_angle_that_does_not_follow_its_move_ends_the_trial(rig, record):
    """The encoder of a geared joint is read without its gear: half of every angle."""
    text = re.sub(r'(of = "MCP"\nslot = \d+\nunit = "rad"\nscale = )1\.0', r"\g<1>0.5", rig.text)
    plan = parse_plan(
        '[plan]\nname = "p"\n[[trial]]\nexperiment = "ID.3-dynamic"\njoint = "MCP"\nposture_deg = [0.0, 0.0, 0.0]\n',
        rig,
    )
    outcome = record(SimulatedRig(parse_rig(text)), plan=plan)
    assert (
        "01-ID.3-dynamic-MCP: after its move 'joint_position MCP' reads 32.5°, not 65.0°; see the coup" in outcome.cause
    )


def test_filtered_terminals_are_refused_for_dynamic_experiments(rig, tmp_path):
    filtered = Controller(filtered=True)
    plan = parse_plan('[plan]\nname = "p"\n[[trial]]\nexperiment = "ID.3-dynamic"\njoint = "DIP"\n', rig)
    with pytest.raises(UserError, match=r"filters at 22 Hz .* spoils 01-ID.3-dynamic-DIP"):
        run(plan, SimulatedRig(rig, filtered), tmp_path / "s.h5")
    assert filtered.state is State.IDLE
    assert list(tmp_path.iterdir()) == []
    allowed = parse_rig(rig_toml(allow_filtered=True))
    machine = SimulatedRig(allowed, Controller(filtered=True))
    outcome = run(plan, machine, tmp_path / "s.h5")
    with h5py.File(outcome.session) as file:
        bandwidth = dict(zip(file["rig/filters/channel"].asstr()[()], file["rig/filters/bandwidth"][()], strict=True))
        assert bandwidth["tension T1"] == 22.0


def test_static_experiments_may_be_filtered(rig, record):
    machine = SimulatedRig(rig, Controller(filtered=True))
    assert record(machine).cause == ""


def test_a_loaded_torque_sensor_cannot_be_tared(rig, record):
    machine = SimulatedRig(rig)
    sensors = machine.controller.sensors
    machine.controller.sensors = replace(sensors, torque_offset=0.1)
    outcome = record(machine)
    assert "cannot be tared" in outcome.cause
    assert outcome.complete == ("01-ID.2-DIP",)


def test_a_gap_is_counted_and_written(rig, record, tmp_path):
    """The host sleeps for longer than the ring lasts. The file gives the number of lost samples."""
    machine = SimulatedRig(rig, Controller(ring=1024))

    def sleep(m):
        m._pause(3.0)

    outcome = record(machine, sleep, at=("01-ID.2-DIP", "moving by hand"))
    assert outcome.cause == ""
    with h5py.File(outcome.session) as file:
        lost = int(file["trials/01-ID.2-DIP"].attrs["lost_samples"])
        assert 1900 < lost < 2200
        assert file["rig/gaps/lost"][()].tolist() == [lost]
        time = file["trials/01-ID.2-DIP/time"][()]
        assert np.diff(time).max() == pytest.approx((lost + 1) * 1e-3)
