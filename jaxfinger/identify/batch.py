"""Fits of many sessions in one compiled program: specimens of a lab, or simulated sessions.

All sessions (the members) share the protocol, the recipe and the noise of one session that was identified by itself,
the template. Each member starts from the template's parameters with links of its own, whose standard deviations are
its own, too, and runs the stages of `identify` in order, by the same solver on the same rows, through
`optimistix.least_squares`. A member that fails or does not converge is reported and does not change the others.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxfinger.compilation import one_blas_thread, quick_jit
from jaxfinger.data import Session
from jaxfinger.errors import UserError, require
from jaxfinger.experiments import Batch
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.gauss_newton import TANGENTS_AT_ONCE, VisibleGaussNewton
from jaxfinger.identify.linearise import Filters, robust_residuals, white_rows
from jaxfinger.identify.nominal import cad_covariance, cad_prior, nominal_model
from jaxfinger.identify.parameters import Free, Parameter, describe, ravel, with_flat
from jaxfinger.identify.readings import readings_of
from jaxfinger.identify.resample import (
    Batching,
    Compressed,
    Plan,
    batching_here,
    compress,
    plan_of,
    prior_block,
    staged_step,
    variance_parts,
    variances,
)
from jaxfinger.identify.solve import KINK_TOLERANCE, MAX_STEPS, STEP_TOLERANCE, parameter_bounds
from jaxfinger.identify.sources import sources_of
from jaxfinger.model import Model

SESSIONS_AT_ONCE = 10  # in one call, so that the next sessions are read and filtered while the device fits these
SOLVER = VisibleGaussNewton(atol=STEP_TOLERANCE, kink=KINK_TOLERANCE)


@dataclass(frozen=True, repr=False)
class Members:
    """Fits of S sessions."""

    values: Float[np.ndarray, "S P"]  # flat vectors; NaN where a member failed
    # The part from the noise is widened as much as the template's is (`intervals`); infinite where the template's are.
    std: Float[np.ndarray, "S P"]
    failed: Bool[np.ndarray, " S"]  # did not converge, or its trials do not determine all parameters
    steps: Int[np.ndarray, " S"]  # linearisations of each member, summed over stages
    template: Fit

    def __repr__(self) -> str:
        count, failed = len(self.failed), np.count_nonzero(self.failed)
        return f"Members({count} fit{'s' * (count != 1)} by recipe {self.template.recipe.name!r}: {failed} failed)"

    def model(self, k: int) -> Model:
        """Model of member `k`."""
        return with_flat(self.template.model, jnp.asarray(self.values[k]))


class _Source(eqx.Module):
    """One experiment of all members, with the parameters and coordinates that it depends on."""

    batch: Batch  # members along the first axis of every array
    filters: Filters
    free: Free  # parameters that it depends on
    columns: Int[Array, " k"]  # their positions in the flat vector
    counts: Int[Array, " r"]  # rows of columns that some member measured
    basis: Float[Array, "k c"]  # their part of the basis of `resample`
    coordinates: Int[Array, " c"]  # numbers of the coordinates of `resample` that move any of them

    def rows(
        self, model: Model, flat: Float[Array, " P"], limit: float | Float[Array, ""]
    ) -> Float[Array | np.ndarray, " r"]:
        """White residuals under Huber's cost."""
        at = self.free.set(model, flat[self.columns])
        return robust_residuals(white_rows(at, self.batch, self.filters)[1].ravel()[self.counts], limit)


class _Stage(eqx.Module):
    """Free parameters of a stage, the experiments that it reads, its prior and its bounds."""

    reads: tuple[int, ...] = eqx.field(static=True)  # indices of the sources that it reads
    affine: tuple[bool, ...] = eqx.field(static=True)  # whether each of them is affine in the free parameters
    free: Int[Array, " p"]  # positions in the flat vector
    mean: Float[Array, "S p"]  # of the prior
    root: Float[Array, "S k p"]
    low: Float[Array, "S p"]
    high: Float[Array, "S p"]


