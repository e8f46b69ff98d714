"""Columns of a mapping: own clocks, other files, unwrapping, sorting, and rows chosen by a condition."""

import re

import numpy as np
import pytest
import scipy.io

from jaxfinger.data.findings import Report
from jaxfinger.data.importing.by_mapping import import_file, import_session
from jaxfinger.errors import UserError
from tests.data.conftest import ONE_JOINT

TIME = np.arange(600) / 100
Q = 0.6 + 0.5 * np.sin(TIME)
RANDOM_STEPS = np.random.default_rng(1).uniform(-1.0, 1.0, len(TIME))
SLOW = np.arange(120) / 20
MAPPING = (
    ONE_JOINT
    + """[trials.a]
file = "log.mat"
experiment = "ID.3-dynamic"
joint = "MCP"
time = "t"
EXTRA
channels.q.MCP = "q"
channels.joint_torque.MCP = TORQUE
"""
)


def bring_in(tmp_path, torque, extra="", others=(), root="", **changes):
    recorded = {"t": TIME, "q": Q, "slow": SLOW, "tau": 0.01 * np.sin(SLOW), "now": 0.01 * np.cos(TIME)} | changes
    scipy.io.savemat(tmp_path / "log.mat", recorded)
    text = MAPPING.replace("EXTRA", extra).replace("TORQUE", torque)
    text = text.replace('time = "t"\n', "") if "time = {" in extra or "rate_hz" in extra else text
    (tmp_path / "m.toml").write_text(text + root)
    report = Report()
    session = import_file([tmp_path / "log.mat", *others], tmp_path / "m.toml", tmp_path / "s.h5", True, report)
    return session["a"], [str(f) for f in report if f.severity == "warning"]


OWN = '{ from = "tau", time = "slow" }'


def test_a_slower_clock_is_interpolated_and_the_trial_cut_to_it(tmp_path):
    trial, said = bring_in(tmp_path, OWN)
    assert trial.time[-1] == pytest.approx(SLOW[-1])
    np.testing.assert_allclose(trial.joint_torque[:, 0], 0.01 * np.sin(trial.time), atol=1e-5)
    assert not any("cut" in text for text in said)  # Less than two intervals are cut, which is no finding.


def test_a_slow_sensor_is_in_no_other_units(tmp_path):
    """A thermocouple or a camera may give a value every 0.4 s."""
    rare = np.arange(16) * 0.4
    _, said = bring_in(tmp_path, OWN, slow=rare, tau=0.01 * np.sin(rare))
    assert not any("slow" in text for text in said)


def test_a_clock_that_covers_a_part(tmp_path):
    trial, said = bring_in(tmp_path, OWN, slow=SLOW[:100], tau=0.01 * np.sin(SLOW[:100]))
    assert trial.time[-1] == pytest.approx(SLOW[99])
    assert any("the trial is cut to what both cover" in text for text in said)
    with pytest.raises(UserError, match=r"covers only a part; name another clock, or cut the trial by span = \[0, "):
        bring_in(tmp_path, OWN, slow=SLOW[:40], tau=SLOW[:40])


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (1e3 * SLOW, "do not share their units"),
        (1e-3 * SLOW, "covers only a part|do not share their units"),
        (SLOW + 100, "do not overlap"),
        (SLOW[::-1].copy(), "does not increase at 119 of 120 samples, first after sample 0"),
        (SLOW[:100], "has 120 samples, and its clock `slow` has 100"),
        (np.full(120, np.nan), "holds 0 samples"),
    ],
)
def test_a_clock_of_its_own_that_cannot_be(tmp_path, clock, words):
    with pytest.raises(UserError, match=words):
        bring_in(tmp_path, OWN, slow=clock)


def test_gaps_of_a_clock_are_said(tmp_path):
    keep = (SLOW < 2) | (SLOW > 4)
    _, said = bring_in(tmp_path, OWN, slow=SLOW[keep], tau=0.01 * np.sin(SLOW[keep]))
    assert any("1 gap, the longest 2" in text for text in said)


