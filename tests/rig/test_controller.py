"""The controller's program: ramps, hard limits, heartbeat, order of a release, latch."""

import struct

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxfinger.rig import contract
from jaxfinger.rig.contract import Kind, Refusal, State, Trip
from jaxfinger.rig.simulated.controller import Controller, HardLimits
from jaxfinger.rig.trips import time_to_cover


class Bench:
    """A controller, and a host that sends heartbeats and commands."""

    def __init__(self, **limits):
        self.c = Controller(limits=HardLimits(**limits))
        self.beat = 0
        self.number = 0

    def send(self, kind, index=0, rate=10.0, acceleration=20.0, target=(), id=None):
        self.number += 1
        order = np.zeros((), contract.COMMAND)
        order["id"], order["kind"], order["index"] = self.number, kind, index
        order["rate"], order["acceleration"] = rate, acceleration
        order["target"] = np.nan
        order["target"][: len(target)] = target
        self.put("stCommand", order)
        self.run(1)
        return self.c.refused

    def put(self, symbol, record):
        at = self.c.place[symbol][0]
        self.c.memory[at : at + record.nbytes] = record.tobytes()

    def bench(self, mode=(1, 1, 1), pose=(0.3, 0.3, 0.3), contact=False, fault=0, slot=0, amount=60.0):
        order = np.zeros((), contract.BENCH)
        order["id"] = self.c.bench + 1
        order["mode"][:3], order["pose"][:3], order["contact"] = mode, pose, contact
        order["fault"], order["fault_slot"], order["amount"] = fault, slot, amount
        self.put("stBench", order)

    def run(self, count, beat=True):
        rows = []
        for _ in range(count):
            if beat:
                self.beat += 1
                struct.pack_into("<Q", self.c.memory, self.c.place["nHostBeat"][0], self.beat)
            self.c.cycle()
            rows.append(list(self.c.setpoint))
        return np.array(rows)


@pytest.fixture
def loaded():
    bench = Bench()
    bench.bench()
    bench.run(300)
    assert bench.send(Kind.ARM) == Refusal.NONE
    assert bench.send(Kind.TENSION, target=[8.0, 6.0, 4.0, 2.0], rate=20.0) == Refusal.NONE
    bench.run(500)
    assert bench.c.state is State.ARMED
    return bench


def test_nothing_moves_before_it_is_armed():
    bench = Bench()
    assert bench.send(Kind.TENSION, target=[2.0] * 4) == Refusal.STATE
    assert bench.send(Kind.JOINT, target=[0.2]) == Refusal.STATE
    assert np.all(bench.run(50) == 0.0)


def test_release_lets_all_tendons_go_together_to_two_newtons_then_to_half_then_off(loaded):
    assert loaded.send(Kind.RELEASE) == Refusal.NONE
    assert loaded.c.state is State.RELEASING
    ramp = loaded.run(800, beat=False)
    loaded_part = ramp[ramp[:, 0] > 0]
    shares = loaded_part / loaded_part[:, :1]
    np.testing.assert_allclose(shares, np.tile([1, 0.75, 0.5, 0.25], (len(shares), 1)), rtol=1e-9)
    assert ramp[200].max() <= 2.0 + 1e-6
    assert np.all(np.diff(ramp, axis=0) <= 1e-12)
    assert loaded.c.state is State.IDLE
    assert np.all(ramp[-1] == 0)


def test_a_lost_heartbeat_stops_and_latches(loaded):
    loaded.run(245, beat=False)
    assert loaded.c.state is State.ARMED
    loaded.run(10, beat=False)
    assert (loaded.c.state, loaded.c.trip) == (State.TRIPPED, Trip.HEARTBEAT)
    loaded.run(800)
    assert loaded.c.state is State.TRIPPED
    assert max(loaded.c.setpoint) == 0
    assert loaded.send(Kind.ARM) == Refusal.STATE
    assert loaded.send(Kind.RESET) == Refusal.NONE
    assert loaded.send(Kind.ARM) == Refusal.NONE


def test_over_tension_drops_all_at_once(loaded):
    loaded.bench(fault=contract.FAULTS.index("spike"), slot=1)
    ramp = loaded.run(6)
    assert loaded.c.state is State.TRIPPED
    assert loaded.c.trip is Trip.TENSION
    assert np.all(ramp[-1] == 0)
    assert loaded.c.trip_slot == 1