class _Described(eqx.Module):
    """What the standard deviations of each member's description say of the q coordinates of `resample`."""

    scale: Float[Array, "S q"]  # of a value that is given: its standard deviation over that of the template's session
    prior: Float[Array, "S q+1 q+1"]  # Gram matrix of the prior's rows


@one_blas_thread
def fit_many(sessions: Sequence[Session], template: Fit, of: Session, batching: Batching | None = None) -> Members:
    """Fit every session as `template` was fitted to the session `of`.

    `batching`: as in `resample.refit`.

    >>> import jaxfinger as jf
    >>> session, fit = jf.read("session.h5"), jf.load("fit.json")
    >>> jf.fit_many([session, session], fit, of=session)
    Members(2 fits by recipe 'emps': 0 failed)

    Raises:
        UserError: a session has another protocol than the template's, other joints or tendons, or a description that
            gives standard deviations of other values.
    """
    require(Fit, template=template)
    require(Session, of=of, **{f"session {k} of those to fit": s for k, s in enumerate(sessions)})
    if not sessions:
        empty = np.zeros((0, ravel(template.model).size))
        return Members(empty, empty, np.zeros(0, bool), np.zeros(0, int), template)
    compressed, how = compress(of, template), batching_here(batching)
    coordinates = jnp.asarray(compressed.basis), compressed.sizes, compressed.grams.reads
    shared = nominal_model(of, template.recipe)
    starts = [_start(s, template, shared, of) for s in sessions]
    at_once = min(len(sessions), SESSIONS_AT_ONCE)
    with ThreadPoolExecutor(1) as device:
        shares = []
        for first in range(0, len(sessions), at_once):
            members = [k % len(sessions) for k in range(first, first + at_once)]  # always as many
            start = jnp.stack([starts[k] for k in members])
            chosen = [sessions[k] for k in members]
            work = _stack_sessions(chosen, template, compressed, start)
            limit = jnp.asarray(template.recipe.fit.huber)
            shares.append(device.submit(_fit_all, template.model, start, *work, coordinates, limit, how))
    columns = zip(*(s.result() for s in shares), strict=True)
    values, parts, sound, steps = (np.concatenate(a)[: len(sessions)] for a in columns)
    noise, given = variances(compressed)
    wider = np.maximum(template.std**2 - given, 0.0)
    std = np.sqrt(parts[:, 0] * np.divide(wider, noise, out=np.ones_like(noise), where=noise > 0.0) + parts[:, 1])
    values[~sound], std[~sound] = np.nan, np.nan
    std[np.ix_(sound, ~np.isfinite(template.std))] = np.inf
    return Members(values, std, ~sound, steps, template)


def _start(session: Session, template: Fit, shared: Model, of: Session) -> Float[Array | np.ndarray, " P"]:
    """Flat vector from which a session starts: the template's, with the links of the session's own description."""
    own = nominal_model(session, template.recipe)
    if jax.tree.structure(own) != jax.tree.structure(shared):
        raise UserError(
            f"{session.file or session.specimen}: has not the joints and tendons of the other sessions; fit it alone"
        )
    parameters = describe(template.model)
    here, there = (np.diag(cad_covariance(s, parameters)) > 0.0 for s in (session, of))
    if np.any(here != there):
        name = parameters[int(np.argmax(here != there))].name
        raise UserError(
            f"{session.file or session.specimen}: /finger: only one of this session and of the template's gives a "
            f"standard deviation of {name}; give it in both, or fit this one alone"
        )
    return ravel(template.model) + ravel(own) - ravel(shared)


