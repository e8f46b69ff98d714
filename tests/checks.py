"""Type checker of the annotations in the tests: beartype, once for each value."""

import sys
from collections.abc import Callable
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

# An `int` may be given where `float` is annotated (PEP 484).
CONFIGURATION = BeartypeConf(is_pep484_tower=True)


def checked(fn: Callable) -> Callable:
    """Wrap one of jaxtyping's checking functions with beartype.

    jaxtyping makes two of them for each function: one checks the arguments before a call, the other the returned value
    after it and the arguments again. Sizes are remembered in between, so that here the second one checks the returned
    value alone.
    """
    for name in ("Bool", "Float", "Int"):  # `data` does not import them, or `check` would wait 0.1 s.
        vars(sys.modules[fn.__module__]).setdefault(name, getattr(jaxtyping, name))
    if fn.__annotations__.get("return", Any) is not Any:
        fn.__annotations__ = {"return": fn.__annotations__["return"]}
    return beartype(conf=CONFIGURATION)(fn)