def test_a_clock_with_a_gap_that_starts_late_is_said_to_cut_the_trial(tmp_path):
    keep = (SLOW > 0.5) & ((SLOW < 2) | (SLOW > 4))
    _, said = bring_in(tmp_path, OWN, slow=SLOW[keep], tau=0.01 * np.sin(SLOW[keep]))
    ends = "the clock `slow` begins 0.55 s after and ends 0.04 s before the trial"
    assert any(f"{ends}; the trial is cut to what both cover" in text for text in said)


def test_how_much_a_clock_of_seconds_since_1970_cuts_is_said(tmp_path):
    slow = (SLOW + 1.7e9)[SLOW > 0.32]
    _, said = bring_in(tmp_path, OWN, t=TIME + 1.7e9, slow=slow, tau=0.01 * np.sin(slow))
    assert any("the clock `slow` begins 0.35 s after and ends 0.04 s before the trial" in text for text in said)


def test_samples_are_sorted_on_request(tmp_path):
    order = np.random.default_rng(0).permutation(len(TIME))
    with pytest.raises(UserError, match="sort = true"):
        bring_in(tmp_path, '"now"', t=TIME[order], q=Q[order], now=0.01 * np.cos(TIME[order]))
    trial, said = bring_in(tmp_path, '"now"', "sort = true", t=TIME[order], q=Q[order], now=0.01 * np.cos(TIME[order]))
    np.testing.assert_allclose(trial.joint_torque[:, 0], 0.01 * np.cos(TIME))
    assert any("was sorted" in text for text in said)


AGAIN = TIME % 3.0  # the clock of a logger that was started twice


@pytest.mark.parametrize("extra", ["", "sort = true"])
@pytest.mark.parametrize("period", [3.0, 4.0])
def test_a_clock_that_begins_again_is_not_sorted(tmp_path, extra, period):
    said = r"`t` runs back by [\d.]+ s after sample \d+: it begins again or wraps, .* by `where`, .* unwrap = "
    with pytest.raises(UserError, match=said):
        bring_in(tmp_path, '"now"', extra, t=TIME % period)


def test_an_hour_that_ends_summer_time_is_said_and_added(tmp_path):
    """Times of day run back by an hour within the trial."""
    t = 10798.0 + TIME - np.where(TIME < 2.0, 0.0, 3600.0)
    with pytest.raises(UserError, match=r"runs back by 3600 s after sample 199, as clocks do when summer time ends"):
        bring_in(tmp_path, '"now"', t=t)
    trial, _ = bring_in(tmp_path, '"now"', 'time = { from = "t", unwrap = 3600 }', t=t)
    np.testing.assert_allclose(trial.time, TIME, atol=1e-6)


def test_a_condition_chooses_a_part_whose_clock_begins_again(tmp_path):
    part = np.where(np.arange(600) < 300, 1.0, 2.0)
    trial, _ = bring_in(tmp_path, '"now"', 'where = "part == 2"', t=AGAIN, part=part)
    np.testing.assert_allclose(trial.time, TIME[:300], atol=1e-9)
    np.testing.assert_allclose(trial.q[:, 0], Q[300:])
    with pytest.raises(UserError, match="on the clock `slow`, and the trial's clock `t` begins again"):
        bring_in(tmp_path, OWN, 'where = "part == 2"', t=AGAIN, part=part)


def test_samples_without_a_time_are_left_out_and_said(tmp_path):
    holes = np.where((TIME > 1.0) & (TIME < 1.04), np.nan, TIME)
    trial, said = bring_in(tmp_path, '"now"', t=holes)
    np.testing.assert_allclose(trial.q[:, 0], Q[np.isfinite(holes)])
    assert any("the clock `t` gives no time for 3 samples, left out" in text for text in said)
    _, said = bring_in(tmp_path, OWN, slow=np.where(SLOW == 1.0, np.nan, SLOW))
    assert any("the clock `slow` gives no time for 1 sample, left out" in text for text in said)


def test_a_counter_that_wraps_is_unwrapped(tmp_path):
    counts = (TIME * 1e6 + 2**32 - 3e6) % 2**32
    reading = 'time = { from = "us", units = "us", unwrap = 4294967296 }'
    trial, _ = bring_in(tmp_path, '"now"', reading, us=counts)
    np.testing.assert_allclose(trial.time, TIME, atol=1e-6)
    np.testing.assert_allclose(trial.q[:, 0], Q)


