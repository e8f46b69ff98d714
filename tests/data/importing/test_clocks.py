"""Which column of a recording is its clock, and at which rate it runs."""

import re

import numpy as np
import pytest

from jaxfinger.cli import main
from jaxfinger.data.importing.by_mapping import import_session
from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.data.importing.survey import clocks_of, columns_of
from jaxfinger.errors import UserError
from tests.data.conftest import GAPPED_MS, ONE_JOINT


def test_a_shuffled_clock_is_said_and_its_rate_is_that_of_sorted_stamps(tmp_path, capsys):
    path, order = tmp_path / "log.csv", np.random.default_rng(5).permutation(len(GAPPED_MS))
    table = np.column_stack([GAPPED_MS, 40 + 30 * np.sin(GAPPED_MS / 1e3)])[order]
    np.savetxt(path, table, "%.6f", ",", header="t,enc", comments="")
    recording = load_recording(path)
    seen = columns_of(recording)
    (clock,) = clocks_of(recording, seen)
    assert (seen[0].units, clock.rate, clock.disordered) == ("ms", pytest.approx(200.0), (np.diff(order) < 0).sum())
    assert main(["look", str(path)]) in (0, None)
    said = capsys.readouterr().out
    assert f"{clock.disordered} stamps out of order or repeated, the rate is of sorted ones" in said
    assert "sort = true" in said


@pytest.mark.parametrize(
    ("name", "time", "said"),
    [
        ("t_ms", np.cumsum(np.random.default_rng(0).choice([9, 10, 10, 10, 11], 500)), 'time = { from = "t_ms"'),
        ("time_s", np.tile(np.arange(300) / 100, 2), "the time begins again after sample 299"),
        ("counter", np.zeros(500), 'time = "?"'),
    ],
    ids=["uneven", "pasted twice", "none"],
)
def test_a_clock_is_told_or_asked_for_and_no_rate_is_invented(tmp_path, name, time, said):
    path = tmp_path / "log.csv"
    table = np.column_stack([time, 40 + 30 * np.sin(np.arange(len(time)) / 50)])
    np.savetxt(path, table, "%.6f", ",", header=f"{name},angle_deg", comments="")
    text = proposal([load_recording(path)])
    assert said in text
    assert "rate_hz =" not in text


def test_a_log_without_a_clock_is_said_to_be_as_fast_as_its_rate(tmp_path):
    """A rate that is wrong by ten shows in how long the log lasts and how fast its joint moves."""
    path = tmp_path / "log.csv"
    angles = 40.0 + 30.0 * np.sin(np.arange(2000) / 50.0)
    np.savetxt(path, angles, "%.6f", header="angle_deg", comments="")
    said = proposal([load_recording(path)])
    assert '# 2000 samples: at 100 Hz they last 20 s and "angle_deg" moves by up to 59.9 deg in 1 s; at 1000 Hz' in said
    assert 'last 2 s and "angle_deg" moves by up to 599 deg in 1 s' in said


def test_a_count_of_samples_is_no_clock_where_there_is_another(tmp_path):
    """As in logs of robots that write an index before the stamp; alone it may be a clock in ms."""
    path, count = tmp_path / "log.csv", np.arange(900)
    columns = {"time_index": count, "timestamp": 5e7 + count / 200, "q": np.sin(count / 50)}
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, "%.6f", ",", header=",".join(columns), comments="")
    assert 'time = "timestamp"\n' in proposal([load_recording(path)])
    np.savetxt(path, rows[:, [0, 2]], "%.6f", ",", header="time_index,q", comments="")
    said = 'time = { from = "time_index", units = "ms" }   # it counts by one: if it counts samples, write `rate_hz`'
    assert said in proposal([load_recording(path)])
    np.savetxt(path, rows[:, [0, 2]], "%.6f", ",", header="time [ms],q", comments="")
    assert "it counts by one" not in proposal([load_recording(path)])


