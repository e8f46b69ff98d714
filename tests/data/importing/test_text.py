"""Text files as serial monitors, instruments and robots write them: the same numbers come out of all of them."""

import numpy as np
import pytest

from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.sources import load_recording
from jaxfinger.data.importing.survey import columns_of
from jaxfinger.errors import UserError
from tests.data.conftest import make_finger

COUNT = 400
TIME = np.arange(COUNT) / 100.0
ANGLE = np.round(40.0 + 30.0 * np.sin(TIME), 3)  # degrees
FORCE = np.round(2.0 + np.cos(TIME), 3)  # N
LVM = """LabVIEW Measurement\t
Separator\tTab
Multi_Headings\tNo
Date\t2026/01/31
Time\t11:59:59.23
***End_of_Header***\t
\t
Channels\t2\t\t
Date\t2026/01/31\t2026/01/31\t
Time\t11:59:59.23\t11:59:59.23\t
X0\t0.0\t0.0\t
Delta_X\t0.010000\t0.010000\t
***End_of_Header***\t\t\t
X_Value\tangle\tforce\tComment
"""


def written(tmp_path, line, head="", name="log.txt"):
    """Recording of a file with the line of each sample."""
    path = tmp_path / name
    rows = (line.format(t=t, ms=1e3 * t, a=a, f=f) for t, a, f in zip(TIME, ANGLE, FORCE, strict=True))
    path.write_text(head + "\n".join(rows) + "\n", encoding="utf-8")
    return load_recording(path)


@pytest.mark.parametrize(
    ("line", "head", "names"),
    [
        ("t_ms:{ms:.0f},angle:{a},force:{f}", "Ready\n", ["t_ms", "angle", "force"]),
        ("time={t:.2f} angle={a} force={f}", "", ["time", "angle", "force"]),
        ("[{t:.2f}] angle: {a}; force: {f}", "", ["time", "angle", "force"]),
        ("time={t:.2f}s angle={a}° force={f} N", "", ["time", "angle", "force"]),
        ("14:23:0{t:.3f} -> angle={a} force={f}", "", ["time", "angle", "force"]),
        ("14:23:0{t:.3f} -> {a},{f}", "", ["column 0", "column 1", "column 2"]),
        ("[14:23:0{t:.3f}] {a};{f}", "", ["column 0", "column 1", "column 2"]),
        ("{t:.2f}\t{a}\t{f}", LVM, ["X_Value", "angle", "force"]),
        ("{t:g} sec,{a}°,{f} N", "time,angle,force\n", ["time", "angle", "force"]),
        ("0 days 00:00:0{t:.6f},{a},{f}", ",angle,force\n", ["column 0", "angle", "force"]),
    ],
)
@pytest.mark.parametrize("name", ["log.txt", "log.log", "log"])
def test_the_same_numbers_come_out_of_every_text(tmp_path, line, head, names, name):
    found = written(tmp_path, line, head, name)
    assert list(found.variables) == names
    time, angle, force = (v.values for v in found.variables.values())
    np.testing.assert_allclose((time - time[0]) * (1e-3 if names[0] == "t_ms" else 1.0), TIME, atol=1e-6)
    np.testing.assert_array_equal(angle, ANGLE)
    np.testing.assert_array_equal(force, FORCE)
    assert [s.name for s in columns_of(found) if s.meaning == "time"] == names[:1]


def test_units_in_the_cells_are_stated(tmp_path):
    found = written(tmp_path, "{ms:.0f} ms;{a} deg;{f} N", "time;angle;force\n")
    assert [v.units for v in found.variables.values()] == ["ms", "deg", "N"]


def test_cells_with_different_units_are_refused(tmp_path):
    path = tmp_path / "log.csv"
    rows = [f"{t:g} {'s' if t < 2.0 else 'min'},{a}" for t, a in zip(TIME, ANGLE, strict=True)]
    path.write_text("\n".join(["time,q", *rows, ""]))
    assert "has cells with different units ('min', 's')" in load_recording(path).unusable["time"]


@pytest.mark.parametrize("said", ["Ready. Press any key", "t,q", "---"])
def test_lines_without_numbers_between_samples_are_left_out_and_said(tmp_path, said):
    path = tmp_path / "log.csv"
    rows = [f"{t:.2f},{a}" for t, a in zip(TIME, ANGLE, strict=True)]
    path.write_text("\n".join(["t,q", *rows[:100], said, *rows[100:], said, ""]))
    found = load_recording(path)
    np.testing.assert_array_equal(found.variables["q"].values, ANGLE)
    assert found.remarks == (
        f"has 2 lines without numbers among its samples, the first in line 102 ({said!r}), left out",
    )


