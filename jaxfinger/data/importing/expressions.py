"""Arithmetic in a mapping, such as `kt * current` or `M @ motors`.

Expressions are parsed, never evaluated as Python. Operators and functions that are not listed here are refused.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from jaxfinger.errors import listed

_OPERATORS: dict[type, Callable] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.BitAnd: np.logical_and,
    ast.BitOr: np.logical_or,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Invert: np.logical_not,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.And: np.logical_and,
    ast.Or: np.logical_or,
    ast.Not: np.logical_not,
}
_FUNCTIONS = {
    name: getattr(np, name) for name in ("sin", "cos", "tan", "arctan", "sqrt", "exp", "log", "deg2rad", "rad2deg")
} | {"abs": np.abs, "sign": np.sign}
_OF_ANGLES, _ANGLES = ("sin", "cos", "tan"), ("rad", "mrad", "deg", "turn")
_MAX_LENGTH = 2000  # characters, longer than any formula. Deep nesting fails earlier, with a message of its own.


class ExpressionError(ValueError):
    """Fault of an expression. The message is the end of a sentence that begins with the expression."""


def evaluate(
    text: str,
    lookup: Callable[[str, Any], Any],
    constants: Mapping[str, Any],
    words: Mapping[str, np.ndarray] = MappingProxyType({}),
) -> np.ndarray:
    """Value of an expression over N samples: (N,) or (N, k).

    Variables are `name`, `outer.inner` or, for names that are no identifiers, `'q [deg]'`. Their values are
    `lookup(name, column)`, where `name[1]` and `name['MCP']` choose a column and `name` alone passes None. A constant
    (number or matrix) goes before a variable of the same name. `[a, b]` puts variables beside each other, and `M @ x`
    multiplies every sample by a matrix. `words` are variables (N,) of text. They can be compared with a word alone, as
    in `phase == 'sweep'`.

    Raises:
        ExpressionError: the text does not parse, holds something that is not allowed, or its shapes do not fit.
    """
    if len(text) > _MAX_LENGTH:
        raise ExpressionError(f"is longer than {_MAX_LENGTH} characters; derive it in steps")
    try:
        tree = ast.parse(text.strip(), mode="eval")
        with np.errstate(all="ignore"):
            return np.asarray(_value(tree.body, lookup, constants, words))
    except ExpressionError:
        raise
    except SyntaxError as error:
        raise ExpressionError(f"is no expression ({error.msg} at column {error.offset}); mend it") from None
    except (RecursionError, MemoryError):
        raise ExpressionError("is nested too deeply; derive it in steps") from None
    except (ValueError, TypeError) as error:
        raise ExpressionError(f"cannot be worked out ({error}); the shapes must fit") from None


def _value(node: ast.AST, lookup: Callable[[str, Any], Any], constants: Mapping[str, Any], words: Mapping) -> Any:
    """Value of a node of the syntax tree; ExpressionError for a kind of node that is not allowed."""

    def inner(child: ast.AST) -> Any:
        return _value(child, lookup, constants, words)

    match node:
        case ast.Constant(value=bool()):
            pass
        case ast.Constant(value=int() | float() as number):
            return np.float64(number)
        case ast.Name(id="pi"):
            return np.pi
        case ast.Name() | ast.Attribute() | ast.Constant(value=str()):
            name = _name(node)
            if name in constants:
                return np.asarray(constants[name], np.float64)
            if name in words:
                example = f"{ast.unparse(node)} == {str(words[name][0])!r}"
                raise ExpressionError(f"computes with {name!r}, which holds words; compare it with one, as {example}")
            return lookup(name, None)
        case ast.Subscript(slice=ast.Constant(value=int() | str() as column)):
            return lookup(_name(node.value), column)
        case ast.UnaryOp() if type(node.op) in _OPERATORS:
            return _OPERATORS[type(node.op)](inner(node.operand))
        case ast.BinOp(left=ast.Name(id=matrix), op=ast.MatMult()) if np.ndim(constants.get(matrix, 0.0)) == 2:
            samples = inner(node.right)
            return samples.reshape(len(samples), -1) @ np.asarray(constants[matrix], np.float64).T
        case ast.BinOp() if type(node.op) in _OPERATORS:
            return _aligned(_OPERATORS[type(node.op)], inner(node.left), inner(node.right))
        case ast.BoolOp():
            values = [inner(value) for value in node.values]
            for value in values[1:]:
                values[0] = _OPERATORS[type(node.op)](values[0], value)
            return values[0]
        case ast.Compare(
            left=ast.Name() | ast.Attribute() | ast.Constant(value=str()) as left,
            ops=[ast.Eq() | ast.NotEq() as op],
            comparators=[ast.Constant(value=str() as word)],
        ) if (name := _name(left)) in words and name not in constants:
            if word not in words[name]:
                there = listed([repr(str(w)) for w in np.unique(words[name])], 10)
                raise ExpressionError(f"asks for {word!r}, which {name!r} never holds; write one of {there}")
            return _OPERATORS[type(op)](words[name], word)
        case ast.Compare(ops=[op], comparators=[right]) if type(op) in _OPERATORS:
            return _OPERATORS[type(op)](inner(node.left), inner(right))
        case ast.List() | ast.Tuple() if node.elts:
            return np.column_stack([inner(item) for item in node.elts])
        case ast.Call(func=ast.Name(id=function), args=[argument], keywords=[]) if function in _FUNCTIONS:
            return _FUNCTIONS[function](inner(argument))
    raise ExpressionError(
        f"holds {ast.unparse(node)!r}, which is not allowed; it may hold variables, constants, + - * / **, "
        f"comparisons, MATRIX @ x, and {', '.join(_FUNCTIONS)}"
    )


def units_of(text: str, lookup: Callable[[str], str], constants: Collection[str]) -> str:
    """Unit in which an expression is, by those of its variables; empty where they do not tell.

    Sums keep the unit of their terms, and deg2rad, rad2deg and arctan give angles. `lookup` gives the unit of a
    variable (`units.unit_name`), empty where it is unknown; `constants` have none.

    Raises:
        ExpressionError: different units are added or compared, or an angle that is not in rad has its sine taken.
    """
    return _units(ast.parse(text.strip(), mode="eval").body, lookup, constants)


def _units(node: ast.AST, lookup: Callable[[str], str], constants: Collection[str]) -> str:
    """Unit of a node of the syntax tree (`units_of`)."""

    def inner(child: ast.AST) -> str:
        return _units(child, lookup, constants)

    match node:
        case ast.Constant(value=int() | float()) | ast.Name(id="pi"):
            return ""
        case ast.Name() | ast.Attribute() | ast.Constant(value=str()):
            name = _name(node)
            return "" if name in constants else lookup(name)
        case ast.Subscript():
            return lookup(_name(node.value))
        case ast.UnaryOp():
            return inner(node.operand)
        case ast.BinOp(op=ast.Add() | ast.Sub()):
            return _common(node, [inner(node.left), inner(node.right)], "adds")
        case ast.Compare(comparators=[right]):
            _common(node, [inner(node.left), inner(right)], "compares")
        case ast.List() | ast.Tuple():
            found = {inner(item) for item in node.elts}
            return found.pop() if len(found) == 1 else ""
        case ast.Call(func=ast.Name(id=function), args=[argument]):
            unit = inner(argument)
            wanted = {"rad2deg": "rad", "deg2rad": "deg"}.get(function, "rad" if function in _OF_ANGLES else unit)
            if unit in _ANGLES and unit != wanted:
                mend = "write deg2rad(…) about it" if (unit, wanted) == ("deg", "rad") else "convert it first"
                raise ExpressionError(f"takes {function} of {unit} in {ast.unparse(argument)!r}; {mend}")
            given = {"deg2rad": "rad", "rad2deg": "deg", "arctan": "rad", "abs": unit}
            return given.get(function, "")
        case _:
            for child in ast.iter_child_nodes(node):
                if isinstance(child, ast.expr):
                    inner(child)
    return ""


def _common(node: ast.AST, units: Sequence[str], verb: str) -> str:
    """The one unit of several terms, empty where none has one.

    Raises:
        ExpressionError: the terms have different ones.
    """
    known = list(dict.fromkeys(unit for unit in units if unit))
    if len(known) > 1:
        raise ExpressionError(f"{verb} {' and '.join(known)} in {ast.unparse(node)!r}; convert one of them first")
    return known[0] if known else ""


def _aligned(apply: Callable, left: Any, right: Any) -> Any:
    """Apply an operator to two values, and to (N,) and (N, k) sample by sample."""
    if {np.ndim(left), np.ndim(right)} == {1, 2}:
        column, table = (left, right) if np.ndim(left) == 1 else (right, left)
        if len(column) == len(table):
            left, right = (value[:, None] if value is column else value for value in (left, right))
    return apply(left, right)


def _name(node: ast.AST) -> str:
    """Name of a variable, `name`, `outer.inner` or `'any name'`."""
    match node:
        case ast.Name(id=name):
            return name
        case ast.Constant(value=str() as name):
            return name
        case ast.Attribute(value=value, attr=inner):
            return f"{_name(value)}.{inner}"
    raise ExpressionError(f"holds {ast.unparse(node)!r}, which names no variable")
