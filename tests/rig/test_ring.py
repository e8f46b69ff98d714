"""Reading the ring: every sample comes once or is counted as lost; torn records and restarts are noticed."""

import re
import threading
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxfinger.errors import UserError
from jaxfinger.rig import contract, parse_rig
from jaxfinger.rig.backend import CommandRefused, ControllerRestarted, Hold, RigError, StaleRig, TensionRamp
from jaxfinger.rig.backends.simulated import SimulatedRig
from jaxfinger.rig.contract import State, Trip
from jaxfinger.rig.ring import MAX_RECORDS, OVERWRITE_MARGIN
from jaxfinger.rig.simulated.controller import Controller, HardLimits
from jaxfinger.rig.simulated.examples import rig_toml


def small(rig, ring=512) -> SimulatedRig:
    return SimulatedRig(rig, Controller(ring=ring))


@settings(max_examples=20, deadline=None)
@given(pauses=st.lists(st.integers(1, 900), min_size=1, max_size=12))
def test_every_sample_comes_once_or_is_counted_as_lost(rig, pauses):
    machine = small(rig)
    with machine:
        expected = 0
        for pause in pauses:
            for _ in range(pause):
                machine.controller.cycle()
            while machine.next_seq < machine.controller.seq:
                block = machine.read_block(1.0)
                assert len(block) <= MAX_RECORDS
                assert int(block.seq[0]) == expected + block.lost_before
                np.testing.assert_array_equal(np.diff(block.seq.astype(np.int64)), 1)
                assert block.lost_before == 0 or pause > 512 - OVERWRITE_MARGIN
                expected = int(block.seq[-1]) + 1
        assert expected == sum(pauses)


def test_a_torn_record_is_read_again(rig):
    machine = small(rig)
    with machine:
        for _ in range(50):
            machine.controller.cycle()
        at = machine.controller.place["aRing"][0] + 20 * 512 + 504
        whole = bytes(machine.controller.memory[at : at + 8])
        machine.controller.memory[at : at + 8] = b"\xff" * 8
        reads = []
        plain = machine._read

        def mended(symbol, offset, size, urgent=False):
            reads.append(symbol)
            if reads.count("aRing") == 2:
                machine.controller.memory[at : at + 8] = whole
            return plain(symbol, offset, size)

        machine._read = mended
        block = machine.read_block(1.0)
        assert reads.count("aRing") == 2
        np.testing.assert_array_equal(block.seq, np.arange(50))


def test_a_restart_is_never_spliced(rig):
    machine = small(rig)
    with machine:
        for _ in range(50):
            machine.controller.cycle()
        machine.read_block(1.0)
        machine.controller.start()
        for _ in range(500):
            machine.controller.cycle()
        with pytest.raises(ControllerRestarted):
            machine.read_block(1.0)


def test_a_restart_while_the_ring_is_read_is_noticed(rig, monkeypatch):
    machine = small(rig)
    with machine:
        for _ in range(50):
            machine.controller.cycle()
        machine.read_block(1.0)
        for _ in range(20):
            machine.controller.cycle()
        read = machine._read

        def restarted_before(symbol, offset, size, urgent=False):
            if symbol == "aRing":
                machine.controller.start()
            return read(symbol, offset, size)

        monkeypatch.setattr(machine, "_read", restarted_before)
        with pytest.raises(ControllerRestarted):
            machine.read_block(1.0)


def test_a_controller_that_stands_still_is_stale(rig):
    machine = small(rig)
    with machine:
        machine.inject("stall")
        machine._pause(0.001)
        while machine.next_seq < machine.controller.seq:
            machine.read_block(1.0)
        with pytest.raises(StaleRig):
            machine.read_block(0.01)


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [("version", 1, "contract version"), ("sample_size", 504, "size of ST_Sample"), ("cycle_ns", 2_000_000, "rate_hz")],
)
def test_another_program_is_refused(rig, field, value, says):
    machine = small(rig)
    info = np.frombuffer(machine._read("stInfo", 0, contract.INFO.itemsize), contract.INFO).copy()
    info[field] = value
    machine._write("stInfo", info.tobytes())
    with pytest.raises(UserError, match=says):
        machine.connect()


