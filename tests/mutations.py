"""Random mistakes in TOML files, and the assertion that a reader reads or refuses them."""

import re

from hypothesis import strategies as st

from jaxfinger.errors import UserError


@st.composite
def mutated(draw, text):
    """Mutate a file: replace keys or values, drop, double or move lines, and change a few characters."""
    lines = text.splitlines()
    other = st.sampled_from(
        [
            "true",
            '"false"',
            "3",
            "-1.5",
            "nan",
            "[]",
            "[1]",
            '["a"]',
            "{}",
            "{ a = 1 }",
            "2024-01-01",
            "''",
            '"[/]"',
            "1e400",
        ]
    )
    for _ in range(draw(st.integers(1, 3))):
        i = draw(st.integers(0, len(lines) - 1))
        key, equals, value = lines[i].partition("=")
        match draw(st.sampled_from(["value", "inner", "key", "drop", "double", "move", "character"])):
            case "value" if equals:
                lines[i] = f"{key}= {draw(other)}"
            case "inner" if numbers := re.findall(r'"[^"]*"|-?\d[\d.e-]*|true|false', value):
                lines[i] = f"{key}={value.replace(draw(st.sampled_from(numbers)), draw(other), 1)}"
            case "key":
                lines[i] = f"{key[:-2]}x {equals}{value}"
            case "drop":
                lines[i] = ""
            case "double":
                lines.insert(i, lines[i])
            case "move":
                lines.insert(draw(st.integers(0, len(lines) - 1)), lines.pop(i))
            case _ if lines[i]:
                k = draw(st.integers(0, len(lines[i]) - 1))
                lines[i] = lines[i][:k] + draw(st.sampled_from("\"'[]{}=.,#\\ 0x\x00é")) + lines[i][k + 1 :]
    return "\n".join(lines)


def assert_read_or_refused(read, text):
    """Assert that `read` accepts the text, or raises a UserError that begins with the file and one of its lines."""
    try:
        read(text)
        said = "mutated.toml, line 1: "
    except UserError as error:
        said = str(error)
    found = re.match(r"(?:.*/)?mutated\.toml, line (\d+): ", said)
    assert found, said
    assert 1 <= int(found[1]) <= text.count("\n") + 1
    assert "\n" not in said
