"""Refits of a fit's own trials under other weights, all in one compiled call.

At the optimum each trial b is compressed to a triangular factor [R_b d_b] (`linearise`). Let B_s be the basis of the
combinations visible to stage s (`gauss_newton`). With trial weights w_b, the stage changes its parameters by B_s z_s,

    H_s = Σ_b w_b [R_b B_1 … R_b B_s d_b]ᵀ [R_b B_1 … R_b B_s d_b]
    z_s = −H_s[s, s]⁻¹ (H_s[s, d] + Σ_{t<s} H_s[s, t] z_t),

so that the errors of a stage propagate to the next as in the fit itself, and a refit costs a sum of small matrices. In
these coordinates H_s[s, s] is near the identity, so that Gram matrices are well conditioned. z_0 is given, not solved
for: errors, in standard deviations, of what CAD gives and no stage estimates.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxfinger.compilation import quick_jit
from jaxfinger.data import Session
from jaxfinger.errors import UserError
from jaxfinger.experiments import Stack
from jaxfinger.identify.fit import Fit
from jaxfinger.identify.joint import JOINT, joint_channels
from jaxfinger.identify.linearise import linearise, triangular
from jaxfinger.identify.nominal import cad_covariance, cad_prior
from jaxfinger.identify.parameters import Free, Parameter, describe, ravel
from jaxfinger.identify.readings import readings_of
from jaxfinger.identify.shooting import AHEAD
from jaxfinger.identify.solve import visible
from jaxfinger.identify.sources import Source, sources_of
from jaxfinger.identify.stages import STAGES, stage_free
from jaxfinger.identify.trial_coverage import coverage_of

Batching = Literal["map", "vmap"]
# For each stage the channels that it reads, by experiment, and the positions of the parameters that it estimates.
Plan = list[tuple[dict[str, tuple[str, ...]], Int[np.ndarray, " _p"]]]
# Smallest pivot of a Cholesky factor of H_s[s, s], which is the identity where all weights are 1. A smaller one means
# that a standard deviation would grow by 10⁴: the weighted trials do not determine the combination.
MIN_PIVOT = 1e-4


class Grams(NamedTuple):
    """Gram matrices of the compressed trials in the q coordinates of the stages; the last column is the residual."""

    H: Float[Array, "K q+1 q+1"]  # one for each trial, then the prior's, whose weight is always 1
    reads: Float[Array, "S K"]  # 1 where a stage reads a trial


@dataclass(frozen=True)
class Compressed:
    """A fit's trials, compressed for refits under other weights."""

    grams: Grams
    sizes: tuple[int, ...]  # number of coordinates: those given (z_0), then those of each stage
    basis: Float[np.ndarray, "P q"]  # δθ = basis z
    theta: Float[np.ndarray, " P"]  # the fit's flat vector
    positions: dict[str, Int[np.ndarray, " _k"]]  # in the flat vector, of what each experiment depends on
    information: Float[np.ndarray, "P P"]  # JᵀJ of all trials, without priors
    trials: tuple[str, ...]
    strata: tuple[tuple, ...]  # experiment, joint and tendon of each trial; trials of one stratum are exchangeable


def compress(session: Session, fit: Fit) -> Compressed:
    """Linearise and compress the trials of `session`, from which the fit was made; no later step reads samples."""
    parameters = describe(fit.model)
    plan, stacks, sources = read_again(session, fit)
    P = len(parameters)
    blocks, trials = [], []
    for e, source in sources.items():
        at = Free.at(fit.model, source.positions)
        factor = linearise(fit.model, at, source.batch, source.filters, fit.recipe.fit.huber).factor
        block = np.zeros((*factor.shape[:2], P + 1))
        block[..., [*source.positions, P]] = factor
        blocks += list(block)
        trials += [(e, t) for t in stacks[e].trials]

    information = sum(b[:, :-1].T @ b[:, :-1] for b in blocks)
    prior = prior_block(session, fit, plan, parameters)
    blocks.append(prior)
    reads = np.array([[*(float(e in r) for e, _ in trials), 1.0] for r, _ in plan])
    bases = [_given(session, plan, parameters)]
    for k, (_, free) in enumerate(plan):
        A = np.concatenate([b[:, free] for b, w in zip(blocks, reads[k], strict=True) if w])
        basis = np.zeros((P, 0))
        if A.size:
            small, _ = visible(triangular(A))
            basis = np.zeros((P, small.shape[1]))
            basis[free] = small
        bases.append(basis)
    basis = np.concatenate(bases, axis=1)
    M = [np.column_stack([b[:, :-1] @ basis, b[:, -1]]) for b in blocks]
    return Compressed(
        Grams(jnp.asarray(np.stack([m.T @ m for m in M])), jnp.asarray(reads)),
        tuple(b.shape[1] for b in bases),
        basis,
        np.asarray(ravel(fit.model)),
        {e: source.positions for e, source in sources.items()},
        np.asarray(information),
        tuple(t for _, t in trials),
        tuple((e, session[t].joint, session[t].tendon) for e, t in trials),
    )


