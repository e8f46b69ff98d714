"""States (memories) of the effects that have them, integrated along a motion."""

import jax
import jax.numpy as jnp
from equinox import tree_at
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from jaxfinger.model.model import Effect, Memory, Model
from jaxfinger.model.motion import Motion

SUBSAMPLES = 5  # instants for each sample of a fit at which a sharp memory is evaluated
KERNEL_REACH = 3  # samples to either side at which the low-pass is cut off; its width is less than one sample


def memories(model: Model, x: Motion) -> tuple[Memory, ...]:
    """State of every effect at each sample, after the fit's low-pass (`Motion.blur`); () for effects without memory."""
    return tuple(_memory_of(model, effect, x) if effect.has_memory else () for effect in model.effects)


def _memory_of(model: Model, effect: Effect, x: Motion) -> Memory:
    if not effect.sharp:
        return _integrated(model, effect, x)
    if (blur := x.blur) is None:
        return _integrated(model, effect, _without_jitter(x))
    fine = _integrated(model, effect, _without_jitter(_resampled(x)))
    return jax.tree.map(lambda z: _low_passed(z, x.time, blur), fine)


def _integrated(model: Model, effect: Effect, x: Motion) -> Memory:
    drives = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), effect.drive(model, x))
    first = jax.tree.map(lambda a: a[0], drives)

    def step(carry, drive):
        memory, before = carry
        memory = effect.next_memory(memory, before, drive)
        return (memory, drive), memory

    _, memory = jax.lax.scan(step, (effect.initial_memory(first), first), drives)
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), memory)


def _without_jitter(x: Motion) -> Motion:
    """Motion whose angles turn back only where they do so by more than the encoder's noise (`Motion.jitter`)."""
    if x.jitter is None:
        return x

    def step(carry, sample):
        (at, way), (q, least) = carry, sample
        moves = ((q - at) * way > 0.0) | (jnp.abs(q - at) > least)
        at, way = jnp.where(moves, q, at), jnp.where(moves, jnp.sign(q - at), way)
        return (at, way), at

    q, least = (jnp.moveaxis(a, -1, 0) for a in (x.q, x.jitter))
    _, settled = jax.lax.scan(step, (q[0], jnp.zeros_like(q[0])), (q, least))
    return tree_at(lambda m: m.q, x, jnp.moveaxis(settled, 0, -1))


def _resampled(x: Motion) -> Motion:
    """Motion at `SUBSAMPLES` instants for each sample: cubic Hermite interpolation of q, linear of all else."""
    s = jnp.arange(SUBSAMPLES, dtype=float) / SUBSAMPLES

    def between(a, bend):
        inner = a[..., :-1, None] + jnp.multiply.outer(jnp.diff(a), s) + bend
        return jnp.concatenate([inner.reshape(*a.shape[:-1], SUBSAMPLES * (a.shape[-1] - 1)), a[..., -1:]], axis=-1)

    step, rise = jnp.diff(x.time)[None], jnp.diff(x.q)
    leaving, arriving = (jnp.where(step > 0.0, step * qd - rise, 0.0) for qd in (x.qd[..., :-1], x.qd[..., 1:]))
    bend = jnp.multiply.outer(leaving, s * (1.0 - s) ** 2) - jnp.multiply.outer(arriving, s**2 * (1.0 - s))
    return tree_at(lambda m: m.q, jax.tree.map(lambda a: between(a, 0.0), x), between(x.q, bend))


def _low_passed(z: Float[Array, "*Tfine"], time: Float[Array, "*T"], blur: Float[Array, "*T"]) -> Float[Array, "*T"]:
    """State after a Gaussian low-pass of standard deviation `blur`, s, averaged over the interval of each sample."""
    reach, count = KERNEL_REACH * SUBSAMPLES, time.shape[-1]
    offset = jnp.arange(-reach, reach + 1)
    step, width = jnp.diff(time)[..., :1], jnp.maximum(blur[..., :1], 1e-9)
    lag = (offset / SUBSAMPLES).reshape(*(1,) * (step.ndim - 1), -1)
    weight = ndtr((lag + 0.5) * step / width) - ndtr((lag - 0.5) * step / width)
    weight = weight / jnp.sum(weight, axis=-1, keepdims=True)
    at = jnp.clip(SUBSAMPLES * jnp.arange(count)[:, None] + offset[None], 0, SUBSAMPLES * (count - 1))
    return jnp.einsum("...tk,...k->...t", z[..., at], weight)
