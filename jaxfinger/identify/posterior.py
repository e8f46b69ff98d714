"""Samples from the full posterior of a joint fit by NUTS (blackjax), the reference for Laplace's covariance.

The coordinates are those of `resample`, in which Laplace's posterior is the unit Gaussian and short trajectories
suffice. A small effective sample size or divergences show that the posterior is far from it.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.joint import JOINT
from jaxfinger.identify.linearise import white_rows
from jaxfinger.identify.parameters import Free, ravel
from jaxfinger.identify.resample import compress, read_again
from jaxfinger.identify.uncertainty import Samples


@dataclass(frozen=True)
class SampledPosterior:
    """Draws from a posterior with their diagnostics."""

    samples: Samples
    effective: Float[np.ndarray, " q"]  # effective sample size of each coordinate
    divergences: int

    @property
    def trusted(self) -> bool:
        """Whether the chain can judge an approximation: no divergence, and effective sample sizes above 100."""
        return self.divergences == 0 and bool(self.effective.min() > 100)


def sampled_posterior(
    session: Session, fit: Fit, draws: int = 500, warmup: int = 300, seed: int = 0
) -> SampledPosterior:
    """Draw from the posterior of a joint fit under its own noise, given the session that it was made from.

    `draws`: number of draws after `warmup` steps of adaptation.

    Raises:
        UserError: the fit is not a joint one, or blackjax is not installed.
    """
    try:
        import blackjax
    except ImportError:
        raise UserError("sampling needs blackjax: install jaxfinger[posterior]") from None
    if JOINT not in {s.name for s in fit.stages}:
        raise UserError("a staged fit is not the optimum of one posterior; refine it first")
    compressed = compress(session, fit)
    basis, start, prior = jnp.asarray(compressed.basis), ravel(fit.model), compressed.grams.H[-1]
    sources = [
        (s.batch, s.filters, Free.at(fit.model, s.positions), s.positions) for s in read_again(session, fit)[2].values()
    ]

    def log_density(z):
        theta = start + basis @ z
        extended = jnp.append(z, 1.0)
        squares = extended @ prior @ extended
        for batch, filters, free, positions in sources:
            at = free.set(fit.model, theta[positions])
            squares = squares + jnp.sum(white_rows(at, batch, filters)[1] ** 2)
        return -0.5 * squares

    @eqx.filter_jit
    def sample(key):
        adapt, walk = jax.random.split(key)
        adaptation = blackjax.window_adaptation(blackjax.nuts, log_density)
        run = adaptation.run  # its annotated protocol lacks the argument num_steps
        (state, parameters), _ = run(adapt, jnp.zeros(basis.shape[1]), warmup)  # type: ignore[call-arg]
        kernel = blackjax.nuts.build_kernel()

        def step(state, key):
            state, info = kernel(key, state, log_density, **parameters)
            return state, (state.position, info.is_divergent)

        return jax.lax.scan(step, state, jax.random.split(walk, draws))[1]

    z, divergent = sample(jax.random.key(seed))
    effective = np.asarray(blackjax.diagnostics.effective_sample_size(z[None]))
    values = compressed.theta + np.asarray(z) @ compressed.basis.T
    return SampledPosterior(
        Samples(values, np.zeros(draws, bool), fit.estimated), np.atleast_1d(effective), int(np.sum(divergent))
    )