def read_again(session: Session, fit: Fit) -> tuple[Plan, dict[str, Stack], dict[str, Source]]:
    """Read the trials of a fit anew.

    Returns:
        The plan, without experiments of which the session has no trial, and the stacks and sources of the others.

    Raises:
        UserError: as `plan_of`.
    """
    plan = plan_of(session, fit)
    names = [t.name for t in session if any(t.experiment in reads for reads, _ in plan)]
    stacks = readings_of(session, names, model=fit.model)
    plan = [({e: c for e, c in reads.items() if e in stacks}, free) for reads, free in plan]
    everything = {e: c for reads, _ in plan for e, c in reads.items()}
    return plan, stacks, sources_of(stacks, everything, fit.noise, describe(fit.model))


def plan_of(session: Session, fit: Fit) -> Plan:
    """What each stage of a fit reads and estimates.

    A stage is left out where later ones estimate all of its parameters again.

    Raises:
        UserError: the session lacks the trials of a stage; or the fit was refined with `ahead`, whose simulations
            cannot be refitted, or by a diagnosis, whose weights differ; or no stage was fitted.
    """
    parameters, file = describe(fit.model), session.file or "the session"
    done = [s.name for s in fit.stages if s.status != "skipped"]
    if not done:
        raise UserError(f"{file}: no stage of the fit was fitted, so no parameter depends on a trial")
    if done[-1] == AHEAD:
        raise UserError(f"{file}: the fit was refined with --ahead; give one without it")
    if done[-1] != JOINT and not {*STAGES, JOINT, AHEAD}.issuperset(done):
        raise UserError(f"{file}: the fit is one of a diagnosis; give one that `identify` or `fit joint` wrote")
    experiments = fit.recipe.fit.joint_experiments
    needed = experiments if JOINT in done else [name for name in done if name in STAGES]
    lacking = [e for e in needed if all(t.experiment != e for t in session)]
    if JOINT in done and len(lacking) < len(needed):
        lacking = []  # The refinement was made from what there is.
    if lacking and ", " not in fit.data:  # Stages of a fit of several sessions may have read another one.
        said = f"has no {lacking[0]} trial, and the fit was made from some"
        raise UserError(f"{file}: {said}; give the session of the fit")
    if JOINT in done:
        return [({e: joint_channels(e) for e in experiments}, fit.estimated)]
    coverage = {name: coverage_of(STAGES[name].reads, session) for name in done}
    plan = [(STAGES[n].reads, stage_free(fit, STAGES[n], parameters, coverage[n])) for n in done]
    later = [np.concatenate([np.zeros(0, int), *(f for _, f in plan[k + 1 :])]) for k in range(len(plan))]
    return [p for p, after in zip(plan, later, strict=True) if not np.isin(p[1], after).all()]


def prior_block(
    session: Session, fit: Fit, plan: Plan, parameters: list[Parameter]
) -> Float[np.ndarray, "rows {len(parameters)}+1"]:
    """Rows [root, root (θ − mean)] of the description's prior on the estimated parameters, at the fit."""
    free = np.unique(np.concatenate([f for _, f in plan]))
    prior = cad_prior(session, fit.recipe, parameters, free)
    rows = np.zeros((len(prior.root), len(parameters) + 1))
    rows[:, free] = prior.root
    rows[:, -1] = prior.root @ (np.asarray(ravel(fit.model))[free] - prior.mean)
    return rows


def _given(session: Session, plan: Plan, parameters: list[Parameter]) -> Float[np.ndarray, "P k"]:
    """Basis of z_0: one standard deviation of each parameter that the description gives and no stage estimates."""
    std = np.sqrt(np.diag(cad_covariance(session, parameters)))
    std[np.concatenate([free for _, free in plan])] = 0.0
    return np.diag(std)[:, std > 0]


