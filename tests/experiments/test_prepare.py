"""Reduction of recordings: directions, valid samples and averages."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from jaxfinger.data import Session, Trial, filter_std, low_pass
from jaxfinger.data.signals.sizes import SLACK_SHARE, sizes_of
from jaxfinger.errors import UserError
from jaxfinger.experiments import EXPERIMENTS, driven, not_judged, prepare
from jaxfinger.synthetic import paper_finger
from jaxfinger.synthetic.plant import joint_tension

RATE, ENCODER = 1000.0, 2e-4  # Hz, rad
CYCLE = 3.0  # s
FINGER = paper_finger().description
MCP = FINGER.joint_names[0]
FILTER = filter_std(EXPERIMENTS["VD.3"].cutoff)
CLEAR, BREAKAWAY = driven.CLEAR_WIDTHS * FILTER, driven.BREAKAWAY_WIDTHS * FILTER  # s


def sweep(duration=9.0, noise=ENCODER, seed=0, **fields) -> Trial:
    """Trial in which the external motor sweeps the MCP, reversing every half cycle without rest."""
    time = np.arange(round(duration * RATE)) / RATE
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    q[:, 0] += 0.5 * np.cos(2 * np.pi * time / CYCLE + 0.3)
    q += noise * np.random.default_rng(seed).standard_normal(q.shape)
    torque = np.full(q.shape, np.nan)
    torque[:, 0] = 1e-2 * np.sign(-np.sin(2 * np.pi * time / CYCLE + 0.3))
    return Trial("sweep", "ID.3-dynamic", time, q, joint_torque=torque, joint=MCP, **fields)


def stack(*trials: Trial, **options):
    session = Session("a finger", FINGER, {t.name: t for t in trials})
    (found,) = prepare(session, **options).values()
    return found


def test_the_torque_of_a_joint_that_is_not_moved_does_not_count():
    """An arm's motors hold the other joints, which yield a little to the load: their friction at rest has any value."""
    moved = sweep()
    moved.q[:, 1] += 2e-3 * np.cos(2 * np.pi * moved.time / CYCLE)
    torque = np.where(np.isnan(moved.joint_torque), 3e-3, moved.joint_torque)
    for experiment, named in product(("ID.3-dynamic", "ID.3-static"), (MCP, None)):
        one = stack(replace(moved, joint_torque=torque, experiment=experiment, joint=named))
        counts = np.asarray(one.batch.mask["joint_torque"]).any(axis=(1, 2))
        assert counts.tolist() == [True, False, False]


@pytest.mark.parametrize("noise", [1e-7, 1e-5, ENCODER])
def test_a_joint_that_rests_does_not_slide_before_it_starts(noise):
    """The filter shows a motion before it starts, and where the encoder is quiet that exceeds its noise."""
    duration, rest, stroke = 1.2, 0.4, 0.6  # s, s, rad
    begins = np.arange(6) * (duration + rest) + rest
    time = np.arange(round((begins[-1] + duration + rest) * RATE)) / RATE
    part = np.clip((time[:, None] - begins) / duration, 0.0, 1.0)
    way = np.where(part < 0.5, 2.0 * part**2, 1.0 - 2.0 * (1.0 - part) ** 2)  # constant acceleration, there and back
    q = np.tile(np.radians([10.0, 30.0, 20.0]), (time.size, 1))
    q[:, 0] += stroke * way @ np.resize([1.0, -1.0], 6)
    q += noise * np.random.default_rng(0).standard_normal(q.shape)
    torque = np.where(np.arange(3) == 0, 0.0 * q, np.nan)
    found = stack(Trial("moves", "ID.3-dynamic", time, q, joint_torque=torque, joint=MCP))
    counts = np.asarray(found.batch.mask["joint_torque"][0, 0]) > 0
    at = np.asarray(found.batch.x.time[0])
    inside = (at[:, None] > begins + CLEAR) & (at[:, None] < begins + duration - CLEAR)
    assert not np.any(counts & ~inside.any(axis=1))
    assert np.all(np.sum(counts[:, None] & inside, axis=0) * found.dt > duration - 2.0 * CLEAR - 0.1)


