"""Scripts beside the package, which no other quick test runs, call it by names and arguments that it has."""

import ast
import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(p for folder in ("benchmarks", "datasets", "docs", "notebooks") for p in (ROOT / folder).rglob("*.py"))


def imported(tree: ast.Module) -> dict[str, object]:
    """Objects of the package by the names under which a script imports them.

    Raises:
        AssertionError: The package lacks one.
    """
    names = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jaxfinger":
            for alias in node.names:
                names[alias.asname or alias.name] = member(importlib.import_module(node.module or ""), alias.name)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.asname and alias.name.split(".")[0] == "jaxfinger":
                    names[alias.asname] = importlib.import_module(alias.name)
    return names


def member(module, name: str) -> object:
    """A member of a module, or its submodule of that name."""
    if not hasattr(module, name):
        try:
            return importlib.import_module(f"{module.__name__}.{name}")
        except ImportError:
            raise AssertionError(f"{module.__name__} has no {name}") from None
    return getattr(module, name)


def calls(tree: ast.Module, names: dict[str, object]) -> Iterator[tuple[ast.Call, object]]:
    """Calls of imported objects and of what modules and classes among them hold."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call):
            continue
        path, called = [], node.func
        while isinstance(called, ast.Attribute):
            path, called = [called.attr, *path], called.value
        if not (isinstance(called, ast.Name) and called.id in names):
            continue
        target = names[called.id]
        for name in path:
            if not (inspect.ismodule(target) or inspect.isclass(target)):
                break
            target = member(target, name) if inspect.ismodule(target) else getattr(target, name)
        else:
            yield node, target


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_script_calls_the_package_as_it_is(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node, target in calls(tree, imported(tree)):
        try:
            signature = inspect.signature(target)  # type: ignore[arg-type]
        except ValueError:  # A class of another language has none.
            continue
        starred = any(isinstance(a, ast.Starred) for a in node.args) or any(k.arg is None for k in node.keywords)
        bind = signature.bind_partial if starred else signature.bind
        positional = [a for a in node.args if not isinstance(a, ast.Starred)]
        try:
            bind(*positional, **{k.arg: k.value for k in node.keywords if k.arg})
        except TypeError as error:
            pytest.fail(f"{path.name}:{node.lineno}: {ast.unparse(node.func)}: {error}")
