"""Many sessions fitted in one compiled call: forty specimens of a lab, or hundreds of simulated sessions.

All members share the protocol, the recipe and the rig's noise with one session that was identified by itself (the
template); the links of each are its own. Each is then a Gauss–Newton iteration of the whole staged fit in the
coordinates of the template, in which every stage's matrix is near the identity: a handful of products of small matrices
an iteration (see `resample`). A member that fails or does not converge is named and leaves the rest as they are.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.experiments import EXPERIMENTS, Batch, prepare
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.linearise import Filters, white_rows
from jaxfinger.identify.parameters import Free, describe, ravel, with_flat
from jaxfinger.identify.resample import Batching, Compressed, batching_here, compress, plan_of, staged_step
from jaxfinger.identify.solve import SMALL
from jaxfinger.identify.stages import nominal_model
from jaxfinger.model import Model

STEPS = 12
TANGENTS = 8  # columns of a Jacobian at a time: more do not fit into the processor's cache
AT_ONCE = 10  # sessions in one call: while the device fits them, the next are read and filtered


@dataclass(frozen=True)
class Members:
    """Fits of many sessions."""

    values: Float[np.ndarray, "S P"]  # flat vectors; NaN where a member failed
    std: Float[np.ndarray, "S P"]
    failed: Bool[np.ndarray, " S"]  # did not converge, or holds data that no fit can take
    steps: np.ndarray  # Gauss–Newton steps of each
    template: Fit

    def model(self, k: int) -> Model:
        """The model of one member."""
        return with_flat(self.template.model, jnp.asarray(self.values[k]))


class _Source(NamedTuple):
    """One experiment of all members, and how it is read."""

    batch: Batch  # every array with the members first
    filters: Filters
    basis: Float[Array, "k c"]  # rows of the basis for the parameters that the experiment depends on
    columns: Int[Array, " c"]  # coordinates that move any of them
    free: Free
    reads: Float[Array, " S"]
    counts: Int[Array, " r"]  # rows of the trials' measured columns
    affine: bool  # in the parameters, so that one linearisation is exact


def fit_many(sessions: Sequence[Session], template: Fit, of: Session, batching: Batching | None = None) -> Members:
    """Fit every session as the template was fitted to the session `of`.

    Raises:
        UserError: a session has another protocol than the template's, or other joints or tendons.
    """
    if not sessions:
        empty = np.zeros((0, ravel(template.model).size))
        return Members(empty, empty, np.zeros(0, bool), np.zeros(0, int), template)
    compressed = compress(of, template)
    prior = (compressed.grams.H[-1], compressed.grams.reads[:, -1])
    basis, how = jnp.asarray(compressed.basis), batching_here(batching)
    shared = nominal_model(of, template.recipe)
    starts = [_start(s, template, shared) for s in sessions]
    at_once = min(len(sessions), AT_ONCE)
    with ThreadPoolExecutor(1) as device:
        shares = []
        for first in range(0, len(sessions), at_once):
            members = [k % len(sessions) for k in range(first, first + at_once)]  # every share has one length
            sources = _stack_sessions([sessions[k] for k in members], template, compressed)
            start = jnp.stack([starts[k] for k in members])
            shares.append(device.submit(_fit_all, template.model, start, sources, basis, compressed.sizes, prior, how))
    columns = zip(*(s.result() for s in shares), strict=True)
    values, std, sound, steps = (np.concatenate(a)[: len(sessions)] for a in columns)
    values[~sound], std[~sound] = np.nan, np.nan
    return Members(values, std, ~sound, steps, template)


def _start(session: Session, template: Fit, shared: Model) -> Float[Array, " P"]:
    """The template's flat vector with the session's own links for the shared ones; CAD's prior then moves with them."""
    own = nominal_model(session, template.recipe)
    if jax.tree.structure(own) != jax.tree.structure(shared):
        raise UserError(
            f"{session.file or session.specimen}: has not the joints and tendons of the other sessions; fit it alone"
        )
    return ravel(template.model) + ravel(own) - ravel(shared)


def _stack_sessions(sessions: Sequence[Session], template: Fit, compressed: Compressed) -> tuple[_Source, ...]:
    plan = plan_of(sessions[0], template)
    reads = {e: c for r, _ in plan for e, c in r.items()}
    prepared = [prepare(s, [t.name for t in s if t.experiment in reads]) for s in sessions]
    parameters = describe(template.model)
    links = {int(i) for i in template.estimated if parameters[i].group in ("mass", "com")}
    out = []
    for e, positions in compressed.positions.items():
        batches = []
        for s, stacks in zip(sessions, prepared, strict=True):
            if e not in stacks or len(stacks[e].trials) != len(prepared[0][e].trials):
                raise UserError(f"{s.file or s.specimen}: has not the {e} trials of the other sessions; fit it alone")
            batches.append(stacks[e].batch)
        T = max(b.x.time.shape[-1] for b in batches)
        whole = jax.tree.map(lambda *a: jnp.stack(a), *(_padded(b, T) for b in batches))
        columns = np.flatnonzero(np.any(compressed.basis[positions] != 0.0, axis=0))
        filters = {c: jnp.asarray(template.noise[e, c].coefficients) for c in reads[e]}
        out.append(
            _Source(
                whole,
                filters,
                jnp.asarray(compressed.basis[np.ix_(positions, columns)]),
                jnp.asarray(columns),
                Free.at(template.model, positions),
                jnp.array([float(e in r) for r, _ in plan]),
                jnp.asarray(_measured_rows([whole.mask[c] for c in filters])),
                not links.intersection(positions.tolist()) and _is_affine(e, reads[e], template.model),
            )
        )
    return tuple(out)