def test_averages_twice_as_long_are_those_of_two():
    """Arrays that the model reads are compared over all blocks that both cover."""
    fine, coarse = (stack(sweep(), coarse=c) for c in (1, 2))
    assert coarse.dt == pytest.approx(2.0 * fine.dt)
    for name in ("q", "qd", "qdd", "time"):
        each, pair = (np.asarray(getattr(s.batch.x, name))[..., :220] for s in (fine, coarse))
        M = each.shape[-1] // 2
        np.testing.assert_allclose(pair[..., :M], each.reshape(*each.shape[:-1], M, 2).mean(axis=-1), atol=1e-12)


def turning_points(duration=9.0):
    k = np.arange(1, 20)
    times = (np.pi * k - 0.3) * CYCLE / (2 * np.pi)
    return times[times < duration]


def test_at_every_sample_a_joint_turns_back_once_and_over_the_way_that_its_encoder_cannot_tell():
    """Friction reverses between the start of the motion back and a travel of 1.5 standard deviations of the encoder."""
    x = stack(sweep(), reduced=False).batch.x
    time, direction = np.asarray(x.time)[0], np.asarray(x.joint_direction)[0, 0]
    turned = time[1:][(np.diff(np.sign(direction)) != 0) & (time[1:] > 0.5)]
    late = turned - turning_points()
    half = np.sqrt(1.5 * ENCODER / (0.5 * (2 * np.pi / CYCLE) ** 2))
    np.testing.assert_allclose(late, half, atol=7e-3)
    assert np.mean(late) == pytest.approx(half, abs=4e-3)
    begins = np.interp(turning_points() - 0.01, time, np.abs(direction))
    np.testing.assert_allclose(begins, 1.0, atol=0.1)


def test_a_joint_that_stops_turns_when_it_moves_again():
    """The joint moves up, stops for a second, in which noise has no direction, and moves down."""
    time = np.arange(4000) / RATE
    q = np.tile(np.interp(time, [0.0, 1.5, 2.5, 4.0], [0.2, 0.8, 0.8, 0.2])[:, None], (1, 3))
    q += ENCODER * np.random.default_rng(4).standard_normal(q.shape)
    torque = np.where(np.arange(3) == 0, 1e-2, np.nan) * np.ones_like(q)
    x = stack(Trial("stop", "ID.3-dynamic", time, q, joint_torque=torque, joint=MCP), reduced=False).batch.x
    direction = np.asarray(x.joint_direction)[0, 0, :4000]
    (turned,) = np.flatnonzero(np.diff(np.sign(direction)) < 0)
    assert direction[200] == 1.0
    assert abs(time[turned] - 2.5) < 0.1


@pytest.mark.parametrize("experiment", ["ID.3-dynamic", "ID.3-static"])
def test_friction_is_not_less_where_a_joint_starts_whose_direction_was_not_known_before(experiment):
    """A joint that turns one way shows friction and elasticity together, and a filter must not tell them apart."""
    time = np.arange(4000) / RATE
    q = np.tile(np.interp(time, [0.0, 1.0, 3.0, 4.0], [0.2, 0.2, 0.8, 0.8])[:, None], (1, 3))
    q += ENCODER * np.random.default_rng(6).standard_normal(q.shape)
    torque = np.where(np.arange(3) == 0, 1e-2, np.nan) * np.ones_like(q)
    batch = stack(Trial("one way", experiment, time, q, joint_torque=torque, joint=MCP)).batch
    counts = np.asarray(batch.mask["joint_torque"])[0, 0] > 0
    assert counts.sum() > 40
    np.testing.assert_allclose(np.asarray(batch.x.joint_direction)[0, 0, counts], 1.0, atol=1e-12)


def test_where_a_prediction_reads_no_acceleration_there_is_none():
    """At constant speed q̈ is the encoder's noise, 2 rad/s² after a filter that resolves reversals."""
    time = np.arange(6000) / RATE
    corners = [0.0, 2.0, 4.0, 6.0], [0.2, 1.0, 0.2, 1.0]
    q = np.tile(np.interp(time, *corners)[:, None], (1, 3)) + ENCODER * np.random.default_rng(5).normal(size=(6000, 3))
    torque = np.where(np.arange(3) == 0, 1e-2, np.nan) * np.ones_like(q)
    x = stack(Trial("even", "ID.3-dynamic", time, q, joint_torque=torque, joint=MCP), reduced=False).batch.x
    qdd = np.asarray(x.qdd)[0, 0, :6000]
    even = np.min(np.abs(time[:, None] - np.array([0.0, 2.0, 4.0, 6.0])), axis=1) > 0.2
    turn = np.abs(time - 2.0) < 0.02
    assert np.sqrt(np.mean(qdd[even] ** 2)) < 1.0
    assert np.abs(qdd[turn]).max() > 20.0