def test_a_clock_without_a_name_is_the_column_that_rises_evenly(tmp_path):
    """A count of samples does not show their times, and a joint that turns one way does so at several speeds."""
    path, n = tmp_path / "log.csv", np.arange(500)
    time = 1297.5 + np.cumsum(np.random.default_rng(0).choice([0.008, 0.010, 0.012], 500))
    angle = np.cos(np.pi * (1.0 - n / 500))
    for before, clock in (([], None), ([time], "column 2"), ([0.2 * n], "column 2")):
        np.savetxt(path, np.column_stack([n, angle, *before, np.sin(n / 20)]), "%.6f", ",")
        said = proposal([load_recording(path)])
        assert (f'time = "{clock}"   # guessed' if clock else 'time = "?"') in said, said
    np.savetxt(path, np.column_stack([n, angle, time, np.sin(n / 20)]), header="n q t tau", comments="")
    assert 'time = "t"\n' in proposal([load_recording(path)])


@pytest.mark.parametrize(("units", "says"), [("ms", True), ("s", False)])
def test_a_clock_whose_stated_units_make_it_too_fast_is_said(tmp_path, units, says, capsys):
    path = tmp_path / "log.csv"
    time = np.arange(2000) / 1000.0
    header = f"time [{units}],angle [deg]"
    np.savetxt(path, np.column_stack([time, 40 + 30 * np.sin(time)]), delimiter=",", header=header, comments="")
    main(["look", str(path)])
    assert ("no sensor is so fast, so the times are in other units" in capsys.readouterr().out) == says