@pytest.mark.parametrize(
    ("limit", "loose", "says"),
    [
        ("tension_max = 18.0", "tension_max = 25.0", "limits.tension_max: is 25, looser than the controller's 20"),
        (
            "max_deg_s = 600.0",
            "max_deg_s = 700.0",
            "limits.joint_velocity_max_deg_s: is 700, looser than the controller's 601",
        ),
    ],
)
def test_limits_looser_than_the_controllers_are_refused(limit, loose, says):
    machine = SimulatedRig(parse_rig(rig_toml().replace(limit, loose)))
    line = 1 + rig_toml().splitlines().index(next(row for row in rig_toml().splitlines() if limit in row))
    with pytest.raises(UserError, match=rf"rig\.toml, line {line}: {says}"):
        machine.connect()


def test_leaving_releases_the_finger(rig):
    machine = small(rig)
    with machine:
        machine.arm()
    assert machine.controller.state is State.RELEASING


def test_an_error_inside_releases_too_and_is_not_hidden(rig):
    machine = small(rig)

    def fail():
        with machine:
            machine.arm()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert machine.controller.state is State.RELEASING


def test_a_latched_stop_needs_a_name_and_a_reset(rig):
    machine = small(rig)
    with machine:
        machine.arm()
        machine.stop(Trip.OPERATOR)
        assert machine.status().state is State.TRIPPED
        assert "operator" in machine.status().cause
        with pytest.raises(CommandRefused, match="ARM"):
            machine.arm()
        with pytest.raises(CommandRefused, match="give the name"):
            machine.reset(" ")
        machine._pause(1.0)
        machine.reset("tester")
        machine.arm()


def test_two_threads_may_command(rig):
    machine = small(rig)
    with machine:
        machine.arm()
        numbers = []

        def hold():
            numbers.extend(machine.command(Hold()) for _ in range(50))

        threads = [threading.Thread(target=hold) for _ in range(2)]
        for t in threads:
            t.start()
        for t in threads:
            t.join()
        assert np.diff(sorted(n - numbers[0] for n in numbers)).tolist() == [1] * 99


def test_a_stop_is_obeyed_whatever_another_program_has_sent(rig):
    machine = small(rig)
    other = SimulatedRig(rig, machine.controller)
    with machine, other:
        other.arm()
        machine.stop(Trip.OPERATOR)
        assert machine.controller.state is State.TRIPPED


def test_a_command_of_another_program_is_noticed(rig):
    machine = small(rig)
    other = SimulatedRig(rig, machine.controller)
    with machine, other:
        machine.arm()
        machine.read_block(1.0)
        other.command(Hold())
        with pytest.raises(RigError, match="another program commands the controller"):
            machine.read_block(1.0)


@pytest.mark.parametrize("alive", [True, False])
def test_a_controller_with_another_host_is_refused(rig, alive):
    class RealTime(SimulatedRig):
        simulated_time = False

        def _pause(self, seconds):
            if alive:
                machine.beat()

    machine = small(rig)
    with machine:
        machine.beat()  # The heartbeat of a program that has ended stays where it is.
        other = RealTime(rig, machine.controller)
        if alive:
            with pytest.raises(UserError, match="another program sends heartbeats"):
                other.connect()
        else:
            other.connect()


def test_a_stop_waits_for_no_other_command(rig):
    """While a command waits for a controller that acknowledges nothing, a STOP is written over it."""
    machine = small(rig)
    with machine:
        arm_and_stall(machine)
        machine.answer_s = 20.0
        said = []

        def ramp():
            try:
                machine.command(TensionRamp({"T1": 5.0}, 5.0))
            except CommandRefused as error:
                said.append(str(error))

        waiting = threading.Thread(target=ramp)
        waiting.start()
        while kind_of(machine) != contract.Kind.TENSION:
            time.sleep(0.001)
        stopping = threading.Thread(target=machine.stop, args=(Trip.OPERATOR,))
        stopping.start()
        waiting.join(10.0)
        assert said == ["TENSION gave way to a stop."]
        assert kind_of(machine) == contract.Kind.STOP
        machine.controller.faults.clear()
        stopping.join(10.0)
        assert machine.status().trip is Trip.OPERATOR


def test_a_stop_is_written_again_where_a_command_that_it_overtook_arrives_late(rig):
    machine = small(rig)
    with machine:
        machine.arm()
        machine._id += 1  # A command that another thread has under way.
        late = np.zeros((), contract.COMMAND)
        late["id"], late["kind"], late["rate"], late["target"] = machine._id, contract.Kind.TENSION, 5.0, 5.0
        write, written = machine._write, []

        def overtaken(symbol, data, mend=True, urgent=False):
            write(symbol, data, mend)
            if not written:
                write(symbol, late.tobytes(), mend)
            written.append(symbol)

        machine._write = overtaken
        machine.stop(Trip.OPERATOR)
        status = machine.status()
        assert (status.state, status.trip) == (State.TRIPPED, Trip.OPERATOR)


