"""The supervisor finds each fault and no other, at the same sample in blocks of any size."""

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxfinger.rig.backend import Block, CommandRefused, JointMove, TensionRamp
from jaxfinger.rig.contract import Flag, State, Trip
from jaxfinger.rig.safety import Supervisor, Violation, admit


def first(rig, block: Block):
    found = Supervisor(rig).check(block)
    return found[0] if found else None


def test_a_finger_at_rest_is_left_alone(rig, quiet_block):
    supervisor = Supervisor(rig)
    for start in range(0, 4000, 100):
        assert supervisor.check(quiet_block(100, start, seed=start)) == []


def column(rig, kind, of=""):
    return rig.index(kind, of)


def spoil(block: Block, change) -> Block:
    x = block.x.copy()
    change(x)
    return replace(block, x=x)


@pytest.mark.parametrize(
    ("kind", "of", "value", "trip"),
    [
        ("tension", "T2", 19.0, Trip.TENSION),
        ("tension", "T2", -19.0, Trip.TENSION),
        ("tension", "T2", np.nan, Trip.INVALID),
        ("tension", "T1", np.inf, Trip.INVALID),
        ("joint_position", "PIP", 3.0, Trip.POSITION),
        ("joint_position", "DIP", -0.5, Trip.POSITION),
        ("external_torque", "", -0.4, Trip.TORQUE),
        ("fingertip_force", "z", -25.0, Trip.FORCE),
        ("motor_temperature", "T4", 71.0, Trip.TEMPERATURE),
        ("motor_temperature", "T4", np.nan, Trip.INVALID),
        ("tension_setpoint", "T1", np.nan, Trip.INVALID),
    ],
)
def test_a_limit_trips_after_three_samples_and_not_before(rig, quiet_block, kind, of, value, trip):
    at = column(rig, kind, of)
    block = quiet_block()

    def three(x):
        x[200:203, at] = value

    found = first(rig, spoil(block, three))
    assert found is not None
    assert (found.trip, found.seq) == (trip, 202)
    assert found.channel == rig.channels[at].name

    def two(x):
        x[200:202, at] = value

    calm = [v for v in Supervisor(rig).check(spoil(block, two)) if v.trip not in (Trip.VELOCITY, Trip.TENSION_RATE)]
    assert calm == []


def test_a_frozen_sensor_trips_after_its_time(rig, quiet_block):
    at = column(rig, "tension", "T3")

    def freeze(x):
        x[300:, at] = x[300, at]

    found = first(rig, spoil(quiet_block(1500), freeze))
    assert found is not None
    assert (found.trip, found.seq) == (Trip.FROZEN, 1300)
    assert found.since == 301  # The values that repeat are no measurement.


def test_a_frozen_encoder_is_found_by_the_tendons_that_run(rig, quiet_block):
    ramp = np.linspace(0, 0.01, 400)
    run = spoil(quiet_block(), lambda x: x.__setitem__((slice(None), column(rig, "excursion", "T2")), ramp))
    supervisor = Supervisor(rig)
    found = [v for k in range(0, 400, 20) for v in supervisor.check(part(run, k, k + 20))]
    assert found
    assert found[0].trip is Trip.FROZEN
    assert found[0].seq < 120  # 1.5 mm of 10 mm in 400 samples, and three blocks

    def moves_too(x):
        x[:, column(rig, "excursion", "T2")] = ramp
        x[:, column(rig, "joint_position", "DIP")] += np.linspace(0, -0.3, 400)

    supervisor = Supervisor(rig)
    moving = spoil(quiet_block(), moves_too)
    assert [v for k in range(0, 400, 20) for v in supervisor.check(part(moving, k, k + 20))] == []


