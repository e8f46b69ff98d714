"""The adapter over real AMS/TCP from another process. Sequence numbers judge it, never the wall clock."""

import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time

import h5py
import numpy as np
import pyads
import pytest

from jaxfinger.data import read_session
from jaxfinger.errors import UserError
from jaxfinger.rig import contract, parse_plan, parse_rig, runner
from jaxfinger.rig.backend import (
    CommandRefused,
    ConnectionLost,
    ControllerRestarted,
    Hold,
    Setup,
    StaleRig,
    TensionRamp,
)
from jaxfinger.rig.backends import ads
from jaxfinger.rig.contract import DRIVES_ON, Kind, State, Trip
from jaxfinger.rig.simulated import standin
from jaxfinger.rig.simulated.ams import AmsServer
from jaxfinger.rig.waits import reached
from tests.rig.conftest import ads_rig


@pytest.fixture(scope="module")
def process():
    with standin.running(speed=1.0, heartbeat=5.0) as where:
        yield where


@pytest.fixture(scope="module")
def fast_process():
    with standin.running(speed=0) as where:
        yield where


def mend(where):
    """Bring a stand-in back to IDLE, whatever the test before did to it."""
    with ads_rig(where) as rig:
        rig.prepare(Setup("", fixed=dict.fromkeys(rig.description.finger.joint_names, 0.0)))
        rig.read_block(20.0)
        while (state := rig.status().state) is not State.IDLE:
            if state in DRIVES_ON:
                rig.release()
            with contextlib.suppress(CommandRefused):
                rig.reset("tester")
            rig.read_block(20.0)
    return where


@pytest.fixture
def real_time(process):
    return mend(process)


@pytest.fixture
def lockstep(fast_process):
    return mend(fast_process)


def collect(rig, samples, patience=20.0):
    """Return sequence numbers and times of at least `samples` samples, and how many were lost."""
    seq, t, lost = [], [], 0
    while sum(map(len, seq)) < samples:
        block = rig.read_block(patience)
        seq.append(block.seq.astype(np.int64))
        t.append(block.t_ns.astype(np.int64))
        lost += block.lost_before
    return np.concatenate(seq), np.concatenate(t), lost


def test_simulated_time_does_not_run_ahead_of_the_reading(lockstep):
    """A command lets one cycle pass, so blocks of one sample come between those of a heartbeat."""
    with ads_rig(lockstep) as rig:
        for _ in range(100):
            rig.release()
            rig.read_block(20.0)
        assert rig.status().head - rig.next_seq <= standin.BURST


def test_every_sample_arrives_also_after_the_host_slept(real_time):
    with ads_rig(real_time) as rig:
        assert rig.fingerprint()["program"] == "jaxfinger stand-in"
        first, _, _ = collect(rig, 300)
        time.sleep(2.0)  # Such as a long compilation; AdsLib would begin to throw notifications away.
        seq, t, lost = collect(rig, 2500)
        assert lost == 0
        assert seq[0] == first[-1] + 1
        np.testing.assert_array_equal(np.diff(seq), 1)
        np.testing.assert_array_equal(np.diff(t), 1_000_000)


def test_a_cut_connection_is_mended_without_a_gap(real_time):
    with ads_rig(real_time) as rig:
        first, _, _ = collect(rig, 100)
        rig.inject("cut")
        seq, _, lost = collect(rig, 500)
        assert rig.reconnects >= 1
        assert lost == 0
        assert seq[0] == first[-1] + 1
        np.testing.assert_array_equal(np.diff(seq), 1)


def test_a_restarted_controller_is_noticed(real_time):
    with ads_rig(real_time) as rig:
        collect(rig, 50)
        rig.inject("restart")
        with pytest.raises(ControllerRestarted):
            collect(rig, 10**6)


def test_a_task_that_stands_still_is_noticed(real_time):
    with ads_rig(real_time) as rig:
        collect(rig, 50)
        rig.inject("stall")
        with pytest.raises(StaleRig):
            collect(rig, 10**6, patience=1.0)
        rig.answer_s = 0.3
        with pytest.raises(ConnectionLost, match="acknowledge"):
            rig.arm()
        rig.prepare(Setup(""))  # The task runs again; the command that was given up must have no effect.
        collect(rig, 50)
        assert rig.status().state is State.IDLE


