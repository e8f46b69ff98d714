"""CSV files of many programs, and files with wrong lines."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxfinger.data.importing.csv_file import load_csv
from jaxfinger.data.importing.proposal import proposal
from jaxfinger.data.importing.survey import columns_of
from jaxfinger.data.units import without_units
from jaxfinger.errors import UserError

NUMBERS = "0.00,1.5,-3\n0.01,1.6,-4\n0.02,1.7,-5\n"


def load(tmp_path, content, name="log.csv"):
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return load_csv(path)


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("t,a,b\n" + NUMBERS, ["t", "a", "b"]),
        ("# made by X\n# t a b\n" + NUMBERS.replace(",", " "), ["t", "a", "b"]),
        ("t,a,b\ns,deg,N\n" + NUMBERS, ["t", "a", "b"]),
        ("t,a,b\nsec,degrees,degrees\n" + NUMBERS, ["t", "a", "b"]),
        ("t,a,b\n(s),(rad),(rad/s)\n" + NUMBERS, ["t", "a", "b"]),
        ('"t", "a", "b"\n' + NUMBERS, ["t", "a", "b"]),
        (NUMBERS, ["column 0", "column 1", "column 2"]),
        ("0,1,2\n" + NUMBERS, ["0", "1", "2"]),
        (",a,b\n" + NUMBERS, ["column 0", "a", "b"]),
        ("t,a,b\r\n" + NUMBERS.replace("\n", "\r\n"), ["t", "a", "b"]),
        ('"t"\t"a"\t"b"\n' + NUMBERS.replace(",", "\t"), ["t", "a", "b"]),
        ("t;a;b\n" + NUMBERS.replace(",", ";").replace(".", ","), ["t", "a", "b"]),
        ('t,a,b\n"0,00","1,5",-3\n"0,01","1,6","-4"\n"0,02","1,7",-5\n', ["t", "a", "b"]),
        ('"t";"a";"b"\n"0,00";"1,5";"-3"\n"0,01";"1,6";"-4"\n"0,02";"1,7";"-5"\n', ["t", "a", "b"]),
        *(
            (mark + ("t,a,b\n" + NUMBERS).encode(encoding), ["t", "a", "b"])
            for mark, encoding in (
                (b"", "utf-8-sig"),
                (b"", "utf-16-le"),
                (b"", "utf-16-be"),
                (b"\xff\xfe", "utf-16-le"),
                (b"\xfe\xff", "utf-16-be"),
            )
        ),
        ("Instrument X\nRun 7, of Monday\n\nt,a,b\n" + NUMBERS, ["t", "a", "b"]),
        ("t,a,b,\n" + NUMBERS, ["t", "a", "b"]),
        ("# t,a,b,\n" + NUMBERS, ["t", "a", "b"]),
        ("t,a,b\n" + NUMBERS.replace("\n", ",\n"), ["t", "a", "b"]),
    ],
)
def test_names_and_numbers(tmp_path, content, names):
    found = load(tmp_path, content)
    assert list(found.variables) == names
    assert found.unusable == {}
    values = [v.values for v in found.variables.values()]
    np.testing.assert_array_equal(values, [[0.0, 0.01, 0.02], [1.5, 1.6, 1.7], [-3, -4, -5]])


def test_names_without_samples_are_said(tmp_path):
    with pytest.raises(UserError, match=r"log\.csv: holds names and no samples; record it again, or leave it out"):
        load(tmp_path, "# made by X\nt [s],a [deg]\n")


@pytest.mark.parametrize("rows", ["0\n0.001\n0.002\n", "0 1\n0.001 1.5\n0.002 1.7\n"])
def test_a_clock_that_begins_with_zero_is_no_line_of_names(tmp_path, rows):
    found = load(tmp_path, rows)
    assert list(found.variables) == [f"column {k}" for k in range(len(found.variables))]
    np.testing.assert_array_equal(found.variables["column 0"].values, [0.0, 0.001, 0.002])


def test_units_below_the_names_or_in_them(tmp_path):
    found = load(tmp_path, "t,a [deg],b\ns,,N\n" + NUMBERS).variables
    assert [v.units for v in found.values()] == ["s", "deg", "N"]


def test_tuples_of_python_in_cells_are_arrays(tmp_path):
    found = load(tmp_path, 't,q\n0,"(0.1, 0.2)"\n1,"(0.3, 0.4)"\n2,"(0.5, 0.6)"\n').variables
    np.testing.assert_array_equal(found["q"].values, [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])


def test_a_line_as_long_as_a_file_is_no_table(tmp_path):
    """A controller's program lists its set-points in one line each."""
    with pytest.raises(UserError, match=r"log\.csv: names 1 column"):
        load(tmp_path, f"n : UDINT := 3;\nphi : ARRAY[1..3] OF REAL := [{', '.join(['0.1'] * 40000)}]\n")


