"""The constant rate of a clock is found again behind rounded stamps, and other clocks stay as they are."""

from itertools import product

import numpy as np
import pytest

from jaxfinger.data import find_holds
from jaxfinger.data.importing.by_mapping import import_session
from jaxfinger.data.importing.rounding import evened
from jaxfinger.data.signals.quantiles import median
from tests.data.conftest import ONE_JOINT

SAMPLES = np.arange(9000)
# Rates in Hz, digits behind the point and lost samples. In ms at 900 Hz, a step of 2 ms may be a lost sample or none.
CLOCKS = [clock for clock in product((300.0, 240.0, 900.0, 70.0), (3, 4, 7), (0, 5)) if clock != (900.0, 3, 5)]


@pytest.mark.parametrize(("rate", "digits", "lost"), CLOCKS)
@pytest.mark.parametrize("how", [np.round, lambda x, digits: np.floor(x * 10**digits) / 10**digits], ids=["to", "down"])
def test_a_constant_rate_is_found_again(rate, digits, how, lost):
    at = np.delete(SAMPLES, np.random.default_rng(1).choice(8000, lost, replace=False) + 500)
    time = at / rate
    rounded = how(time + 0.00012344, digits)
    found = evened(rounded)
    assert np.ptp(found - time) < 0.05 * np.ptp(rounded - time) + 1e-12
    assert np.abs(found - rounded).max() <= 10.0**-digits


def test_stamps_of_seconds_since_1970_are_found_again_as_far_as_they_are_kept():
    time = SAMPLES / 300.0
    assert np.ptp(evened(np.round(1.7e9 + time, 3)) - 1.7e9 - time) < 1e-6


@pytest.mark.parametrize(
    "time",
    [
        SAMPLES / 1000.0,
        SAMPLES / 300.0,
        np.cumsum(np.random.default_rng(0).choice([0.009, 0.010, 0.011], 900)),
        np.cumsum(0.01 + 0.001 * np.random.default_rng(0).standard_normal(900)),
        np.concatenate([SAMPLES[:300] / 100.0, 3.0 + SAMPLES[1:300] / 150.0]).round(4),
    ],
    ids=["even", "even without digits", "late", "jitter", "two rates"],
)
def test_other_clocks_stay_as_they_are(time):
    np.testing.assert_array_equal(evened(time), time)


def stairs(rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Times, s, and angles, rad, of a joint that steps every 2 s."""
    time = np.arange(int(20 * rate)) / rate
    corners = np.sort(np.concatenate([np.arange(0.0, 20.0, 2.0), np.arange(0.5, 20.0, 2.0)]))
    angle = np.interp(time, corners, np.repeat(0.15 * np.arange(11.0), 2)[1:21])
    return time, angle + 1e-4 * np.random.default_rng(0).standard_normal(len(time))


@pytest.mark.parametrize(("form", "units"), [("%.3f", "s"), ("%.7f", "s"), ("%.0f", "ms")])
def test_the_holds_of_a_rounded_clock_are_those_of_the_exact_one(tmp_path, form, units):
    """At 300 Hz a hold begins and ends at a sample, which rounding may move out of it."""
    exact, angle = stairs(300.0)
    trials = []
    for name, time, how in (("exact", exact, "%.17g"), ("log", exact * (1e3 if units == "ms" else 1.0), form)):
        table = np.column_stack([time, angle, 0.01 * angle])
        np.savetxt(tmp_path / f"{name}.csv", table, [how, "%.9f", "%.9f"], ",", header="t,q,tau", comments="")
        (tmp_path / "m.toml").write_text(
            f"""{ONE_JOINT}
[trials.a]
experiment = "ID.3-static"
joint = "MCP"
time = {{ from = "t", units = "{units if name == "log" else "s"}" }}
channels.q.MCP = "q"
channels.joint_torque.MCP = "tau"
"""
        )
        trials.append(import_session([tmp_path / f"{name}.csv"], tmp_path / "m.toml")["a"])
    assert median(np.diff(trials[1].time)) == pytest.approx(1.0 / 300.0, rel=1e-4)
    assert find_holds(trials[0]).max() > 5
    np.testing.assert_array_equal(find_holds(trials[1]), find_holds(trials[0]))
