"""The scan for periods in the session's time, against all pairs of periods and against a planted drift."""

from itertools import combinations

import numpy as np
import pytest

from jaxfinger.effects import CATALOGUE
from jaxfinger.gap import diagnose
from jaxfinger.gap.screening import Scan
from jaxfinger.gap.signatures import Variant
from tests.gap.conftest import RIVALS, session_with

DRIFT = CATALOGUE["torque_sensor_drift"]
SITE = ("torque_sensor",)


def columns(time, periods):
    return np.concatenate([[f(2 * np.pi * time / p) for f in (np.cos, np.sin)] for p in periods])


def left(rows, r):
    return float(np.sum((r - rows.T @ np.linalg.lstsq(rows.T, r, rcond=None)[0]) ** 2))


@pytest.mark.parametrize("seed", range(5))
def test_the_scan_leaves_as_little_as_the_best_of_all_pairs_of_periods(seed):
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0, 1000.0, 300))
    periods = 1.0 / np.arange(5e-4, 0.03, 5e-4)
    r = rng.standard_normal(4) @ columns(time, rng.uniform(40.0, 300.0, 2)) + 0.1 * rng.standard_normal(time.size)
    slope = (time / 1000.0)[None]
    shape = tuple((n, grid[0]) for n, (_, grid) in DRIFT.SHAPES.items())
    items = [Variant(DRIFT, SITE, shape)]
    (found,) = Scan(items, periods, 500.0, np.vstack([slope, columns(time, periods)])).best(lambda rows: rows, r)
    expected = min(left(np.vstack([slope, columns(time, p)]), r) for p in combinations(periods, 2))
    shape = dict(found.shape)
    assert left(np.vstack([slope, columns(time, (shape["P"], shape["P_2"]))]), r) == pytest.approx(expected, rel=1e-6)
    assert shape["middle"] == 500.0


def test_a_wandering_sensor_is_named_with_its_periods():
    """Periods that lie between those of the scan, and far from the first value of either."""
    truth = {"A": 1e-3, "B": -5e-4, "A_2": 4e-4, "B_2": 4e-4, "P": 71.0, "P_2": 26.3, "T": 1e4, "tare": 3.0}
    keep = {*RIVALS, "torque_sensor_drift"}
    found = diagnose(session_with(("torque_sensor_drift", SITE, truth)), without=tuple(sorted(set(CATALOGUE) - keep)))
    assert found.verdict.effects == (("torque_sensor_drift", SITE),)
    (drift,) = found.augmented.model.effects
    assert sorted([float(drift.P), float(drift.P_2)]) == pytest.approx([26.3, 71.0], rel=0.05)