def test_lists_in_cells_are_arrays(tmp_path):
    text = 't,q,tau,mode\n0,"[0.1, 0.2]","[1 2\n 3]","[up]"\n1,,"[4 5\n 6]","[up]"\n2,"[0.5, 0.6]","[7 8]","[up]"\n'
    found = load(tmp_path, text)
    np.testing.assert_array_equal(found.variables["q"].values, [[0.1, 0.2], [np.nan, np.nan], [0.5, 0.6]])
    assert set(found.variables) == {"t", "q"}
    assert "different lengths" in found.unusable["tau"]
    assert "lists of words" in found.unusable["mode"]
    found = load(tmp_path, text.replace("[7 8]", "[7 8 9]"))
    np.testing.assert_array_equal(found.variables["tau"].values, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])


def test_truth_dates_and_empty_cells(tmp_path):
    text = "when,on,x\n2024-03-01 12:00:00.000,True,1\n2024-03-01 12:00:00.005,False,\n2024-03-01T12:00:00.010,True,3\n"
    found = load(tmp_path, text).variables
    np.testing.assert_allclose(np.diff(found["when"].values), 0.005, atol=1e-6)
    np.testing.assert_array_equal(found["on"].values, [1, 0, 1])
    np.testing.assert_array_equal(found["x"].values, [1, np.nan, 3])


def test_a_text_column_leaves_the_others_usable(tmp_path):
    found = load(tmp_path, "t,what\n0,idle\n1,moves\n2,moves\n")
    assert list(found.variables) == ["t"]
    assert found.unusable["what"] == "holds the words 'idle', 'moves'; a trial's `where` can test it"
    assert found.words["what"].tolist() == ["idle", "moves", "moves"]


def test_numbers_of_which_most_are_spoiled_are_no_words(tmp_path):
    found = load(tmp_path, "t,a\n0,err\n1,err\n2,3.5\n3,err\n")
    assert "holds 'err' in line 2, which is no number, and 2 more cells of this kind" in found.unusable["a"]
    assert not found.words


@pytest.mark.parametrize("blank", ["", "-", "n/c"])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_samples_with_words_are_kept_where_the_column_is_blank_later(tmp_path, blank, place):
    """Between two trials a logger goes on without a name."""
    rows = [[f"{k}", f"{0.5 * k}"] for k in range(400)]
    for k, row in enumerate(rows):
        row.insert(place, "first" if k < 100 else blank if k < 300 else "second")
    names = ["t", "q"]
    names.insert(place, "trial")
    path = tmp_path / "log.csv"
    path.write_text("\n".join(map(",".join, [names, *rows])) + "\n")
    found = load_csv(path)
    np.testing.assert_array_equal(found.variables["t"].values, np.arange(400.0))
    assert [str(found.words["trial"][k]) for k in (0, 200, 399)] == ["first", blank, "second"]


def test_a_text_column_without_a_name_is_said(tmp_path):
    assert "'idle', 'moves'" in load(tmp_path, "0,idle\n1,moves\n2,moves\n").unusable["column 1"]


def test_a_word_among_numbers_is_named_with_its_line(tmp_path):
    found = load(tmp_path, "# made\n\nt,a\n0,1\n1,err\n2,3\n3,3\n4,5\n5,1\n")
    assert "holds 'err' in line 5" in found.unusable["a"]