def test_samples_around_a_reversal_do_not_count_and_the_others_do():
    batch = stack(sweep()).batch
    time, counts = np.asarray(batch.x.time)[0], np.asarray(batch.mask["joint_torque"])[0, 0] > 0
    time, counts = time[: round(9.0 * 50)], counts[: round(9.0 * 50)]
    apart = np.abs(time[:, None] - turning_points()[None]).min(axis=1)
    assert not counts[apart < CLEAR].any()
    inside = (time > 0.2) & (time < 8.8)
    assert counts[inside & (apart > 2 * CLEAR)].all()


@pytest.mark.parametrize("creep", [-0.01, 0.01])
def test_a_creep_whose_direction_is_not_known_does_not_count(creep):
    """Its speed is within the noise, before the first motion or after one in the other direction."""
    time = np.arange(6000) / RATE
    rate = np.select([time < 1.0, time < 2.0, time < 4.0, time < 5.0], [0.0, creep, 0.6, creep], 0.6)
    q = np.tile(np.radians([-40.0, 30.0, 20.0]), (time.size, 1))
    q[:, 0] += np.cumsum(rate) / RATE
    q += ENCODER * np.random.default_rng(3).standard_normal(q.shape)
    batch = stack(Trial("free", "VD.3", time, q, tendon_force=np.zeros((time.size, FINGER.n)))).batch
    at, counts = np.asarray(batch.x.time)[0], np.asarray(batch.mask["joint_torque"])[0, 0] > 0
    direction = np.asarray(batch.x.joint_direction)[0, 0]
    assert not counts[at < 2.0].any()
    assert counts[(at > 2.3) & (at < 3.8)].all()
    assert np.all(direction[counts] * np.interp(at[counts], time, rate) > 0.0)


def test_around_a_slip_faster_than_the_filter_no_joint_counts():
    """The DIP jumps by 0.2 rad within 15 ms, twice, while the PIP sweeps on; a jump disturbs every joint."""
    time = np.arange(4000) / RATE
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    q[:, 1] += 0.3 * time
    smooth = q + ENCODER * np.random.default_rng(2).standard_normal(q.shape)
    jumps = (1.2, 2.6)
    slips = smooth.copy()
    for at in jumps:
        slips[:, 2] += 0.2 * np.clip((time - at) / 0.015, 0.0, 1.0)
    batches = [
        stack(Trial("free", "VD.3", time, x, tendon_force=np.zeros((time.size, FINGER.n)))).batch
        for x in (smooth, slips)
    ]
    at = np.asarray(batches[0].x.time)[0]
    before, after = (np.asarray(b.mask["joint_torque"])[1, 0] > 0 for b in batches)
    near = np.abs(at[:, None] - jumps).min(axis=1)
    assert before[near < 0.5].all()
    since = (at[:, None] - jumps)[np.arange(len(at)), np.abs(at[:, None] - jumps).argmin(axis=1)]
    assert not after[(since > -CLEAR) & (since < CLEAR + BREAKAWAY)].any()  # a free joint breaks away at once
    assert after[(near > 0.15) & (near < 0.5)].all()
    assert after[(since > -0.15) & (since < -0.1)].all()


def test_where_a_joint_sticks_and_slips_no_joint_counts():
    """Fourteen steps of 40 mrad in a second are small beside the travel, and smooth after a filter of 10 Hz."""
    time = np.arange(4000) / RATE
    steps = np.interp(time % 0.07, [0.0, 0.05, 0.07], [0.0, 0.0, 0.04]) + 0.04 * np.floor(time / 0.07)
    smooth = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1)) + 0.3 * time[:, None] * [0.0, 1.0, 1.0]
    smooth += ENCODER * np.random.default_rng(2).standard_normal(smooth.shape)
    jerky = smooth.copy()
    middle = (time > 1.4) & (time < 2.8)
    jerky[middle, 2] += (steps - 0.04 / 0.07 * time)[middle]
    batches = [
        stack(Trial("free", "VD.3", time, q, tendon_force=np.zeros((time.size, FINGER.n)))).batch
        for q in (smooth, jerky)
    ]
    at = np.asarray(batches[0].x.time)[0]
    before, after = (np.asarray(b.mask["joint_torque"])[1:, 0] > 0 for b in batches)
    assert before[:, (at > 0.2) & (at < 3.8)].all()
    assert not after[:, (at > 1.4) & (at < 2.8)].any()
    assert after[:, (at > 0.2) & (at < 1.3)].all()


