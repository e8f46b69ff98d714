"""What checks the annotations in the tests: beartype, of each value once."""

from collections.abc import Callable
from typing import Any

from beartype import BeartypeConf, beartype

# Where `float` stands, an `int` may too (PEP 484).
CONFIGURATION = BeartypeConf(is_pep484_tower=True)


def checked(fn: Callable) -> Callable:
    """jaxtyping has two functions made for one: before a call the first is given the arguments (and returns anything),
    after it the second is given the arguments again and returns what the call did. It remembers the sizes that the
    arguments had, so the second checks the return alone.
    """
    if fn.__annotations__.get("return", Any) is not Any:
        fn.__annotations__ = {"return": fn.__annotations__["return"]}
    return beartype(conf=CONFIGURATION)(fn)
