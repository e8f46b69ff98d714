"""How functions are compiled and run: what runs a few times only must compile cheaply."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import equinox as eqx

Item = TypeVar("Item")
Result = TypeVar("Result")

# XLA's fusion emitters take half as long again, or more, to compile these scalar formulas, which then run no faster;
# neither do they at -O2 and beyond, which takes a tenth more. What the environment's XLA_FLAGS state goes first.
QUICK = {
    name: value
    for name, value in {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}.items()
    if name not in os.environ.get("XLA_FLAGS", "")
}

# The overloads of equinox leave the options of jit out.
quick_jit = eqx.filter_jit(compiler_options=QUICK)  # type: ignore[call-overload]


def side_by_side(f: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """f of each item, in order, two at a time: while one is traced by Python, another compiles or runs.

    No program among them may call LAPACK, as QR and `solve` do: two that do, dispatched at once, can hold all of XLA's
    processor threads and wait for ever (8,192 systems of three equations do). NumPy has no such trap.
    """
    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(f, items)