def test_a_tendon_that_may_only_stretch_has_no_known_friction():
    """A tendon of 40 µm/N shortens by 2 mm/s at −50 N/s; at that motor speed its other end may be at rest."""
    time = np.arange(4000) / RATE
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1)) + 0.3 * time[:, None]
    q += ENCODER * np.random.default_rng(2).standard_normal(q.shape)
    tension = np.interp(time, [0.0, 1.9, 2.1, 4.0], [12.0, 12.0, 2.0, 2.0])[:, None] * np.ones(FINGER.n)
    excursion = -1.5e-3 * time[:, None] * np.ones(FINGER.n)
    path = Trial("path", "VD.1", time, q, tension, 2.5 * excursion)  # an excursion of 15 mm, 1.25 mm a newton
    batch = stack(path, Trial("free", "VD.3", time, q, tension, excursion), names=["free"]).batch
    at, counts = np.asarray(batch.x.time)[0], np.asarray(batch.mask["joint_torque"])[0, 0] > 0
    assert not counts[(at > 1.9) & (at < 2.1)].any()
    assert counts[(at > 0.2) & (at < 1.7)].all()
    assert counts[(at > 2.3) & (at < 3.8)].all()


def test_a_tendon_that_stands_still_for_a_moment_has_no_known_friction():
    """It stops for 60 ms, which a filter of 5 Hz shows as half the speed."""
    time = np.arange(4000) / RATE
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1)) + 0.3 * time[:, None]
    q += ENCODER * np.random.default_rng(2).standard_normal(q.shape)
    speed = np.where((time > 2.0) & (time < 2.06), 0.0, 3e-3)
    excursion = np.cumsum(speed)[:, None] / RATE * np.ones(FINGER.n)
    excursion += 1e-5 * np.random.default_rng(3).standard_normal(excursion.shape)
    batch = stack(Trial("free", "VD.3", time, q, np.full_like(excursion, 5.0), excursion)).batch
    at, counts = np.asarray(batch.x.time)[0], np.asarray(batch.mask["joint_torque"])[0, 0] > 0
    assert not counts[(at > 2.0) & (at < 2.06 + BREAKAWAY)].any()
    assert counts[(at > 0.2) & (at < 1.9)].all()
    assert counts[(at > 2.3) & (at < 3.8)].all()


@pytest.mark.parametrize(("loss", "second_release_counts"), [(0.05, True), (0.3, False)])
def test_between_holds_counts_a_tension_that_goes_on_or_a_joint_that_slides(loss, second_release_counts):
    """A tendon sticks where its tension turns back; a joint may stick at the ends of a move.

    With more friction the tendon sticks all through its first release, and slips at some time in the second.
    """
    time = np.arange(7000) / RATE
    heights = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 3.0, 2.0, 1.0])
    second = np.floor(time).astype(int)
    step = np.interp(time - second, [0.0, 0.3], [0.0, 1.0])  # 0.3 s to the next height, then at rest
    level = heights[second] + step * (heights[second + 1] - heights[second])
    hold = np.where(time - second > 0.33, second, -1).astype(np.int32)
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    tension = 2.0 * level[:, None] * (np.arange(FINGER.n) == 0)
    at_joint = joint_tension(tension.T, loss * tension.T)[0]
    torque = np.where(np.arange(3) == 0, -6e-3 * at_joint[:, None], np.nan)
    fixed = Trial("pull", "ID.4", time, q, tension, joint_torque=torque, joint=MCP, tendon="T1", hold=hold)
    moved = q + 0.05 * level[:, None] * (np.arange(3) == 0)
    stepped = Trial("steps", "ID.3-static", time, moved, joint_torque=torque, joint=MCP, hold=hold)
    held, static = (stack(t) for t in (fixed, stepped))
    counts = np.asarray(held.batch.mask["joint_torque"])[0, 0] > 0
    between = {k: counts[20 * k : 20 * k + 6] for k in range(7)}  # the 0.3 s before hold number k
    whole = [False, False, True, True, False, second_release_counts, True]
    assert [bool(x.all()) for x in between.values()] == whole
    assert not between[4].any()
    moves, at = np.asarray(static.batch.mask["joint_torque"])[0, 0] > 0, np.asarray(static.batch.x.time)[0]
    turns, end = np.abs(at - 4.0) < 0.1, at > 6.9  # the filter spreads the jump of friction and the last sample's noise
    np.testing.assert_array_equal(moves[(static.holds[0] >= 0) & ~turns & ~end], True)
    assert all(moves[20 * k + 2 : 20 * k + 4].all() and not moves[20 * k + 6] for k in range(7))
    rate = low_pass(time, np.where(time - second < 0.3, np.diff(heights)[second] * 0.05 / 0.3, 0.0), 5.0)
    np.testing.assert_allclose(np.asarray(static.batch.x.qd)[0, 0, :140], rate.reshape(140, 50).mean(axis=1), atol=1e-3)
    assert [len(k) for k in held.samples_of_holds(0, counts)] == [13] * 7


