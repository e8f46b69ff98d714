"""The scan for periods agrees with trying all sets of periods, and finds a planted drift."""

from dataclasses import replace
from itertools import combinations

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from jaxfinger.effects import CATALOGUE, Scales, amplitude, shape
from jaxfinger.gap import diagnose
from jaxfinger.gap.exact import Baseline
from jaxfinger.gap.formula import Parameters
from jaxfinger.gap.parts import absorbed_causes
from jaxfinger.gap.result import Key
from jaxfinger.gap.screening import MAX_PERIODS, Scan, read_parts
from jaxfinger.gap.signature_table import table_of
from jaxfinger.gap.signatures import Signatures, Variant, variants
from jaxfinger.model import Finger
from jaxfinger.synthetic import paper_finger

from .conftest import RIVALS, session_with

DRIFT = CATALOGUE["torque_sensor_drift"]
SITE = ("torque_sensor",)
SCALES = Scales.of(Finger.from_description(paper_finger().description))


def columns(time, periods):
    return np.concatenate([[f(2 * np.pi * time / p) for f in (np.cos, np.sin)] for p in periods])


def left(rows, r):
    return float(np.sum((r - rows.T @ np.linalg.lstsq(rows.T, r, rcond=None)[0]) ** 2))


class ThreePeriods(DRIFT):
    """A user's effect with three periods."""

    A_3: Float[Array, ""] = amplitude("N m", 0.006, "torque", signed=True)
    B_3: Float[Array, ""] = amplitude("N m", 0.006, "torque", signed=True)
    P_3: Float[Array, ""] = shape("s", (0.05, 0.04, 10.0), "session", period_of=("A_3", "B_3"))


@pytest.mark.parametrize("effect", [DRIFT, ThreePeriods])
@pytest.mark.parametrize("seed", range(3))
def test_the_scan_leaves_as_little_as_the_best_of_all_sets_of_periods(effect, seed):
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0, 1000.0, 300))
    periods = 2000.0 / np.arange(1, 60)
    r = rng.standard_normal(4) @ columns(time, rng.uniform(40.0, 300.0, 2)) + 0.1 * rng.standard_normal(time.size)
    slope = (time / 1000.0)[None]
    items = [Variant(effect, SITE, (), scales=SCALES)]
    unread = object.__new__(Signatures)  # Scan.best uses its rows alone.
    scan = Scan(unread, items, periods, 500.0, np.vstack([slope, columns(time, periods)]))
    found = scan.best(lambda rows: rows, r)
    sets = combinations(periods, len(effect.periods()))
    expected = min(left(np.vstack([slope, columns(time, p)]), r) for p in sets)
    assert found.keys() == effect.periods().keys()
    assert left(np.vstack([slope, columns(time, found.values())]), r) == pytest.approx(expected, rel=1e-6)


@pytest.mark.long
def test_a_long_session_is_scanned_down_to_a_longer_period(planted, monkeypatch):
    """A session of a day does not need memory in proportion, and one of an instant still has a period to try."""
    monkeypatch.setattr(Signatures, "white_changes", lambda self, members: np.zeros((len(members), 1)))
    problem, days = planted, {}
    for length in (0.0, 100.0, 86400.0):
        for e, stack in problem.stacks.items():
            x = stack.batch.x
            clock = np.linspace(0.0, length, x.session_time.size).reshape(x.session_time.shape)
            days[e] = replace(stack, batch=replace(stack.batch, x=replace(x, session_time=jnp.asarray(clock))))
        there = Signatures(replace(problem, stacks=days))
        scan = Scan.of(there, [Variant(DRIFT, SITE, (), scales=problem.scales)])
        assert len(DRIFT.periods()) <= len(scan.periods) <= MAX_PERIODS
        assert np.all(scan.periods > 0.0)


@pytest.mark.long
def test_a_wandering_sensor_is_named_with_its_period():
    """The period lies between two of the scan, and far from the first value that is tried."""
    truth = {"A": 1e-3, "B": -5e-4, "P": 71.0, "T": 1e4, "tare": 3.0}
    keep = {*RIVALS, "torque_sensor_drift"}
    found = diagnose(session_with(("torque_sensor_drift", SITE, truth)), without=tuple(sorted(set(CATALOGUE) - keep)))
    assert found.named == (Key("torque_sensor_drift", SITE),)
    (drift,) = found.augmented.model.effects
    strongest = max((abs(drift.A) + abs(drift.B), drift.P), (abs(drift.A_2) + abs(drift.B_2), drift.P_2))
    assert float(strongest[1]) == pytest.approx(71.0, rel=0.05)


def test_what_the_nominal_parameters_imitate_could_hide_at_any_size(planted):
    """The elastic torque's constant imitates a constant torque: more of it could hide than any machine has."""
    baseline = Baseline.of(planted, Parameters())
    items = variants({"joint_offset": CATALOGUE["joint_offset"]}, planted.nominal.finger, planted.scales)
    table = table_of(planted, baseline, read_parts(planted, items, baseline.columns))
    assert table.offers == []
    assert {effect for effect, _ in table.absorbed} == {"joint_offset"}
    assert min(table.absorbed.values()) > 1.0 - 1e-9
    assert min(size for sizes in table.hidden.values() for size in sizes.values()) > 1e5  # N m
    blamed = next(iter(table.absorbed))  # A cause that the verdict names is shown by these trials.
    listed = {(x.key.effect, x.key.site) for x in absorbed_causes(planted, table, {blamed})}
    assert listed == set(table.absorbed) - {blamed}


def test_a_signature_of_rounding_is_not_seen(planted):
    """A cause that no trial shows is neither offered nor said to be imitated."""
    baseline = Baseline.of(planted, Parameters())
    items = variants({"joint_stribeck": CATALOGUE["joint_stribeck"]}, planted.nominal.finger, planted.scales)
    (part,) = read_parts(planted, items, baseline.columns)
    assert table_of(planted, baseline, [part]).offers
    rounding = replace(part, rows=part.rows.scaled(np.full(part.rows.count, 1e-13)))
    table = table_of(planted, baseline, [rounding])
    assert table.offers == []
    assert table.absorbed == {}


def test_an_amplitude_is_expected_no_larger_than_allowed(planted):
    """Of a tilt the finger's plane shows little, so that it might fill the gap after many turns only."""
    baseline = Baseline.of(planted, Parameters())
    kinds = {k: CATALOGUE[k] for k in ("gravity_tilt", "tendon_backlash", "joint_presliding")}
    items = variants(kinds, planted.nominal.finger, planted.scales)
    table = table_of(planted, baseline, read_parts(planted, items, baseline.columns))
    expected = [
        (table.units[i] * size, v.effect.amplitudes()[n].most)
        for v, at in table.rows.items()
        for i, (n, size) in zip(at, v.sizes.items(), strict=True)
    ]
    assert all(unit <= most * (1.0 + 1e-9) for unit, most in expected)
    assert any(unit == pytest.approx(most) for unit, most in expected)
    assert {key[0] for key in table.keys} == set(kinds)
