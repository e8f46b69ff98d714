"""Signatures: what an effect adds to every whitened row, nominal parameters as they are.

One compiled function a class of effects and experiment serves every site, shape and amplitude: they are arrays, mapped over.
Only what the effect changes is evaluated; the rigid body is left out where it does not move.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects import CatalogueEffect, Site
from jaxfinger.gap.problem import Problem
from jaxfinger.identify.noise import whiten
from jaxfinger.model import (
    Model,
    Motion,
    contact_map,
    excursion,
    external_torque,
    fingertip_force,
    resisting_torque,
)


@dataclass(frozen=True)
class Variant:
    """One effect at one site with one shape."""

    effect: type[CatalogueEffect]
    site: Site
    shape: dict[str, float]

    @property
    def key(self) -> tuple[str, Site]:
        """What a verdict names."""
        return self.effect.ID, self.site

    def at(self, finger, amplitudes: dict[str, float]) -> CatalogueEffect:
        """The effect itself."""
        return self.effect.at(finger, self.site, **self.shape, **amplitudes)


def variants(effects: dict[str, type[CatalogueEffect]], finger) -> list[Variant]:
    """Every effect at every site with every shape worth trying."""
    return [
        Variant(effect, site, shape)
        for effect in effects.values()
        for site in effect.sites(finger)
        for shape in effect.shapes(finger, site)
    ]


@eqx.filter_jit
def _deltas(
    effects: CatalogueEffect, nominal: Model, x: Motion, y0: dict[str, Array], mask: dict[str, Array],
    filters: dict[str, Array], contact: Array | None,
) -> Float[Array, "variants rows"]:
    """Whitened change of the prediction, one row a member of `effects` (arrays stacked along their first axis)."""
    base = resisting_torque(nominal, x)

    def one(effect):
        model = eqx.tree_at(lambda m: m.effects, nominal, (effect,), is_leaf=lambda v: isinstance(v, tuple))
        true = model.true_motion(x)
        out = []
        for c in filters:
            y = effect.reading(c, true, _changed(c, effect, model, nominal, true, x, y0[c], base, contact))
            w = whiten(y - y0[c], mask[c], filters[c], demean=c == "tendon_excursion")
            out.append(jnp.moveaxis(w, 1, 0).reshape(w.shape[1], -1))
        return jnp.concatenate(out, axis=1).reshape(-1)

    return jax.lax.map(one, effects)


def _changed(c, effect, model, nominal, true, x, y0, base, contact):
    """The channel's prediction with the effect, its sensor apart."""
    if c == "tendon_excursion":
        return y0 + excursion(model, true) - excursion(nominal, x)
    if effect.MOVES_RIGID_BODY:
        full = external_torque if c == "joint_torque" else fingertip_force
        return y0 + full(model, true) - full(nominal, x)
    change = resisting_torque(model, true) - base
    return y0 + (change if c == "joint_torque" else jnp.sum(contact * change[None], axis=1))


_contact = eqx.filter_jit(contact_map)


@dataclass(frozen=True)
class Signatures:
    """Reads signatures off a problem; `nominal` may be another point than the problem's own."""

    problem: Problem
    nominal: Model

    def of(self, members: list[CatalogueEffect]) -> Float[np.ndarray, "members N"]:
        """Whitened change of every row, for effects of one class."""
        out = np.zeros((len(members), self.problem.r.size))
        kind = type(members[0])
        stacked = jax.tree.map(lambda *a: jnp.stack(a), *[_nameless(m) for m in members])
        for e, rows in self.problem.rows.items():
            shown = kind.SHOWS.get(e, ())
            if not shown or not rows.size:
                continue
            stack = self.problem.stacks[e]
            channels = stack.experiment.channels
            contact = _contact(self.nominal, stack.batch.x) if "fingertip_force" in shown else None
            filters = {c: jnp.asarray(self.problem.noise[e, c].coefficients) for c in shown}
            y0 = {c: jnp.asarray(self.problem.predicted[e, c]) for c in shown}
            mask = {c: stack.batch.mask[c] for c in shown}
            flat = np.asarray(_deltas(stacked, self.nominal, stack.batch.x, y0, mask, filters, contact))
            out[:, rows.start : rows.start + rows.size] = _place(flat, rows, channels, shown, stack)
        return out

    def columns(self, variant_list: list[Variant], amplitudes: list[dict[str, float]] | None = None):
        """(variants, amplitudes, N) signatures per unit of plausible size, for variants of one class."""
        effect, finger = variant_list[0].effect, self.nominal.finger
        names = list(effect.AMPLITUDES)
        members = [
            v.at(finger, {n: effect.AMPLITUDES[n][1]}) for v, n in product(variant_list, names)
        ]
        return self.of(members).reshape(len(variant_list), len(names), -1)


def _nameless(effect: CatalogueEffect) -> CatalogueEffect:
    return replace(effect, site=())


def _place(flat, rows, channels, shown, stack):
    """The rows that count, from a block that holds only the channels shown."""
    B, T = stack.batch.x.time.shape
    widths = {c: stack.batch.mask[c].shape[0] for c in channels}
    if tuple(shown) == tuple(channels):
        return flat[:, rows.keep]
    first, offset = {}, 0
    for c in shown:
        first[channels.index(c)] = offset
        offset += widths[c]
    out = np.zeros((len(flat), rows.size))
    inside = np.isin(rows.channel, list(first))
    wide = np.array([first.get(k, 0) for k in range(len(channels))])[rows.channel] + rows.column
    position = np.ravel_multi_index((rows.trial, wide, rows.time), (B, offset, T), mode="clip")
    out[:, inside] = flat[:, position[inside]]
    return out


def by_class(items: list[Variant]) -> dict[str, list[Variant]]:
    """Variants in groups of one class."""
    groups: dict[str, list[Variant]] = {}
    for v in items:
        groups.setdefault(v.effect.ID, []).append(v)
    return groups


def all_columns(signatures: Signatures, items: list[Variant], progress=lambda message: None, threads: int = 2):
    """Signatures of every variant by effect; classes are compiled side by side."""
    groups = by_class(items)
    done = 0

    def work(name):
        return name, signatures.columns(groups[name])

    out = {}
    with ThreadPoolExecutor(threads) as pool:
        for name, columns in pool.map(work, groups):
            out[name] = columns
            done += 1
            progress(f"signatures of {name} ({done} of {len(groups)} effects)")
    return groups, out


__all__ = ["Signatures", "Variant", "all_columns", "by_class", "partial", "variants"]
