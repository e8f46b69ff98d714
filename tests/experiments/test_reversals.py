"""Samples beside reversals of a joint that a motor moves, and how their friction changes with the reversals' time."""

from dataclasses import replace

import numpy as np
import pytest

from jaxfinger.data import Trial
from jaxfinger.experiments import Stack
from jaxfinger.experiments.reduction import Reversals
from tests.experiments.test_prepare import CLEAR, ENCODER, MCP, RATE
from tests.experiments.test_prepare import stack as stacked

CYCLE, PHASE, DURATION = 1.0, 0.3, 4.0  # s, rad, s
TURNS = (np.arange(1, 8) - PHASE / np.pi) * CYCLE / 2  # s, at which the sweep turns back, but for the last time


def direction(time, cycle=CYCLE):
    return np.sign(-np.sin(2 * np.pi * time / cycle + PHASE))


def sweep(noise=ENCODER, cycle=CYCLE, late=0.0) -> Trial:
    """Trial in which the external motor sweeps the MCP, `late` by so many s; noise in rad."""
    time = np.arange(round(DURATION * RATE)) / RATE
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    q[:, 0] += 0.5 * np.cos(2 * np.pi * (time - late) / cycle + PHASE)
    q += noise * np.random.default_rng(0).standard_normal(q.shape)
    torque = np.full(q.shape, np.nan)
    torque[:, 0] = 1e-2 * direction(time - late, cycle)
    return Trial("sweep", "ID.3-dynamic", time, q, joint_torque=torque, joint=MCP)


def stack(trial: Trial) -> Stack:
    return stacked(trial, reversals=True)


def reversals_of(found: Stack) -> Reversals:
    assert found.reversals is not None
    return found.reversals


def near(found, width):
    """Whether a block is within a time of a reversal, s."""
    time = np.asarray(found.batch.x.time)[0]
    return np.abs(time[:, None] - TURNS).min(axis=1) < width


@pytest.mark.parametrize("experiment", ["ID.3-dynamic", "VD.3"])
def test_samples_count_either_for_certain_or_beside_a_reversal_of_a_motor(experiment):
    found = stack(replace(sweep(), experiment=experiment))
    if experiment == "VD.3":
        assert found.reversals is None
        return
    beside, known = reversals_of(found).beside[0, 0], np.asarray(found.batch.mask["joint_torque"])[0, 0] > 0
    inside = (np.asarray(found.batch.x.time)[0] > CLEAR + 0.05) & (
        np.asarray(found.batch.x.time)[0] < DURATION - CLEAR - 0.05
    )
    assert not (beside & known).any()
    assert (beside | known)[inside].all()
    assert beside[near(found, 0.02)].all()
    assert not beside[~near(found, 0.15) & inside].any()
    assert not reversals_of(found).beside[1:].any()


def test_directions_change_as_they_do_when_the_joint_turns_back_later():
    delay = 0.002  # s
    now, later = stack(sweep(noise=1e-5)), stack(sweep(noise=1e-5, late=delay))
    moved = np.asarray(later.batch.x.joint_direction - now.batch.x.joint_direction)[0, 0]
    earlier, change = reversals_of(now).changes[:, 0, 0]
    for way, expected in ((earlier, -moved), (change, moved)):
        beside = near(now, 0.06)
        share = way[beside] @ expected[beside] / (np.linalg.norm(way[beside]) * np.linalg.norm(expected[beside]))
        assert share > 0.95
        assert np.abs(way[~near(now, 0.1) & (np.asarray(now.batch.x.time)[0] < 3.8)]).max() < 1e-6


def test_a_reversal_at_which_the_joint_rests_does_not_count():
    """Friction of a joint at rest has any value, however short the rest."""
    trial, rest = sweep(noise=1e-5), 0.4
    begin = int(np.searchsorted(trial.time, TURNS[1]))
    pause = round(rest * RATE)
    still = np.insert(np.arange(len(trial.time)), begin, [begin] * pause)
    paused = {"time": np.arange(still.size) / RATE, "q": trial.q[still]}
    found = stack(
        replace(trial, **paused, joint_torque=np.where(np.arange(3) == 0, 1e-2, np.full((still.size, 3), np.nan)))
    )
    at = (np.asarray(found.batch.x.time)[0] > TURNS[1] - CLEAR) & (
        np.asarray(found.batch.x.time)[0] < TURNS[1] + rest + CLEAR
    )
    assert not reversals_of(found).beside[0, 0][at].any()
    assert reversals_of(found).beside[0, 0].any()


def test_a_reversal_whose_time_the_encoder_does_not_show_does_not_count():
    assert reversals_of(stack(sweep(cycle=1.5))).beside.any()
    assert not reversals_of(stack(sweep(cycle=4.0, noise=5.0 * ENCODER))).beside.any()


def test_commanded_directions_change_where_the_joint_turns_back():
    """A joint turns back later than its command; friction follows the joint."""
    plain = sweep()
    commanded = np.zeros(plain.q.shape, np.int8)
    commanded[:, 0] = direction(plain.time + 0.01)
    told = stack(replace(plain, joint_direction=commanded))
    free = stack(plain)
    beside = reversals_of(told).beside[0, 0]
    assert beside.any()
    np.testing.assert_allclose(
        np.asarray(told.batch.x.joint_direction)[0, 0][beside],
        np.asarray(free.batch.x.joint_direction)[0, 0][beside],
        atol=0.05,
    )