def _stack_sessions(
    sessions: Sequence[Session], template: Fit, compressed: Compressed, starts: Float[Array, "S P"]
) -> tuple[tuple[_Source, ...], tuple[_Stage, ...], _Described]:
    plan, parameters = plan_of(sessions[0], template), describe(template.model)
    reads = {e: c for r, _ in plan for e, c in r.items()}
    prepared = [readings_of(s, [t.name for t in s if t.experiment in reads]) for s in sessions]
    reads = {e: c for e, c in reads.items() if e in compressed.positions}
    for s, stacks in zip(sessions, prepared, strict=True):
        for e in reads:
            if e not in stacks or len(stacks[e].trials) != len(prepared[0][e].trials):
                raise UserError(f"{s.file or s.specimen}: has not the {e} trials of the other sessions; fit it alone")
    single = sources_of(prepared[0], reads, template.noise, parameters)
    sources = []
    for e, source in single.items():
        batches = [stacks[e].batch for stacks in prepared]
        T = max(b.x.time.shape[-1] for b in batches)
        whole = jax.tree.map(lambda *a: jnp.stack(a), *(_padded(b, T) for b in batches))
        moving = np.flatnonzero(np.any(compressed.basis[source.positions] != 0.0, axis=0))
        sources.append(
            _Source(
                whole,
                source.filters,
                Free.at(template.model, source.positions),
                jnp.asarray(source.positions),
                jnp.asarray(_measured_rows([whole.mask[c] for c in source.filters])),
                jnp.asarray(compressed.basis[np.ix_(source.positions, moving)]),
                jnp.asarray(moving),
            )
        )
    stages, names = [], list(single)
    for of_stage, free in plan:
        mine = [e for e in names if e in of_stage]
        priors = [cad_prior(s, template.recipe, parameters, free) for s in sessions]
        ends = [parameter_bounds(with_flat(template.model, start), free) for start in starts]
        low, high = (jnp.asarray(np.stack(side)) for side in zip(*ends, strict=True))
        stages.append(
            _Stage(
                tuple(names.index(e) for e in mine),
                tuple(single[e].is_affine(template.model, free) for e in mine),
                jnp.asarray(free),
                jnp.asarray(np.stack([p.mean for p in priors])),
                jnp.asarray(np.stack([p.root for p in priors])),
                low,
                high,
            )
        )
    return tuple(sources), tuple(stages), _described(sessions, template, compressed, plan, parameters)


def _described(
    sessions: Sequence[Session], template: Fit, compressed: Compressed, plan: Plan, parameters: list[Parameter]
) -> _Described:
    """What the sessions' descriptions say, one row a session."""
    basis, k = compressed.basis, compressed.sizes[0]
    at = basis[:, :k].argmax(axis=0)  # positions of the values that are given, of which each column holds one
    priors, scales = [], []
    for s in sessions:
        rows, scale = prior_block(s, template, plan, parameters), np.ones(basis.shape[1])
        M = np.column_stack([rows[:, :-1] @ basis, rows[:, -1]])
        scale[:k] = np.sqrt(np.diag(cad_covariance(s, parameters))[at]) / basis[at, np.arange(k)]
        priors.append(M.T @ M)
        scales.append(scale)
    return _Described(jnp.asarray(np.stack(scales)), jnp.asarray(np.stack(priors)))


def _measured_rows(masks: list[Float[Array, "S _columns B T"]]) -> Int[np.ndarray, " r"]:
    """Positions, in the order of `white_rows`, of the rows of columns that any session measured."""
    some = np.concatenate([np.asarray(m).any(axis=(0, 3)) for m in masks])  # (columns of all channels, B)
    return np.flatnonzero(np.repeat(some.T[..., None], masks[0].shape[-1], axis=-1))


def _padded(batch: Batch, T: int) -> Batch:
    """Pad a batch to T samples; the added ones have mask 0."""
    more = T - batch.x.time.shape[-1]

    def pad(a, mode):
        return jnp.asarray(np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, more)], mode=mode))

    x = jax.tree.map(lambda a: pad(a, "edge"), batch.x)
    return Batch(x, *({c: pad(v, "constant") for c, v in d.items()} for d in (batch.y, batch.mask)))


@quick_jit
def _fit_all(model, starts, sources, stages, described, coordinates, limit, batching):
    def one(member):
        start, batches, known, own_description = member
        own = [eqx.tree_at(lambda s: s.batch, s, b) for s, b in zip(sources, batches, strict=True)]
        theirs = [eqx.tree_at(of_each, s, k) for s, k in zip(stages, known, strict=True)]
        return _fit(model, start, own, theirs, own_description, coordinates, limit)

    def of_each(stage: _Stage):
        return stage.mean, stage.root, stage.low, stage.high

    members = (starts, [s.batch for s in sources], [of_each(s) for s in stages], described)
    return jax.lax.map(one, members) if batching == "map" else jax.vmap(one)(members)