def test_one_odd_sample_does_not_hide_a_frozen_encoder(rig, quiet_block):
    """The tension changes just where the excursion is not a number; it counts from the next sample."""

    def run(x):
        x[60:, column(rig, "tension", "T2")] += 1.0
        x[100:, column(rig, "excursion", "T2")] = np.linspace(0, 0.01, 300)
        x[60, column(rig, "excursion", "T2")] = np.nan

    found = first(rig, spoil(quiet_block(), run))
    assert found is not None
    assert found.trip is Trip.FROZEN
    assert found.seq < 160


@pytest.mark.parametrize(("kind", "of"), [("tension", "T2"), ("joint_position", "MCP"), ("excursion", "T2")])
def test_one_odd_sample_does_not_make_a_stretched_tendon_a_frozen_encoder(rig, quiet_block, kind, of):
    rise = np.linspace(0.0, 1.0, 340)

    def stretch(x):
        for what, by in (("tension", 6.0), ("tension_setpoint", 6.0), ("excursion", 2e-3)):
            x[60:, column(rig, what, "T2")] += by * rise
        x[59, column(rig, kind, of)] = np.nan

    assert Supervisor(rig).check(spoil(quiet_block(), stretch)) == []


@pytest.mark.parametrize("odd", [0, 2])
def test_an_encoder_that_does_not_follow_the_motor(rig, quiet_block, odd):
    """Also where the last samples before the command are not finite, too few of them to stop the rig."""
    supervisor, at = Supervisor(rig), column(rig, "joint_position", "MCP")
    supervisor.check(spoil(quiet_block(50), lambda x: x.__setitem__((slice(50 - odd, 50), at), np.nan)))
    supervisor.commanded(JointMove("MCP", 1.0, 0.5))
    blocks = [quiet_block(50, 50 * k, seed=k, state=State.MOVING) for k in range(1, 12)]
    found = [v for b in blocks for v in supervisor.check(b)]
    assert [v.trip for v in found] == [Trip.FROZEN]
    assert found[0].channel == "joint_position MCP"


SPEEDS = [(speed, acceleration) for speed in (0.2, 1.0, 2.0) for acceleration in (1.0, 10.0, 100.0)]


def moved(rig, quiet_block, speed, acceleration, delay):
    """Findings of the supervisor where an encoder follows the motor after `delay` s, and the motor's way in rad."""
    time, start = np.arange(1500) / rig.rate_hz, speed / acceleration
    covered = np.where(time < start, 0.5 * acceleration * time**2, speed * (time - 0.5 * start))
    block, at = quiet_block(1500, 50, state=State.MOVING), column(rig, "joint_position", "MCP")
    follows = np.interp(time - delay, time, np.minimum(covered, 0.5))
    supervisor = Supervisor(rig)
    supervisor.check(quiet_block(50))
    supervisor.commanded(JointMove("MCP", 2.0, speed, acceleration))
    found = supervisor.check(spoil(block, lambda x: x.__setitem__((slice(None), at), x[:, at] + follows)))
    return [v for v in found if v.trip is Trip.FROZEN], covered


@pytest.mark.parametrize(("speed", "acceleration"), SPEEDS)
def test_an_encoder_that_follows_the_motor_is_sound_at_any_speed(rig, quiet_block, speed, acceleration):
    found, _ = moved(rig, quiet_block, speed, acceleration, delay=0.01)
    assert found == []


@pytest.mark.parametrize(("speed", "acceleration"), SPEEDS)
def test_a_frozen_one_is_found_when_the_motor_has_covered_a_tenth_of_a_radian(rig, quiet_block, speed, acceleration):
    found, covered = moved(rig, quiet_block, speed, acceleration, delay=np.inf)
    assert [v.channel for v in found] == ["joint_position MCP"]
    assert covered[found[0].seq - 50] == pytest.approx(0.1, abs=2.0 * speed / rig.rate_hz)