def refit(
    compressed: Compressed,
    weights: Float[np.ndarray, "R K"],
    given: Float[np.ndarray, "R k"] | None = None,
    batching: Batching | None = None,
) -> tuple[Float[np.ndarray, "R P"], Bool[np.ndarray, " R"]]:
    """Refit the trials under each row of weights.

    `weights`: of R refits and K trials. `given`: z_0 of each refit, in standard deviations (default zero).
    `batching`: refits run one after another (`map`, best on a CPU) or in lockstep (`vmap`, best on a GPU); the default
    suits the device.

    Returns:
        Flat vectors (R, P) in SI units, NaN where a refit failed, and which of them failed (R,).
    """
    weights = np.concatenate([weights, np.ones((len(weights), 1))], axis=1)
    if given is None:
        given = np.zeros((len(weights), compressed.sizes[0]))
    members = (jnp.asarray(weights), jnp.asarray(given))
    z, sound = _refit_all(compressed.grams, compressed.sizes, members, batching_here(batching))
    theta = compressed.theta + np.asarray(z) @ compressed.basis.T
    failed = ~np.asarray(sound)
    theta[failed] = np.nan
    return theta, failed


def variances(compressed: Compressed) -> Float[np.ndarray, "2 P"]:
    """Variances in SI units of all trials' fit: those that their noise alone makes, and those that z_0 makes."""
    covariance = np.asarray(_covariance(compressed.grams, compressed.sizes))
    return np.asarray(variance_parts(compressed.basis, covariance, compressed.sizes[0]))


def variance_parts(
    basis: Float[Array | np.ndarray, "P q"], covariance: Float[Array | np.ndarray, "q q"], given: int
) -> Float[Array | np.ndarray, "2 P"]:
    """Variances that noise makes, and those that the `given` coordinates z_0 make, which are independent of it."""
    xp = basis.__array_namespace__()
    inherited = xp.sum((basis @ covariance[:, :given]) ** 2, axis=1)  # the covariance of z_0 is the identity
    return xp.stack([xp.maximum(xp.sum((basis @ covariance) * basis, axis=1) - inherited, 0.0), inherited])


def batching_here(batching: Batching | None) -> Batching:
    """The batching asked for, else the one that suits the device."""
    return batching or ("map" if jax.default_backend() == "cpu" else "vmap")


@quick_jit
def _refit_all(grams: Grams, sizes: tuple[int, ...], members: tuple[Array, Array], batching: Batching):
    def one(member):
        return _refit(grams, sizes, *member)

    return jax.lax.map(one, members) if batching == "map" else jax.vmap(one)(members)


@quick_jit
def _covariance(grams: Grams, sizes: tuple[int, ...]) -> Float[Array, "q q"]:
    return staged_step(jnp.tensordot(grams.reads, grams.H, 1), sizes, jnp.zeros(sizes[0]))[1]


def _refit(grams: Grams, sizes: tuple[int, ...], weights: Float[Array, " K"], given: Float[Array, " k"]):
    H = jnp.tensordot(grams.reads * weights[None], grams.H, 1)
    z, _, sound = staged_step(H, sizes, given)
    return z, sound & jnp.all(jnp.isfinite(z))


def staged_step(
    H: Float[Array, "S r r"], sizes: tuple[int, ...], given: Float[Array, " k"]
) -> tuple[Float[Array, " q"], Float[Array, "q q"], Bool[Array, ""]]:
    """Solve for z stage by stage, and propagate the covariance.

    `H`: weighted Gram matrices, summed over the trials of each stage; r = q + 1. `given`: z_0.

    Returns:
        z, its covariance, and whether the trials determine all of z.
    """
    z, covariance, sound = given, jnp.eye(given.size), jnp.array(True)
    for stage, size in zip(H, sizes[1:], strict=True):
        start = z.size
        own = slice(start, start + size)
        L = jnp.linalg.cholesky(stage[own, own])
        sound &= jnp.all(jnp.diagonal(L) > MIN_PIVOT)  # false for NaN too
        # K of the equation in `propagate`, and the step.
        right = jnp.concatenate([stage[own, :start], stage[own, -1:]], axis=1)
        solved = jax.scipy.linalg.cho_solve((L, True), right)
        K = solved[:, :start]
        z = jnp.concatenate([z, -solved[:, -1] - K @ z])
        cross = K @ covariance
        new = jax.scipy.linalg.cho_solve((L, True), jnp.eye(size)) + cross @ K.T
        covariance = jnp.block([[covariance, -cross.T], [-cross, new]])
    return z, covariance, sound