def test_a_clock_that_begins_again_is_said(tmp_path, capsys):
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([GAPPED_MS % 4000.0, GAPPED_MS]), "%.6f", ",", header="t,enc", comments="")
    (clock,) = clocks_of(recording := load_recording(path), columns_of(recording))
    assert (clock.rate, clock.restarts) == (pytest.approx(200.0), int(GAPPED_MS[-1] // 4000.0))
    main(["look", str(path)])
    said = capsys.readouterr().out
    assert "it begins again or wraps at" in said
    assert "# the time begins again after sample 792: a trial for each part, chosen by `where`" in said
    assert "sort = true" not in said


@pytest.mark.parametrize("rate", [50.0, 1000.0])
def test_speeds_tell_the_rate_of_a_log_without_a_clock(tmp_path, rate):
    """A joint beside them, a torque and a constant column have no speed, nor are they one."""
    t, rng = np.arange(4000) / rate, np.random.default_rng(2)
    angles = [0.5 * np.sin(3.0 * t) + 0.2 * np.sin(5.1 * t), 0.4 * np.cos(2.2 * t)]
    rates = [1.5 * np.cos(3.0 * t) + 1.02 * np.cos(5.1 * t), -0.88 * np.sin(2.2 * t)]
    columns = [*angles, np.sin(1.1 * t), *(x + 0.03 * rng.standard_normal(t.size) for x in rates), np.sign(rates[0])]
    path = tmp_path / "log.csv"
    np.savetxt(path, np.column_stack([*columns, 0.0 * t]), delimiter=",")
    said = proposal([load_recording(path)])
    found = re.findall(r'"column (\d)" of "column (\d)" at ([\d.]+)', said)
    assert [pair[:2] for pair in found] == [("3", "0"), ("4", "1")]
    assert [float(pair[2]) for pair in found] == pytest.approx([rate, rate], rel=0.01)
    np.savetxt(path, np.column_stack([t, *columns]), delimiter=",")  # a guessed clock, which the speeds confirm
    assert '"column 4" of "column 1" at ' in proposal([load_recording(path)])
    np.savetxt(path, np.column_stack([t, *columns]), delimiter=",", header="t,a,b,c,d,e,f", comments="")
    assert "# speeds" not in proposal([load_recording(path)])


@pytest.mark.parametrize("often", [2, 3])
def test_samples_that_are_logged_several_times_are_left_out(tmp_path, often):
    """They tell no rate, unlike other samples with a stamp in common."""
    path, stamps = tmp_path / "log.csv", np.repeat(np.arange(500) / 100.0, often)
    np.savetxt(path, np.column_stack([stamps, np.sin(stamps)]), "%.6f", ",", header="t,q", comments="")
    said = proposal([load_recording(path)])
    assert 'time = "t"\nsort = true' in said
    assert "rate_hz" not in said


def test_coarse_stamps_may_be_rounded_unevenly(tmp_path):
    path, time = tmp_path / "log.csv", np.arange(2000) / 100.0 + 0.002 * np.random.default_rng(0).standard_normal(2000)
    np.savetxt(path, np.column_stack([time.round(1), np.sin(time)]), ["%.1f", "%.6f"], ",", header="t,q", comments="")
    assert "rate_hz = 100" in proposal([load_recording(path)])


@pytest.mark.parametrize("shared", [5, 500])
def test_coarse_stamps_are_replaced_by_a_rate(tmp_path, shared):
    path = tmp_path / "log.csv"
    stamps = np.arange(10000) // shared * shared / 500
    np.savetxt(path, np.column_stack([stamps, np.sin(np.arange(10000) / 500)]), "%.6f", ",", header="t,q", comments="")
    said = proposal([load_recording(path)])
    assert 'rate_hz = 500   # several samples share each stamp of "t"' in said
    assert "time =" not in said
    assert "sort" not in said


STEPS_MS = np.random.default_rng(3).choice([9.0, 10.0, 10.0, 11.0], 500)


def stepped(folder, name, steps):
    """A log with a column of steps, and the mapping that reads its proposed times."""
    path = folder / "log.csv"
    q = 40 + 30 * np.sin(np.arange(len(steps)) / 50)
    np.savetxt(path, np.column_stack([steps, q]), "%.9f", ",", header=f"{name},angle_deg", comments="")
    return path, proposal([load_recording(path)])


def imported_times(folder, path, time):
    mapping = folder / "m.toml"
    trial = '[trials.a]\nexperiment = "ID.3-static"\njoint = "MCP"\n'
    channels = 'channels.q.MCP = { from = "angle_deg", units = "deg" }\n'
    channels += 'channels.joint_torque.MCP = { from = "angle_deg", scale = 1e-3, units = "N m" }\n'
    mapping.write_text(f"{ONE_JOINT}\n{trial}{time}\n{channels}")
    return next(iter(import_session([path], mapping))).time


@pytest.mark.parametrize(
    ("name", "factor"),
    [("dt", 1e-3), ("dt", 1.0), ("delta_t", 1e-3), ("Δt [us]", 1e3), ("time_step", 1e-3), ("deltaTime_ms", 1.0)],
)
def test_the_sum_of_steps_of_time_is_a_clock(tmp_path, name, factor):
    path, said = stepped(tmp_path, name, factor * STEPS_MS)
    (time,) = (line for line in said.splitlines() if line.startswith("time = "))
    assert f'# the sum of the steps of time in "{name}"' in time
    np.testing.assert_allclose(imported_times(tmp_path, path, time)[-1], 1e-3 * STEPS_MS[1:].sum(), rtol=1e-6)


def test_steps_of_time_are_not_read_as_times(tmp_path):
    path, _ = stepped(tmp_path, "time_step", 1e-3 * STEPS_MS)
    with pytest.raises(UserError, match=r"'time_step', which holds the times between samples; name their sum, time_st"):
        imported_times(tmp_path, path, 'time = "time_step"')


@pytest.mark.parametrize("values", [np.arange(500) / 100, np.repeat(np.arange(50), 10) / 10.0, STEPS_MS - 10.0])
def test_a_name_alone_makes_no_steps_of_time(tmp_path, values):
    """Times and numbers of steps go on, and no step of time is below zero."""
    assert "the sum of" not in stepped(tmp_path, "time_step", values)[1]


def test_steps_of_which_some_are_missing_have_no_sum(tmp_path):
    steps = 1e-3 * STEPS_MS
    steps[[0, 7]] = np.nan
    said = stepped(tmp_path, "dt", steps)[1]
    assert 'time = "?"' in said
    assert '# "dt.time" has no sum, since 1 step of time cannot be read; fill in what is missing' in said
