"""Times of a fit, of bootstrap refits and of inverse dynamics on every kind of device that JAX has here.

    python benchmarks/devices.py

The same code runs on the processor first, and then on a GPU where there is one. Its results are compared with the
processor's. Each work is done twice: the first time includes compilation.
"""

import time
from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxfinger.identify import compress, identify, refit
from jaxfinger.identify.parameters import ravel
from jaxfinger.identify.uncertainty import draw_weights
from jaxfinger.model import Finger, rigid_body
from jaxfinger.synthetic import SHORT, clean_session, measure, recipe_from

RECIPE = {"specimen": {"kind": "polynomial"}, "trials": SHORT}
RESAMPLES = 1000
SAMPLES = (10**5, 10**6, 10**7)  # of inverse dynamics

Result = TypeVar("Result")


def timed(what: str, work: Callable[[], Result]) -> Result:
    """Do the work twice, and print the seconds of both."""
    start = time.perf_counter()
    jax.block_until_ready(work())
    between = time.perf_counter()
    result = jax.block_until_ready(work())
    print(f"  {what:<44s}{between - start:8.3f} s, again {time.perf_counter() - between:8.4f} s", flush=True)
    return result


def devices() -> list:
    """The processor, and the first device of another kind that JAX uses here."""
    return list(dict.fromkeys([jax.devices("cpu")[0], jax.devices()[0]]))


def main() -> None:
    """Print times and differences of every device."""
    with jax.default_device(jax.devices("cpu")[0]):
        session = measure(clean_session(recipe_from(RECIPE)), 0)
    finger, rng = Finger.from_description(session.finger), np.random.default_rng(0)
    inverse_dynamics, on_processor = eqx.filter_jit(rigid_body.inverse_dynamics), None
    for device in devices():
        with jax.default_device(device):
            print(device)
            fit = timed("identify a session", lambda: identify(session))
            compressed = compress(session, fit)
            weights = draw_weights(compressed.strata, RESAMPLES, np.random.default_rng(0))
            refits, _ = timed(f"{RESAMPLES} refits", lambda c=compressed, w=weights: refit(c, w))
            for samples in SAMPLES:
                moving = [jnp.asarray(x) for x in rng.uniform(-1, 1, (3, finger.m, samples))]
                timed(f"inverse dynamics, {samples:,} samples", lambda x=moving: inverse_dynamics(finger, *x))
            estimates = np.stack([np.asarray(ravel(fit.model)), *np.asarray(refits)])[:, fit.estimated]
            if on_processor is None:
                on_processor = estimates
            difference = np.abs((estimates - on_processor) / fit.std[fit.estimated]).max(axis=1)
            print(f"  largest difference of an estimate from the processor's: {difference[0]:.0e} standard deviations,")
            print(f"  of a refit {difference[1:].max():.0e}")


if __name__ == "__main__":
    main()