def test_labels_that_occur_twice_are_no_names(tmp_path):
    with pytest.raises(UserError, match="holds no column of numbers"):
        written(tmp_path, "t={t:.2f},x={a},x={f}")


def test_a_line_with_a_number_and_another_width_is_no_prompt(tmp_path):
    path = tmp_path / "log.csv"
    rows = [f"{t:.2f},{a}" for t, a in zip(TIME, ANGLE, strict=True)]
    path.write_text("\n".join(["t,q", *rows[:100], "1.005", *rows[100:], ""]))
    with pytest.raises(UserError, match=r"line 102 has 1 cells, the others have 2"):
        load_recording(path)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("A,{t:.2f},{a}", "B,{t:.2f},{f},{f}"),
        ("{t:.2f},{a}", "{t:.2f},{f},{f}"),
        ("A,{t:.2f},{a}", "B,{t:.2f},{f}"),
        ("ENC {t:.2f} {a}", "LC {t:.2f} {f}"),
        ("1,{t:.2f},{a}", "2,{t:.2f},{f}"),
        ("$ENC,{t:.2f},{a}", "$LC,{t:.2f},{f},{f}"),
        ("t={t:.2f} q={a}", "t={t:.2f} f={f} g={f}"),
    ],
)
@pytest.mark.parametrize("often", [1, 5])
def test_lines_of_two_devices_in_one_file_are_refused_with_the_mend(tmp_path, first, second, often):
    """Neither device is dropped, and numbers of both are never in one column."""
    path, rows = tmp_path / "log.txt", []
    for k, (t, a) in enumerate(zip(TIME, ANGLE, strict=True)):
        rows += [first.format(t=t, a=a), *([second.format(t=t, f=0.01 * k)] if k % often == 0 else [])]
    path.write_text("\n".join([*rows, ""]))
    with pytest.raises(UserError, match="of each device a file of its own"):
        load_recording(path)


def test_a_few_damaged_lines_are_no_second_device(tmp_path):
    path = tmp_path / "log.txt"
    rows = [f"t={t:.2f} q={a}" for t, a in zip(TIME, ANGLE, strict=True)]
    path.write_text("\n".join([*rows[:50], "t=0.5 q=0.3 x=1", "t=0.5", "t=0.5", "t=0.5", *rows[50:], ""]))
    assert len(load_recording(path).variables["q"].values) == len(rows)


def test_brackets_before_a_name_are_a_part_of_it(tmp_path):
    found = written(tmp_path, "{t:.2f},{a}", "time,[ID:001] Present Position\n")
    assert columns_of(found)[1].meaning == "q"


@pytest.mark.parametrize(
    ("whole", "rest", "factor", "stamp"),
    [
        ("header.stamp.secs", "header.stamp.nsecs", 1e9, "header.stamp"),
        ("stamp_sec", "stamp_nanosec", 1e9, "stamp"),
        ("tv_sec", "tv_usec", 1e6, "tv"),
        ("sec", "nsec", 1e9, "stamp"),
    ],
)
def test_stamps_in_two_columns_are_one(tmp_path, whole, rest, factor, stamp):
    path = tmp_path / "log.csv"
    rows = [f"{int(t)},{round(t % 1.0 * factor)},{a}" for t, a in zip(TIME, ANGLE, strict=True)]
    path.write_text("\n".join([f"{whole},{rest},angle_deg", *rows, ""]))
    found = load_recording(path)
    np.testing.assert_allclose(found.variables[stamp].values, TIME, atol=1e-9)
    assert f'time = "{stamp}"' in proposal([found])


def test_days_are_a_unit_of_times(tmp_path):
    """As spreadsheets and `datenum` count them."""
    path = tmp_path / "log.csv"
    rows = [f"{46053.5 + t / 86400:.10f},{a}" for t, a in zip(TIME, ANGLE, strict=True)]
    path.write_text("\n".join(["Timestamp,angle_deg", *rows, ""]))
    assert 'time = { from = "Timestamp", units = "day" }' in proposal([load_recording(path)])


