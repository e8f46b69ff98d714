"""Channels that come late are reported with their delay; friction, play and stretch are not taken for delays."""

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.bad_input import complaints
from jaxfinger.data.checks.delay import check_delay
from jaxfinger.data.checks.pulls import check_pulls
from jaxfinger.data.findings import Report
from jaxfinger.data.session import Session
from jaxfinger.synthetic import recipe_from, simulate
from tests.data.checks.sweeps import Sweep, alone, late, led, play, pre_sliding, pulled, swept

SEVERAL, ONE = Sweep(), Sweep((0.5,), lasts=20.0)
MACHINES = [
    SEVERAL,
    ONE,
    Sweep((0.3, 1.0), rate=500.0),
    Sweep((0.02, 0.05), rate=20.0, lasts=100.0),
    Sweep((2.0, 5.0), lasts=3.0),
]


def delays(session, trial) -> list[str]:
    report = Report()
    check_delay(alone(session, trial), report)
    check_pulls(alone(session, trial), report)
    return [str(finding) for finding in report]


@pytest.mark.parametrize("delay", [0.03, 0.1, 0.3])
@pytest.mark.parametrize(
    ("channel", "said"),
    [
        ("torque", "/sweep/joint_torque: column MCP comes {} ms after q of MCP"),
        ("angle", "/sweep/q: column MCP comes {} ms after joint_torque of MCP"),
        ("excursion", "/lead/tendon_excursion: columns T1, T2 come {} ms after q of MCP"),
        ("led angle", "/lead/q: column MCP comes {} ms after tendon_excursion of T1, T2"),
    ],
)
def test_a_late_channel_is_named_with_its_delay(session, channel, said, delay):
    q, torque, l = SEVERAL.q, SEVERAL.torque(), SEVERAL.excursion()
    trial = {
        "torque": lambda: swept(SEVERAL, q, late(SEVERAL, torque, delay)),
        "angle": lambda: swept(SEVERAL, late(SEVERAL, q, delay), torque),
        "excursion": lambda: led(SEVERAL, q, late(SEVERAL, l, delay)),
        "led angle": lambda: led(SEVERAL, late(SEVERAL, q, delay), l),
    }[channel]()
    (found,) = (text for text in complaints(alone(session, trial)) if " ms after " in text)
    number = re.search(r"(\d+) ms", found)
    assert number
    assert float(number[1]) == pytest.approx(1e3 * delay, rel=0.1)
    assert said.format(number[1]) in found


def test_a_filter_of_one_channel_is_a_delay(session):
    """An exponential filter with a time constant of 80 ms."""
    kernel = np.exp(-np.arange(200) / (0.08 * SEVERAL.rate))
    q = np.convolve(np.pad(SEVERAL.q, (199, 0), mode="edge"), kernel / kernel.sum(), "valid")
    assert (
        "/q: column MCP comes 6" in delays(session, swept(SEVERAL, q, SEVERAL.torque()))[0]
    )  # about the time constant


@pytest.mark.parametrize("noise", [1.0, 1e-3])
@pytest.mark.parametrize("machine", MACHINES, ids=str)
def test_what_depends_on_travel_is_no_delay(session, machine, noise):
    q, l = machine.q, machine.excursion()
    for reach in (2e-3, 0.01, 0.05, 0.2):
        assert delays(session, swept(machine, q, machine.torque(pre_sliding(q, reach)), noise)) == []
        assert delays(session, led(machine, q, l + 5e-4 * pre_sliding(q, reach), noise)) == []
    for half in (5e-3, 0.02, 0.1):
        behind = play(q, half)
        assert delays(session, swept(machine, q, 0.03 * behind, noise)) == []
        assert delays(session, led(machine, q, 0.008 * behind, noise)) == []


@pytest.mark.parametrize("machine", MACHINES, ids=str)
def test_sound_channels_are_in_time(session, machine):
    q, torque, l = machine.q, machine.torque(), machine.excursion()
    relaxing = q.copy()  # A spring behind a damper: it follows the angle within 0.1 s.
    for k in range(1, len(q)):
        relaxing[k] = relaxing[k - 1] + (q[k] - relaxing[k - 1]) / (0.1 * machine.rate + 1.0)
    for noise in (1.0, 1e-3):
        assert delays(session, swept(machine, q, torque, noise)) == []
        assert delays(session, swept(machine, q, torque + 2e-3 * (q - relaxing), noise)) == []
        assert delays(session, led(machine, q, l, noise)) == []


