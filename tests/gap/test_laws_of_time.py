"""Noise of repeats that a law of the session's time makes differ."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from jaxfinger.data import Session
from jaxfinger.effects import CATALOGUE
from jaxfinger.experiments import differs_in_repeats
from jaxfinger.gap import diagnose
from jaxfinger.gap.laws_of_time import Repeats, without_laws_of_time
from jaxfinger.gap.problem import build
from jaxfinger.gap.result import Key
from jaxfinger.identify import Recipe

from .conftest import session_with

DRIFT = ("torque_sensor_drift", ("torque_sensor",), {"A": 1e-3, "B": -5e-4, "P": 71.0, "T": 1e4, "tare": 3.0})
WARM_UP = ("joint_friction_warmup", ("PIP",), {"a": 8.0, "T": 300.0})
DYNAMIC = ("ID.3-dynamic", "joint_torque")


def problem_with(*effects):
    return build(session_with(*effects), Recipe())


@pytest.fixture(scope="module")
def quiet():
    """The problem of a session without any effect."""
    return problem_with()


def with_red_noise(session: Session, seconds: float, std: float, seed: int) -> Session:
    """Add noise to torques that decays within so many seconds, as an Ornstein–Uhlenbeck process."""
    rng = np.random.default_rng(seed)

    def noisy(trial):
        if trial.joint_torque is None:
            return trial
        a = np.exp(-float(np.median(np.diff(trial.time))) / seconds)
        start = std * rng.standard_normal((200, trial.joint_torque.shape[1]))
        drive = np.concatenate([start, std * rng.standard_normal(trial.joint_torque.shape)]) * np.sqrt(1 - a**2)
        return replace(trial, joint_torque=trial.joint_torque + lfilter([1.0], [1.0, -a], drive, axis=0)[200:])

    return replace(session, trials={t.name: noisy(t) for t in session})


def with_wander(session: Session, seconds: float, std: float, seed: int) -> Session:
    """Add to torques what a smooth random offset has changed since a tare 3 s before each trial."""
    t = np.arange(-10.0 * seconds, 1000.0, seconds / 20.0)
    kernel = np.exp(-0.5 * (np.arange(-100, 101) / 20.0) ** 2)
    white = np.random.default_rng(seed).standard_normal(t.size)
    offset = std * np.convolve(white, kernel / np.linalg.norm(kernel), "same")

    def drifting(trial):
        if trial.joint_torque is None:
            return trial
        since = np.interp(trial.session_start + trial.time, t, offset) - np.interp(trial.session_start - 3.0, t, offset)
        return replace(trial, joint_torque=trial.joint_torque + since[:, None])

    return replace(session, trials={t.name: drifting(t) for t in session})


def test_only_laws_of_the_sessions_time_differ_in_repeats(quiet):
    finger = quiet.nominal.finger
    found = {name for name, kind in CATALOGUE.items() if differs_in_repeats(kind, finger)}
    assert found == {"joint_friction_warmup", "torque_sensor_drift"}


@pytest.mark.parametrize("effect", [DRIFT, WARM_UP])
def test_a_law_of_time_is_no_noise(quiet, effect):
    loud = problem_with(effect)
    found = without_laws_of_time(loud, CATALOGUE)
    column = {"torque_sensor_drift": slice(None), "joint_friction_warmup": slice(1, 2)}[effect[0]]
    before, after, expected = (p.noise[DYNAMIC].std[column] for p in (loud, found, quiet))
    assert np.all(before > 1.5 * expected)
    assert after == pytest.approx(expected, rel=0.3)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_a_wander_without_a_period_is_named(seed):
    found = diagnose(with_wander(session_with(), 60.0, 2e-3, seed), quick=True)
    assert Key("torque_sensor_drift", ("torque_sensor",)) in found.named


def test_repeats_that_differ_by_noise_alone_keep_their_noise(quiet, planted):
    """An effect that is the same in all repeats is no reason, either."""
    assert without_laws_of_time(quiet, CATALOGUE) is quiet
    assert without_laws_of_time(planted, CATALOGUE) is planted


@pytest.mark.parametrize("seconds", [0.3, 3.0])
def test_slow_noise_is_no_law(seconds):
    noisy = build(with_red_noise(session_with(), seconds, 5e-4, seed=1), Recipe())
    assert without_laws_of_time(noisy, CATALOGUE) is noisy


def test_deviations_are_those_of_the_same_samples(quiet):
    """What repeats share cancels, and what differs stays, in rows of motions that are repeated."""
    repeats = Repeats.of(quiet)
    kind, trial, time = quiet.column_of_row, quiet.trial_of_row, np.empty(quiet.r.size)
    for rows in quiet.rows.values():
        time[rows.start : rows.start + rows.size] = rows.time
    for rows in repeats.rows:
        assert np.all(kind[rows] == kind[rows[:1]])
        assert np.all(time[rows] == time[rows[:1]])
        assert len(set(trial[rows[:, 0]])) == len(rows)
    shared = np.sin(time + kind)
    for alike, different in zip(repeats.deviations(shared), repeats.deviations(shared + trial), strict=True):
        assert np.allclose(alike, 0.0)
        assert np.allclose(np.abs(different), 0.5)


def test_a_session_without_repeats_keeps_its_noise(quiet):
    apart = {e: replace(s, motions=(None,) * len(s.motions)) for e, s in quiet.stacks.items()}
    alone = replace(quiet, stacks=apart)
    assert without_laws_of_time(alone, CATALOGUE) is alone
