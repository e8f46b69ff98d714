"""What next: the trial of the format that would best separate the members of an ambiguous set.

Every trial of the session is imagined again: other joints elsewhere, tendons pulled further and let go again, slower
and faster; and where an experiment is missing, its trials are imagined with the motion of one that resembles it. All
members, as fitted to the file, predict the trial. Its expected log evidence for i against j is

    D_ij = ½ min_η ( ‖δ − A η‖² + ηᵀ P η ),   δ = ŷ_i − ŷ_j,

δ white, A the derivatives of j's prediction by the nominal parameters and its own, and P the information on them that
the file holds already: what j can imitate without contradicting the file separates nothing (T-optimality; Atkinson &
Fedorov, Biometrika 62 (1975) 57). The trial that separates the worst pair best is the suggestion.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxfinger.experiments import EXPERIMENTS, Batch, Stack, affected_channels
from jaxfinger.gap.exact import Projector, SearchState, derivatives
from jaxfinger.gap.formula import Weights
from jaxfinger.gap.problem import Problem, imagined
from jaxfinger.gap.result import NextExperiment, Posture
from jaxfinger.gap.signatures import Signatures
from jaxfinger.model import Finger

SETTLES = 3.5  # log evidence at which one member has 97 %
REPEATS = 10  # a trial that must be repeated more often than this is no suggestion
REST = 0.05  # rad (or, of a joint that slides, a twentieth of its range): a joint that moves by less is at rest
PLACES = (0.2, 0.8)  # of their ranges, where joints at rest are imagined too
HIGHEST = 15.0  # N: as far as the format's protocols pull a tendon
LOOSE = 3.0  # times: how much further tendons are pulled that a protocol keeps at about 2 N
FASTEST, SLOWER = 1.5, 0.25  # rad/s, times the speed
# Whose motion an experiment that the session lacks would have. VD.1 and VD.3 have motions of their own.
LIKE = {"VD.2": "ID.4", "ID.4": "VD.2", "ID.3-static": "ID.2", "ID.3-dynamic": "ID.2"}


def next_experiment(problem: Problem, members: Sequence[SearchState]) -> NextExperiment | None:
    """For the fitted sets that rivals belong to; none where no trial is expected to separate them."""
    if len(members) < 2:
        return None
    shown = {e for m in members for x in m.effects for e in affected_channels(type(x), problem.nominal.finger)}
    ones = Weights.plain(members[0].columns)
    project, own = Projector(problem, members[0].columns, ones), Signatures(problem)
    steps, known = [], []
    for m in members:
        change, slopes = derivatives(own, m)
        steps.append(project.nominal_step(problem.r - change))
        known.append(_information(problem, slopes))
    best, place = 0.0, None
    for stacks in _short_list(problem, shown):
        there = imagined(problem, stacks)
        signatures = Signatures(there)
        read = [derivatives(signatures, m) for m in members]
        predicted = [there.J @ step + change for step, (change, _) in zip(steps, read, strict=True)]
        slopes = [np.vstack([there.J.T, of_member]) for _, of_member in read]
        trials = [(stack, b) for stack in stacks.values() for b in range(len(stack.trials))]
        for number, trial in enumerate(trials):
            rows = np.flatnonzero(there.trial_of_row == number)
            worst = min(
                expected_evidence(predicted[i][rows] - predicted[j][rows], slopes[j][:, rows], known[j])
                for i, j in permutations(range(len(members)), 2)
            )
            if worst > best:
                best, place = worst, trial
    if place is None or best * REPEATS < SETTLES:
        return None
    alike = set.intersection(*(set(m.keys) for m in members))
    ids = tuple(dict.fromkeys(e for m in members for e, site in m.keys if (e, site) not in alike))
    return _described(problem, *place, best, ids)


def _information(problem: Problem, slopes: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "q q"]:
    """What the trials and priors say of the nominal parameters and of a set's coordinates together: q = p + k."""
    A, p = np.vstack([problem.J.T, slopes]), problem.J.shape[1]
    P = A @ A.T
    P[:p, :p] += problem.root.T @ problem.root
    P[p:, p:] += np.eye(len(slopes))
    return P