@pytest.mark.parametrize(
    "content",
    [
        't,a\n0.00,"1,234.50"\n0.01,"12,345.0"\n0.02,"1,234,567"\n',
        "t;a\n0.00;1,234.50\n0.01;12,345.0\n0.02;1,234,567\n",
        "t;a\n0,00;1.234,50\n0,01;12.345,0\n0,02;1.234.567\n",
        "t;a\n0,00;1\u202f234,50\n0,01;12\u202f345\n0,02;1\u202f234\u202f567\n",
        "t;a\n0.00;1'234.50\n0.01;12'345\n0.02;1'234'567\n",
    ],
)
def test_groups_of_three_digits(tmp_path, content):
    found = load(tmp_path, content).variables
    np.testing.assert_array_equal([v.values for v in found.values()], [[0.0, 0.01, 0.02], [1234.5, 12345.0, 1234567.0]])


@pytest.mark.parametrize(
    "content",
    [
        "t\ta\n0.010\t1,900\n0.020\t1,937\n0.030\t2,011\n",
        't,a\n0.010,"1,900"\n0.020,"1,937"\n0.030,"2,011"\n',
        "t;a\n0,010;1.900\n0,020;1.937\n0,030;2.011\n",
    ],
)
def test_one_group_of_three_digits_is_not_taken_for_decimals(tmp_path, content):
    found = load(tmp_path, content)
    assert list(found.variables) == ["t"]
    assert "in line 2, which is 1.900 or 1900, and 2 more cells" in found.unusable["a"]
    assert "without thousands separators" in found.unusable["a"]


def test_decimal_commas_beside_dates_with_a_point(tmp_path):
    text = "".join(f"2024-03-01 12:00:00.00{k};1,23{k}\n" for k in range(5))
    np.testing.assert_allclose(load(tmp_path, "t;a\n" + text).variables["a"].values, 1.23 + 0.001 * np.arange(5))


@pytest.mark.parametrize(
    "word",
    [
        *("-", "--", "---", "—", "***", "???", ".", "NA", "n/a", "N.A.", "n/c", "nc", "n.d.", "NULL", "None", "nan"),
        *("#N/A", "#NV", "#DIV/0!", "1.#QNAN", "-1.#IND", "1.#INF"),
    ],
)
def test_words_for_a_missing_value(tmp_path, word):
    found = load(tmp_path, f"a,t\n1,0\n{word},1\n3,2\n4,3\n")
    np.testing.assert_array_equal(found.variables["a"].values, [1, np.nan, 3, 4])
    assert found.unusable == {}


def test_missing_values_are_counted(tmp_path):
    """Also where they stand among units in cells; and a mark is no sample above the numbers."""
    rows = "".join(f"{k},{'---' if k % 9 == 5 else k % 7} mm,{'n/c' if k % 8 == 3 else k % 5}\n" for k in range(90))
    found = load(tmp_path, "t,l,f\n---,---,---\n" + rows.replace("--- mm", "---"))
    assert [s.missing for s in columns_of(found)] == [0, 10, 11]


def test_exponents_of_double_precision_are_numbers(tmp_path):
    """As Fortran writes them. A code such as 1D3 is a word."""
    found = load(tmp_path, " t a b\n" + "".join(f" 0.{k}D+00 -.15d-02 1D{k}\n" for k in range(1, 9)))
    np.testing.assert_allclose(found.variables["t"].values, np.arange(1, 9) / 10.0)
    np.testing.assert_array_equal(found.variables["a"].values, -0.0015)
    assert "'1D1', '1D2'" in found.unusable["b"]


def test_a_ratio_has_the_unit_of_a_dash(tmp_path):
    assert [v.units for v in load(tmp_path, "t,a,b\ns,-,-\n" + NUMBERS).variables.values()] == ["s", "-", "-"]