def test_commands_states_and_the_latch(real_time):
    with ads_rig(real_time) as rig:
        assert rig.status().state is State.IDLE
        with pytest.raises(CommandRefused, match="not in state IDLE"):
            rig.command(Hold())
        rig.prepare(Setup("", fixed=dict.fromkeys(rig.description.finger.joint_names, 0.2)))
        rig.arm()
        number = rig.command(TensionRamp({"T1": 3.0}, 20.0))
        while True:
            block = rig.read_block(20.0)
            if reached(block, number):
                break
        rig.inject("spike", rig.description.channels[rig.description.index("tension", "T1")].slot)
        while rig.status().state is not State.TRIPPED:
            rig.read_block(20.0)
        status = rig.status()
        assert status.trip is Trip.TENSION
        assert status.trip_channel == "tension T1"
        assert "tension T1 = " in status.cause


def test_a_joint_that_runs_beyond_its_stop_is_let_go_in_the_right_order(lockstep):
    """A tendon pulls the free MCP past 92°, the controller's own limit. No supervisor runs on this side."""
    with ads_rig(lockstep) as rig:
        rig.prepare(Setup("", fixed={"PIP": 0.3, "DIP": 0.3}))
        rig.arm()
        rig.command(TensionRamp({"T1": 3.0, "T2": 3.0, "T3": 15.0, "T4": 3.0}, 10.0))
        blocks = [rig.read_block(20.0)]
        while (status := rig.status()).state is not State.TRIPPED or blocks[-1].seq[-1] < status.trip_seq + 1000:
            blocks.append(rig.read_block(20.0))
        assert status.trip is Trip.POSITION
        assert status.trip_channel == "joint_position MCP"
        assert "joint beyond its limits (joint_position MCP = 92." in status.cause
        with pytest.raises(CommandRefused, match="in state TRIPPED"):
            rig.arm()
        columns = rig.description.columns("tension", rig.description.finger.tendon_names)
    at = int(status.trip_seq) - int(blocks[0].seq[0])
    tension = np.concatenate([b.x for b in blocks])[at:, columns]
    share = tension[:300] / tension[0]
    np.testing.assert_allclose(share, share[:, [2]] * np.ones(4), atol=0.05)  # together; sensors' noise is 0.02 N
    assert tension[250:].max() < 2.1  # at most 2 N after 0.2 s, and the drives' lag
    assert np.abs(tension[900:]).max() < 0.1  # off


def test_a_second_program_on_this_computer_cuts_off_nobody(real_time):
    with ads_rig(real_time) as rig:
        with pytest.raises(UserError, match="another program on this computer has the controller"):
            ads_rig(real_time).connect()
        rig.status()
        assert rig.reconnects == 0
        threading.Timer(0.2, rig.close).start()
        with ads_rig(real_time) as other:  # The first one was about to end.
            other.status()