def test_angles_that_may_be_in_turns_are_said(tmp_path):
    """Some motor drives count turns; an angle that would then pass the joint's limits is in rad."""
    for size, said in ((0.2, True), (0.9, False)):
        table = np.column_stack([TIME, size * np.sin(TIME) ** 2])
        np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header="time,pos_MCP", comments="")
        text = proposal([load_recording(tmp_path / "log.csv")], make_finger())
        assert ("# q runs from 0 to 11 degrees if in rad, and from 0 to 72 degrees if in turns" in text) == said
        assert f'channels.q.MCP = {{ from = "pos_MCP", units = "{"?" if said else "rad"}" }}' in text


def test_joints_that_only_their_numbers_tell_are_said(tmp_path):
    """Some hands number their joints from the tip."""
    table = np.column_stack([TIME, np.sin(TIME), np.cos(TIME)])
    np.savetxt(tmp_path / "log.csv", table, "%.6f", ",", header="time,FFJ2.position,FFJ1.position", comments="")
    text = proposal([load_recording(tmp_path / "log.csv")], make_finger())
    assert '# q by numbers or in their order, "FFJ2.position" of PIP, "FFJ1.position" of MCP: correct this' in text


@pytest.mark.parametrize(
    ("name", "mend"),
    [
        ("a.tdms", r"nptdms.TdmsFile.read\('a.tdms'\)"),
        ("a.csv.gz", "unpack it"),
        ("a.pickle", "pandas.read_pickle"),
        ("a.bin", "unknown"),
    ],
)
def test_what_is_not_read_is_told_how_to_be_written(tmp_path, name, mend):
    (tmp_path / name).write_bytes(b"\x00\x01")
    with pytest.raises(UserError, match=mend):
        load_recording(tmp_path / name)


def test_labview_states_units_in_its_header(tmp_path):
    """Above the line of names, with the unit of times by the dimension of x; volts are no unit of a force."""
    head = LVM.replace("X0\t", "Y_Unit_Label\tDeg\tVolts\t\nX_Dimension\tTime\tTime\t\nX0\t")
    found = written(tmp_path, "{t:.2f}\t{a}\t{f}", head, "log.lvm")
    assert {name: v.units for name, v in found.variables.items()} == {"X_Value": "s", "angle": "Deg", "force": "Volts"}
    said = proposal([found])
    assert 'time = "X_Value"' in said
    assert 'from = "angle", units = "deg" }' in said
    assert 'from = "force", units = "?" }   # it states Volts: write `scale` too' in said


def test_labview_may_write_times_before_each_channel_or_only_their_step(tmp_path):
    """The channels then have clocks of their own, or the times of the header."""
    head = LVM[: LVM.index("Channels")] + "{}***End_of_Header***\t\t\t\t\nX_Value\tangle\tX_Value\tforce\tComment\n"
    lines = "Y_Unit_Label\tDeg\t\tNewtons\t\nX_Dimension\tTime\t\tTime\t\n"
    found = written(tmp_path, "{t:.2f}\t{a}\t{t:.2f}\t{f}\t", head.format(lines), "several.lvm")
    assert {name: v.clock for name, v in found.variables.items() if v.clock} == {
        "angle": "angle.time",
        "force": "force.time",
    }
    np.testing.assert_allclose(found.variables["force.time"].values, TIME)
    head = LVM.replace("X0\t", "Y_Unit_Label\tDeg\tNewtons\t\nX_Dimension\tTime\tTime\t\nX0\t")
    found = written(tmp_path, "\t{a}\t{f}\t", head, "none.lvm")
    np.testing.assert_allclose(found.variables["X_Value"].values, TIME, atol=1e-12)
    assert 'time = "X_Value"\n' in proposal([found])


def test_a_name_alone_makes_no_clock_of_a_column(tmp_path):
    """Only below LabVIEW's header is `angle.time` the clock of `angle`."""
    found = written(tmp_path, "{t:.2f},{a},{f}", "angle.time,angle,force\n", "log.csv")
    assert [v.clock for v in found.variables.values()] == ["", "", ""]


def test_labview_need_not_state_units(tmp_path):
    head = LVM[: LVM.index("Channels")] + "X0\t0.0\t\t0.0\t\nX_Value\tangle\tX_Value\tforce\tComment\n"
    found = written(tmp_path, "{t:.2f}\t{a}\t{t:.2f}\t{f}\t", head, "log.lvm")
    assert {name: v.clock for name, v in found.variables.items() if v.clock} == {
        "angle": "angle.time",
        "force": "force.time",
    }
