"""Times of batch fits and bootstrap refits, beside single fits and SciPy, as ratios from one run.

    python benchmarks/batch.py [--resamples 1000] [--sessions 100] [--processes 2]

Each number of resamples or sessions compiles once; compile times are printed separately. The batch runs in one process
and, spread by `identify.distributed`, in one process per core. Single fits with `identify` may use all cores too.
"""

import argparse
import os
import socket
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import numpy as np
import scipy.optimize

from jaxfinger.identify import compress, fit_many, identify, refit
from jaxfinger.identify.distributed import fit_many_distributed, initialise, share
from jaxfinger.identify.parameters import ravel
from jaxfinger.identify.uncertainty import draw_weights
from jaxfinger.synthetic import SHORT, clean_session, measure, recipe_from

RECIPE = {
    "specimen": {"kind": "polynomial"},
    "trials": SHORT,
}


def timed(work):
    """Result, seconds of a first call (with compilation) and seconds of a second one."""
    start = time.perf_counter()
    work()
    first = time.perf_counter() - start
    start = time.perf_counter()
    result = work()
    return result, first, time.perf_counter() - start


def scipy_refit(compressed, roots, weights) -> np.ndarray:
    """One staged refit by SciPy: a least-squares problem for each stage, on the rows of the compressed trials."""
    z, start = np.zeros(compressed.sizes[0]), compressed.sizes[0]
    for row, size in zip(np.asarray(compressed.grams.reads), compressed.sizes[1:], strict=True):
        w = np.sqrt(row * np.append(weights, 1.0))
        A = np.concatenate([s * r for s, r in zip(w, roots, strict=True) if s > 0])
        own, given = A[:, start : start + size], A[:, -1] + A[:, :start] @ z
        found = scipy.optimize.least_squares(
            lambda x, o=own, g=given: o @ x + g,
            np.zeros(size),
            jac=lambda x, o=own: o,  # pyright: ignore[reportArgumentType]: SciPy's default value gives the type
            method="lm",
        )
        z, start = np.concatenate([z, found.x]), start + size
    return compressed.theta + compressed.basis @ z


def bootstrap_table(session, fit, resamples: int) -> None:
    """Print times of refits in one call, and of a SciPy loop over the same compressed trials."""
    compressed, first, again = timed(lambda: compress(session, fit))
    print(f"compress the session: {first:.2f} s, {again:.2f} s warm")
    roots = []
    for H in np.asarray(compressed.grams.H):
        values, vectors = np.linalg.eigh(H)
        roots.append(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)
    rng = np.random.default_rng(0)
    cost = {}
    for count in (10, 100, resamples):
        weights = draw_weights(compressed.strata, count, rng)
        (theta, failed), first, cost[count] = timed(lambda w=weights: refit(compressed, w))
        print(f"{count:5d} refits: {cost[count]:8.4f} s, compile {first - cost[count]:.2f} s, failed {failed.sum()}")
    few = min(resamples, 100)
    start = time.perf_counter()
    expected = np.array([scipy_refit(compressed, roots, w) for w in weights[:few]])
    loop = (time.perf_counter() - start) * resamples / few
    free = fit.estimated
    difference = np.abs((theta[:few] - expected)[:, free] / np.maximum(np.abs(expected[:, free]), fit.std[free])).max()
    print(f"SciPy loop: {loop:.2f} s for {resamples} ({few} run); ratio {loop / cost[resamples]:.0f}")
    print(f"largest relative difference {difference:.1e}")
    print(f"cost of {resamples} over 10: {cost[resamples] / cost[10]:.1f} for {resamples / 10:.0f} times the members")


def session_table(clean, session, fit, count: int, processes: int) -> None:
    """Print times of sessions in one batch, and of single fits with `identify`. Both include the filters."""
    sessions = [measure(clean, seed) for seed in range(count)]
    members, first, batch = timed(partial(fit_many, sessions, fit, session))
    few = min(count, 10)
    start = time.perf_counter()
    alone = [identify(s) for s in sessions[:few]]
    each = (time.perf_counter() - start) / few
    difference = max(
        np.abs((members.values[k] - np.asarray(ravel(a.model)))[fit.estimated] / a.std[fit.estimated]).max()
        for k, a in enumerate(alone)
    )
    print(f"one after another: {each * count:.2f} s ({few} run)")
    print(f"{count} sessions in one batch: {batch:.2f} s, compile {first - batch:.2f} s, failed {members.failed.sum()}")
    print(f"  ratio {each * count / batch:.1f}")
    print(f"  largest difference {difference:.2f} standard deviations (the batch takes the template's noise)")
    del sessions  # The processes make their own.
    first, spread = spread_over(processes, count)
    print(f"the same spread over {processes} processes: {spread:.2f} s, compile {first - spread:.2f} s")
    print(f"  ratio {each * count / spread:.1f}")


def spread_over(processes: int, count: int) -> tuple[float, float]:
    """Seconds of a first and a second batch in several processes, until the last has gathered all members."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{s.getsockname()[1]}"
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        each = [pool.submit(one_process, address, processes, k, count) for k in range(processes)]
        first, again = zip(*(one.result() for one in each), strict=True)
    return max(first), max(again)


def one_process(address: str, processes: int, process: int, count: int) -> tuple[float, float]:
    """Work of one process, as a launch command starts it on every machine of a cluster: seconds of two batches."""
    initialise(address, processes, process)
    clean = clean_session(recipe_from(RECIPE))
    session = measure(clean, 0)
    fit, mine = identify(session), share(count)
    sessions = [measure(clean, k) if mine.start <= k < mine.stop else session for k in range(count)]
    _, first, again = timed(lambda: fit_many_distributed(sessions, fit, session))
    return first, again


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--resamples", type=int, default=1000)
    parser.add_argument("--sessions", type=int, default=100)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    options = parser.parse_args()
    clean = clean_session(recipe_from(RECIPE))
    session = measure(clean, 0)
    fit = identify(session)
    bootstrap_table(session, fit, options.resamples)
    session_table(clean, session, fit, options.sessions, options.processes)


if __name__ == "__main__":
    main()
