"""Whole sessions on the simulated rig: complete ones, and ones that a fault ends."""

import json
import re
import resource
import signal
import time
from dataclasses import replace

import h5py
import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import parse_plan, parse_rig, recorder, recover, wal
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.contract import Flag, Kind, State, Trip
from jaxfinger.rig.operator import Nobody
from jaxfinger.rig.reader import Reader
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.runner import RELEASED, TENSION_NOT_SEEN_TO_FALL, Runner
from jaxfinger.rig.safety import Supervisor
from jaxfinger.rig.session import log_path, run
from jaxfinger.rig.signals import ENDING, Interrupts
from jaxfinger.rig.simulated.controller import Controller
from jaxfinger.rig.simulated.examples import rig_toml
from tests.rig.conftest import SHORT, Away, serious, slot


def wait_until_written(log, trial):
    """Wait for the writer: it may be a whole sync behind a simulated rig, which runs as fast as it is read."""
    deadline = time.monotonic() + 30.0
    while trial.encode() not in log.read_bytes():
        assert time.monotonic() < deadline
        time.sleep(0.01)


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


FAULTS = [
    ("nan", ("external_torque", ""), 0.0, Trip.INVALID, 20),
    ("spike", ("tension", "T3"), 60.0, Trip.TENSION, 20),
    ("spike", ("tension", "T1"), 4.0, Trip.TRACKING, 220),
    ("spike", ("motor_temperature", "T2"), 45.0, Trip.TEMPERATURE, 20),
    ("freeze", ("tension", "T1"), 0.0, Trip.FROZEN, 1300),
    ("clock-back", ("tension", "T1"), 0.5, Trip.CLOCK, 20),
    ("flag", ("tension", "T1"), 0.0, Trip.INVALID, 20),
]


@pytest.mark.parametrize(
    ("fault", "channel", "amount", "trip", "within"), FAULTS, ids=[f"{f[0]}-{f[3].name}" for f in FAULTS]
)
def test_a_fault_ends_the_trial_safely_with_cause_and_data(rig, record, fault, channel, amount, trip, within):
    machine = SimulatedRig(rig)
    at = []

    def strike(machine):
        at.append(machine.controller.seq)
        machine.inject(fault, slot(machine, *channel), amount=amount)

    outcome = record(machine, strike)
    assert trip.sentence in outcome.cause
    assert machine.controller.state is State.TRIPPED
    assert max(machine.controller.setpoint) <= 8.0
    assert 0 < machine.controller.trip_seq - at[0] <= within + 100  # samples; a block of the host may have 100
    assert outcome.complete == ("01-ID.2-DIP",)
    assert serious(outcome.session) == []
    session = read_session(outcome.session)
    assert session["01-ID.2-DIP"].complete
    cut = session["02-ID.4-T3-MCP"]
    assert not cut.complete
    assert np.isfinite(cut.tendon_force).all()
    assert cut.tendon_force.max() < 8.0  # The spike itself is not in the trial.
    with h5py.File(outcome.session) as file:
        attributes = file["trials/02-ID.4-T3-MCP"].attrs
        assert attributes["trip"] == trip
        assert trip.sentence in attributes["cause"]
        after = file["rig/dropped/02-ID.4-T3-MCP"]
        assert after["seq"].shape[0] > 500  # Samples after the trip lie beside the trial.
        assert any(trip.sentence in json.loads(e)["text"] for e in file["rig/events"].asstr()[()])


def test_tension_is_off_a_second_after_a_trip(rig, record):
    machine = SimulatedRig(rig)
    record(machine, lambda m: m.inject("nan", slot(m, "external_torque")))
    assert machine.controller.seq - machine.controller.trip_seq > 900
    assert max(machine.controller.setpoint) == 0.0


def test_a_frozen_encoder_under_the_operators_hand(rig, record):
    machine = SimulatedRig(rig)

    def strike(m):
        m.inject("freeze", slot(m, "joint_position", "DIP"))

    outcome = record(machine, strike, at=("01-ID.2-DIP", "moving by hand"))
    assert Trip.FROZEN.sentence in outcome.cause
    assert "encoder" in outcome.cause