def test_a_span_that_is_too_long_is_told_in_its_own_count(tmp_path):
    """The advised span counts from the recording's first sample, as the given one does."""
    short = SLOW[SLOW < 3.0]
    with pytest.raises(UserError, match=r"cut the trial by span = \[1, 2\.95\]"):
        bring_in(tmp_path, OWN, "span = [1.0, 6.0]", slow=short, tau=0.01 * np.sin(short))


def test_a_column_of_another_file(tmp_path):
    (tmp_path / "day").mkdir()
    other = tmp_path / "day" / "torque.csv"
    other.write_text("t,tau\n" + "\n".join(f"{1e3 * t:.3f},{0.01 * np.sin(t):.8f}" for t in SLOW))
    spec = '{ from = "tau", file = "day/torque.csv", time = { from = "t", units = "ms" } }'
    trial, _ = bring_in(tmp_path, spec, others=[other])
    np.testing.assert_allclose(trial.joint_torque[:, 0], 0.01 * np.sin(trial.time), atol=1e-5)
    with pytest.raises(UserError, match=r"not of the trial's own file; name its clock by `time`"):
        bring_in(tmp_path, '{ from = "tau", file = "torque.csv" }', others=[other])


def test_a_recording_that_no_trial_reads_is_said(tmp_path):
    (tmp_path / "rest.csv").write_text("t,a\n0,1\n1,2\n")
    _, said = bring_in(tmp_path, '"now"', others=[tmp_path / "rest.csv"])
    assert any("is read by no trial" in text for text in said)


def test_derived_variables_and_rows_by_a_condition(tmp_path):
    root = "[constants]\nkt = 0.05\nM = [[1.0, 1.0], [1.0, -1.0]]\n"
    root += '[derived]\ntau2 = "kt * now"\nboth = "M @ [now, tau2]"\n'
    trial, _ = bring_in(tmp_path, '{ from = "both", column = 1 }', 'where = "t >= 2 and t < 4"', root=root)
    assert trial.duration == pytest.approx(1.99)
    np.testing.assert_allclose(trial.joint_torque[:, 0], 0.95 * 0.01 * np.cos(trial.time + 2.0), atol=1e-12)


def test_rows_by_a_column_of_words(tmp_path):
    """A log of two trials says in words which rows are which."""
    phase = np.where(TIME < 3.0, "rest, or so", "sweep")
    rows = zip(TIME, Q, phase, strict=True)
    (tmp_path / "log.csv").write_text("t,q,phase\n" + "".join(f'{t:.2f},{q:.6f},"{p}"\n' for t, q, p in rows))
    text = MAPPING.replace("log.mat", "log.csv").replace("TORQUE", '"moves"')
    root = "[derived]\nmoves = \"phase == 'sweep'\"\n"

    def bring(condition):
        (tmp_path / "m.toml").write_text(text.replace("EXTRA", f'where = "{condition}"') + root)
        return import_file([tmp_path / "log.csv"], tmp_path / "m.toml", tmp_path / "s.h5", True)["a"]

    for condition in ("phase == 'sweep'", "moves == 1"):
        trial = bring(condition)
        np.testing.assert_allclose(trial.q[:, 0], Q[TIME >= 3.0], atol=1e-6)
        np.testing.assert_array_equal(trial.joint_torque[:, 0], 1.0)
    with pytest.raises(UserError, match=r"'swep', which 'phase' never holds; write one of 'rest, or so', 'sweep'"):
        bring("phase == 'swep'")


def test_an_encoder_in_counts_is_unwrapped(tmp_path):
    counts = np.round(Q * 4096 / (2 * np.pi) * 10) % 4096  # The encoder is on the motor's side of a gear of 10:1.
    text = '{ from = "counts", unwrap = 4096, scale = 0.00015339807878856412, units = "rad" }'
    recorded = {"t": TIME, "counts": counts, "now": 0.01 * np.cos(TIME)}
    scipy.io.savemat(tmp_path / "log.mat", recorded)
    mapping = (
        MAPPING.replace("EXTRA", "")
        .replace("TORQUE", '"now"')
        .replace('channels.q.MCP = "q"', f"channels.q.MCP = {text}")
    )
    (tmp_path / "m.toml").write_text(mapping)
    q = import_file([tmp_path / "log.mat"], tmp_path / "m.toml", tmp_path / "s.h5")["a"].q[:, 0]
    np.testing.assert_allclose(np.diff(q), np.diff(Q), atol=2e-3 / 10 + 2e-4)