def test_speed_and_tension_rate(rig, quiet_block):
    def fast(x):
        x[:, column(rig, "joint_position", "MCP")] = np.clip(np.arange(400) * 0.012 - 2.0, 0.0, 1.2)

    found = first(rig, spoil(quiet_block(), fast))
    assert found is not None
    assert found.trip is Trip.VELOCITY

    def steep(x):
        x[200:, column(rig, "tension", "T1")] += np.clip(np.arange(200) * 0.8, 0, 12)

    found = first(rig, spoil(quiet_block(), steep))
    assert found is not None
    assert found.trip is Trip.TENSION_RATE


@pytest.mark.parametrize("tension", [-1.5, 5.5])
@pytest.mark.parametrize("pieces", [1, 7, 900])
def test_a_tension_that_stays_away_from_its_set_point(rig, quiet_block, tension, pieces):
    """The set-point is 2 N. An error above 3 N may last 0.2 s, in blocks of any size."""

    def astray(x):
        x[20:220, column(rig, "tension", "T3")] = tension  # 200 samples are allowed
        x[1020:, column(rig, "tension", "T3")] = tension  # each good sample before takes off a quarter
        x[:, column(rig, "tension", "T3")] += np.random.default_rng(1).normal(0, 1e-3, 1300)

    block, supervisor = spoil(quiet_block(1300), astray), Supervisor(rig)
    edges = np.linspace(0, 1300, pieces + 1).astype(int)
    found = [v for a, b in pairwise(edges) for v in supervisor.check(part(block, a, b)) if v.trip is Trip.TRACKING]
    assert (found[0].seq, found[0].channel) == (1220, "set-point minus tension T3")
    assert found[0].value == pytest.approx(2.0 - tension, abs=0.01)
    off = replace(block, state=np.full(1300, State.IDLE, np.uint32))
    assert not [v for v in Supervisor(rig).check(off) if v.trip is Trip.TRACKING]  # drives off


def test_time_that_jumps_back(rig, quiet_block):
    block = quiet_block()
    t = block.t_ns.copy()
    t[250:] -= np.uint64(10**9)
    found = first(rig, replace(block, t_ns=t))
    assert found is not None
    assert (found.trip, found.seq) == (Trip.CLOCK, 250)


def test_flags_of_the_terminals(rig, quiet_block):
    block = quiet_block()
    flags = block.flags.copy()
    flags[100:103] = int(Flag.ENCODER) | 7 << 16
    found = first(rig, replace(block, flags=flags))
    assert found is not None
    assert (found.trip, found.seq) == (Trip.INVALID, 102)


def part(block: Block, start: int, stop: int) -> Block:
    cut = slice(start, stop)
    return Block(block.seq[cut], block.t_ns[cut], block.x[cut], block.state[cut], block.flags[cut])


KINDS = ("nan", "over", "flag", "fast", "steep", "astray", "freeze", "frozen encoder", "clock", "rate", "odd state")