def test_a_second_program_is_refused_whatever_its_folders_and_its_name_for_the_controller(real_time, tmp_path):
    """The controller would keep the newer connection, and the first program would lose its trial."""
    second = (
        "import sys\nfrom tests.rig.conftest import ads_rig\n"
        "try:\n    ads_rig(sys.argv[1]).connect()\nexcept Exception as error:\n    print(error)\n"
    )
    name = real_time.replace("127.0.0.1", "localhost")
    with ads_rig(real_time) as rig:
        done = subprocess.run(
            [sys.executable, "-c", second, name],
            env={**os.environ, "TMPDIR": str(tmp_path), "HOME": str(tmp_path)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert f"another program on this computer has the controller at {name}" in done.stdout
        rig.status()
        assert rig.reconnects == 0


def test_nobody_there(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    rig = ads_rig(f"127.0.0.1:{port}")
    rig.description.address["reconnect_s"] = 0
    with pytest.raises(ConnectionLost, match="route back"), rig:
        pass


def test_stop_overtakes_a_call_whose_answer_does_not_come(real_time, monkeypatch):
    """The call would wait for 4 s. The stand-in's own watchdog is at 5 s, so it is STOP that releases the finger."""
    monkeypatch.setattr(ads, "TIMEOUT_MS", 4000)
    with ads_rig(real_time) as rig:
        rig.prepare(Setup("", fixed=dict.fromkeys(rig.description.finger.joint_names, 0.2)))
        rig.arm()
        rig.inject("mute")
        answered = threading.Event()

        def read():
            with contextlib.suppress(ConnectionLost):
                rig._read("aRing", 0, contract.SAMPLE.itemsize)
            answered.set()

        reader = threading.Thread(target=read)
        reader.start()
        while not rig._lock.locked():
            time.sleep(0.001)
        time.sleep(0.1)
        before = int(np.frombuffer(rig._read("stStatus", 0, 56, urgent=True), contract.STATUS)["head"][0])
        rig.stop(Trip.OPERATOR)
        assert not answered.is_set()
        record = np.frombuffer(rig._read("stStatus", 0, 56, urgent=True), contract.STATUS)[0]
        assert record["state"] == State.TRIPPED
        assert record["trip"] == Trip.OPERATOR
        assert record["trip_seq"] - before < 400  # samples of 1 ms; it takes a few where the machine is free
        rig._given_up = True  # Or it would connect again, and wait as long once more.
        reader.join()


@pytest.mark.parametrize("fails", ["port", "connection"])
def test_where_the_port_of_stop_fails_nothing_is_armed_and_stop_takes_its_turn(real_time, fails):
    with ads_rig(real_time) as rig:
        rig.prepare(Setup("", fixed=dict.fromkeys(rig.description.finger.joint_names, 0.2)))
        if fails == "port":
            pyads.pyads_ex.adsPortCloseEx(rig._stop_port)
            with pytest.raises(ConnectionLost, match="nothing was armed: STOP would not reach the controller at once"):
                rig.arm()
            assert rig.status().state is State.IDLE
        else:
            rig.arm()
            rig.inject("cut")
        rig.stop(Trip.OPERATOR)
        assert rig.status().trip is Trip.OPERATOR


def test_stop_has_its_port_again_after_a_cut(real_time):
    with ads_rig(real_time) as rig:
        rig.inject("cut")
        collect(rig, 100)
        assert rig.reconnects >= 1
        assert rig._call_at_once(rig._reading("stStatus", 0, 56))


def test_a_program_without_the_symbols_is_refused():
    lock = threading.Lock()
    server = AmsServer(bytearray(64), {"MAIN.x": (0, 8)}, lock)
    try:
        with pytest.raises(UserError, match=r"no symbol GVL_Jaxfinger\.stInfo"), ads_rig(f"127.0.0.1:{server.port}"):
            pass
    finally:
        server.close()


def listening(pid: int) -> set[str]:
    """Local addresses (hex) on which a process listens, from /proc."""
    inodes = set()
    for link in os.listdir(f"/proc/{pid}/fd"):
        try:
            target = os.readlink(f"/proc/{pid}/fd/{link}")
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    rows = []
    for table in ("tcp", "tcp6"):
        with open(f"/proc/{pid}/net/{table}") as file:
            rows += [line.split() for line in file.readlines()[1:]]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and row[9] in inodes}


def test_the_adapter_listens_nowhere_and_the_stand_in_on_loopback_alone(real_time):
    with ads_rig(real_time) as rig:
        collect(rig, 50)
        assert listening(os.getpid()) == set()
    server = AmsServer(bytearray(64), {"MAIN.x": (0, 8)}, threading.Lock())
    assert listening(os.getpid()) == {"0100007F"}
    server.close()


def test_any_ads_client_can_read_the_stand_in(real_time):
    """pyads' own calls read by name and by handle, and get an error code for an unknown symbol."""
    plc = pyads.Connection(standin.NET_ID, 851, real_time)
    plc.open()
    try:
        assert plc.read_device_info()[0] == "jaxfinger"
        assert plc.read_state()[0] == pyads.ADSSTATE_RUN
        handle = plc.get_handle("GVL_Jaxfinger.nHostBeat")
        plc.write_by_name("", 41, pyads.PLCTYPE_ULINT, handle=handle)
        assert plc.read_by_name("GVL_Jaxfinger.nHostBeat", pyads.PLCTYPE_ULINT) == 41
        plc.release_handle(handle)
        with pytest.raises(pyads.ADSError) as error:
            plc.read_by_name("GVL_Jaxfinger.nothing", pyads.PLCTYPE_INT)
        assert error.value.err_code == 1808
        with pytest.raises(pyads.ADSError):
            plc.read(0x4040, 2**31, pyads.PLCTYPE_INT)
    finally:
        plc.close()


def test_a_session_over_the_wire(lockstep, record):
    outcome = record(ads_rig(lockstep))
    assert outcome.cause == ""
    session = read_session(outcome.session)
    assert [t.complete for t in session] == [True, True]
    with h5py.File(outcome.session) as file:
        clocks = [file[f"trials/{t.name}"].attrs for t in session]
        assert np.isfinite([c["host_minus_device_s"] for c in clocks]).all()
        assert clocks[1]["device_time_s"] > clocks[0]["device_time_s"] + session["01-ID.2-DIP"].duration
    for trial in session:
        np.testing.assert_allclose(np.diff(trial.time), 1e-3, atol=1e-9)


@pytest.mark.parametrize("lags", [False, True])
def test_the_controllers_own_trip_ends_the_trial_with_its_cause(lockstep, record, monkeypatch, lags):
    """The rig file has no stop before 170°, so the host sees nothing wrong when a tendon pulls the MCP past 92°.

    Where samples lag, the host learns of the trip by a command that is refused. Either way it sends no stop of its own.
    """
    if lags:
        monkeypatch.setattr(runner, "tripped", lambda block: False)
    rig = ads_rig(lockstep)
    rig.description = parse_rig(re.sub("limits = .*", "limits_deg = [-90.0, 170.0]", rig.description.text))
    trial = 'experiment = "VD.3"\nmean = [2.0, 2.0, 7.0, 2.0]\namplitude = 3.0\nposture_deg = [75.0, 20.0, 20.0]'
    plan = parse_plan(f'[plan]\nname = "into the stop"\n[[trial]]\n{trial}\ntension_rate = 5.0\n', rig.description)
    outcome = record(rig, plan=plan)
    assert "01-VD.3: the controller stopped: joint beyond its limits (joint_position MCP = 92." in outcome.cause
    with h5py.File(outcome.session) as file:
        attributes, angle = file["trials/01-VD.3"].attrs, file["trials/01-VD.3/q"][:, 0]
        assert attributes["trip"] == Trip.POSITION
        assert attributes["cause"] in outcome.cause
        events = [e for e in map(json.loads, file["rig/events"].asstr()[()]) if e["kind"] != "arm"]
    assert np.degrees(angle[-1]) == pytest.approx(92.0, abs=0.5)
    assert [(e["kind"], "joint beyond its limits" in e["text"]) for e in events] == [("trip", True)]


def test_a_limit_that_only_the_host_has_latches_the_controller_over_the_wire(lockstep, record):
    rig = ads_rig(lockstep)
    slot = rig.description.channels[rig.description.index("tension", "T1")].slot
    outcome = record(rig, lambda r: r.inject("spike", slot, amount=4.0))
    assert Trip.TRACKING.sentence in outcome.cause
    with h5py.File(outcome.session) as file:
        assert file["trials/02-ID.4-T3-MCP"].attrs["trip"] == Trip.TRACKING
        events = [e for e in map(json.loads, file["rig/events"].asstr()[()]) if e["kind"] != "arm"]
        assert [e["kind"] for e in events] == ["stop"]
        assert events[0]["text"] in outcome.cause
        held = file["rig/dropped/02-ID.4-T3-MCP/value"][-1, rig.description.columns("tension_setpoint", ["T3"])]
    assert held == 0.0  # released, and still recorded
    with ads_rig(lockstep) as rig:
        status = rig.status()
        assert (status.state, status.trip) == (State.TRIPPED, Trip.TRACKING)
        with pytest.raises(CommandRefused, match="in state TRIPPED"):
            rig.arm()


@pytest.mark.parametrize("kind", [Kind.DISARM, Kind.STOP], ids=lambda kind: kind.name)
def test_a_prompt_ends_where_the_controller_lets_go(lockstep, record, kind):
    rig, waited = ads_rig(lockstep), []
    by_itself = rig.prepare
    rig.prepare = lambda setup: not setup.hand and by_itself(setup)

    class Person:
        def ask(self, text, keep_waiting):
            rig._send(kind, index=Trip.HOST)  # as from another panel
            deadline = time.monotonic() + 5.0
            while keep_waiting() and time.monotonic() < deadline:
                time.sleep(0.01)
            waited.append(keep_waiting())

        def stop_request(self):
            return ""

    outcome = record(rig, operator=Person())
    assert waited == [False]
    assert "01-ID.2-DIP: the controller " in outcome.cause
    assert outcome.complete == ()


def test_a_connection_that_stays_cut_ends_the_trial(lockstep, record):
    rig = ads_rig(lockstep)
    rig.description.address["reconnect_s"] = 1

    def pull_the_plug(r):
        r.description.address["ip"] = "127.0.0.1:1"
        r.inject("cut")

    outcome = record(rig, pull_the_plug)
    assert "connection to the controller is lost" in outcome.cause
    assert not read_session(outcome.session)["02-ID.4-T3-MCP"].complete
