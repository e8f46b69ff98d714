"""Signatures: the change of every white row by an effect, at fixed nominal parameters.

Site, shape and amplitude of an effect are arrays, and trials of one kind are stacked whatever their experiment. One
compiled function for each class of effects and kind of prediction therefore serves all sites, shapes and trials. Only
channels that the effect changes are evaluated.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxfinger.compilation import quick_jit
from jaxfinger.effects import CATALOGUE, CatalogueEffect, Changed, Scales, Site, changes, file_of, nominal_terms
from jaxfinger.errors import UserError
from jaxfinger.experiments import TRIALS, affected_channels, change, refuse_broken
from jaxfinger.gap.problem import Problem, Rows
from jaxfinger.identify import Fit, Recipe
from jaxfinger.identify.parameters import describe
from jaxfinger.model import Finger, Model, Motion, Terms

# Share of an effect's signature that it may leave at zero amplitude: more is no rounding.
MAX_ABSENT = 1e-6
CHUNK = 8  # effects of one compiled call. Each needs memory of the size of the channel that it changes.


@dataclass(frozen=True)
class Variant:
    """One effect at one site with one choice of shapes, and the size at which its signature is read."""

    effect: type[CatalogueEffect]
    site: Site
    shape: tuple[tuple[str, float], ...]
    size: float = 1.0  # in plausible sizes of every amplitude
    scales: Scales = field(kw_only=True, compare=False)  # scales of the specimen

    @property
    def key(self) -> tuple[str, Site]:
        """Effect and site, as a verdict names them."""
        return self.effect.ID, self.site

    @property
    def sizes(self) -> dict[str, float]:
        """Plausible size of every amplitude, in its own unit."""
        return self.effect.sizes(self.scales, self.site)

    def with_shape(self, **values: float) -> "Variant":
        """Replace the values of some shapes."""
        return replace(self, shape=tuple((dict(self.shape) | values).items()))

    def at(self, finger: Finger, amplitudes: dict[str, float]) -> CatalogueEffect:
        """Make the effect with these amplitudes, in their own units."""
        return self.effect.at(finger, self.site, **dict(self.shape), **amplitudes)


def catalogue_for(
    recipe: Recipe, own: dict[str, type[CatalogueEffect]] | None, finger: Finger
) -> dict[str, type[CatalogueEffect]]:
    """Effects that may be at work, by id: the catalogue, the terms that a recipe may leave out, and a user's `own`.

    Raises:
        UserError: an effect of the user's fails in a prediction, or changes none.
    """
    for kind in (own or {}).values():
        refuse_broken(kind, finger)
    return CATALOGUE | nominal_terms(recipe.model.elastic_degree, recipe.model.friction_degree) | (own or {})


def changes_of(fit: Fit) -> dict[str, type[CatalogueEffect]]:
    """Effects «changed since an earlier fit», by id, for the groups of parameters that the fit gives an uncertainty."""
    torque, parameters = fit.model.joint_torque, describe(fit.model)
    degrees = torque.elastic.shape[1] - 1, torque.friction.shape[1] - 1, fit.recipe.model.moment_arm_degree
    known = {p.group for p, s in zip(parameters, fit.std, strict=True) if 0.0 < s < np.inf}
    return {
        name: change
        for name, change in changes(*degrees).items()
        if issubclass(change, Changed) and change.GROUP in known
    }


def variants(effects: Mapping[str, type[CatalogueEffect]], finger: Finger, scales: Scales) -> list[Variant]:
    """Variants of every effect: all its sites, shapes worth trying, and sizes."""
    return [
        Variant(effect, site, tuple(shape.items()), size, scales=scales)
        for effect in effects.values()
        for site in effect.sites(finger)
        for shape in effect.shapes(finger, site, scales)
        for size in effect.SIZES
    ]


def placed(items: Sequence[Variant], finger: Finger) -> dict[Site, CatalogueEffect]:
    """The class of some variants at each of their sites, in arrays of NumPy."""
    return jax.device_get({site: v.at(finger, {}) for site, v in {v.site: v for v in items}.items()})


@quick_jit
def _change(
    channel: str,
    effects: CatalogueEffect,
    nominal: Model,
    x: Motion,
    y0: Float[Array, "columns B T"],
    terms: Terms | None,
    contact: Array | None,
    count: Array,
) -> Float[Array, "variants columns B T"]:
    """Change of one channel's prediction by each of the first `count` effects, stacked along their arrays' first axis.

    Rows from `count` on are zero.
    """

    def put(k, out):
        effect = jax.tree.map(lambda a: jax.lax.dynamic_index_in_dim(a, k, keepdims=False), effects)
        one = change(channel, effect, nominal, x, y0, terms, contact)
        return jax.lax.dynamic_update_index_in_dim(out, one, k, 0)

    return jax.lax.fori_loop(0, count, put, jnp.zeros((CHUNK, *y0.shape)))


@dataclass(frozen=True)
class Signatures:
    """Evaluates what effects change in a problem's rows, at its nominal model."""

    problem: Problem

    def white_changes(self, members: list[CatalogueEffect]) -> Float[np.ndarray, "members N"]:
        """Change of every white row by each of some effects of one class."""
        out = np.zeros((len(members), self.problem.r.size))
        for k in range(0, len(members), CHUNK):
            for e, channel, raw in self.changes(members[k : k + CHUNK]):
                rows = self.problem.rows[e]
                number = self.problem.stacks[e].experiment.channels.index(channel)
                of_channel = np.flatnonzero(rows.channel == number)
                with np.errstate(invalid="ignore"):  # A user's effect may be NaN, which is then said.
                    white = whitened(raw, self.problem, rows, of_channel, channel)
                _refuse_no_numbers(members[k : k + CHUNK], white, e, channel)
                out[k : k + CHUNK, rows.start + of_channel] = white
        return out

    def changes(self, members: list[CatalogueEffect]) -> Iterator[tuple[str, str, Float[np.ndarray, "members c B T"]]]:
        """Change of every channel that shows the effects, with its experiment; not whitened, in the channel's unit.

        `members` are effects of one class, CHUNK at most.
        """
        kind, nominal = type(members[0]), self.problem.nominal
        padded = members + members[:1] * (CHUNK - len(members))
        leaves = zip(*map(jax.tree.leaves, padded), strict=True)
        anywhere = jax.tree.structure(replace(jax.device_put(members[0]), site=()))
        stacked = jax.tree.unflatten(anywhere, [np.stack(a) for a in leaves])
        count = jax.device_put(len(members))
        where = affected_channels(kind, nominal.finger)
        for group in self.problem.groups:
            shown = [e for e in group.trials if group.channel in where.get(e, ())]
            if not shown:
                continue
            y0, terms = self.problem.without_effects[group.channel, group.held]
            columns, _, T = y0[0].shape
            raw = np.empty((len(members), columns, len(y0), TRIALS, T))
            # An effect that only resists motion changes the fingertip's force by the joint torques that it adds. The
            # program that computes joint torques then serves for both.
            by_torque = group.channel == "fingertip_force" and not (kind.moves_rigid_body() or kind.reads())
            for b in group.of(shown):
                x, contact = group.x[b], group.contact[b]
                if by_torque:
                    none = jax.device_put(np.zeros(x.q.shape))
                    torque = np.asarray(_change("joint_torque", stacked, nominal, x, none, terms[b], None, count))
                    raw[:, :, b] = np.einsum("dmbt,kmbt->kdbt", np.asarray(contact), torque[: len(members)])
                else:
                    found = _change(group.channel, stacked, nominal, x, y0[b], terms[b], contact, count)
                    raw[:, :, b] = np.asarray(found)[: len(members)]
            raw = raw.reshape(len(members), columns, -1, T)
            for e in shown:
                mine, length = group.trials[e], self.problem.stacks[e].batch.x.time.shape[-1]
                yield e, group.channel, raw[:, :, mine.start : mine.stop, :length]

    def per_amplitude(self, items: list[Variant]) -> Float[np.ndarray, "variants amplitudes N"]:
        """Signatures of variants of one class, for each amplitude alone, in units of its plausible size."""
        names = list(items[0].effect.amplitudes())
        none = dict.fromkeys(names, 0.0)
        there = placed(items, self.problem.nominal.finger)
        members = [
            there[v.site].with_values(**dict(v.shape) | none | {n: v.size * v.sizes[n]})
            for v, n in product(items, names)
        ]
        found = self.white_changes(members).reshape(len(items), len(names), -1)
        found /= np.array([v.size for v in items])[:, None, None]
        return found

    def refuse_odd(self, kind: type[CatalogueEffect], scales: Scales) -> None:
        """Check a user's effect at every site, in one shape and size.

        Raises:
            UserError: it changes a prediction at zero amplitude, or acts alike at two joints.
        """
        finger, file = self.problem.nominal.finger, file_of(kind)
        seen: dict[bytes, Site] = {}
        tried = variants({kind.ID: kind}, finger, scales)[:1]
        for site in kind.sites(finger) if tried else ():
            shape, sizes = dict(tried[0].shape), tried[0].sizes
            members = [kind.at(finger, site, **shape, **size) for size in (sizes, dict.fromkeys(sizes, 0.0))]
            there, absent = self.white_changes(members)
            if np.linalg.norm(absent) > MAX_ABSENT * np.linalg.norm(there):
                raise UserError(
                    f"{file}: {kind.ID} at {'-'.join(site)} changes {self._where(int(np.argmax(np.abs(absent))))} at "
                    "zero amplitude; let its amplitudes multiply all that it does"
                )
            other = seen.setdefault(there.tobytes(), site)
            # Two tendons over one joint may well do the same in these trials.
            if kind.PLACE == "joint" and other != site and there.any():
                raise UserError(
                    f"{file}: {kind.ID} does the same at {'-'.join(other)} and at {'-'.join(site)}; "
                    "let it act at `self.index` alone, or give it a single PLACE"
                )

    def _where(self, row: int) -> str:
        """Channel and experiment of a row."""
        rows = next(x for x in self.problem.rows.values() if row < x.start + x.size)
        channels = self.problem.stacks[rows.experiment].experiment.channels
        return f"{channels[rows.channel[row - rows.start]]} of {rows.experiment}"