@pytest.mark.parametrize(("experiment", "channel"), [("ID.3-static", "joint_torque"), ("VD.3", "tendon_excursion")])
def test_noise_is_as_small_at_the_ends_of_a_recording_as_elsewhere(experiment, channel):
    """Beyond the ends the filter mirrors the signal about the last sample, whose noise no average reduces."""
    rng, rate = np.random.default_rng(3), 5e3
    time = np.arange(round(8 * rate)) / rate
    second, hold = np.floor(time).astype(int), np.where(time % 1.0 > 0.5, np.floor(time), -1).astype(np.int32)
    level = second + np.interp(time - second, [0.0, 0.4], [0.0, 1.0])
    q = np.radians([10.0, 30.0, 20.0]) + 0.1 * level[:, None] * (np.arange(3) == 0)
    noise, largest = 1e-2, []
    for k in range(10):
        torque = np.where(np.arange(3) == 0, noise * rng.standard_normal(q.shape), np.nan)
        excursion = noise * rng.standard_normal((time.size, FINGER.n))
        tension = np.ones_like(excursion)
        trial = Trial(f"steps {k}", experiment, time, q, tension, excursion, torque, joint=MCP, hold=hold)
        if experiment == "VD.3":
            trial = replace(trial, hold=None, joint=None)
        found = stack(trial)
        y, mask = np.asarray(found.batch.y[channel])[0, 0], np.asarray(found.batch.mask[channel])[0, 0] > 0
        largest.append(np.abs(y[mask]).max())
    assert max(largest) < 5.0 * noise / np.sqrt(rate * found.dt)


def test_a_slow_sweep_of_the_motor_slides_and_a_finger_as_slow_may_stick():
    time = np.arange(4000) / RATE
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    q[:, 0] += 0.05 * time
    q += 0.1 * ENCODER * np.random.default_rng(1).standard_normal(q.shape)
    fast = q + np.where(time[:, None] > 3.0, 3.0 * (time[:, None] - 3.0), 0.0)  # slow beside the rest
    torque = np.where(np.arange(3) == 0, 1e-2, np.nan) * np.ones_like(q)
    driven = stack(Trial("slow", "ID.3-dynamic", time, fast, joint_torque=torque, joint=MCP))
    free = stack(Trial("free", "VD.3", time, fast, tendon_force=np.zeros((time.size, FINGER.n))))
    middle = slice(25, 125)  # 0.5 to 2.5 s
    assert np.asarray(driven.batch.mask["joint_torque"])[0, 0, middle].all()
    assert not np.asarray(free.batch.mask["joint_torque"])[0, 0, middle].any()


def test_the_protocols_directions_are_taken_as_they_are():
    commanded = np.tile([1, 0, 0], (9000, 1)).astype(np.int8)
    x = stack(sweep(joint_direction=commanded), reduced=False).batch.x
    np.testing.assert_array_equal(np.asarray(x.joint_direction)[:, 0, :9000].T, commanded)


