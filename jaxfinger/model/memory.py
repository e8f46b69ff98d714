"""States of the effects with memory, driven along a motion."""

import jax
import jax.numpy as jnp
from equinox import tree_at
from jax.scipy.special import ndtr
from jaxtyping import Array, Float

from jaxfinger.model.model import Effect, Memory, Model
from jaxfinger.model.motion import Motion

FINER = 5  # instants a sample of a fit at which a sharp memory is driven
REACH = 3  # samples on either side that a low-pass is cut at: it is narrower than a sample


def memories(model: Model, x: Motion) -> tuple[Memory, ...]:
    """State of every effect with memory at each sample, as the fit's low-pass shows it (`Motion.blur`)."""
    return tuple(_seen(model, effect, x) if effect.has_memory else () for effect in model.effects)


def _seen(model: Model, effect: Effect, x: Motion) -> Memory:
    if not effect.sharp:
        return _along(model, effect, x)
    if (blur := x.blur) is None:
        return _along(model, effect, _settled(x))
    return jax.tree.map(lambda z: _blurred(z, x.time, blur), _along(model, effect, _settled(_finer(x))))


def _along(model: Model, effect: Effect, x: Motion) -> Memory:
    drives = jax.tree.map(lambda a: jnp.moveaxis(a, -1, 0), effect.drive(model, x))
    first = jax.tree.map(lambda a: a[0], drives)

    def step(carry, drive):
        memory, before = carry
        memory = effect.next_memory(memory, before, drive)
        return (memory, drive), memory

    _, memory = jax.lax.scan(step, (effect.initial_memory(first), first), drives)
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), memory)


def _settled(x: Motion) -> Motion:
    """Angles turn back only where they go back by more than the encoder's noise."""
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


def _finer(x: Motion) -> Motion:
    """`FINER` instants a sample: cubic Hermite curves of q and q̇, straight lines of all else."""
    s = jnp.arange(FINER, dtype=float) / FINER

    def between(a, bend):
        inner = a[..., :-1, None] + jnp.multiply.outer(jnp.diff(a), s) + bend
        return jnp.concatenate([inner.reshape(*a.shape[:-1], FINER * (a.shape[-1] - 1)), a[..., -1:]], axis=-1)

    step, rise = jnp.diff(x.time)[None], jnp.diff(x.q)
    leaving, arriving = (jnp.where(step > 0.0, step * qd - rise, 0.0) for qd in (x.qd[..., :-1], x.qd[..., 1:]))
    bend = jnp.multiply.outer(leaving, s * (1.0 - s) ** 2) - jnp.multiply.outer(arriving, s**2 * (1.0 - s))
    return tree_at(lambda m: m.q, jax.tree.map(lambda a: between(a, 0.0), x), between(x.q, bend))


def _blurred(z: Float[Array, "*Tfine"], time: Float[Array, "*T"], blur: Float[Array, "*T"]) -> Float[Array, "*T"]:
    """Mean over every sample's interval of what the low-pass lets through."""
    reach, count = REACH * FINER, time.shape[-1]
    offset = jnp.arange(-reach, reach + 1)
    step, width = jnp.diff(time)[..., :1], jnp.maximum(blur[..., :1], 1e-9)
    lag = (offset / FINER).reshape(*(1,) * (step.ndim - 1), -1)
    weight = ndtr((lag + 0.5) * step / width) - ndtr((lag - 0.5) * step / width)
    weight = weight / jnp.sum(weight, axis=-1, keepdims=True)
    at = jnp.clip(FINER * jnp.arange(count)[:, None] + offset[None], 0, FINER * (count - 1))
    return jnp.einsum("...tk,...k->...t", z[..., at], weight)