def test_a_stretched_tendon_is_not_late(session):
    """Friction raises the tension where the tendon is pulled in, and the tendon stretches."""
    l = SEVERAL.excursion() + 2e-4 * np.sign(np.gradient(SEVERAL.q))
    assert delays(session, led(SEVERAL, SEVERAL.q, l)) == []


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_friction_that_grows_with_load_is_no_delay(session, share):
    """A geared servo swings a pendulum, a few strokes long: a law without the load improves with some shift."""
    servo = Sweep((0.8,))
    time = servo.time
    q = 1.3 * np.sin(2.0 * np.pi * 0.8 * time + 1.5) * np.sin(0.5 * np.pi * time)
    rate = np.gradient(q, time)
    load = 0.3 * np.sin(q) + 0.01 * np.gradient(rate, time)
    torque = load + 0.02 * rate + share * np.abs(load) * np.tanh(rate / 0.02)
    assert delays(session, swept(servo, q, torque)) == []


def test_friction_that_depends_on_posture_is_neither_a_delay_nor_a_filter():
    """Friction of the paper's MCP rises from 2.5 to 11 N mm through its range, which all strokes cross at one speed."""
    sweeps = {"experiments": ["ID.3-dynamic"], "id3_dynamic": {"cycles": 5}}
    session = simulate(recipe_from({"specimen": {"kind": "polynomial"}, "trials": sweeps}), seed=0)
    report = Report()
    check_delay(session, report)
    assert not list(report)


def pulls(session, **how) -> list[str]:
    """What is said of five pulls."""
    report = Report()
    trials = {f"{k}": replace(pulled(seed=k, **how), name=f"{k}") for k in range(5)}
    check_pulls(Session("x", session.finger, trials), report)
    return [str(finding) for finding in report]


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("delay", [0.1, 0.2])
def test_a_tension_that_comes_late_is_named(session, delay, share):
    """Each of several trials shows less than a single one must, and all of them the same."""
    for said, names in (
        (
            pulls(session, late_tension=delay, share=share),
            "tendon_force: column T1 comes {} ms after joint_torque of MCP",
        ),
        (
            pulls(session, late_torque=delay, share=share),
            "joint_torque: column MCP comes {} ms after tendon_force of T1",
        ),
    ):
        assert len(said) == 5
        number = re.search(r"(\d+) ms", said[0])
        assert number
        assert float(number[1]) == pytest.approx(1e3 * delay, abs=50.0)
        assert names.format(number[1]) in said[0]


def test_one_pull_alone_shows_a_long_delay(session):
    (said,) = delays(session, pulled(late_tension=0.2))
    assert "/pull/tendon_force: column T1 comes 2" in said


@pytest.mark.parametrize("rate", [50.0, 1000.0])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.6])
@pytest.mark.parametrize("noise", [1e-3, 1.0, 8.0])
def test_friction_of_a_tendon_is_no_delay(session, rate, share, noise):
    assert pulls(session, rate=rate, share=share, noise=noise) == []


def filtered(sweep, x, cutoff, order=1):
    """x behind low-passes of first order."""
    for _ in range(order):
        out = x.copy()
        for k in range(1, len(x)):
            out[k] = out[k - 1] + (1.0 - np.exp(-2.0 * np.pi * cutoff / sweep.rate)) * (x[k] - out[k - 1])
        x = out
    return x


@pytest.mark.parametrize(("cutoff", "order"), [(0.3, 1), (0.6, 1), (1.0, 1), (1.0, 2)])
def test_a_torque_behind_a_low_pass_is_named(session, cutoff, order):
    trial = swept(SEVERAL, SEVERAL.q, filtered(SEVERAL, SEVERAL.torque(), cutoff, order))
    (said,) = delays(session, trial)
    number = re.search(r"/sweep/joint_torque: column MCP has passed a low-pass filter of about ([\d.]+) Hz", said)
    assert number
    assert float(number[1]) == pytest.approx(cutoff, rel=0.5)


@pytest.mark.parametrize("machine", MACHINES, ids=str)
@pytest.mark.parametrize("stiffness", [0.005, 0.02, 0.1])
@pytest.mark.parametrize("time_constant", [0.03, 0.1, 0.4])
def test_a_joint_that_relaxes_is_not_filtered(session, machine, stiffness, time_constant):
    """A spring behind a damper, beside one of 0.02 N m/rad: its torque leads the angle, as no filter's does."""
    q, constant = machine.q, time_constant / machine.frequencies[-1]
    relaxing = q.copy()
    for k in range(1, len(q)):
        relaxing[k] = relaxing[k - 1] + (q[k] - relaxing[k - 1]) / (constant * machine.rate + 1.0)
    for friction in (None, np.zeros(len(q))):
        torque = machine.torque(friction) + stiffness * (q - relaxing)
        assert not [text for text in delays(session, swept(machine, q, torque)) if "low-pass" in text]
