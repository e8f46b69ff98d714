"""Arithmetic in a mapping: its values, and the refusal of everything else."""

import numpy as np
import pytest

from jaxfinger.data.expressions import ExpressionError, evaluate

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
