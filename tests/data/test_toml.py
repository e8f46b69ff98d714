"""Reader of TOML: any text is either read, or refused in one sentence with file and line."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import pytest
from hypothesis import given, settings

from jaxfinger.data.finger_file import finger_from
from jaxfinger.data.importing.mapping import MappingFile
from jaxfinger.data.toml import NotEmpty, OneOf, Positive, Within, parse_toml, read_toml
from jaxfinger.errors import UserError
from tests.data.importing.test_by_mapping import MAPPING
from tests.mutations import assert_read_or_refused, mutated


@dataclass(frozen=True)
class Sensor:
    std: Annotated[float, Within(0.0, 1.0, "N")]
    from_: str = "x"
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kind: Literal["load", "angle"] = "load"


@dataclass(frozen=True)
class Bench:
    sensors: dict[str, Sensor]
    rows: tuple[Sensor, ...] = ()
    names: Annotated[tuple[str, ...], NotEmpty(), OneOf(("MCP", "PIP"))] = ("MCP",)
    rate: Positive | None = None
    scale: float | str = 1.0
    count: int = 0
    on: bool = False
    more: dict[str, str] = field(default_factory=dict)


GOOD = '# a comment\nscale = "g"\n\n[sensors."a.b"]\nstd = 1\nfrom = "q"\n'


def test_a_table_becomes_a_record():
    bench = parse_toml(GOOD + "[[rows]]\nstd = 0.5\n[more]\nx = 'y'", "b.toml").read(Bench)
    assert bench.sensors["a.b"] == Sensor(1.0, "q")
    assert bench.rows == (Sensor(0.5),)
    assert (bench.scale, bench.more) == ("g", {"x": "y"})


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("scael = 1\n" + GOOD, "1: scael: is unknown (did you mean 'scale'?); it may be one of sensors, rows, "),
        (GOOD + "kind = 'laod'", "7: sensors.a.b.kind: is 'laod' (did you mean 'load'?); choose one of load, angle"),
        (GOOD + "place = [1,\n 2,\n 'x']", "9: sensors.a.b.place[2]: must be a number, not 'x'"),
        (GOOD + "place = [1, 2]", "7: sensors.a.b.place: must be a list of 3 numbers, not 2"),
        (GOOD.replace("std = 1", "std = 1.5"), "5: sensors.a.b.std: is 1.5 N, which is outside 0 to 1 N"),
        (GOOD.replace("std = 1", "std = nan"), "5: sensors.a.b.std: must be a finite number, not nan"),
        (GOOD.replace("std = 1\n", ""), "4: sensors.a.b.std: is missing; add a line 'std = …'"),
        (GOOD + "[[rows]]\nstd = 1\n[[rows]]\n\nstd = true", "11: rows[1].std: must be a number, not true"),
        ("names = []\n" + GOOD, "1: names: is empty"),
        ("names = ['MCP',\n'PPI']\n" + GOOD, "2: names[1]: is 'PPI' (did you mean 'PIP'?); choose one of MCP, PIP"),
        ("rate = 0\n" + GOOD, "1: rate: is 0; it must be above 0"),
        (GOOD.replace('"g"', "[1]"), "2: scale: must be a number or a string, not [1]"),
        ("on = 'true'\n" + GOOD, "1: on: must be true or false, not 'true'"),
        ("count = 1.0\n" + GOOD, "1: count: must be a whole number, not 1.0"),
        ("more.x.y = 1\n" + GOOD, "1: more.x: must be a string in quotes, not a table"),
        ("sensors = 2024-05-01", "1: sensors: must be a table, not 2024-05-01"),
        ("\n[sensors", "2: is not valid TOML (Expected"),
        ("a = 1\n\na = 2", "3: is not valid TOML (Cannot overwrite a value"),
        ("a = 1\nb = “x”", "2: is not valid TOML (Invalid value); write straight quotes"),
        (
            'a = "C:\\logs\\x.csv"',
            "1: is not valid TOML (Unescaped '\\' in a string); write this path in single quotes",
        ),
        (
            "a = { b = 1,5, c = 2 }",
            "1: is not valid TOML (Expected '=' after a key in a key/value pair); write decimals",
        ),
        ("a = " + "[" * 5000, "1: is nested too deeply"),
        ("a = " + "9" * 5000, "1: is not valid TOML"),
    ],
)
def test_a_mistake_is_named_with_its_line(text, says):
    with pytest.raises(UserError) as refused:
        parse_toml(text, "b.toml").read(Bench)
    assert str(refused.value).startswith(f"b.toml, line {says}")


def test_a_file_that_is_not_text(tmp_path):
    (tmp_path / "b.toml").write_bytes(b"a = 1\nb = '\xff'")
    with pytest.raises(UserError, match=r"b\.toml, line 2: is not text in UTF-8"):
        read_toml(tmp_path / "b.toml")
    (tmp_path / "b.toml").write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert read_toml(tmp_path / "b.toml").read(Bench).scale == "g"


@settings(max_examples=100, deadline=None)
@given(mutated(MAPPING))
def test_a_mutated_mapping_is_read_or_refused(text):
    def read(text):
        document = parse_toml(text, "mutated.toml")
        finger_from(document.read(MappingFile).finger, document.place / "finger")

    assert_read_or_refused(read, text)


@settings(max_examples=100, deadline=None)
@given(mutated(MAPPING))
def test_every_key_has_the_line_on_which_it_stands(text):
    try:
        document = parse_toml(text, "mutated.toml")
    except UserError:
        return
    lines = text.split("\n")

    def walk(value, place):
        for key, item in value.items() if isinstance(value, dict) else ():
            assert key in lines[(place / key).line - 1]
            walk(item, place / key)

    walk(document.content, document.place)