def faulty(rig, block: Block, kind: str, at: np.ndarray) -> Block:
    """Return the stream with one kind of fault at the samples of the mask `at`."""
    x, t, flags, state = block.x.copy(), block.t_ns.astype(np.int64), block.flags.copy(), block.state.copy()
    first = int(np.argmax(at)) if at.any() else len(x)
    if kind in ("nan", "over"):
        x[at, rig.index("tension", "T2")] = np.nan if kind == "nan" else 30.0
    elif kind == "flag":
        flags[at] |= int(Flag.ANALOG)
    elif kind == "fast":
        x[:, rig.index("joint_position", "PIP")] = 0.2 + np.cumsum(at * 0.02)
        x[:, rig.index("joint_position", "PIP")] %= 1.5
    elif kind == "steep":
        x[:, rig.index("tension", "T1")] += np.cumsum(at * 0.7) % 14.0
    elif kind == "astray":
        x[at, rig.index("tension_setpoint", "T4")] = 6.0
    elif kind == "freeze":
        x[first:, rig.index("tension", "T3")] = x[min(first, len(x) - 1), rig.index("tension", "T3")]
    elif kind == "frozen encoder":
        x[:, rig.index("excursion", "T2")] += np.cumsum(at) * 1e-4
    elif kind == "clock":
        t = t - np.cumsum(at) * 2_000_000
    elif kind == "rate":
        t = t + np.cumsum(at) * 3_000_000
    else:
        state[at] = 42
    return Block(block.seq, t.astype(np.uint64), x, state, flags)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(KINDS),
    pattern=st.lists(st.booleans(), min_size=1, max_size=8),
    start=st.integers(0, 1200),
    length=st.integers(0, 1300),
    cuts=st.one_of(st.lists(st.integers(1, 1299), max_size=12), st.sampled_from([1, 2, 3, 10, 50])),
)
def test_the_first_trip_is_the_same_however_samples_arrive(rig, quiet_block, kind, pattern, start, length, cuts):
    """For every check, any pattern of good and bad samples and any partition of the stream."""
    at = np.zeros(1300, bool)
    at[start : start + length] = np.resize(pattern, min(length, 1300 - start))
    block = faulty(rig, quiet_block(1300), kind, at)
    whole = Supervisor(rig).check(block)
    supervisor = Supervisor(rig)
    edges = range(0, 1301, cuts) if isinstance(cuts, int) else sorted({0, *cuts, 1300})
    online = []
    for a, b in pairwise(edges):
        online = supervisor.check(part(block, a, b))
        if online:
            break
    if isinstance(cuts, int) and 1300 % cuts and not online:
        online = supervisor.check(part(block, 1300 - 1300 % cuts, 1300))
    assert repr(online[:1]) == repr(whole[:1])  # repr also compares NaN


@pytest.mark.parametrize(
    "command",
    [
        TensionRamp({"T1": 18.5}, 5.0),
        TensionRamp({"T1": -0.1}, 5.0),
        TensionRamp({"T1": float("nan")}, 5.0),
        TensionRamp({"T9": 2.0}, 5.0),
        TensionRamp({"T1": 2.0}, 50.0),
        TensionRamp({"T1": 2.0}, 0.0),
        TensionRamp({"T1": 2.0}, float("nan")),
        JointMove("MCP", 1.6, 0.5),
        JointMove("MCP", float("nan"), 0.5),
        JointMove("XIP", 0.5, 0.5),
        JointMove("MCP", 0.5, 9.0),
        JointMove("MCP", 0.5, 0.5, float("inf")),
        JointMove("MCP", 0.5, 0.5, 21.0),
    ],
)
def test_a_set_point_beyond_the_limits_is_refused_and_nothing_is_sent(rig, simulated, command):
    with pytest.raises(CommandRefused):
        admit(command, rig)
    with simulated:
        simulated.arm()
        before = simulated.status().acknowledged
        with pytest.raises(CommandRefused):
            simulated.command(command)
        assert simulated.status().acknowledged == before


def test_a_sentence_has_the_units_of_the_rig_files_limits(rig, quiet_block):
    block = quiet_block(400)
    block.x[200:, rig.index("joint_position", "MCP")] = np.radians(93.5)
    block.flags[300:] = int(Flag.ANALOG) | int(Flag.BUS) | 0xABCD << 16
    position, velocity, flagged = (
        next(v for v in Supervisor(rig).check(block) if v.trip is trip).sentence
        for trip in (Trip.POSITION, Trip.VELOCITY, Trip.INVALID)
    )
    assert "(joint_position MCP = 93.5° at sample 202); see" in position
    assert re.search(r"\(joint_position MCP = \d+ °/s at sample 202\); see", velocity)
    assert "(working counter or device state bad and an analog input over or under its range at sample 302)" in flagged


@pytest.mark.parametrize(
    "trip", [trip for trip in Trip if trip not in (Trip.NONE, Trip.OPERATOR)], ids=lambda t: t.name
)
def test_every_trip_says_what_happened_and_where_to_look(trip):
    sentence = Violation(trip, "tension T3", 12, 30.0, unit="N").sentence
    assert sentence.startswith(f"{trip.sentence} (tension T3 = 30 N at sample 12); see ")
