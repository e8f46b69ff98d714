"""Arithmetic in a mapping: its values, and the refusal of everything else."""

import re

import numpy as np
import pytest

from jaxfinger.data.importing.expressions import ExpressionError, evaluate, units_of

X = np.arange(4.0)
TABLE = np.column_stack([X, 10 * X])
WORDS = {"phase": np.array(["rest", "sweep", "sweep", "rest"], np.dtypes.StringDType())}
VALUES = {"x": X, "q [deg]": 2 * X, "log.y": X + 1, "table": TABLE}
CONSTANTS = {"k": 3.0, "M": [[1, 1], [0, 2], [1, 0]], "gains": [1.0, 0.5]}


def lookup(name, column):
    if name not in VALUES:
        raise ExpressionError(f"no {name}")
    return VALUES[name] if column is None else VALUES[name][:, column]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("k * x - 1", 3 * X - 1),
        ("'q [deg]' / 2 + log.y ** 2", X + (X + 1) ** 2),
        ("table[1] + x", 11 * X),
        ("gains * table", TABLE * [1.0, 0.5]),
        ("x * table", X[:, None] * TABLE),
        ("M @ table", TABLE @ np.array([[1, 1], [0, 2], [1, 0]]).T),
        ("M @ [x, 10 * x]", TABLE @ np.array([[1, 1], [0, 2], [1, 0]]).T),
        ("deg2rad(180 * sin(x) / pi)", np.sin(X)),
        ("x > 1 and not x == 3", [False, False, True, False]),
        ("-abs(-x)", -X),
        ("phase == 'sweep' and x < 2", [False, True, False, False]),
        ("'phase' != 'sweep'", [True, False, False, True]),
    ],
)
def test_values(text, expected):
    np.testing.assert_allclose(evaluate(text, lookup, CONSTANTS, WORDS), expected)


@pytest.mark.parametrize(
    "text",
    [
        *(
            "__import__('os').system('true')",
            "x.__class__",
            "open('f')",
            "lambda: 1",
            "[i for i in x]",
            "x if x else x",
        ),
        *(
            "x @ M",
            "nothing + 1",
            "k *",
            "9 ** 9 ** 9 ** x[",
            "x" + "+x" * 2000,
            "(" * 300 + "x" + ")" * 300,
            "table[5:]",
        ),
        *("exec('1')", "f'{x}'", "x := 3", "sin(x, out=x)", "True", "gains + x"),
    ],
)
def test_what_is_refused(text):
    with pytest.raises(ExpressionError):
        evaluate(text, lookup, CONSTANTS)


def test_powers_of_powers_come_to_an_end():
    assert evaluate("9 ** 9 ** 9 ** 9", lookup, CONSTANTS) == np.inf


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("phase == 'swep'", "'swep', which 'phase' never holds; write one of 'rest', 'sweep'"),
        ("phase > 'rest'", "computes with 'phase', which holds words; compare it with one, as phase == 'rest'"),
        ("2 * phase", "computes with 'phase'"),
    ],
)
def test_what_words_cannot_do(text, words):
    with pytest.raises(ExpressionError, match=words):
        evaluate(text, lookup, CONSTANTS, WORDS)


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("angle - 3", "deg"),
        ("-angle + offset", "deg"),
        ("abs(angle) + 'angle'", "deg"),
        ("deg2rad(angle)", "rad"),
        ("rad2deg(turned)", "deg"),
        ("arctan(length / length)", "rad"),
        ("2 * angle", ""),
        ("M @ [angle, angle]", ""),
        ("[angle, angle]", "deg"),
        ("[angle, length]", ""),
        ("length[1] - length[0]", "mm"),
        ("12.5 * (volts - 0.2)", ""),
        ("sin(deg2rad(angle)) * length", ""),
        ("sin(volts)", ""),
        ("(angle > 3) and not length < 2", ""),
    ],
)
def test_sums_keep_the_unit_of_their_terms(text, unit):
    known = {"angle": "deg", "turned": "rad", "length": "mm"}
    assert units_of(text, lambda name: known.get(name, ""), ("offset", "M")) == unit


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("2 * (angle + turned)", "adds deg and rad in 'angle + turned'; convert one of them first"),
        ("angle > length", "compares deg and mm"),
        ("length * sin(angle)", "takes sin of deg in 'angle'; write deg2rad(…) about it"),
        ("deg2rad(turned)", "takes deg2rad of rad in 'turned'; convert it first"),
    ],
)
def test_units_that_do_not_fit_are_refused(text, says):
    known = {"angle": "deg", "turned": "rad", "length": "mm"}
    with pytest.raises(ExpressionError, match=re.escape(says)):
        units_of(text, lambda name: known.get(name, ""), ())