def test_a_joint_beyond_its_stops_is_let_go_after_three_cycles(loaded):
    """The stop lies at 92°. All tendons go down together."""
    loaded.bench(fault=contract.FAULTS.index("spike"), slot=loaded.c.slots.angle[0], amount=1.4)
    before, held = loaded.c.seq, list(loaded.c.setpoint)
    ramp = loaded.run(4)
    assert (loaded.c.state, loaded.c.trip) == (State.TRIPPED, Trip.POSITION)
    assert loaded.c.trip_seq - before == 2
    assert loaded.c.trip_slot == loaded.c.slots.angle[0]
    np.testing.assert_allclose(ramp[-1] / held, ramp[-1, 0] / held[0])  # in proportion
    loaded.run(800)
    assert max(loaded.c.setpoint) == 0
    assert loaded.send(Kind.ARM) == Refusal.STATE


def coupled(tension):
    """A bench whose external motor holds the PIP while T2 pulls it with `tension` N."""
    bench = Bench()
    bench.bench(mode=(1, 2, 1), pose=(0.4, 0.5, 0.3))
    bench.run(600)
    bench.send(Kind.ARM)
    bench.send(Kind.TENSION, target=[0.0, tension, 0.0, 0.0], rate=20.0)
    bench.run(1000)
    assert bench.c.state is State.ARMED
    return bench


@pytest.mark.parametrize("cause", ["stop", "release", "heartbeat", "over-tension", "beyond its stop"])
def test_a_joint_that_holds_tension_is_not_let_go_before_the_tension(cause):
    """Of ID.4: 14 N on T2 would throw a PIP without torque into its stop within 0.1 s."""
    bench = coupled(14.0)
    at, fault = bench.c.plant.q[1], contract.FAULTS.index("spike")
    if cause in ("stop", "release"):
        bench.send(Kind.STOP if cause == "stop" else Kind.RELEASE, index=int(Trip.OPERATOR))
    elif cause == "over-tension":
        bench.bench(mode=(1, 2, 1), pose=(0.4, 0.5, 0.3), fault=fault, slot=1)
    elif cause == "beyond its stop":  # The encoder of another joint fails.
        bench.bench(mode=(1, 2, 1), pose=(0.4, 0.5, 0.3), fault=fault, slot=bench.c.slots.angle[2], amount=1.4)
    path = []
    for _ in range(1300):
        bench.run(1, beat=cause != "heartbeat")
        path.append((max(bench.c.tension), bench.c.plant.q[1], bench.c.plant.qd[1]))
    tension, angle, speed = np.array(path).T
    np.testing.assert_allclose(angle[tension > 0.6], at, atol=1e-9)
    assert np.abs(speed).max() < 0.5  # The speed limit of a plan is 2 rad/s.
    assert (bench.c.motor, tension[-1] < 1e-3) == (None, True)


def test_a_move_in_the_cycle_in_which_the_motor_is_coupled_is_carried_out():
    bench = Bench()
    bench.bench()
    bench.run(300)
    bench.send(Kind.ARM)
    bench.bench(mode=(1, 2, 1))
    assert bench.send(Kind.JOINT, target=[0.6], rate=1.5) == Refusal.NONE
    bench.run(600)
    assert bench.c.plant.q[1] == pytest.approx(0.6, abs=1e-6)


def test_arming_keeps_no_set_point_from_before():
    """While the drives are off somebody may turn the joint, or couple the motor to another one."""
    bench = coupled(3.0)
    bench.send(Kind.JOINT, target=[1.0], rate=1.5)
    bench.run(1000)
    bench.send(Kind.RELEASE)
    bench.run(1500)  # The joint falls.
    bench.c.setpoint = bench.c.target = [1.0] * 4  # of a program that keeps them
    fallen = bench.c.plant.q[1]
    assert abs(fallen - 1.0) > 0.1
    bench.send(Kind.ARM)
    setpoint = bench.run(300)
    assert bench.c.plant.q[1] == pytest.approx(fallen, abs=1e-2)
    assert setpoint.max() == 0.0