def _measured_rows(masks: list[Float[Array, "S columns B T"]]) -> Int[np.ndarray, " r"]:
    """Positions, in the order of `white_rows`, of the columns that a trial of any session has measured."""
    some = np.concatenate([np.asarray(m).any(axis=(0, 3)) for m in masks])  # (columns of all channels, B)
    return np.flatnonzero(np.repeat(some.T[..., None], masks[0].shape[-1], axis=-1))


def _is_affine(experiment: str, channels: tuple[str, ...], model: Model) -> bool:
    """Excursions and the torques of slack tendons are in the parameters, where no link (m times c) is free."""
    return not model.effects and (EXPERIMENTS[experiment].slack or channels == ("tendon_excursion",))


def _padded(batch: Batch, T: int) -> Batch:
    """Longer by samples that do not count."""
    more = T - batch.x.time.shape[-1]

    def pad(a, mode):
        return jnp.asarray(np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, more)], mode=mode))

    x = jax.tree.map(lambda a: pad(a, "edge"), batch.x)
    return Batch(x, *({c: pad(v, "constant") for c, v in d.items()} for d in (batch.y, batch.mask)))


@eqx.filter_jit
def _fit_all(model, starts, sources, basis, sizes, prior, batching):
    def one(member):
        start, batches = member
        own = [s._replace(batch=b) for s, b in zip(sources, batches, strict=True)]
        return _fit(model, start, own, basis, sizes, prior)

    members = (starts, [s.batch for s in sources])
    return jax.lax.map(one, members) if batching == "map" else jax.vmap(one)(members)


def _fit(model: Model, start: Float[Array, " P"], sources: list[_Source], basis, sizes, prior):
    """Gauss–Newton on all stages at once, θ = θ_start + basis z, until nothing moves by more than SMALL."""
    (prior_gram, prior_reads), q = prior, basis.shape[1]

    def grams(z, of: list[_Source]):
        """H of every stage at z, from some of the experiments."""
        H = jnp.zeros((prior_reads.size, q + 1, q + 1))
        at = with_flat(model, start + basis @ z)
        for s in of:
            own = jnp.append(s.columns, q)
            H = H.at[:, own[:, None], own].add(s.reads[:, None, None] * _gram(at, s))
        return H

    affine = prior_reads[:, None, None] * prior_gram + grams(jnp.zeros(q), [s for s in sources if s.affine])

    def stages(z):
        """H of every stage at z; residuals that are affine in z have moved with it."""
        shift = jnp.eye(q + 1).at[:-1, -1].set(z)
        return shift.T @ affine @ shift + grams(z, [s for s in sources if not s.affine])

    def step(state):
        z, _, _, k, _ = state
        dz, covariance, sound = staged_step(stages(z), sizes, jnp.zeros(sizes[0]))
        return z + dz, covariance, jnp.max(jnp.abs(dz)), k + 1, sound & jnp.all(jnp.isfinite(dz))

    def going(state):
        _, _, size, k, sound = state
        return sound & (size > SMALL) & (k < STEPS)

    start_state = (jnp.zeros(q), jnp.zeros((q, q)), jnp.inf, 0, jnp.array(True))
    z, covariance, size, k, sound = jax.lax.while_loop(going, step, start_state)
    variance = jnp.sum((basis @ covariance) * basis, axis=1)
    return start + basis @ z, jnp.sqrt(jnp.maximum(variance, 0.0)), sound & (size <= SMALL), k


def _gram(model: Model, source: _Source) -> Float[Array, "c+1 c+1"]:
    """[J r]ᵀ[J r] of one experiment, J in the coordinates that bear on it."""
    theta = source.free.get(model)

    def rows(dz):
        return white_rows(source.free.set(model, theta + source.basis @ dz), source.batch, source.filters)[1].ravel()[
            source.counts
        ]

    r, push = jax.linearize(rows, jnp.zeros(source.basis.shape[1]))
    A = jnp.concatenate([jax.lax.map(push, jnp.eye(source.basis.shape[1]), batch_size=TANGENTS), r[None]])
    return A @ A.T