def _fit(
    model: Model,
    start: Float[Array, " P"],
    sources: list[_Source],
    stages: list[_Stage],
    described: _Described,
    coordinates,
    limit,
):
    """Run the stages of one member in order, then compute its covariance."""
    model = with_flat(model, start)  # the member's own links
    flat, sound, steps = start, jnp.array(True), jnp.array(0)
    for stage in stages:
        found = _fit_stage(model, flat, sources, stage, limit)
        flat = flat.at[stage.free].set(found.value)
        sound &= found.result == optx.RESULTS.successful
        steps += found.stats["linearisations"]
    covariance, seen = _covariance(model, flat, sources, stages, described, coordinates, limit)
    basis, sizes, _ = coordinates
    variances = variance_parts(basis * described.scale[None], covariance, sizes[0])
    return flat, variances, sound & seen & jnp.all(jnp.isfinite(flat)), steps


def _fit_stage(model: Model, flat: Float[Array, " P"], sources: list[_Source], stage: _Stage, limit):
    """Fit one stage; experiments that are affine in the free parameters are linearised once, r + J δ."""
    start, mine = flat[stage.free], [sources[k] for k in stage.reads]

    def white(y, of: list[_Source]):
        return [s.rows(model, flat.at[stage.free].set(y), 0.0) for s in of]

    affine = [s for s, is_affine in zip(mine, stage.affine, strict=True) if is_affine]
    curved = [s for s, is_affine in zip(mine, stage.affine, strict=True) if not is_affine]
    along = []  # r and J of the affine sources
    if affine:
        r, push = jax.linearize(lambda y: jnp.concatenate(white(y, affine)), start)
        along = [(r, jax.lax.map(push, jnp.eye(start.size), batch_size=TANGENTS_AT_ONCE).T)]

    def rows(y, _):
        moved = [r + J @ (y - start) for r, J in along]
        return robust_residuals(jnp.concatenate([*moved, *white(y, curved)]), limit), stage.root @ (y - stage.mean)

    linear_beyond = jnp.where(limit > 0.0, limit, jnp.inf), jnp.inf
    options = {"lower": stage.low, "upper": stage.high, "linear_beyond": linear_beyond}
    return optx.least_squares(rows, SOLVER, start, None, options, max_steps=MAX_STEPS, throw=False)


def _covariance(
    model: Model,
    flat: Float[Array, " P"],
    sources: list[_Source],
    stages: list[_Stage],
    described: _Described,
    coordinates,
    limit,
):
    """Covariance at the optimum of the coordinates of `resample`, in units of `described.scale`.

    Returns:
        The covariance, and whether the trials determine all of the coordinates.
    """
    basis, sizes, reads = coordinates
    q, last = basis.shape[1], reads[:, -1]
    H = last[:, None, None] * described.prior[None]
    for k, s in enumerate(sources):
        gram = _gram(model, flat, s, limit)
        own = jnp.append(s.coordinates, q)
        of_stage = jnp.array([float(k in stage.reads) for stage in stages])
        H = H.at[:, own[:, None], own].add(of_stage[:, None, None] * gram[None])
    units = jnp.append(described.scale, 1.0)
    H = H * (units[:, None] * units[None])[None]
    _, covariance, sound = staged_step(H, sizes, jnp.zeros(sizes[0]))
    return covariance, sound


def _gram(model: Model, flat: Float[Array, " P"], source: _Source, limit) -> Float[Array, "w w"]:
    """Gram matrix [J r]ᵀ[J r] of one experiment, with J by the c coordinates that move it, w = c + 1."""

    def rows(dz):
        return source.rows(model, flat.at[source.columns].add(source.basis @ dz), limit)

    r, push = jax.linearize(rows, jnp.zeros(source.basis.shape[1]))
    A = jnp.concatenate([jax.lax.map(push, jnp.eye(source.basis.shape[1]), batch_size=TANGENTS_AT_ONCE), r[None]])
    return A @ A.T
