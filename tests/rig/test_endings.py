"""How a run on the simulated rig ends: by faults, disks, keys and signals; and whether tension is seen to fall."""

import json
import resource
import shutil
import signal
import time

import h5py
import numpy as np
import pytest

from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import recorder, recover, wal
from jaxfinger.rig.backend import ConnectionLost
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.contract import Kind, State, Trip
from jaxfinger.rig.course import Course
from jaxfinger.rig.operator import STOP_KEY, Nobody
from jaxfinger.rig.reader import Reader
from jaxfinger.rig.recorder import Recorder
from jaxfinger.rig.runner import NO_HINDSIGHT, RELEASED, TENSION_NOT_SEEN_TO_FALL, Runner
from jaxfinger.rig.safety import Supervisor
from jaxfinger.rig.session import log_path, run
from jaxfinger.rig.signals import ENDING, Interrupts
from tests.rig.conftest import serious, slot


def wait_until_written(log, trial):
    """Wait for the writer: it may be a whole sync behind a simulated rig, which runs as fast as it is read."""
    deadline = time.monotonic() + 30.0
    while trial.encode() not in log.read_bytes():
        assert time.monotonic() < deadline
        time.sleep(0.01)


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


@pytest.mark.parametrize("stopped", [False, True], ids=["killed", "stopped"])
def test_a_trial_is_complete_only_once_a_sensor_that_froze_at_its_end_would_have_shown(rig, short, tmp_path, stopped):
    """The log is copied as `kill -9` leaves it, right after the end of the first trial; or the run is interrupted."""
    log, copy, seen = log_path(tmp_path / "session.h5"), tmp_path / "killed.wal", []

    def observe(view):
        if (view.trial, view.doing, view.recording) == ("01-ID.2-DIP", "waiting", False) and not seen:
            seen.append(wait_until_written(log, "ENDT"))
            shutil.copy(log, copy)
            if stopped:
                signal.raise_signal(signal.SIGINT)

    outcome = run(short, SimulatedRig(rig), tmp_path / "session.h5", observe=observe)
    assert recover(copy, tmp_path / "killed.h5").incomplete == ("01-ID.2-DIP",)
    with h5py.File(tmp_path / "killed.h5") as file:
        assert file["trials/01-ID.2-DIP"].attrs["cause"] == NO_HINDSIGHT
    assert outcome.complete == (() if stopped else ("01-ID.2-DIP", "02-ID.4-T3-MCP"))
    if stopped:
        again = run(short, SimulatedRig(rig), tmp_path / "session.h5", resume=True)
        assert again.complete == ("01-ID.2-DIP-2", "02-ID.4-T3-MCP")


def test_a_log_that_is_deleted_ends_the_run(rig, record, tmp_path, monkeypatch):
    """What follows would be lost, an hour of it with the same care."""
    monkeypatch.setattr(recorder, "SYNC_S", 0.0)
    path = tmp_path / "session.h5"

    def delete(m):
        wait_until_written(log_path(path), "02-ID.4-T3-MCP")
        log_path(path).unlink()

    says = r"02-ID.4-T3-MCP: session\.h5\.wal cannot be written: somebody has deleted it; .*all that was recorded is"
    with pytest.raises(UserError, match=says):
        record(SimulatedRig(rig), delete, output=path)


def test_a_file_that_has_come_to_lie_at_the_output_is_not_overwritten(rig, record, tmp_path):
    path = tmp_path / "session.h5"
    with pytest.raises(
        UserError, match=r"session\.h5: exists already .* jaxfinger recover .*\.wal --output .* makes it"
    ):
        record(SimulatedRig(rig), lambda m: path.write_text("precious"), output=path)
    assert path.read_text() == "precious"
    path.unlink()
    assert len(recover(log_path(path), path).trials) == 2


def test_a_log_is_not_recovered_while_its_run_goes_on(rig, record, tmp_path):
    """Whoever takes a run for dead is told that its finger may be armed; and its session keeps its place."""
    path, said = tmp_path / "session.h5", []

    def rescue(m):
        with pytest.raises(
            UserError, match=r"session\.h5\.wal: a recorder still writes to it, and the finger may"
        ) as e:
            recover(log_path(path), path)
        said.append(e)

    assert record(SimulatedRig(rig), rescue, output=path).cause == ""
    assert said


def test_the_operators_stop_key(rig, record):
    class Presses:
        asked = 0

        def ask(self, text, keep_waiting):
            raise AssertionError("a simulated rig prepares itself")

        def stop_request(self):
            self.asked += 1
            return STOP_KEY if self.asked > 60 else ""

    machine = SimulatedRig(rig)
    outcome = record(machine, operator=Presses())
    assert STOP_KEY in outcome.cause
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
        runner = Runner(Course(machine, Reader(machine, recorder, Supervisor(rig)), Nobody(), Interrupts()))
        begun = time.monotonic()
        assert runner.abort_interrupted() == "the run was interrupted"
        assert time.monotonic() - begun < 10.0  # `host_limit` allows 70 s for each of two waits
        recorder.close()


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


def test_a_tension_that_cannot_be_seen_was_not_seen_to_fall(rig, record):
    """The controller has stopped and released, and one load cell reads nothing, or stays where it was."""
    machine = SimulatedRig(rig)
    outcome = record(machine, lambda m: m.inject("nan", slot(m, "tension", "T3")))
    assert max(machine.controller.setpoint) == 0.0
    assert TENSION_NOT_SEEN_TO_FALL in outcome.cause


def test_a_controller_that_is_lost_as_the_drives_go_on_was_not_seen_to_release(rig, record):
    """The newest sample is from before, and shows it idle."""
    machine = SimulatedRig(rig)
    arm = machine.arm

    def lost(*_):
        raise ConnectionLost("the connection to the controller is lost.")

    def arm_and_cut():
        number = arm()
        machine.read_block = machine.stop = machine.release = machine.status = machine.command = lost
        return number

    machine.arm = arm_and_cut
    assert record(machine).cause == f"the connection to the controller is lost; {TENSION_NOT_SEEN_TO_FALL}"


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