@pytest.mark.parametrize(
    ("header", "rows"),
    [
        ("t [ms],a", ["12:00:59.990,1", "12:01:00.000,2", "12:01:00.010,3"]),
        ("t;a", ["0:00:59,990;1,5", "0:01:00;2,5", "0:01:00,010;3,5"]),
        ("t;a", ["31.01.2026 12:00:59,990;1,5", "31.01.2026 12:01:00;2,5", "31.01.2026 12:01:00,010;3,5"]),
        ("t\ta", ["31.01.2026, 12:00:59.990\t1.5", "31.01.2026, 12:01:00\t2.5", "31.01.2026, 12:01:00.010\t3.5"]),
    ],
    ids=["of day", "a comma", "dotted", "dotted, a comma"],
)
def test_times_of_day_and_dotted_dates_are_seconds(tmp_path, header, rows):
    """Whatever unit the header states."""
    time = load(tmp_path, "\n".join([header, *rows, ""])).variables[re.split("[,;\t]", header)[0]]
    np.testing.assert_allclose(np.diff(time.values), 0.01, atol=1e-6)
    assert time.units == "s"


@pytest.mark.parametrize("cell", ["31/31/2026 12:00:00.0", "12:00", "13:59:58 PM", "12:61:00"])
def test_a_time_that_is_not_clear_is_told_how_to_be_written(tmp_path, cell):
    found = load(tmp_path, "t,a\n" + "".join(f"{cell},{k}\n" for k in range(3)))
    assert (
        "in line 2, which is no number, and 2 more cells of this kind; write seconds, or dates" in found.unusable["t"]
    )
    assert f'# "t" holds {cell!r} in line 2' in proposal([replace(found, path=Path("log.csv"))])


def test_a_line_of_another_width(tmp_path):
    with pytest.raises(UserError, match=r"line 3 has 2 cells, the others have 3"):
        load(tmp_path, "t,a,b\n0,1,2\n1,2\n2,3,4\n3,4,5\n")
    found = load(tmp_path, "t,a,b\n" + NUMBERS + "0.03,1.")
    assert len(found.variables["t"].values) == 3
    assert found.remarks == ("its last line is cut short and is left out",)


def test_columns_of_one_name(tmp_path):
    found = load(tmp_path, "t,a,a\n" + NUMBERS)
    assert list(found.variables) == ["t"]
    assert "columns 2 and 3" in found.unusable["a"]


def test_what_ros2_topic_echo_prints_is_told_how_to_be_written(tmp_path):
    message = "header:\n  stamp:\n    sec: 1\n    nanosec: {k}\nname:\n- MCP\nposition:\n- 0.{k}\n---\n"
    with pytest.raises(UserError, match=r"log\.csv: holds messages as `ros2 topic echo` prints them; echo with --csv"):
        load(tmp_path, "".join(message.format(k=k) for k in range(90)))


@pytest.mark.parametrize("content", ["", "t,a\n", "only words\nand words\n", b"\x00\x01\x02"])
def test_what_is_no_table(tmp_path, content):
    with pytest.raises(UserError):
        load(tmp_path, content)


def test_quoted_groups_of_digits_are_no_decimals(tmp_path):
    """Where a decimal comma shows elsewhere in the file, three digits behind a comma are decimals."""
    groups = load(tmp_path, 't,a\n1,"1,234"\n2,"2,345"\n3,950\n')
    assert "which is 1.234 or 1234" in groups.unusable["a"]
    decimals = load(tmp_path, 't,a\n"0,001","1,234"\n"0,002","2,345"\n"0,003","0,950"\n')
    np.testing.assert_array_equal(decimals.variables["a"].values, [1.234, 2.345, 0.95])


def test_lists_in_quotes_are_no_decimals(tmp_path):
    lists = load(tmp_path, 't,a\n1.5,"1,2"\n2.5,"3,4"\n3.5,"3,5"\n')
    assert list(lists.words["a"]) == ["1,2", "3,4", "3,5"]