def test_a_frozen_tendon_encoder_while_its_joint_is_moved_by_hand(rig, record):
    """Its excursion would be wrong in the session. None of the samples since it froze belongs to the trial."""
    machine = SimulatedRig(rig)
    outcome = record(
        machine, lambda m: m.inject("freeze", slot(m, "excursion", "T2"), 300), at=("01-ID.2-DIP", "moving by hand")
    )
    assert outcome.cause.startswith("01-ID.2-DIP: a channel is frozen (excursion T2 = ")
    excursion = read_session(outcome.session)["01-ID.2-DIP"].tendon_excursion[:, 1]
    assert np.all(np.diff(excursion) != 0)


@pytest.mark.parametrize("before", [300, -100], ids=["within the trial", "after its end"])
def test_a_fault_that_shows_after_the_trials_end_takes_its_bad_samples_out(rig, record, tmp_path, monkeypatch, before):
    """A frozen sensor shows after a second. The simulated rig repeats itself, so a sound run says where the end is."""
    ends, begun, end = [], [], Reader.end
    monkeypatch.setattr(Reader, "end", lambda reader, value: ends.append(end(reader, value)) or ends[-1])
    record(SimulatedRig(rig), lambda m: begun.append(m.controller.seq), output=tmp_path / "sound.h5")
    after = ends[-1] - begun[0] - before

    outcome = record(SimulatedRig(rig), lambda m: m.inject("freeze", slot(m, "external_torque"), after))
    assert Trip.FROZEN.sentence in outcome.cause
    whole = before < 0
    assert outcome.complete == ("01-ID.2-DIP", "02-ID.4-T3-MCP")[: 1 + whole]
    trial = read_session(outcome.session)["02-ID.4-T3-MCP"]
    assert trial.complete == whole
    assert np.all(np.diff(trial.joint_torque[:, 0]) != 0.0)
    with h5py.File(outcome.session) as file:
        attributes = file["trials/02-ID.4-T3-MCP"].attrs
        assert attributes.get("trip") == (None if whole else Trip.FROZEN)
        if not whole:
            assert file["rig/dropped/02-ID.4-T3-MCP/seq"].shape == (before,)


def test_a_log_that_is_deleted_ends_the_run(rig, record, tmp_path, monkeypatch):
    """What follows would be lost, an hour of it with the same care."""
    monkeypatch.setattr(recorder, "SYNC_S", 0.0)
    path = tmp_path / "session.h5"

    def delete(m):
        wait_until_written(log_path(path), "02-ID.4-T3-MCP")
        log_path(path).unlink()

    with pytest.raises(
        UserError, match=r"02-ID.4-T3-MCP: session\.h5\.wal cannot be written: somebody has deleted it; the"
    ):
        record(SimulatedRig(rig), delete, output=path)


def test_the_operators_stop_key(rig, record):
    class Presses:
        asked = 0

        def ask(self, text, keep_waiting):
            raise AssertionError("a simulated rig prepares itself")

        def stop_requested(self):
            self.asked += 1
            return self.asked > 60

    machine = SimulatedRig(rig)
    outcome = record(machine, operator=Presses())
    assert Trip.OPERATOR.sentence in outcome.cause
    assert machine.controller.trip is Trip.OPERATOR


@pytest.mark.parametrize("number", [*ENDING, None], ids=lambda number: number.name if number else "KeyboardInterrupt")
def test_a_signal_stops_the_rig_and_keeps_the_trial(rig, record, number):
    """KeyboardInterrupt is what a second signal raises."""

    def interrupt(m):
        if number is None:
            raise KeyboardInterrupt
        signal.raise_signal(number)

    machine = SimulatedRig(rig)
    before = [signal.getsignal(n) for n in ENDING]
    outcome = record(machine, interrupt)
    assert outcome.cause == f"02-ID.4-T3-MCP: the run was interrupted; {RELEASED}"
    assert machine.controller.trip is Trip.OPERATOR
    assert machine.controller.state is State.TRIPPED
    assert not read_session(outcome.session)["02-ID.4-T3-MCP"].complete
    assert [signal.getsignal(n) for n in ENDING] == before