def test_a_hold_keeps_the_direction_that_led_to_it_though_nothing_says_so():
    """After two steps up and one down, friction at each hold has the sign of the step before it."""
    time = np.arange(8000) / RATE
    corners = ([0.0, 2.0, 2.5, 4.0, 4.5, 6.0, 6.5, 8.0], [0.2, 0.2, 0.5, 0.5, 0.8, 0.8, 0.5, 0.5])
    q = np.tile(np.interp(time, *corners)[:, None], (1, 3)) + ENCODER * np.random.default_rng(2).normal(size=(8000, 3))
    torque = np.where(np.arange(3) == 0, 1e-2, np.nan) * np.ones_like(q)
    batch = stack(Trial("steps", "ID.3-static", time, q, joint_torque=torque, joint=MCP)).batch
    at, counts = np.asarray(batch.x.time)[0], np.asarray(batch.mask["joint_torque"])[0, 0] > 0
    direction = np.asarray(batch.x.joint_direction)[0, 0]
    for begin, end, sign in ((2.6, 3.9, 1.0), (4.6, 5.9, 1.0), (6.6, 7.9, -1.0)):
        held = counts & (at > begin) & (at < end)
        assert held.sum() > 10
        np.testing.assert_allclose(direction[held], sign, atol=0.02)


@pytest.mark.parametrize(
    ("experiment", "pulled"),
    [("VD.3", [1.0, 1.0]), ("VD.1", [1.0, 1.0]), ("ID.4", [1.0, 0.0]), ("ID.3-dynamic", [0.0, 0.0])],
)
def test_a_little_tension_counts_unless_the_protocol_leaves_its_tendon_slack(experiment, pulled):
    tension = np.full((9000, FINGER.n), 0.5 * SLACK_SHARE * 5.0)
    tension[:, 0] = 5.0
    trial = replace(sweep(tendon_force=tension), experiment=experiment)
    if experiment == "VD.3":
        trial = replace(trial, joint_torque=None, joint=None)
    if experiment == "VD.1":
        trial = replace(trial, tendon_excursion=np.zeros((9000, FINGER.n)))
    found = np.asarray(stack(trial).batch.x.tension)[:2, 0]
    expected = np.array(pulled)[:, None] * tension[0, :2, None]
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape))


def test_spikes_do_not_count_and_do_not_spread():
    trial = sweep(noise=0.0)
    spiked = trial.joint_torque.copy()
    spiked[1000::500, 0] += 1.0
    with_spikes = stack(replace(trial, joint_torque=spiked)).batch
    without = stack(trial).batch
    np.testing.assert_allclose(with_spikes.y["joint_torque"], without.y["joint_torque"], atol=2e-5)


def test_predictions_are_subtracted_where_there_are_some():
    trial = sweep()
    known = {"sweep": {"time": trial.time, "joint_torque": trial.joint_torque}}
    batch = stack(trial, minus=known).batch
    assert np.asarray(batch.mask["joint_torque"])[0].sum() > 100
    np.testing.assert_allclose(batch.y["joint_torque"], 0.0, atol=1e-12)
    assert not np.asarray(stack(trial, minus={}).batch.mask["joint_torque"]).any()


def test_trials_of_other_rates_are_refused_by_name():
    slow = sweep()
    slow = replace(slow, name="slow", time=slow.time * 40.0)
    with pytest.raises(UserError, match="resample trial slow to at least 50 Hz"):
        stack(sweep(), slow)


def stairs(first: float, duration=8.0, seed=2):
    """Trial with steps of the MCP up and down, after a rest of `first` s of unknown approach."""
    time = np.arange(round((first + duration) * RATE)) / RATE
    corners = np.array([0.0, first, first + 0.5, first + 2.0, first + 2.5, first + 4.0, first + 4.5, first + 6.0])
    q = np.tile(np.interp(time, corners, [0.2, 0.2, 0.5, 0.5, 0.8, 0.8, 0.5, 0.5])[:, None], (1, 3))
    q += ENCODER * np.random.default_rng(seed).normal(size=q.shape)
    torque = np.where(np.arange(3) == 0, 1e-2, np.nan) * np.ones_like(q)
    return Trial("steps", "ID.3-static", time, q, joint_torque=torque, joint=MCP)


