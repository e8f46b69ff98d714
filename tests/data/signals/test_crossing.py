"""Frequency above which noise of angles, as torque of inertia, exceeds that of the torque."""

import numpy as np
import pytest

from jaxfinger.data import Session, Trial
from jaxfinger.data.signals.crossing import crossing_of
from tests.experiments.test_prepare import FINGER


def sweeps(inertia, of_angle, of_torque, unit=1.0, pace=1.0) -> Session:
    """A joint swept to and fro with spring, friction, damping and noise; torques times `unit`, times times `pace`."""
    rng, time, turn = np.random.default_rng(0), np.arange(0.0, 12.0, 1e-3), 2.0 * np.pi * np.array([[0.7], [1.6]])
    swing = np.array([[1.0], [0.3]]) * np.exp(1j * turn * time)
    q, qd, qdd = (np.sum(((1j * turn) ** k * swing).imag, axis=0) for k in range(3))
    torque = inertia * qdd + 0.02 * q + 0.004 * np.sign(qd) + 0.001 * qd + of_torque * rng.standard_normal(time.size)
    angles = np.tile((q + of_angle * rng.standard_normal(time.size))[:, None], FINGER.m)
    torques = np.where(np.arange(FINGER.m) == 0, unit * torque[:, None], np.nan)
    trial = Trial("sweep", "ID.3-dynamic", pace * time, angles, joint_torque=torques, joint=FINGER.joint_names[0])
    return Session("a finger", FINGER, {"sweep": trial})


@pytest.mark.parametrize(
    ("inertia", "of_angle", "of_torque"), [(1e-4, 2e-4, 3e-4), (1e-2, 2e-4, 3e-4), (1e-3, 1e-3, 1e-4)]
)
def test_the_crossing_is_where_both_noises_are_alike(inertia, of_angle, of_torque):
    expected = np.sqrt(of_torque / (inertia * of_angle)) / (2.0 * np.pi)
    assert crossing_of(sweeps(inertia, of_angle, of_torque), 1.0) == pytest.approx(expected, rel=0.15)


def test_units_and_pace_do_not_change_what_is_above_it():
    """Times four times as long make the same inertia sixteen times as slow to act, and the frequency a quarter."""
    crossing = crossing_of(sweeps(1e-3, 2e-4, 3e-4), 1.0)
    assert crossing_of(sweeps(1e-3, 2e-4, 3e-4, unit=1e3), 1.0) == pytest.approx(crossing, rel=1e-6)
    assert crossing_of(sweeps(1e-3, 2e-4, 3e-4, pace=4.0), 4.0) == pytest.approx(crossing / 4.0, rel=1e-6)


def test_without_noise_or_without_sweeps_it_is_unknown():
    assert crossing_of(sweeps(1e-3, 0.0, 0.0), 1.0) == np.inf
    assert crossing_of(Session("a finger", FINGER, {}), 1.0) == np.inf


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of NumPy, that numbers overflow
def test_a_damaged_clock_whose_rates_overflow_tells_nothing():
    assert crossing_of(sweeps(1e-3, 2e-4, 3e-4, pace=1e-200), 1e-200) == np.inf