def test_the_first_signal_is_a_wish_and_the_second_an_exception():
    with Interrupts() as interrupts:
        signal.raise_signal(signal.SIGINT)
        assert interrupts.requested
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)


def test_ctrl_c_again_and_again_does_not_cut_off_the_look_whether_tension_falls(rig, record):
    machine = SimulatedRig(rig)
    release = machine.controller._release

    def press(*_):
        signal.raise_signal(signal.SIGINT)

    def panic():
        release()
        machine.report_alive, machine.beat = press, lambda: None  # from every call that waits

    def begin(m):
        m.controller._release = panic
        press()

    outcome = record(machine, begin)
    assert outcome.cause == f"02-ID.4-T3-MCP: the run was interrupted; {RELEASED}"
    assert machine.controller.off >= 0


def test_a_session_that_ends_with_a_user_error_keeps_what_it_recorded(rig, record, tmp_path, monkeypatch):
    """The error is of a kind that otherwise says that nothing was armed."""
    abort = Runner.abort

    def fail(runner, error):
        abort(runner, error)
        raise UserError("the end of the end has failed")

    monkeypatch.setattr(Runner, "abort", fail)
    with pytest.raises(UserError, match="the end of the end"):
        record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    assert recover(log_path(tmp_path / "session.h5"), tmp_path / "rescued.h5").trials[0] == "01-ID.2-DIP"


def test_a_run_that_nothing_reads_ends_at_once(rig, tmp_path):
    """An interrupt may strike before the reader has started: no sample can come, so none is waited for."""
    machine = SimulatedRig(rig)
    machine.synchronous = False
    with machine:
        recorder = Recorder(tmp_path / "session.h5.wal", {})
        runner = Runner(machine, Reader(machine, recorder, Supervisor(rig)), Nobody(), Interrupts())
        begun = time.monotonic()
        assert runner.abort_interrupted() == "the run was interrupted"
        assert time.monotonic() - begun < 10.0  # _host_limit allows 70 s for each of two waits
        recorder.close()


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


