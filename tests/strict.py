"""Annotations are checked while tests run, at a price that loops can pay."""

from typing import Any

from beartype import BeartypeConf, beartype

# Where `float` stands, an `int` may too (PEP 484).
CONF = BeartypeConf(is_pep484_tower=True)
# What is called more often is called in a loop, mostly with the same shapes: a simulated finger's laws, at each sample.
FIRST, THEN = 1000, 100


def checked(dummy):
    """What jaxtyping calls to check a function's parameters, and again to check what it returns.

    It is made when first needed, which for most functions is never, and checks the first thousand calls, then each
    hundredth.
    """
    if dummy.__annotations__.get("return", Any) is not Any:  # parameters were checked before the call
        dummy.__annotations__ = {"return": dummy.__annotations__["return"]}
    checking, calls = None, 0

    def check(*args, **kwargs):
        nonlocal checking, calls
        calls += 1
        if calls <= FIRST or calls % THEN == 0:
            checking = checking or beartype(conf=CONF)(dummy)
            checking(*args, **kwargs)

    return check
