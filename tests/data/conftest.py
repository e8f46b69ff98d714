"""Fixture: a small session with every experiment and channel of the format."""

import numpy as np
import pytest

from jaxfinger.data import FingerDescription, Session, Trial

JOINTS, TENDONS = ("MCP", "PIP"), ("T1", "T2", "T3")


def make_finger() -> FingerDescription:
    return FingerDescription(
        gravity=np.array([0.0, 0.0, -9.81]),
        joint_names=JOINTS,
        axis=np.array([[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]),
        origin=np.array([[0.0, 0.0, 0.0], [0.045, 0.0, 0.0]]),
        limits=np.array([[-0.3, 1.6], [-0.1, 1.8]]),
        mass=np.array([0.02, 0.01]),
        com=np.array([[0.02, 0.0, 0.0], [0.015, 0.0, 0.0]]),
        inertia=np.stack([np.diag([1e-6, 4e-6, 4e-6]), np.diag([5e-7, 1e-6, 1e-6])]),
        fingertip=np.array([0.03, 0.0, 0.0]),
        tendon_names=TENDONS,
        active=np.array([True, True, False]),
        crosses=np.array([[True, True], [True, False], [False, True]]),
        mass_std=np.array([1e-3, 5e-4]),
        rotor_inertia=np.array([2e-6, 0.0]),
        rotor_inertia_std=np.array([1e-7, 0.0]),
        excursion=np.array([[[0.008, 1e-3], [0.005, 0.0]], [[0.01, 0.0], [0.0, 0.0]], np.full((2, 2), np.nan)]),
        excursion_std=np.array([[[5e-4, 1e-4], [5e-4, 0.0]], [[5e-4, 0.0], [0.0, 0.0]], np.full((2, 2), np.nan)]),
    )


def steps(count, levels):
    """Staircase with ramps between its levels: the value at each sample, and the index of its hold."""
    each = count // len(levels)
    x, hold = np.zeros(count), np.full(count, -1, np.int32)
    for i, level in enumerate(levels):
        begin, end = i * each, (i + 1) * each if i < len(levels) - 1 else count
        ramp = begin + each // 3
        x[begin:ramp] = np.linspace(levels[i - 1] if i else level, level, ramp - begin)
        x[ramp:end] = level
        hold[ramp + each // 10 : end] = i
    return x, hold


def make_session() -> Session:
    rng = np.random.default_rng(0)
    count = 900
    time = np.arange(count) / 100.0
    noise = lambda *shape: rng.standard_normal(shape)  # noqa: E731
    sweep = 0.6 - 0.5 * np.cos(2 * np.pi * time / time[-1] * 2)
    still = np.full(count, 0.4) + 1e-4 * noise(count)
    trials = []

    def tension(level=2.0):
        return np.column_stack([level + 0.02 * noise(count), level + 0.02 * noise(count), np.full(count, np.nan)])

    q = np.column_stack([sweep, still])
    excursion = np.column_stack([0.008 * sweep, 0.01 * sweep, np.full(count, np.nan)])
    trials.append(Trial("01-ID.2-MCP", "ID.2", time, q, tension(), excursion, joint="MCP", motion="a"))
    held, hold = steps(count, [0.1, 0.4, 0.8, 0.4, 0.1])
    direction = np.zeros((count, 2), np.int8)
    direction[:, 1] = np.where(time < time[-1] * 0.6, 1, -1)
    torque = np.column_stack([np.full(count, np.nan), 0.01 * held])
    q = np.column_stack([still, held])
    trials.append(
        Trial(
            "02-ID.3-static-PIP", "ID.3-static", time, q, tension(0.0), None, torque, None, direction, None, hold, "PIP"
        )
    )
    q = np.column_stack([sweep, still])
    torque = np.column_stack([0.01 * sweep, np.full(count, np.nan)])
    trials.append(Trial("03-ID.3-dynamic-MCP", "ID.3-dynamic", time, q, None, None, torque, joint="MCP"))
    pulled, hold = steps(count, [2.0, 6.0, 10.0, 6.0, 2.0])
    q = np.column_stack([still, still])
    force = tension(0.0)
    force[:, 0] = pulled
    torque = np.column_stack([-0.005 * pulled, np.full(count, np.nan)])
    excursion = np.full((count, 3), np.nan)
    excursion[:, 0] = 0.003
    trials.append(
        Trial("04-ID.4-T1-MCP", "ID.4", time, q, force, excursion, torque, hold=hold, joint="MCP", tendon="T1")
    )
    q = np.column_stack([sweep, 0.5 * sweep])
    excursion = np.column_stack([0.008 * sweep, 0.01 * sweep, np.full(count, np.nan)])
    trials.append(Trial("05-VD.1", "VD.1", time, q, tension(), excursion))
    tip = np.column_stack([-0.15 * pulled, 0 * pulled, 0.1 * pulled])
    q = np.column_stack([still, still])
    trials.append(Trial("06-VD.2-T1", "VD.2", time, q, force, None, None, tip, hold=hold, tendon="T1", complete=False))
    q = np.column_stack([sweep, 0.5 * sweep])
    warm = {"temperature": 300.0 + np.outer(time, [0.1, 0.2]), "temperature_names": ("motor T1", "motor T2")}
    trials.append(Trial("07-VD.3", "VD.3", time, q, tension(2.0 + 0.5 * sweep), excursion, **warm))
    q = np.column_stack([sweep, 0.5 * sweep])  # Both joints move at once, so the trial has no attribute `joint`.
    trials.append(Trial("08-ID.3-dynamic", "ID.3-dynamic", time, q, joint_torque=0.01 * q))
    return Session("test finger", make_finger(), {t.name: t for t in trials}, "tests", "2026-01-01T00:00:00+00:00")


@pytest.fixture(scope="session")
def session() -> Session:
    return make_session()


# The start of a mapping file, up to the end of the finger.
GAPPED_MS = np.delete(np.arange(1000), [500, 501, 502, 503, 504, 505, 506]) * 5.0  # stamps, ms, with a gap
ONE_JOINT = """
specimen = "bench finger"
[finger]
gravity = [0.0, 0.0, -9.81]
fingertip = [0.03, 0.0, 0.0]
[[finger.joints]]
name = "MCP"
axis = [0.0, 1.0, 0.0]
origin = [0.0, 0.0, 0.0]
limits = [-0.3, 1.6]
mass = 0.02
com = [0.02, 0.0, 0.0]
inertia = [[1e-6, 0.0, 0.0], [0.0, 4e-6, 0.0], [0.0, 0.0, 4e-6]]
[[finger.tendons]]
name = "T1"
crosses = ["MCP"]
[[finger.tendons]]
name = "T2"
crosses = ["MCP"]
"""