def expected_evidence(
    delta: Float[np.ndarray, " N"], slopes: Float[np.ndarray, "k N"], information: Float[np.ndarray, "k k"]
) -> float:
    """½ min over η of ‖δ − slopesᵀ η‖² + ηᵀ P η."""
    scale = np.sqrt(np.diag(information) + np.sum(slopes**2, axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    H = (information + slopes @ slopes.T) / np.outer(scale, scale)
    b = slopes @ delta / scale
    return 0.5 * float(delta @ delta - b @ np.linalg.pinv(H, rcond=1e-10, hermitian=True) @ b)


# The short list -------------------------------------------------------------------------------------------------------
def _short_list(problem: Problem, shown: set[str]) -> Iterator[dict[str, Stack]]:
    """The session's trials as they are and otherwise, then those of the experiments that it lacks.

    All experiments change together, since stacks of the shapes of the session's own are compiled already.
    """
    own = problem.stacks
    lacks = {
        name: _borrowed(problem, name, own[like])
        for name, like in LIKE.items()
        if name in shown and name not in own and like in own
    }
    for stacks in (own, lacks):
        if shown & set(stacks):
            for share in (None, *PLACES):
                there = {e: _at(s, problem.nominal.finger, share) for e, s in stacks.items()}
                yield there
                yield {e: _harder(s) for e, s in there.items()}
                yield {e: _slower(s) for e, s in there.items()}


def _borrowed(problem: Problem, name: str, like: Stack) -> Stack:
    """An experiment that the session lacks, with the motion of another."""
    spec, x, finger = EXPERIMENTS[name], like.batch.x, problem.nominal.finger
    if spec.slack:
        x = replace(x, tension=jnp.zeros_like(x.tension), tendon_direction=jnp.zeros_like(x.tendon_direction))
    joints = [problem.session[t].joint for t in like.trials]
    motor = np.zeros(x.q.shape)
    if name != "VD.2":
        for b, joint in enumerate(joints):
            crossed = finger.crosses[int(np.argmax(np.ptp(np.asarray(x.tension)[:, b], axis=-1)))]
            own = [finger.joint_names.index(joint)] if joint else np.flatnonzero(crossed)[:1]
            motor[own, b] = 1.0
    counts = np.stack([np.asarray(m) for m in like.batch.mask.values() for m in m]).max(axis=0)
    mask, y = {}, {}
    for c in spec.channels:
        columns = {"joint_torque": finger.m, "tendon_excursion": finger.n, "fingertip_force": 3}[c]
        shown = motor if c == "joint_torque" else np.ones((columns, *counts.shape))
        if c == "tendon_excursion":
            shown = shown * (np.asarray(x.tension).max(axis=-1) > 0)[..., None]
        mask[c] = jnp.asarray(shown * counts)
        y[c] = jnp.zeros_like(mask[c])
    x = replace(x, motorised=jnp.asarray(motor), held=spec.held)
    measured = dict.fromkeys(spec.channels, True)
    return Stack(spec, Batch(x, y, mask), like.trials, like.motions, like.holds, like.dt, measured)


def _at(stack: Stack, finger: Finger, share: float | None) -> Stack:
    """With the joints that rest so far up their ranges."""
    if share is None:
        return stack
    q = np.asarray(stack.batch.x.q)
    low, high = (np.asarray(finger.limits)[:, k, None, None] for k in (0, 1))
    return _with(stack, q=np.where(_moves(finger, q)[..., None], q, low + share * (high - low)))


def _harder(stack: Stack) -> Stack:
    """With tendons pulled further, and at held joints let go again in the same steps; without tension, faster."""
    x, spec = stack.batch.x, stack.experiment
    if spec.name == "VD.3":  # its motion follows from its tension
        return stack
    if spec.slack:
        speed = float(np.percentile(np.abs(np.asarray(x.qd)).max(axis=0), 99))
        return stack if spec.rests else _at_speed(stack, max(1.0, FASTEST / max(speed, 1e-3)))
    f = np.asarray(x.tension)
    top = f.max(axis=(0, -1), keepdims=True)
    top = np.where(top > 0.0, top, HIGHEST)
    f = f * np.clip(HIGHEST / top, 1.0, np.inf if spec.held else LOOSE)
    falls = f[..., -1].max(axis=0) < 0.5 * f.max(axis=(0, -1))
    if not spec.held or falls.all():
        return _with(stack, tension=f)
    T = f.shape[-1]
    there_and_back = np.r_[0:T:2, T - 1 - T % 2 : 0 : -2]
    mask = {c: m[..., there_and_back] for c, m in stack.batch.mask.items()}
    pulled = _with(stack, tension=f[..., there_and_back])
    return replace(pulled, batch=replace(pulled.batch, mask=mask))


def _slower(stack: Stack) -> Stack:
    """Where joints move and the speed is free."""
    spec = stack.experiment
    return stack if spec.rests or spec.name == "VD.3" else _at_speed(stack, SLOWER)


def _at_speed(stack: Stack, times: float) -> Stack:
    x = stack.batch.x
    return _with(stack, time=x.time / times, qd=x.qd * times, qdd=x.qdd * times**2)


def _with(stack: Stack, **motion) -> Stack:
    x = replace(stack.batch.x, **{k: jnp.asarray(v) for k, v in motion.items()})
    return replace(stack, batch=replace(stack.batch, x=x))


def _moves(finger: Finger, q: Float[np.ndarray, "m *T"]) -> np.ndarray:
    """Which joints move in a trial."""
    slides = np.array(finger.prismatic)
    low, high = np.asarray(finger.limits).T
    rest = np.where(slides, 0.05 * (high - low), REST)
    return np.ptp(q, axis=-1) > rest.reshape(-1, *[1] * (q.ndim - 2))


# As data --------------------------------------------------------------------------------------------------------------
def _described(problem: Problem, stack: Stack, b: int, evidence: float, ids: tuple[str, ...]) -> NextExperiment:
    finger, spec = problem.nominal.finger, stack.experiment
    trial = problem.session[stack.trials[b]]
    x = stack.batch.x
    counts = np.stack([np.asarray(m)[b] for mask in stack.batch.mask.values() for m in mask]).max(axis=0) > 0
    q, f = np.asarray(x.q)[:, b][:, counts], np.asarray(x.tension)[:, b][:, counts]
    moves = _moves(finger, q)
    postures = tuple(
        Posture(name, float(q[i].min()), float(q[i].max()), bool(moves[i]), finger.prismatic[i])
        for i, name in enumerate(finger.joint_names)
    )
    speed = None
    if not spec.rests:
        speed = float(np.percentile(np.abs(np.asarray(x.qd)[:, b]).max(axis=0), 99))
    often = int(np.ceil(SETTLES / evidence))
    return NextExperiment(
        spec.name,
        spec.name not in problem.stacks,
        trial.joint if trial.joint and spec.name.startswith("ID") else None,
        trial.tendon if trial.tendon and spec.held else None,
        postures,
        None if spec.slack else float(f.max()),
        spec.held,
        spec.held and bool(f[:, -1].max() < 0.5 * f.max()),
        speed,
        any(finger.prismatic),
        often,
        often * evidence,
        ids,
    )
