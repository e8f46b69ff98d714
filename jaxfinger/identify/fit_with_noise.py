"""A fit whose noise is estimated along with it, from its own residuals."""

from functools import partial

import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.experiments import Stack
from jaxfinger.identify.noise import LONG_SIGNAL_WINDOW, MIN_STD, SIGNAL_WINDOW, Noise, estimate
from jaxfinger.identify.parameters import describe
from jaxfinger.identify.prior import Prior
from jaxfinger.identify.solve import ROUGH_TOLERANCE, Solution, Tangents, solve, total_cost
from jaxfinger.identify.sources import Source, residuals_each, sources_of
from jaxfinger.identify.start import start_values
from jaxfinger.model import Model


def estimate_with_noise(
    model: Model,
    free: Int[np.ndarray, " p"],
    stacks: dict[str, Stack],
    reads: dict[str, tuple[str, ...]],
    known: dict[tuple[str, str], Noise],
    prior: Prior | None,
    huber: float,
    tangents: Tangents | None = None,
    fitted: bool = False,
) -> tuple[Model, Solution, dict[str, Source], dict[tuple[str, str], Noise]]:
    """Fit the free parameters, after estimating the noise of the channels read unless all of it is `known`.

    Unknown noise is guessed first, or, where the model is `fitted` and taken to be right, estimated from its residuals:
    the guess is white, with which a fit would follow coloured noise. Then the noise of all channels is estimated twice,
    each time from the residuals of a fit. The last fit uses Huber's cost.

    Returns:
        The model, the solution, the sources and the noise.
    """
    tangents, parameters, noise = tangents or Tangents(), describe(model), dict(known)
    window = LONG_SIGNAL_WINDOW if fitted else SIGNAL_WINDOW
    first = partial(estimate, window=window) if fitted else first_noise
    unknown = {(e, c): first(stacks[e], c, x) for (e, c), x in residuals_for_noise(model, stacks, reads, noise).items()}
    model = start_values(model, free, parameters, sources_of(stacks, reads, noise | unknown, parameters))
    for _ in range(2 if unknown else 0):
        sources = sources_of(stacks, reads, noise | unknown, parameters)
        model, solution = solve(model, free, sources, prior, tangents=tangents, tolerance=ROUGH_TOLERANCE)
        noise |= _noise(solution, stacks, reads, window)
        unknown = {}
    sources = sources_of(stacks, reads, noise, parameters)
    model, solution = solve(model, free, sources, prior, huber, tangents=tangents)
    again = start_values(model, free, parameters, sources)
    if again is not model:  # a tendon's friction has slid into a dead zone
        other, second = solve(again, free, sources, prior, huber, tangents=tangents)
        if total_cost(other, second, free, prior) < total_cost(model, solution, free, prior):
            model, solution = other, second
    return model, solution, sources, noise


def residuals_for_noise(
    model: Model,
    stacks: dict[str, Stack],
    reads: dict[str, tuple[str, ...]],
    known: dict[tuple[str, str], Noise],
) -> dict[tuple[str, str], Float[np.ndarray, "_columns _B _T"]]:
    """Residuals of a model, in the channels' units, by experiment and channel, where the noise is not known."""
    reads = {e: channels for e, channels in reads.items() if any((e, c) not in known for c in channels)}
    white = {(e, c): Noise.white(np.ones(len(stacks[e].batch.y[c])), "none") for e in reads for c in reads[e]}
    residuals = residuals_each(model, sources_of(stacks, reads, white, describe(model)))
    return {(e, c): np.asarray(residuals[e][c]) for e, c in white if (e, c) not in known}


def first_noise(stack: Stack, channel: str, residual: Float[Array | np.ndarray, "columns B T"]) -> Noise:
    """First guess of a channel's noise: white, as large as the median step of its residuals from sample to sample.

    It serves for a first fit, from whose residuals the noise is estimated. Residuals are used since the channel itself
    may be zero throughout, as the torque on a free finger.
    """
    residual, mask = np.asarray(residual), np.asarray(stack.batch.mask[channel]) > 0
    step = np.diff(residual, axis=-1)[mask[..., 1:] & mask[..., :-1]]
    size = float(np.median(np.abs(step))) if step.size else 1.0
    return Noise.white(np.full(len(residual), max(size, MIN_STD)), "first guess")


def _noise(solution: Solution, stacks, reads, window: int) -> dict[tuple[str, str], Noise]:
    return {
        (e, c): estimate(stacks[e], c, np.asarray(solution.linearised[e].residuals[c]), window)
        for e, channels in reads.items()
        for c in channels
    }