@pytest.mark.parametrize(
    ("stated", "mend"),
    [
        ("[rad]", r"runs from 2.51 to 8.7 rad, more than a turn, and the recording states rad; if the joint turns on,"),
        ("", r'convert deg to rad \(`units = "deg"` in a mapping\)'),
    ],
)
def test_an_angle_of_more_than_a_turn_in_stated_units_is_not_to_be_converted(tmp_path, stated, mend):
    """Small numbers of degrees would fit the limits; but the recording says what they are."""
    log, name = tmp_path / "log.csv", f"position {stated}".strip()
    table = np.column_stack([TIME, 5.6 - 3.1 * np.cos(TIME), 0.01 * np.sin(TIME)])
    np.savetxt(log, table, "%.6f", ",", header=f"t [s],{name},tau", comments="")
    text = MAPPING.replace("EXTRA", "").replace("TORQUE", '"tau"').replace("log.mat", "log.csv")
    text = text.replace('time = "t"', 'time = "t [s]"').replace('MCP = "q"', f'MCP = "{name}"')
    (tmp_path / "m.toml").write_text(text)
    with pytest.raises(UserError, match=mend) as caught:
        import_file([log], tmp_path / "m.toml", tmp_path / "s.h5", True, Report())
    assert ("`limits_deg = [0, 720]` in the finger's file" in str(caught.value)) == bool(stated)


def test_a_number_in_place_of_a_missing_angle_shows_no_turns(tmp_path):
    """Two samples in a hundred are -9999 degrees."""
    degrees = np.where(np.arange(len(Q)) % 50, np.degrees(Q), -9999.0)
    table = np.column_stack([TIME, degrees, 0.01 * np.sin(TIME)])
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header="t,position [deg],tau", comments="")
    text = MAPPING.replace("EXTRA", "").replace("TORQUE", '"tau"').replace("log.mat", "log.csv")
    text = text.replace('MCP = "q"', 'MCP = { from = "position [deg]", units = "deg" }')
    (tmp_path / "m.toml").write_text(text)
    report = Report()
    import_file([tmp_path / "log.csv"], tmp_path / "m.toml", tmp_path / "s.h5", True, report)
    assert any("as where a number stands for a missing value" in finding.message for finding in report)


def test_the_start_of_a_span_is_the_first_sample(tmp_path):
    trial, _ = bring_in(tmp_path, '"now"', "span = [1.0, 3.0]", t=TIME + 1.7e9)
    np.testing.assert_allclose(trial.q[:, 0], Q[100:300])


def blanks(tmp_path, there, time='time = "t"', torque='"tau"'):
    """Import a CSV whose torque has cells where `there` alone."""
    lines = [f"{t:.4f},{q:.6f},{0.01 * np.sin(t):.9f}" if k else f"{t:.4f},{q:.6f}," for t, q, k in
             zip(TIME, Q, there, strict=True)]  # fmt: skip
    (tmp_path / "log.csv").write_text("\n".join(["t,q,tau", *lines]))
    text = MAPPING.replace("log.mat", "log.csv").replace("EXTRA", "").replace("TORQUE", torque)
    (tmp_path / "m.toml").write_text(text.replace('time = "t"\nEXTRA', "").replace('time = "t"', time))
    report = Report()
    session = import_file([tmp_path / "log.csv"], tmp_path / "m.toml", tmp_path / "s.h5", True, report)
    return session["a"], [str(f) for f in report if "interpolated" in f.message]


EVERY = np.arange(len(TIME))