def _echoed(joints=("mcp", "pip"), fields=("position", "velocity", "effort"), frame="", nan=(), count=40):
    """Lines of `ros2 topic echo --csv` on a JointState, and the values of its fields."""
    rng = np.random.default_rng(0)
    values = {field: rng.standard_normal((count, len(joints))) for field in fields}
    values |= {field: np.full((count, len(joints)), np.nan) for field in nan}
    lines = []
    for k in range(count):
        arrays = [
            ",".join(map(repr, values[f][k].tolist())) if f in values else ""
            for f in ("position", "velocity", "effort")
        ]
        lines.append(",".join([str(1700000000 + k // 10), str(k % 10 * 10**8), frame, *joints, *arrays]))
    return "\n".join(lines) + "\n", values


@pytest.mark.parametrize("joints", [("mcp",), ("mcp", "pip"), tuple(f"joint_{k}" for k in range(7))])
@pytest.mark.parametrize("fields", [("position", "velocity", "effort"), ("position", "effort"), ("position",)])
@pytest.mark.parametrize("frame", ["", "base_link"])
def test_joint_states_that_ros2_topic_echo_wrote_have_their_names(tmp_path, joints, fields, frame):
    text, values = _echoed(joints, fields, frame)
    found = load(tmp_path, "WARNING: topic [/joint_states] does not appear to be published yet\n" + text).variables
    assert set(found) == {"stamp", *fields}
    np.testing.assert_allclose(found["stamp"].values - 1.7e9, np.arange(40) / 10.0, atol=1e-6)
    for field in fields:
        assert found[field].columns == joints
        np.testing.assert_array_equal(found[field].values, values[field])


def test_efforts_that_a_driver_does_not_know_are_nan_and_no_empty_array(tmp_path):
    found = load(tmp_path, _echoed(fields=("position", "velocity"), nan=("effort",))[0]).variables
    assert set(found) == {"stamp", "position", "velocity", "effort"}
    assert np.isnan(found["effort"].values).all()


def test_joint_states_may_have_what_the_middleware_says_of_them(tmp_path):
    """`--include-message-info` writes four more cells, of which some middlewares leave counts out."""
    text, values = _echoed()
    info = [f"{1700000000000000000 + 10**7 * k},{1700000000000300000 + 10**7 * k},None,{k}," for k in range(40)]
    lines = [before + line for before, line in zip(info, text.splitlines(), strict=True)]
    found = load(tmp_path, "\n".join(lines) + "\n").variables
    assert set(found) == {"stamp", *values}
    for field, x in values.items():
        np.testing.assert_array_equal(found[field].values, x)
        assert found[field].columns == ("mcp", "pip")
    np.testing.assert_array_equal(found["stamp"].values, load(tmp_path, text).variables["stamp"].values)


def test_lost_messages_are_no_samples(tmp_path):
    first, *rest = _echoed()[0].splitlines()
    lost = "A message was lost!!!\n\ttotal count change:1\n\ttotal count: 1---"
    found = load(tmp_path, "\n".join([first, lost, *rest[:30], lost, *rest[30:]]) + "\n")
    assert found.remarks == ("says 2 times that messages were lost",)
    assert len(found.variables["stamp"].values) == 40


def test_joint_states_whose_names_change_are_refused(tmp_path):
    one, other = _echoed()[0], _echoed(("index_mcp", "index_pip"))[0]
    mixed = "".join(a + "\n" + b + "\n" for a, b in zip(one.splitlines(), other.splitlines(), strict=True))
    with pytest.raises(UserError, match=r"holds the words 'mcp', 'index_mcp'; echo the topic of one publisher alone"):
        load(tmp_path, mixed)


@pytest.mark.parametrize("before", ["1,{}", "{},1", "0.5,{}00000000"])
def test_other_tables_without_names_are_no_joint_states(tmp_path, before):
    text = "".join(f"{before.format(k)},left,walk,0.1,0.2,{k}\n" for k in range(9))
    assert "column 4" in load(tmp_path, text).variables


def test_lines_of_numbers_above_the_first_whole_sample_are_said(tmp_path):
    """Nothing that was recorded is left out without a word."""
    rows = [f"{k / 100},{k},{k}" for k in range(20)]
    assert load(tmp_path, "\n".join(["t,a,b", *rows])).remarks == ()
    found = load(tmp_path, "\n".join(["t,a,b", "0.0,x,0", "0.01,x,1", *rows[2:]]))
    assert found.remarks == ("has numbers in line 2 above its first whole sample, which are left out",)
    assert len(found.variables["t"].values) == 18


def test_a_minus_sign_of_typesetters_is_one(tmp_path):
    found = load(tmp_path, "t,a\n" + "".join(f"{k},\u2212{k}.5\n" for k in range(20)))
    np.testing.assert_array_equal(found.variables["a"].values, -0.5 - np.arange(20))


@pytest.mark.parametrize(
    ("name", "units"),
    [("q/rad", "rad"), ("F / N", "N"), ("Zeit/ms", "ms"), ("speed/(rad/s)", "rad/s"), ("/hand/m", ""), ("a/b", "")],
)
def test_units_may_stand_behind_a_stroke(tmp_path, name, units):
    found = load(tmp_path, f"x,{name}\n" + "1,2\n2,3\n3,4\n")
    assert found.variables[name].units == units
    assert without_units(name) == {"/hand/m": "hand/m", "a/b": "a/b"}.get(name, re.split(" ?/", name)[0])


@pytest.mark.parametrize(
    ("name", "frame"),
    [
        ("log.log", "(170000{k}.5) can0 141#9C{k:04X}0000001100"),
        ("log.txt", "  can0  141   [8]  9C {k:02X} 00 00 00 00 11 00"),
        ("log.asc", "   {k}.0010 1  141             Rx   d 8 9C {k:02X} 00 00 00 00 11 00"),
    ],
    ids=["candump -l", "candump", "Vector"],
)
def test_frames_of_a_bus_are_told_how_to_be_written(tmp_path, name, frame):
    with pytest.raises(UserError, match=f"{name}: holds frames of a CAN bus.* decode them"):
        load(tmp_path, "\n".join(frame.format(k=k) for k in range(200)), name)


@pytest.mark.parametrize("form", ["0x{:X}", "{:04X}"])
def test_hexadecimal_numbers_are_no_words_and_no_powers_of_ten(tmp_path, form):
    """12E4 is one of them."""
    found = load(tmp_path, "t,enc\n" + "".join(f"{k / 100},{form.format(4000 + k)}\n" for k in range(1000)))
    assert list(found.variables) == ["t"]
    assert "enc" not in found.words
    assert re.match(r"holds numbers in hexadecimal \('.*' in line \d+\); write them in decimal", found.unusable["enc"])


def test_names_below_those_of_groups_are_joined(tmp_path):
    """As pandas writes two levels of columns."""
    found = load(tmp_path, ",MCP,MCP,PIP,PIP\n,q,tau,q,tau\n" + "".join(f"{k / 100},{k}.5,1,2,3\n" for k in range(20)))
    assert list(found.variables) == ["column 0", "MCP.q", "MCP.tau", "PIP.q", "PIP.tau"]


def test_a_recording_that_begins_within_a_line_has_no_names(tmp_path):
    """As a serial monitor that is opened while a board sends."""
    found = load(tmp_path, ".51,2.0\n" + "".join(f"{k * 1000},{k}.5,2.0\n" for k in range(20)))
    assert list(found.variables) == ["column 0", "column 1", "column 2"]
    assert found.remarks == ("has numbers in line 1 above its first whole sample, which are left out",)


def test_a_message_above_the_numbers_is_no_name(tmp_path):
    """One above numbers that are as many as its words may be their names, separated in another way."""
    rows = "".join(f"{k}\t{k}.5\t2.0\n" for k in range(20))
    assert list(load(tmp_path, "Ready.\nCalibrating...\n" + rows).variables) == ["column 0", "column 1", "column 2"]
    with pytest.raises(UserError, match="names 1 column and holds 3"):
        load(tmp_path, "t q tau\n" + rows)


def test_counts_in_a_header_are_no_samples(tmp_path):
    """As in LabVIEW's files."""
    header = "Channels\t2\t\nSamples\t100\t100\nX_Value\tAngle\tTorque\n"
    assert load(tmp_path, header + "".join(f"{k}\t{k}.5\t2.0\n" for k in range(20))).remarks == ()
