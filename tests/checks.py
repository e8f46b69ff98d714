"""What checks the annotations in the tests: beartype, of each value once."""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

# Where `float` stands, an `int` may too (PEP 484).
CONFIGURATION = BeartypeConf(is_pep484_tower=True)


def checked(fn: Callable) -> Callable:
    """A function that jaxtyping made to check another: one for the arguments, before a call, and one for what it
    returned, after it, which is given the arguments once more. Their sizes are remembered in between, so that the
    second one checks what was returned alone.
    """
    if fn.__annotations__.get("return", Any) is not Any:
        fn.__annotations__ = {"return": fn.__annotations__["return"]}
    return beartype(conf=CONFIGURATION)(fn)