def test_a_stop_that_is_not_acknowledged_stays_until_the_controller_obeys_it(rig):
    """Its task stands still, as at a breakpoint. A release that overwrote the stop would leave nothing latched."""
    machine = small(rig)
    with machine:
        arm_and_stall(machine)
        machine.answer_s = 0.05
        for send in (lambda: machine.stop(Trip.OPERATOR), machine.release):
            with pytest.raises(UserError, match="did not acknowledge STOP"):
                send()
        with pytest.raises(CommandRefused, match="TENSION gave way to a stop"):
            machine.command(TensionRamp({"T1": 5.0}, 5.0))
        machine.controller.faults.clear()
        machine._pause(0.01)
        assert (machine.status().state, machine.status().trip) == (State.TRIPPED, Trip.OPERATOR)


def arm_and_stall(machine) -> None:
    """Arm the rig, then let the controller's task stand still: it acknowledges nothing."""
    machine.arm()
    machine.inject("stall")
    machine._pause(0.01)


def kind_of(machine) -> int:
    record = machine._read("stCommand", 0, contract.COMMAND.itemsize)
    return int(np.frombuffer(record, contract.COMMAND)["kind"][0])


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("tension_max", 50.0, "tension_max: may be 36 on the controller, which runs 50"),
        ("joint_velocity_max", 1e3, "joint_velocity_max_deg_s: may be 1200 on the controller, which runs 57295.8"),
        ("heartbeat_s", 0.3, "heartbeat_s: may be 0.25 on the controller, which runs 0.3"),
        ("heartbeat_s", 0.0, "which runs 0;"),
        ("heartbeat_s", np.nan, "which runs nan"),
        ("fingertip_force_max", np.inf, "which runs inf"),
    ],
)
def test_a_controller_whose_limits_are_looser_than_the_rig_file_allows_is_refused(rig, field, value, says):
    machine = SimulatedRig(rig, Controller(limits=HardLimits(**{field: value})))
    with pytest.raises(UserError, match=r"rig\.toml, line \d+: ") as error:
        machine.connect()
    assert says in str(error.value)
    text = rig_toml() + f"\n[controller]\n{field.replace('velocity_max', 'velocity_max_deg_s')} = {value}\n"
    if 0 < value < np.inf and field != "joint_velocity_max":
        SimulatedRig(parse_rig(text), machine.controller).connect()


@pytest.mark.parametrize(("symbol", "size"), [("stStatus", 48), ("aFilter", 944), ("nHostBeat", 4), ("aRing", 1000)])
def test_every_symbols_size_is_compared(rig, symbol, size):
    machine = small(rig)
    machine.controller.place[symbol] = machine.controller.place[symbol][0], size
    with pytest.raises(UserError, match=rf"GVL_Jaxfinger\.{symbol} has {size} bytes on the controller"):
        machine.connect()


@pytest.mark.parametrize(("field", "says"), [("state", "state is 77"), ("trip", "trip is 77")])
def test_a_code_that_the_contract_does_not_know_is_a_sentence(rig, field, says):
    machine = small(rig)
    at = machine.controller.place["stStatus"][0] + contract.STATUS.fields[field][1]
    machine.controller.memory[at : at + 4] = np.uint32(77).tobytes()
    with pytest.raises(UserError, match=f"the controller's {says}, which the contract does not define"):
        machine.connect()


@pytest.mark.parametrize(
    ("trip", "value", "says"),
    [
        (Trip.POSITION, 100.0, "joint beyond its limits (joint_position MCP = 95°); see the joint's fixture"),
        (Trip.VELOCITY, 100.0, "joint velocity above its limit (joint_position MCP = 100 °/s); see the joint's"),
    ],
)
def test_the_controllers_trip_is_told_in_the_units_of_the_rig_files_limits(trip, value, says):
    """The offset of an encoder belongs to its angle, and not to its speed."""
    text = re.sub(
        r'(of = "MCP"\nslot = \d+\nunit = )"rad"\nscale = 1.0\noffset = 0.0',
        r'\1"deg"\nscale = 1.0\noffset = -5.0',
        rig_toml(),
    )
    machine = SimulatedRig(parse_rig(text))
    machine.controller._stop(trip, machine.controller.slots.angle[0], value)
    machine.controller._status()
    assert machine.status().cause.startswith(says)
