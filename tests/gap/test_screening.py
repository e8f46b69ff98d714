"""The scan for periods in the session's time, against all pairs of periods and against a planted drift."""

from dataclasses import replace
from itertools import combinations
from typing import ClassVar

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap import diagnose
from jaxfinger.gap.screening import MOST, Scan
from jaxfinger.gap.signatures import Signatures, Variant

from .conftest import RIVALS, session_with

DRIFT = CATALOGUE["torque_sensor_drift"]
SITE = ("torque_sensor",)


def columns(time, periods):
    return np.concatenate([[f(2 * np.pi * time / p) for f in (np.cos, np.sin)] for p in periods])


def left(rows, r):
    return float(np.sum((r - rows.T @ np.linalg.lstsq(rows.T, r, rcond=None)[0]) ** 2))


class OnePeriod(DRIFT):
    """As a user's effect with one period would be."""

    PERIODS: ClassVar = {"P": ("A", "B")}


@pytest.mark.parametrize("effect", [DRIFT, OnePeriod])
@pytest.mark.parametrize("seed", range(3))
def test_the_scan_leaves_as_little_as_the_best_of_all_sets_of_periods(effect, seed):
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0, 1000.0, 300))
    periods = 2000.0 / np.arange(1, 60)
    r = rng.standard_normal(4) @ columns(time, rng.uniform(40.0, 300.0, 2)) + 0.1 * rng.standard_normal(time.size)
    slope = (time / 1000.0)[None]
    items = [Variant(effect, SITE, ())]
    scan = Scan(None, items, periods, 500.0, np.vstack([slope, columns(time, periods)]))
    found = scan.best(lambda rows: rows, r)
    sets = combinations(periods, len(effect.PERIODS))
    expected = min(left(np.vstack([slope, columns(time, p)]), r) for p in sets)
    assert found.keys() == effect.PERIODS.keys()
    assert left(np.vstack([slope, columns(time, found.values())]), r) == pytest.approx(expected, rel=1e-6)


def test_a_long_session_is_scanned_down_to_a_longer_period(diagnosis, monkeypatch):
    """A session over a day does not ask for memory in proportion, nor one of an instant for no period at all."""
    monkeypatch.setattr(Signatures, "of", lambda self, members: np.zeros((len(members), 1)))
    problem, days = diagnosis.problem, {}
    for length in (0.0, 100.0, 86400.0):
        for e, stack in problem.stacks.items():
            x = stack.batch.x
            clock = np.linspace(0.0, length, x.session_time.size).reshape(x.session_time.shape)
            days[e] = replace(stack, batch=replace(stack.batch, x=replace(x, session_time=clock)))
        there = Signatures(replace(problem, stacks=days))
        scan = Scan.of(there, [Variant(DRIFT, SITE, ())])
        assert len(DRIFT.PERIODS) <= len(scan.periods) <= MOST
        assert np.all(scan.periods > 0.0)


def test_a_wandering_sensor_is_named_with_its_periods():
    """Periods that lie between those of the scan, and far from the first value of either."""
    truth = {"A": 1e-3, "B": -5e-4, "A_2": 4e-4, "B_2": 4e-4, "P": 71.0, "P_2": 26.3, "T": 1e4, "tare": 3.0}
    keep = {*RIVALS, "torque_sensor_drift"}
    found = diagnose(session_with(("torque_sensor_drift", SITE, truth)), without=tuple(sorted(set(CATALOGUE) - keep)))
    assert found.verdict.effects == (("torque_sensor_drift", SITE),)
    (drift,) = found.augmented.model.effects
    assert sorted([float(drift.P), float(drift.P_2)]) == pytest.approx([26.3, 71.0], rel=0.05)