def own(kind: type[CatalogueEffect]) -> bool:
    """Whether an effect is a user's, and not one of the catalogue."""
    return not kind.__module__.startswith("jaxfinger.")


def _refuse_no_numbers(
    members: Sequence[CatalogueEffect], white: Float[np.ndarray, "members rows"], experiment: str, channel: str
) -> None:
    """Refuse a user's effect whose prediction is NaN or infinite in a row that counts: no evidence could be weighed."""
    for effect, row in zip(members, white, strict=True):
        if own(type(effect)) and not np.isfinite(row).all():
            values = ", ".join(f"{n} = {v:.3g}" for n, v in effect.values().items())
            raise UserError(
                f"{file_of(type(effect))}: {effect.ID} at {'-'.join(effect.site)} predicts NaN or infinity in "
                f"{channel} of {experiment} with {values}; keep every hook finite at each angle, speed and tension"
            )


def whitened(
    raw: Float[np.ndarray, "members columns B T"],
    problem: Problem,
    rows: Rows,
    of_channel: Int[np.ndarray, " rows"],
    channel: str,
) -> Float[np.ndarray, "members rows"]:
    """Whiten changes of a channel as its residuals are (`noise.whiten`), in its rows `of_channel` of an experiment.

    As in the residuals, the arbitrary zero of an excursion is projected out in every trial.
    """
    column, trial, time = rows.column[of_channel], rows.trial[of_channel], rows.time[of_channel]
    filters = problem.noise[rows.experiment, channel].coefficients[column, rows.history[of_channel]]
    lags = range(filters.shape[1])
    white = np.asarray(sum(filters[:, k] * raw[:, column, trial, time - k] for k in lags))
    if channel == "tendon_excursion":
        constant = filters.sum(axis=1)
        series = trial * raw.shape[1] + column
        count = int(series.max(initial=0)) + 1
        energy = np.bincount(series, constant**2, count)
        share = np.stack([np.bincount(series, constant * w, count) for w in white]) / np.maximum(energy, 1e-300)
        white = white - constant * share[:, series]
    if channel in rows.reversals:
        every = np.zeros((rows.size, len(white)))
        every[of_channel] = white.T
        white = white + (rows.reversals[channel] @ every)[of_channel].T
    return white