@pytest.mark.parametrize("there", [EVERY % 5 == 0, EVERY % 3 != 1, (EVERY * 2) % 5 < 2, EVERY % 20 == 3])
@pytest.mark.parametrize("given", [{}, {"time": "rate_hz = 100"}, {"torque": '{ from = "tau", time = "t" }'}])
def test_a_slower_column_with_blank_cells_is_interpolated(tmp_path, there, given):
    if "torque" in given:
        given = given | {"time": 'time = "t"'}
    trial, said = blanks(tmp_path, there, **given)
    first, last = np.flatnonzero(there)[[0, -1]]
    assert len(trial.time) == last - first + 1
    torque = 0.01 * np.sin(trial.time + TIME[first])
    np.testing.assert_allclose(trial.joint_torque[:, 0], torque, atol=6e-5)  # 0.01 · 0.2²/8
    assert len(said) == 1
    assert f"has a value at {there.sum()} of 600 samples, one every" in said[0]
    assert "choose them by `where`" in said[0]


RANDOM = np.random.default_rng(0).random((len(TIME), 4)) > [0.01, 0.1, 0.3, 0.6]


@pytest.mark.parametrize("there", [*RANDOM.T, EVERY % 100 != 50, (EVERY < 200) | (EVERY > 500), EVERY < 400])
def test_lost_values_are_not_interpolated(tmp_path, there):
    with pytest.raises(UserError, match=f"column MCP is NaN in {(~there).sum()} of 600 samples"):
        blanks(tmp_path, there)


def test_a_shorter_column_with_a_clock_of_its_own_is_sound(tmp_path):
    lines = [f"{t:.2f},{q:.6f}," + (f"{t * 5:.2f},{np.sin(t):.6f}" if k < 120 else ",") for k, (t, q) in
             enumerate(zip(TIME, Q, strict=True))]  # fmt: skip
    (tmp_path / "log.csv").write_text("\n".join(["t,q,slow,tau", *lines]))
    (tmp_path / "m.toml").write_text(MAPPING.replace("log.mat", "log.csv").replace("EXTRA", "").replace("TORQUE", OWN))
    report = Report()
    import_file([tmp_path / "log.csv"], tmp_path / "m.toml", tmp_path / "s.h5", True, report)
    assert not [f for f in report if "gives no time" in f.message or "interpolated" in f.message]


def test_samples_of_two_sensors_in_rows_of_their_own_are_put_together(tmp_path):
    """A logger that writes a row for each message of a sensor leaves the cells of the other one blank."""
    rows = sorted([(t, f"{q:.6f}", "") for t, q in zip(TIME, Q, strict=True)] +
                  [(t, "", f"{0.01 * np.sin(t):.9f}") for t in np.arange(0.0041, 6.0, 0.03)])  # fmt: skip
    (tmp_path / "log.csv").write_text("\n".join(["t,q,tau", *(f"{t:.4f},{q},{tau}" for t, q, tau in rows)]))
    text = MAPPING.replace("log.mat", "log.csv").replace("EXTRA", "").replace("TORQUE", '"tau"')
    (tmp_path / "m.toml").write_text(text)
    report = Report()
    session = import_file([tmp_path / "log.csv"], tmp_path / "m.toml", tmp_path / "s.h5", True, report)
    assert len([f for f in report if "is interpolated between them" in f.message]) == 2
    np.testing.assert_allclose(session["a"].joint_torque[:, 0], 0.01 * np.sin(session["a"].time + 0.0041), atol=2e-6)


@pytest.mark.parametrize(("rate", "step"), [(500.0, 0.01), (3000.0, 0.001), (1700.0, 0.001), (250.0, 0.1)])
def test_coarse_stamps_are_replaced_by_a_rate(tmp_path, rate, step):
    """The advice gives the right times."""
    time = np.arange(6000) / rate + 0.3 * step
    logs = {"t": np.floor(time / step + 1e-9) * step, "q": 0.6 + 0.5 * np.sin(time), "now": 0.01 * np.cos(time)}
    with pytest.raises(UserError, match=r"changes every .* s only, after .* samples on average; write rate_hz") as said:
        bring_in(tmp_path, '"now"', **logs)
    (advised,) = re.findall(r"rate_hz = ([\d.]+) in place of `time`", str(said.value))
    text = (tmp_path / "m.toml").read_text().replace('time = "t"', f"rate_hz = {advised}")
    (tmp_path / "m.toml").write_text(text)
    session = import_file([tmp_path / "log.mat"], tmp_path / "m.toml", tmp_path / "s.h5", True)
    np.testing.assert_allclose(session["a"].time, time - time[0], rtol=2e-3)