def test_a_full_disk_ends_the_trial_and_keeps_what_was_written(rig, record, tmp_path):
    machine = SimulatedRig(rig)
    old = resource.getrlimit(resource.RLIMIT_FSIZE)

    path = tmp_path / "session.h5"

    def fill(m):
        wait_until_written(log_path(path), "02-ID.4-T3-MCP")
        size = log_path(path).stat().st_size
        resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100_000, old[1]))

    try:
        outcome = record(machine, fill, output=path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert "cannot be written" in outcome.cause
    assert machine.controller.trip is Trip.RECORDER
    session = recover(log_path(path), path.with_name("again.h5"))
    assert session.incomplete == ("02-ID.4-T3-MCP",)
    assert read_session(path)["01-ID.2-DIP"].complete


def test_a_disk_that_stays_too_slow_ends_the_trial_and_keeps_what_was_written(rig, record, tmp_path, monkeypatch):
    machine, write, path = SimulatedRig(rig), wal.LogWriter.write, tmp_path / "session.h5"
    monkeypatch.setattr(recorder, "QUEUE_LIMIT", 2000)

    def slow(log, tag, payload):
        time.sleep(0.2 if tag == wal.DATA else 0.0)
        write(log, tag, payload)

    def brake(m):
        wait_until_written(log_path(path), "02-ID.4-T3-MCP")
        monkeypatch.setattr(wal.LogWriter, "write", slow)

    outcome = record(machine, brake, output=path)
    assert "the disk is too slow" in outcome.cause
    assert machine.controller.trip is Trip.RECORDER
    assert outcome.complete == ("01-ID.2-DIP",)
    cut = read_session(outcome.session)["02-ID.4-T3-MCP"]
    assert not cut.complete
    np.testing.assert_allclose(np.diff(cut.time), 1e-3, atol=1e-9)


def test_the_view_at_a_prompt_and_after_a_stop_shows_the_newest_samples(rig, short, tmp_path):
    """Hands are at an armed finger, and then it is stopped: an old tension on the screen would be a wrong one."""
    machine, views = SimulatedRig(rig), []
    person = Away(machine, "Hold DIP", late=0.2)
    person.stop_requested = lambda: "Hold DIP" in person.prompts[-1] if person.prompts else False
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


def test_a_tension_that_cannot_be_seen_was_not_seen_to_fall(rig, record):
    """The controller has stopped and released, and one load cell reads nothing, or stays where it was."""
    machine = SimulatedRig(rig)
    outcome = record(machine, lambda m: m.inject("nan", slot(m, "tension", "T3")))
    assert max(machine.controller.setpoint) == 0.0
    assert TENSION_NOT_SEEN_TO_FALL in outcome.cause


def test_a_tension_that_fell_is_not_asked_for(rig, record):
    outcome = record(SimulatedRig(rig), lambda m: m.inject("nan", slot(m, "external_torque")))
    assert outcome.cause.endswith(f"; {RELEASED}")


def test_a_controller_that_does_not_release_is_said(rig, record):
    """RELEASE after the last trial and STOP are both ignored. The run says so and asks to switch the drives off."""
    machine = SimulatedRig(rig)
    outcome = record(machine, lambda m: m.controller.strike("deaf"))
    assert "after the last trial: the finger was not seen to be released (state ARMED)" in outcome.cause
    assert "switch the drives off" in outcome.cause
    assert len(outcome.complete) == 2


@pytest.mark.parametrize("pull", [6.0, -6.0])
def test_tension_that_stays_after_the_last_trial_is_said(rig, record, pull):
    """The controller is idle, but a tendon is caught in its drive, or its load cell is broken."""
    machine = SimulatedRig(rig)
    release = machine.release

    def caught():
        machine.inject("spike", slot(machine, "tension", "T3"), after=300, amount=pull)
        return release()

    outcome = record(machine, lambda m: setattr(m, "release", caught))
    assert outcome.cause.startswith("after the last trial: the finger was not seen to be released ('tension T3' reads ")
    assert TENSION_NOT_SEEN_TO_FALL in outcome.cause
    assert len(outcome.complete) == 2


@pytest.mark.parametrize("kind", [Kind.DISARM, Kind.RELEASE], ids=lambda kind: kind.name)
def test_a_controller_that_lets_go_by_itself_ends_the_trial(rig, record, kind):
    """From a panel of its own the controller can be told to let go. What follows is no measurement."""
    machine = SimulatedRig(rig)
    outcome = record(machine, lambda m: m.controller._obey(kind, 0, 0.0, 0.0, []), at=("01-ID.2-DIP", "moving by hand"))
    assert "let go of the finger without being told to" in outcome.cause
    assert outcome.complete == ()
    assert not read_session(outcome.session)["01-ID.2-DIP"].complete
    assert machine.controller.state is State.TRIPPED


@pytest.mark.parametrize("where", ["observer", "stop"])
def test_an_error_of_any_kind_at_an_armed_finger_stops_it_and_looks_whether_tension_falls(rig, record, where):
    machine = SimulatedRig(rig)

    def fail(m):
        if where == "stop":
            m.stop = fail
        raise OSError("no such socket")

    outcome = record(machine, fail)
    assert outcome.cause.startswith("02-ID.4-T3-MCP: the recorder failed (OSError: no such socket)")
    assert (TENSION_NOT_SEEN_TO_FALL in outcome.cause) == (where == "stop")
    assert not read_session(outcome.session)["02-ID.4-T3-MCP"].complete
    for _ in range(1200):
        machine.controller.cycle()
    assert machine.controller.state is not State.ARMED
    assert max(machine.controller.setpoint) == 0.0
