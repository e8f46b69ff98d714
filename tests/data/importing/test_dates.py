"""Dates and times of day in logs, as texts or packed into one number."""

import json

import numpy as np
import pytest

from jaxfinger.data.importing.dates import seconds
from jaxfinger.data.importing.sources import load_recording

NOON = 1769860799.23  # 2026-01-31T11:59:59.23Z


@pytest.mark.parametrize(
    "cell",
    [
        "2026-01-31 11:59:59.23",
        "2026-01-31T11:59:59,230000000Z",
        "2026-01-31T13:59:59.23+02:00",
        "2026-01-31 11:59:59.23 UTC",
        "2026/01/31 11:59:59.23",
        "2026/1/31 11:59:59:230",
        "2026_01_31_11:59:59.23",
        "31/01/2026 11:59:59.23",
        "31.01.2026, 11:59:59,23",
        "31/01/26 11:59:59.23",
        "1/31/2026 11:59:59.23 AM",
        "31-Jan-2026 11:59:59.23",
        "20260131_115959.23",
        "20260131T115959.230Z"[:-1],
        "20260131-115959230",
    ],
)
def test_a_date_is_read_however_it_is_written(cell):
    assert seconds(cell) == pytest.approx(NOON, abs=1e-6)


@pytest.mark.parametrize(("cell", "hour"), [("12:00:30 AM", 0), ("12:00:30 PM", 12), ("11:00:30 pm", 23)])
def test_half_days_are_read(cell, hour):
    assert seconds(cell) == 3600.0 * hour + 30.0


@pytest.mark.parametrize(
    "cell", ["12:00", "12:61:00", "12:61.5", "13:00:00 PM", "31/31/2026 12:00:00", "2026-02-30 12:00:00", "1"]
)
def test_what_is_no_clear_time_is_none(cell):
    assert seconds(cell) is None


def test_minutes_and_seconds_are_read_where_a_fraction_tells_them():
    """As spreadsheets show times of parts of a second. 12:30 alone may be hours and minutes."""
    assert seconds("12:30.5") == 750.5


def stamps(path):
    """The clock `t` of a file, s from its first sample."""
    variable = load_recording(path).variables["t"]
    assert variable.units == "s"
    return variable.values - variable.values[0]


def packed(k, form="{h:02}{m:02}{s:05.2f}"):
    """Text of the k-th hundredth of a second after 11:58:30."""
    total = 11 * 360000 + 58 * 6000 + 3000 + k
    return form.format(h=total // 360000, m=total // 6000 % 60, s=total % 6000 / 100.0)


@pytest.mark.parametrize("day", ["20260131", "20260131_", "20260131T", "260131", ""])
@pytest.mark.parametrize("mark", [".", ","])
def test_digits_packed_into_a_number_are_a_time(tmp_path, day, mark):
    path, count = tmp_path / "log.csv", np.arange(20000)
    rows = [f"{day}{packed(k)};{np.sin(k / 99):.6f}".replace(".", mark) for k in count]
    path.write_text("t;q\n" + "\n".join(rows) + "\n")
    np.testing.assert_allclose(stamps(path), count / 100.0, atol=1e-4)


def test_milliseconds_may_follow_without_a_point(tmp_path):
    path, count = tmp_path / "log.csv", np.arange(9000)
    rows = [f"20260131{packed(k).replace('.', '')}0,{k % 7}" for k in count]
    path.write_text("t,q\n" + "\n".join(rows) + "\n")
    np.testing.assert_allclose(stamps(path), count / 100.0, atol=1e-6)


def test_packed_times_pass_midnight_as_others_do(tmp_path):
    path = tmp_path / "log.npz"
    of_day = (np.arange(86280, 86520)) % 86400
    np.savez(path, t=of_day // 3600 * 10000.0 + of_day // 60 % 60 * 100.0 + of_day % 60)
    assert np.flatnonzero(np.diff(stamps(path)) < 0.0).tolist() == [119]
    assert np.unique(np.diff(stamps(path))).tolist() == [-86399.0, 1.0]


@pytest.mark.parametrize("kind", ["npz", "json", "jsonl"])
def test_dates_are_read_from_other_files_too(tmp_path, kind):
    count = np.arange(9000)
    numbers = [float(packed(k)) for k in count]
    texts = [f"2026-01-31T{packed(k, '{h:02}:{m:02}:{s:05.2f}')}" for k in count]
    for t in (numbers, texts):
        path = tmp_path / f"log.{kind}"
        if kind == "npz":
            np.savez(path, t=np.array(t), q=count)
        elif kind == "json":
            path.write_text(json.dumps({"t": t, "q": count.tolist()}))
        else:
            path.write_text("".join(json.dumps({"t": x, "q": int(k)}) + "\n" for k, x in zip(count, t, strict=True)))
        np.testing.assert_allclose(stamps(path), count / 100.0, atol=1e-4)


@pytest.mark.parametrize(
    "values",
    [
        np.arange(0, 300000, 10),  # ms
        np.arange(0, 3700, 100),
        np.arange(0, 5500, 50),
        115900.0 + np.arange(5900) / 100.0,  # seconds
        1000.0 * np.arange(60),
        1.7e9 + np.arange(500.0),
        1.7e12 + np.arange(500.0),
        1.7e18 + 1e6 * np.arange(500.0),
        20260131115900.0 + np.arange(200.0),
        np.full(90, 115959.0),
        np.tile([115900.0, 120000.0], 50),
    ],
)
def test_other_numbers_stay_as_they_are(tmp_path, values):
    path = tmp_path / "log.npz"
    np.savez(path, t=values)
    np.testing.assert_array_equal(load_recording(path).variables["t"].values, values)


@pytest.mark.parametrize(
    ("days", "first", "said"),
    [
        (("31/01/2026", "01/02/2026"), "day", False),
        (("01/31/2026", "02/01/2026"), "month", False),
        (("01/02/2026", "02/02/2026"), "day", True),
        (("02/01/2026", "02/02/2026"), "month", True),
        (("03/04/2026", "03/04/2026"), "day", False),
    ],
)
def test_days_tell_whether_they_or_months_come_first(tmp_path, days, first, said):
    """Within one day the order changes no difference."""
    path, later = tmp_path / "log.csv", days[0] != days[1]
    cells = [f"{days[0]} 23:59:59.{k}" for k in range(10)] + [
        f"{days[1]} {'00:00:00' if later else '23:59:59'}.{k}" for k in range(10)
    ]
    path.write_text("t,q\n" + "".join(f"{cell},{k}\n" for k, cell in enumerate(cells)))
    assert np.diff(stamps(path))[9] == pytest.approx(0.1 if later else -0.9, abs=1e-6)
    assert load_recording(path).remarks == (
        (f"t has dates such as {days[0]}, read with the {first} first",) if said else ()
    )


def test_a_date_that_is_none_is_named_with_its_line(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,q\n" + "".join(f"2026/01/31 11:59:0{k},{k}\n" for k in range(9)) + "2026/02/31 11:59:09,9\n")
    assert "holds '2026/02/31 11:59:09' in line 11, which is no number" in load_recording(path).unusable["t"]


def test_times_of_day_go_on_after_midnight(tmp_path):
    path, count = tmp_path / "log.csv", np.arange(4000)
    times = 86390.0 + count / 100.0
    rows = [f"{t // 3600 % 24:02.0f}:{t // 60 % 60:02.0f}:{t % 60:05.2f},{k % 7}" for k, t in enumerate(times.tolist())]
    path.write_text("t,q\n" + "\n".join(rows) + "\n")
    np.testing.assert_allclose(stamps(path), count / 100.0, atol=1e-9)
