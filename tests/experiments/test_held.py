"""Reduction of trials in which a fixture holds the joints while a tendon is pulled (ID.4, VD.2)."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from jaxfinger.data import Session, Trial
from jaxfinger.data.checks.trial import check_trial
from jaxfinger.data.findings import Report
from jaxfinger.data.signals.sizes import SLACK_SHARE, sizes_of
from jaxfinger.experiments import not_judged
from jaxfinger.synthetic.plant import joint_tension
from tests.experiments.test_prepare import ENCODER, FINGER, MCP, RATE, stack


def test_the_excursion_of_a_taut_tendon_counts_on_every_ramp():
    """Friction does not change the excursion, but the length of a slack tendon is not that of its path."""
    time = np.arange(5000) / RATE
    level = np.interp(time, [0.5, 1.0, 2.0, 2.5, 3.5, 4.0], [0.0, 4.0, 4.0, 8.0, 8.0, 2.0])
    hold = np.where((time > 1.05) & (time < 2.0), 0, np.where((time > 2.55) & (time < 3.5), 1, -1)).astype(np.int32)
    tension = level[:, None] * (np.arange(FINGER.n) == 0)
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    trial = Trial("pull", "VD.2", time, q, tension, tendon_excursion=0.0 * tension, tendon="T1", hold=hold)
    found = stack(trial)
    pulled, slack = (np.asarray(found.batch.mask["tendon_excursion"])[k, 0, :100] > 0 for k in (0, 1))
    at = found.batch.x.time[0, :100]
    np.testing.assert_array_equal(pulled, level.reshape(100, 50).min(axis=1) > SLACK_SHARE * level.max())
    assert not slack[(at < 1.0) | (at > 3.5)].any()


@pytest.mark.parametrize("reduced", [True, False])
def test_a_held_joint_follows_what_its_fixture_yields_and_no_noise(reduced):
    """Otherwise noise of the angle would look like a law of the angle in the residual excursion."""
    time = np.arange(9000) / RATE
    level = np.floor(time) + np.interp(time % 1.0, [0.0, 0.3], [-1.0, 0.0])  # a step every second, up in 0.3 s
    hold = np.where(time % 1.0 > 0.35, np.floor(time), -1).astype(np.int32)
    true = np.radians([40.0, 30.0, 20.0]) + 0.004 * level[:, None] * np.array([1.0, 0.0, 0.0])
    q = true + ENCODER * np.random.default_rng(2).standard_normal(true.shape)
    tension = np.maximum(level, 0.0)[:, None] * (np.arange(FINGER.n) == 0)
    trial = Trial("pull", "VD.2", time, q, tension, tendon_excursion=0.0 * tension, tendon="T1", hold=hold)
    found = stack(trial, reduced=reduced)
    N = 180 if reduced else 9000
    wrong = np.asarray(found.batch.x.q)[:, 0, :N].T - true.reshape(N, -1, 3).mean(axis=1)
    counts = found.holds[0, :N] >= 0
    of_a_hold = ENCODER / np.sqrt(650)
    assert (np.std(wrong[counts, 1:], axis=0) < 0.6 * of_a_hold).all()
    assert np.std(wrong[counts, 0]) < 1.5 * of_a_hold
    np.testing.assert_allclose(wrong[counts | (time[:: 9000 // N] > 1.0), 0], 0.0, atol=5 * ENCODER)


def ramps(rise: float, start: float = 0.0, rest: float = 0.0) -> Trial:
    """Trial in which a tendon rests for `rest` s, is pulled to 8 N in `rise` s and released as slowly, twice."""
    corners = rest + rise * np.arange(5)
    time = np.arange(round(corners[-1] * RATE)) / RATE
    rng = np.random.default_rng(7)
    tension = np.interp(time, corners, [start, 8.0, 1.0, 8.0, 1.0])
    tension = (tension + 0.02 * rng.standard_normal(time.size))[:, None] * (np.arange(FINGER.n) == 0)
    q = np.radians([40.0, 30.0, 20.0]) + ENCODER * rng.standard_normal((time.size, 3))
    torque = np.where(np.arange(3) == 0, 1e-2, np.nan) * np.ones_like(q)
    return Trial("pull", "ID.4", time, q, tension, joint_torque=torque, joint=MCP, tendon="T1")


@pytest.mark.parametrize(("noise", "counting"), [(0.3, True), (3.0, False)])
def test_steps_count_where_the_noise_of_the_tension_is_less_than_that_of_the_load(noise, counting):
    """One noise stands for all samples of a channel, and the mean tension of a hold has hardly any.

    `noise`: torque by the noise of the tension, over that of the torque sensor.
    """
    time, rng, arm, torque_noise = np.arange(7000) / RATE, np.random.default_rng(4), 6e-3, 3e-4
    level = np.floor(time) + np.interp(time % 1.0, [0.0, 0.3], [-1.0, 0.0])
    hold = np.where(time % 1.0 > 0.35, np.floor(time), -1).astype(np.int32)
    true = np.maximum(level, 0.0)[:, None] * (np.arange(FINGER.n) == 0)
    torque = np.full((time.size, 3), np.nan)
    torque[:, 0] = -arm * joint_tension(true.T, 0.1 * true.T)[0] + torque_noise * rng.standard_normal(time.size)
    tension = true + noise * torque_noise / arm * rng.standard_normal(true.shape)
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    found = stack(Trial("pull", "ID.4", time, q, tension, joint_torque=torque, joint=MCP, tendon="T1", hold=hold))
    counts = np.asarray(found.batch.mask["joint_torque"])[0, 0, :140] > 0
    rests = found.holds[0, :140] >= 0
    assert counts[rests].all()
    assert counts[60:][~rests[60:]].all() == counting
    pulled, y = np.asarray(found.batch.x.tension)[0, 0, :140], np.asarray(found.batch.y["joint_torque"])[0, 0, :140]
    residual = np.where(counts, y + arm * 0.9 * pulled, 0.0)
    assert np.std(residual[60:][counts[60:]]) < 1.5 * np.std(residual[rests])


def test_a_released_tendon_counts_while_it_sticks_all_through_a_step_and_once_it_slips():
    """It sticks until the tension has fallen by the friction of both directions; that step is not known."""
    rng, loss, arm = np.random.default_rng(6), 0.3, 6e-3
    heights = np.array([0.0, 2.0, 3.0, 4.0, 3.75, 3.5, 3.25, 3.0, 2.75, 2.5, 2.25, 2.0, 1.75, 1.5])
    time = np.arange(round((heights.size - 1) * RATE)) / RATE
    second = np.floor(time).astype(int)
    level = heights[second] + np.interp(time - second, [0.0, 0.3], [0.0, 1.0]) * np.diff(heights)[second]
    hold = np.where(time - second > 0.35, second, -1).astype(np.int32)
    tension = level[:, None] * (np.arange(FINGER.n) == 0)
    q = np.tile(np.radians([40.0, 30.0, 20.0]), (time.size, 1))
    torque = np.full(q.shape, np.nan)
    torque[:, 0] = -arm * joint_tension(tension.T, loss * tension.T)[0] + 1e-5 * rng.standard_normal(time.size)
    found = stack(Trial("pull", "ID.4", time, q, tension, joint_torque=torque, joint=MCP, tendon="T1", hold=hold))
    counts = np.asarray(found.batch.mask["joint_torque"])[0, 0] > 0
    between = [counts[20 * k : 20 * k + 6].all() for k in range(heights.size - 1)]
    falls = np.diff(heights) < 0.0
    turns, slips = (int(np.argmax(x)) for x in (falls, falls & (heights[1:] * (1 + loss) < 4.0 * (1 - loss))))
    sticking, slipping = range(turns + 1, slips), range(slips + 1, heights.size - 1)
    assert len(sticking) > 3
    assert [k for k in range(turns, len(between)) if between[k]] == [*sticking, *slipping]


@pytest.mark.parametrize("reduced", [True, False])
def test_slow_ramps_of_tension_count_without_holds(reduced):
    trial = ramps(4.0)
    found = stack(trial, reduced=reduced)
    T = 320 if reduced else trial.time.size
    counts = np.asarray(found.batch.mask["joint_torque"])[0, 0, :T] > 0
    assert counts.mean() > 0.97
    pulled = np.asarray(found.batch.x.tension)[0, 0, :T]
    turns = [0, *(T * np.arange(1, 4) // 4), T]
    for k, (a, b) in enumerate(pairwise(turns)):
        inner = pulled[a + T // 80 : b - T // 80]
        assert (np.diff(inner) * (1 if k % 2 == 0 else -1) >= 0.0).all()  # noise does not add up
    assert not_judged({"ID.4": found}) == [("ID.4", "tendon_excursion", "no trial measured it")]


def test_quick_ramps_without_holds_are_not_judged_and_said_not_to_be():
    found = stack(ramps(0.1))
    assert not np.asarray(found.batch.mask["joint_torque"]).any()
    (torque, excursion) = not_judged({"ID.4": found})
    assert torque.experiment == "ID.4"
    assert torque.channel == "joint_torque"
    assert "no tendon is pulled" in torque.reason
    assert excursion.reason == "no trial measured it"


@pytest.mark.parametrize("newton", [1e-2, 1.0, 1e2])
@pytest.mark.parametrize(
    ("rise", "pulled", "said"),
    [(4.0, 1.0, ""), (0.1, 1.0, "next to nothing of the trial is judged"), (4.0, 0.01, "T1 is never pulled")],
)
def test_the_checker_says_what_a_fit_counts(rise, pulled, said, newton):
    """The size of the forces does not matter; another trial gives their scale."""
    trials = [ramps(rise), replace(ramps(4.0), name="another", tendon="T2")]
    own, other = (newton * t.tendon_force for t in trials)
    trials = [
        replace(trials[0], tendon_force=own * np.where(np.arange(FINGER.n) == 0, pulled, 0.0)),
        replace(trials[1], tendon_force=np.roll(other, 1, axis=1)),
    ]
    session, report = Session("a finger", FINGER, {t.name: t for t in trials}), Report()
    check_trial(trials[0], FINGER, sizes_of(session), report)
    told = [f.message for f in report if f.place.endswith("tendon_force") and f.severity != "note"]
    assert said in " ".join(told)
    assert len(told) == bool(said)
    counts = np.asarray(stack(*trials).batch.mask["joint_torque"])[0, 0].any()
    assert counts == (said == "")


def test_a_tendon_that_was_taut_before_the_recording_counts_from_its_first_change_on():
    """It is not known whether its tension rose or fell before."""
    found = stack(ramps(4.0, start=4.0, rest=2.0))
    at, counts = np.asarray(found.batch.x.time)[0], np.asarray(found.batch.mask["joint_torque"])[0, 0] > 0
    assert not counts[at < 2.0].any()
    assert counts[(at > 3.5) & (at < 17.5)].all()


def test_another_unit_of_force_leaves_what_counts_alone():
    pull = ramps(4.0)
    trials = pull, replace(pull, tendon_force=1e3 * pull.tendon_force)
    for a, b in zip(*(stack(t).batch.mask.values() for t in trials), strict=True):
        np.testing.assert_array_equal(a, b)