@pytest.mark.parametrize(("crossing", "moves"), [(6.0, True), (4.0, False)])
def test_holds_alone_count_for_a_fit_where_noise_of_angles_hides_the_inertia(crossing, moves):
    """Noise of q̈, times an inertia, is in motion alone. The cut-off is at 5 Hz."""
    session = Session("a finger", FINGER, {"stairs": stairs(1.0)})
    sizes = replace(sizes_of(session), crossing=crossing)
    for reduced, expected in ((True, moves), (False, True)):
        found = prepare(session, sizes=sizes, reduced=reduced)["ID.3-static"]
        counts = np.asarray(found.batch.mask["joint_torque"])[0, 0] > 0
        assert counts[found.holds[0] >= 0].mean() > 0.5
        assert counts[found.holds[0] < 0].any() == expected


@pytest.mark.parametrize("given", [True, False])
def test_a_hold_before_the_first_motion_tells_nothing_of_friction(given):
    trial = stairs(2.0)
    if given:
        direction = np.where(trial.time[:, None] < 2.0, 0, np.where(trial.time[:, None] < 6.0, 1, -1))
        trial = replace(trial, joint_direction=(direction * [1, 0, 0]).astype(np.int8))
    batch = stack(trial).batch
    at, counts = np.asarray(batch.x.time)[0], np.asarray(batch.mask["joint_torque"])[0, 0] > 0
    assert not counts[at < 1.9].any()
    assert counts[(at > 2.8) & (at < 3.7)].all()


def test_the_torque_of_a_motor_that_was_not_recorded_is_not_taken_for_zero():
    """No external torque acts on a finger that tendons drive, but a motor that sweeps a joint does exert one."""
    found = stack(replace(sweep(), joint_torque=None))
    assert not_judged({"ID.3-dynamic": found}) == [("ID.3-dynamic", "joint_torque", "no trial measured it")]


def test_several_joints_excited_at_once_are_all_motorised():
    trial = sweep()
    q = trial.q.copy()
    q[:, 1] += 0.3 * np.sin(2 * np.pi * trial.time / 2.0)
    torque = 1e-2 * np.ones(q.shape) * [1.0, 1.0, np.nan]
    batch = stack(replace(trial, q=q, joint=None, joint_torque=torque)).batch
    np.testing.assert_array_equal(np.asarray(batch.x.motorised)[:, 0, 0], [1.0, 1.0, 0.0])
    counts = np.asarray(batch.mask["joint_torque"])[:, 0].mean(axis=-1)
    assert (counts[:2] > 0.5).all()
    assert counts[2] == 0.0


def test_another_unit_of_force_and_length_leaves_what_counts_alone():
    """Samples are the same for a finger 1000 times as strong and ten times as long."""
    time = np.arange(4000) / RATE
    q = np.radians([40.0, 30.0, 20.0]) + 0.3 * time[:, None]
    q += ENCODER * np.random.default_rng(2).standard_normal(q.shape)
    tension = np.interp(time, [0.0, 1.9, 2.1, 4.0], [12.0, 12.0, 2.0, 2.0])[:, None] * np.ones(FINGER.n)
    excursion = -1.5e-3 * time[:, None] * np.ones(FINGER.n)
    small = Trial("free", "VD.3", time, q, tension, excursion)
    large = replace(small, tendon_force=1e3 * tension, tendon_excursion=10.0 * excursion)
    for a, b in zip(*(stack(t).batch.mask.values() for t in (small, large)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_steps_are_read_at_their_own_pace_however_quick_the_sweeps_are():
    """Sweeps of ten cycles a second do not change the reduction of steps at the protocol's pace."""
    step, rng = 1.0 / 200.0, np.random.default_rng(1)
    levels = np.radians([*range(0, 81, 10), *range(70, -1, -10)])
    time = np.arange(0.0, 1.8 * len(levels), step)
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    q[:, 0] = np.interp(
        time, np.repeat(1.8 * np.arange(len(levels)), 2) + np.tile([0.0, 1.2], len(levels)), np.repeat(levels, 2)
    )
    q += np.radians(0.03) * rng.standard_normal(q.shape)
    stairs = Trial("stairs", "ID.3-static", time, q, joint_torque=np.full(q.shape, 1e-2), joint=MCP)
    quick = replace(sweep(), time=sweep().time / 30.0)
    x = prepare(Session("a finger", FINGER, {t.name: t for t in (stairs, quick)}))["ID.3-static"]
    alone = prepare(Session("a finger", FINGER, {"stairs": stairs}))["ID.3-static"]
    for name in ("joint_direction", "q", "qd"):
        np.testing.assert_array_equal(getattr(x.batch.x, name), getattr(alone.batch.x, name))
