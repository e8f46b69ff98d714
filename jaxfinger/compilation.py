"""Compilation and threads of JAX functions; most run only a few times, so compile time matters most."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TypeVar

import jax
from threadpoolctl import threadpool_limits

from jaxfinger.programs import Program

Item = TypeVar("Item")
Result = TypeVar("Result")
Function = TypeVar("Function", bound=Callable)

# XLA's fusion emitters compile these scalar formulas 50 % slower or worse, and -O2 and above 10 % slower; neither makes
# them run faster. YNNPACK, to which XLA hands sums, spends 30 % of a diagnosis's processor time on those over short
# axes (Linux's `perf record`); XLA's own loops spend little on them.
QUICK = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 1,
    "xla_cpu_experimental_ynn_fusion_type": "",
}


@cache
def quick_options() -> dict[str, bool | int | str]:
    """`QUICK`, without what the environment's XLA_FLAGS sets itself and what this version of XLA does not know."""
    return {k: v for k, v in QUICK.items() if k not in os.environ.get("XLA_FLAGS", "") and _has_option(k, v)}


def _has_option(option: str, value: bool | int | str) -> bool:
    try:
        jax.jit(lambda: 0.0, compiler_options={option: value}).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


def quick_jit(f: Callable) -> Program:
    """Compile a function quickly, and keep its programs for later processes."""
    return Program(f, quick_options)


def side_by_side(f: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Apply f to each item, two at a time, and yield the results in order.

    While Python traces one call, the other compiles or runs. The programs must not call LAPACK, as QR and `solve` do:
    two programs that do can hold all of XLA's processor threads and deadlock (8,192 systems of three equations do).
    NumPy's LAPACK calls are safe.
    """
    with ThreadPoolExecutor(2) as pool:
        yield from pool.map(f, items)


def one_blas_thread(f: Function) -> Function:
    """Decorate a function that calls programs and NumPy's linear algebra in turn.

    Threads of both wait busily for their next work, and take the processors from each other. NumPy and SciPy get one
    thread: our matrices are too small for more to be of use.
    """
    return threadpool_limits.wrap(limits=1, user_api="blas")(f)