@pytest.mark.parametrize(
    "rows",
    [
        np.sort(np.random.default_rng(0).integers(0, 600, 600)),  # with gaps
        np.sort(np.concatenate([np.arange(600), np.arange(100, 130)])),  # of which some are logged twice
        np.arange(600) ^ 1,  # in disorder
    ],
)
def test_stamps_that_are_not_coarse_are_to_be_sorted(tmp_path, rows):
    with pytest.raises(UserError, match="have import do so by `sort = true`"):
        bring_in(tmp_path, '"now"', t=TIME[rows], q=Q[rows], now=0.01 * np.cos(TIME[rows]))


@pytest.mark.parametrize(
    ("rate", "clock", "said"),
    [
        (100.0, TIME, ""),
        (100.0, 1e3 * TIME, ""),  # Its units are not stated.
        (100.0, TIME + 0.002 * RANDOM_STEPS, ""),
        (1000.0, TIME, "the recording's own clock 't' goes on by 0.01, which no unit fits; name it as `time`"),
        (50.0, 1e3 * TIME, "goes on by 10, which no unit fits; name it as `time` in place of rate_hz = 50"),
        (100.0, np.where(TIME < 3.0, TIME, TIME + 2.0), "has 1 gap, which the rate closes"),
        (500.0, np.arange(len(TIME)) * 1.0, ""),  # A count of samples.
        (100.0, TIME % 3.0, ""),  # It begins again.
    ],
)
def test_a_rate_is_compared_with_the_clock_of_the_file(tmp_path, rate, clock, said):
    """`rate_hz` alone decides the times, so that a wrong one is silent."""
    _, warnings = bring_in(tmp_path, '"now"', f"rate_hz = {rate}", t=clock)
    found = [text for text in warnings if "own clock" in text]
    assert len(found) == bool(said)
    assert all(said in text for text in found)


def test_a_span_in_ms_is_said(tmp_path):
    _, warnings = bring_in(tmp_path, '"now"', "span = [0, 5000]")
    assert any("trials.a.span: ends at 5000 s, and the recording at" in text for text in warnings)
    for sound in ("[0, 5]", "[1, 1e9]", "[0, 6.5]"):
        assert not any(".span" in text for text in bring_in(tmp_path, '"now"', f"span = {sound}")[1])


@pytest.mark.parametrize(
    ("clock", "words"),
    [
        (np.floor(TIME * 20.0) / 20.0 / 86400.0, "samples a second, as no sensor does; it is not in s"),
        (np.floor(TIME / 300.0) * 300.0, "its stamps are too coarse; write rate_hz in place of `time`"),
        ((TIME + 86397.0) % 86400.0, "a clock that wraps after 86400 s by its period"),
    ],
)
def test_a_clock_is_mended_by_what_is_wrong_with_it(tmp_path, clock, words):
    with pytest.raises(UserError, match=re.escape(words)):
        bring_in(tmp_path, '"now"', t=clock)


@pytest.mark.parametrize(
    ("torque", "said"),
    [
        ("'tau [N mm]' - 0.1", "the formula of 'load' gives N mm, and the mapping reads N m; correct one of them"),
        ("1e-3 * 'tau [N mm]'", ""),
    ],
)
def test_units_of_a_formula_are_compared(tmp_path, torque, said):
    rows = np.column_stack([TIME, Q, np.cos(TIME)])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,q,tau [N mm]", comments="")
    text = MAPPING.replace("EXTRA", "").replace("TORQUE", '"load"').replace("log.mat", "log.csv")
    (tmp_path / "m.toml").write_text(text + f'\n[derived]\nload = "{torque}"\n')
    report = Report()
    import_session([tmp_path / "log.csv"], tmp_path / "m.toml", report)
    assert [f.message for f in report if "formula" in f.message] == ([said] if said else [])