def test_a_motor_that_moves_a_joint_with_slack_tendons_loses_its_torque_at_once():
    """Of ID.3: it may have caught a hand."""
    bench = coupled(0.0)
    bench.send(Kind.JOINT, target=[1.2], rate=1.5)
    bench.run(300)
    assert bench.c.state is State.MOVING
    bench.send(Kind.STOP, index=int(Trip.OPERATOR))
    assert bench.c.motor is None


def test_a_motor_that_moves_a_joint_under_tension_brakes():
    bench = coupled(3.0)
    bench.send(Kind.JOINT, target=[1.2], rate=1.5, acceleration=20.0)
    bench.run(300)
    start = bench.c.plant.q[1]
    bench.send(Kind.STOP, index=int(Trip.OPERATOR))
    bench.run(200)
    assert bench.c.plant.qd[1] == 0.0
    assert bench.c.plant.q[1] - start == pytest.approx(1.5**2 / (2 * 20.0), abs=5e-3)


@pytest.mark.parametrize(("fault", "slot"), [("nan", 9), ("flag", 0)])
def test_an_invalid_value_stops_within_three_cycles(loaded, fault, slot):
    before = loaded.c.seq
    loaded.bench(fault=contract.FAULTS.index(fault), slot=slot)
    loaded.run(5)
    assert loaded.c.trip is Trip.INVALID
    assert loaded.c.trip_seq - before <= 3


def test_reset_waits_until_tension_is_off(loaded):
    loaded.send(Kind.STOP, index=int(Trip.OPERATOR))
    assert loaded.c.trip is Trip.OPERATOR
    loaded.run(100)
    assert loaded.send(Kind.RESET) == Refusal.STATE
    loaded.run(700)
    assert loaded.send(Kind.RESET) == Refusal.NONE


commands = st.tuples(
    st.sampled_from([Kind.ARM, Kind.TENSION, Kind.TENSION, Kind.JOINT, Kind.HOLD, Kind.RELEASE, Kind.STOP, Kind.RESET]),
    st.lists(st.one_of(st.floats(-5, 40), st.just(float("nan")), st.just(float("inf"))), min_size=4, max_size=4),
    st.one_of(st.floats(-5, 800), st.just(float("nan"))),
    st.integers(1, 120),
)


@settings(max_examples=40, deadline=None)
@given(st.lists(commands, max_size=12))
@example([(Kind.ARM, [0.0] * 4, 10.0, 1), (Kind.TENSION, [0.0, 0.0, 0.0, 1.0], 251.0, 1)])
def test_no_sequence_of_commands_breaks_the_limits(sequence):
    """Set-points stay within the hard limit of tension and rise no faster than that of its rate."""
    bench = Bench(heartbeat_s=1e9)
    bench.bench(mode=(2, 1, 1))
    before = np.zeros(4)
    for kind, target, rate, wait in sequence:
        bench.send(kind, index=int(Trip.HOST), rate=rate, target=target)  # which takes a cycle
        for row in [np.array(bench.c.setpoint), *bench.run(wait)]:
            assert np.all((row >= 0) & (row <= 20.0 + 1e-9))
            assert np.all(row - before <= 0.5 + 1e-9)
            before = row


@settings(max_examples=15, deadline=None)
@given(st.floats(-0.1, 1.5), st.floats(0.05, 10.0), st.floats(1.0, 50.0))
def test_the_motor_reaches_its_goal_without_passing_it(goal, speed, acceleration):
    """Friction at a hold keeps the direction of approach, so the motor must not overrun its goal."""
    bench = Bench(heartbeat_s=1e9)
    bench.bench(mode=(2, 1, 1))
    bench.run(5)
    bench.send(Kind.ARM)
    assert bench.send(Kind.JOINT, rate=speed, acceleration=acceleration, target=[goal]) == Refusal.NONE
    start = bench.c.plant.q[0]
    path = [start]
    while bench.c.state is State.MOVING and len(path) < 40000:
        bench.run(1)
        path.append(bench.c.plant.q[0])
    steps = np.diff(path) * np.sign(goal - start)
    assert np.all(steps >= -1e-12)
    assert path[-1] == pytest.approx(goal, abs=1e-9)
    assert np.abs(np.diff(path)).max() <= speed * 1e-3 + 1e-6
    expected = 2.0 * time_to_cover(abs(goal - start) / 2.0, speed, acceleration)
    assert 1e-3 * len(path) == pytest.approx(expected, rel=0.01, abs=0.01)
