"""Sensors that are read too slowly or stand still are reported; coarse sensors, rests and stops are not."""

import numpy as np
import pytest

from benchmarks.bad_input import complaints
from jaxfinger.data.checks.held import check_held
from jaxfinger.data.findings import Report
from tests.data.checks.sweeps import Sweep, alone, led, pre_sliding, swept

SWEEP = Sweep()
Q, TORQUE, L = SWEEP.q, SWEEP.torque(), SWEEP.excursion()


def found(session, trial) -> list[str]:
    report = Report()
    check_held(alone(session, trial), report)
    return [str(finding) for finding in report]


def changed(trial, *channels, by):
    """Trial with the first column of the channels changed."""
    for channel in channels:
        values = getattr(trial, channel).copy()
        values[:, 0] = by(values[:, 0])
        trial = trial.__class__(**{**vars(trial), channel: values})
    return trial


def held(x, samples=10):
    return x[np.arange(len(x)) // samples * samples]


def rounded(step):
    return lambda x: step * np.round(x / step)


def frozen(begin, lasts):
    def change(x):
        at = (SWEEP.time >= begin) & (SWEEP.time < begin + lasts)
        return np.where(at, x[np.argmax(at)], x)

    return change


def dwelling(x, at=5.0, lasts=4.0, on=SWEEP.time):
    """x with a rest in it."""
    return np.interp(np.where(on < at, on, np.maximum(at, on - lasts)), on, x)


@pytest.mark.parametrize("channel", ["q", "joint_torque"])
def test_a_column_that_is_read_more_slowly_than_the_others_is_named(session, channel):
    (said,) = (
        x for x in complaints(alone(session, changed(swept(SWEEP, Q, TORQUE), channel, by=held))) if "holds" in x
    )
    assert f"/sweep/{channel}: holds each value of MCP for 10 samples, 22 ms late on average" in said


def test_sensors_that_are_all_read_at_one_rate_are_sound(session):
    trial = swept(SWEEP, held(Q), held(TORQUE), noise=0.0)
    trial.q[:, 1] = held(trial.q[:, 1])
    assert found(session, trial) == []
    assert found(session, changed(trial, "q", by=rounded(0.0175))) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("sweep", "q", frozen(8.0, 0.4)), "/q: column MCP stands still at"),
        (("sweep", "q", frozen(8.0, 99.0)), "while joint_torque of MCP goes on, in 1 place, first from 8 s for 10 s"),
        (("sweep", "joint_torque", frozen(8.0, 0.8)), "/joint_torque: column MCP stands still at"),
        (
            ("sweep", "joint_torque", lambda x: np.maximum(x, 0.0)),
            "column MCP stands still at 0 while q of MCP goes on",
        ),
        (
            ("lead", "q", lambda x: np.minimum(x, 0.8)),
            "/q: column MCP stands still at 0.8 while tendon_excursion of T1",
        ),
        (("lead", "tendon_excursion", lambda x: np.minimum(x, 6e-3)), "column T1 stands still at 0.006 while q of MCP"),
        (("lead", "tendon_excursion", frozen(2.0, 1.0)), "/tendon_excursion: column T1 stands still at"),
    ],
)
def test_a_sensor_that_stands_still_is_named(session, change, words):
    kind, channel, by = change
    trial = swept(SWEEP, Q, TORQUE) if kind == "sweep" else led(SWEEP, Q, L)
    said = [text for text in complaints(alone(session, changed(trial, channel, by=by))) if "stands still" in text]
    assert len(said) == 1
    assert words in said[0]


@pytest.mark.parametrize("noise", [1.0, 0.0])
def test_coarse_sensors_rests_and_stops_are_sound(session, noise):
    coarse = [("q", step) for step in (1e-4, 1.5e-3, 0.0175, 0.05)]
    coarse += [("joint_torque", step) for step in (1e-4, 1e-3, 5e-3)]
    coarse += [("tendon_excursion", step) for step in (1e-5, 5e-5, 3e-4)]
    stopped = np.minimum(Q, 0.8)  # At its stop the joint's torque rises.
    for q, torque, l in (
        (Q, TORQUE, L),
        (dwelling(Q), dwelling(TORQUE), dwelling(L)),
        (stopped, TORQUE + 3.0 * (Q - stopped), np.minimum(L, L[np.argmax(Q >= 0.8)])),
    ):
        for trial in (swept(SWEEP, q, torque, noise), led(SWEEP, q, l, noise)):
            assert found(session, trial) == []
            for channel, step in coarse:
                if getattr(trial, channel) is not None:
                    assert found(session, changed(trial, channel, by=rounded(step))) == []


def test_coarse_sensors_are_not_held(session):
    """At an even speed a coarse encoder steps evenly, and from a slow to a quick motion in steps of several sizes."""
    even = Sweep((0.125,), lasts=32.0)
    q = np.abs((even.time / 4.0) % 2.0 - 1.0)
    assert found(session, changed(swept(even, q, even.torque(), noise=0.0), "q", by=rounded(0.03))) == []
    slow, quick = Sweep((0.05,), 50.0, 30.0), Sweep((1.2,), 50.0, 3.0)
    q = np.concatenate([slow.q, quick.q])
    trial = swept(Sweep((0.05,), 50.0, 33.0), q, 0.02 * q)
    assert found(session, changed(trial, "q", by=rounded(0.0175))) == []


def test_a_hold_that_is_short_for_the_motion_is_not_said(session):
    slow = Sweep((0.1, 0.3))
    assert found(session, changed(swept(slow, slow.q, slow.torque()), "q", by=lambda x: held(x, 3))) == []


def test_a_clipped_torque_is_said_once_and_a_dead_band_is_sound(session):
    for limit in (lambda x: np.minimum(x, 4e-3), lambda x: np.where(np.abs(x) < 4e-3, 0.0, x)):
        assert found(session, changed(swept(SWEEP, Q, TORQUE), "joint_torque", by=limit)) == []


def test_what_happens_within_the_resolution_is_no_fault_of_the_sensor(session):
    """A tendon that settles while the joint turns within one step of an encoder of 6 degrees."""
    sweep = Sweep((0.5,), lasts=20.0)
    q, l = (dwelling(x, on=sweep.time) for x in (sweep.q, sweep.excursion()))
    trial = led(sweep, q, l + 3e-3 * pre_sliding(q, 0.05))
    assert found(session, changed(trial, "q", by=rounded(0.1))) == []
