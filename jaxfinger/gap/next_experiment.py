"""The next experiment: the trial that is expected to separate the members of an ambiguous set best.

Candidates are the session's trials and variants of them: resting joints elsewhere, tendons pulled further and released
again, motion slower or faster. Trials of a missing experiment borrow the motion of an experiment that resembles it. All
members, as fitted to the file, predict each trial. Its expected log evidence for member i against member j is

    D_ij = ½ min_η ( ‖δ − A η‖² + ηᵀ P η ),   δ = ŷ_i − ŷ_j,

with δ whitened, A the derivatives of j's prediction by the nominal parameters and j's own, and P the information on
these that the file holds already. A difference that j can imitate without contradicting the file separates nothing
(T-optimality; Atkinson & Fedorov, Biometrika 62 (1975) 57). The trial with the largest min D_ij is suggested.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import permutations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.effects import Scales
from jaxfinger.experiments import EXPERIMENTS, Batch, Stack, affected_channels
from jaxfinger.gap.exact import SearchState, derivatives
from jaxfinger.gap.formula import Weights
from jaxfinger.gap.problem import Problem, imagined
from jaxfinger.gap.projector import Projector
from jaxfinger.gap.result import NextExperiment, Posture
from jaxfinger.gap.signatures import Signatures
from jaxfinger.model import Finger

DECISIVE = 3.5  # Log evidence at which one of two members has a probability of 97 %: 1 / (1 + e^−3.5).
MAX_REPEATS = 10  # A trial that needs more repeats to be decisive is not suggested: it would take a session of its own.
# rad, or the share of the range of a sliding joint: a joint that moves by less is at rest. Held joints yield by less,
# and commanded motions go through more.
MIN_MOTION = 0.05
REST_POSITIONS = (0.2, 0.8)  # Shares of the range at which resting joints are tried, well clear of the stops.
# Where joints are free, tension only keeps tendons taut, with about 2 N in the protocols (docs/experiments.md). Three
# times as much is still at the lower end of the 4 to 15 N with which tendons of held joints are pulled.
MAX_TENSION_FACTOR = 3.0
SLOW_FACTOR = 0.25  # A quarter of the speed brings the protocol's sweeps (0.5 to 1.5 rad/s) below their slowest.
# The experiment whose motion a missing one borrows. VD.1 and VD.3 have motions of their own.
MOTION_FROM = {"VD.2": "ID.4", "ID.4": "VD.2", "ID.3-static": "ID.2", "ID.3-dynamic": "ID.2"}


def next_experiment(problem: Problem, members: Sequence[SearchState]) -> NextExperiment | None:
    """The trial that is expected to separate the fitted sets `members` best, one set for each rival.

    Returns None where there are fewer than two, or where no trial would separate them in MAX_REPEATS repeats.
    """
    if len(members) < 2:
        return None
    showing = {e for m in members for x in m.effects for e in affected_channels(type(x), problem.nominal.finger)}
    ones = Weights.plain(members[0].columns)
    project, own = Projector(problem, members[0].columns, ones), Signatures(problem)
    steps, known = [], []
    for m in members:
        change, slopes = derivatives(own, m)
        steps.append(project.nominal_step(problem.r - change))
        known.append(_information(problem, slopes))
    best, place = 0.0, None
    for stacks in _short_list(problem, showing):
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
    if place is None or best * MAX_REPEATS < DECISIVE:
        return None
    shared = set.intersection(*(set(m.keys) for m in members))
    ids = tuple(dict.fromkeys(e for m in members for e, site in m.keys if (e, site) not in shared))
    return _described(problem, *place, best, ids)


def _information(problem: Problem, slopes: Float[np.ndarray, "k N"]) -> Float[np.ndarray, "q q"]:
    """Information P of the file's trials and the priors on nominal parameters and a set's coordinates, q = p + k."""
    A, p = np.vstack([problem.J.T, slopes]), problem.J.shape[1]
    P = A @ A.T
    P[:p, :p] += problem.root.T @ problem.root
    P[p:, p:] += np.eye(len(slopes))
    return P


def expected_evidence(
    delta: Float[np.ndarray, " N"], slopes: Float[np.ndarray, "k N"], information: Float[np.ndarray, "k k"]
) -> float:
    """D = ½ min over η of ‖δ − slopesᵀ η‖² + ηᵀ P η, with `information` P."""
    scale = np.sqrt(np.diag(information) + np.sum(slopes**2, axis=1))
    scale = np.where(scale > 0, scale, 1.0)
    H = (information + slopes @ slopes.T) / np.outer(scale, scale)
    b = slopes @ delta / scale
    return 0.5 * float(delta @ delta - b @ np.linalg.pinv(H, rcond=1e-10, hermitian=True) @ b)


# The short list -------------------------------------------------------------------------------------------------------
def _short_list(problem: Problem, showing: set[str]) -> Iterator[dict[str, Stack]]:
    """Candidate trials: the session's own, those of missing experiments in `showing`, and variants of both.

    One variant holds all experiments, since stacks in the shapes of the session's own are compiled already.
    """
    own = problem.stacks
    lacking = {
        name: _borrowed(problem, name, own[like])
        for name, like in MOTION_FROM.items()
        if name in showing and name not in own and like in own
    }
    for stacks in (own, lacking):
        if showing & set(stacks):
            for share in (None, *REST_POSITIONS):
                there = {e: _resting_at(s, problem.nominal.finger, share) for e, s in stacks.items()}
                yield there
                yield {e: _harder(s, problem.scales) for e, s in there.items()}
                yield {e: _slower(s) for e, s in there.items()}


def _borrowed(problem: Problem, name: str, like: Stack) -> Stack:
    """Trials of an experiment that the session lacks, with the motion of another; measured channels are zero."""
    experiment, x, finger = EXPERIMENTS[name], like.batch.x, problem.nominal.finger
    if experiment.slack:
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
    for c in experiment.channels:
        columns = {"joint_torque": finger.m, "tendon_excursion": finger.n, "fingertip_force": 3}[c]
        shown = motor if c == "joint_torque" else np.ones((columns, *counts.shape))
        if c == "tendon_excursion":
            shown = shown * (np.asarray(x.tension).max(axis=-1) > 0)[..., None]
        mask[c] = jnp.asarray(shown * counts)
        y[c] = jnp.zeros_like(mask[c])
    x = replace(x, motorised=jnp.asarray(motor), held=experiment.held)
    measured = dict.fromkeys(experiment.channels, True)
    return Stack(experiment, Batch(x, y, mask), like.trials, like.motions, like.holds, like.dt, measured)


def _resting_at(stack: Stack, finger: Finger, share: float | None) -> Stack:
    """The stack with resting joints at a share of their ranges, or as it is for None."""
    if share is None:
        return stack
    q = np.asarray(stack.batch.x.q)
    low, high = (np.asarray(finger.limits)[:, k, None, None] for k in (0, 1))
    return _with(stack, q=np.where(_moves(finger, q)[..., None], q, low + share * (high - low)))


def _harder(stack: Stack, scales: Scales) -> Stack:
    """The stack with tendons pulled further, and at held joints released again in the same steps.

    Without tension it moves faster instead. Tension and speed stay within those of the session (`scales`), which the
    rig is known to bear. VD.3 stays as it is, since its motion follows from its tension.
    """
    x, experiment = stack.batch.x, stack.experiment
    if experiment.name == "VD.3":
        return stack
    if experiment.slack:
        moves = not experiment.rests and _speed(x.qd) > 0.0
        return _sped_up(stack, max(1.0, scales("speed") / _speed(x.qd))) if moves else stack
    f = np.asarray(x.tension)
    top = f.max(axis=(0, -1), keepdims=True)
    largest = scales("tension")
    further = largest / np.where(top > 0.0, top, largest)
    f = f * np.clip(further, 1.0, np.inf if experiment.held else MAX_TENSION_FACTOR)
    falls = f[..., -1].max(axis=0) < 0.5 * f.max(axis=(0, -1))
    if not experiment.held or falls.all():
        return _with(stack, tension=f)
    T = f.shape[-1]
    there_and_back = np.r_[0:T:2, T - 1 - T % 2 : 0 : -2]
    mask = {c: m[..., there_and_back] for c, m in stack.batch.mask.items()}
    pulled = _with(stack, tension=f[..., there_and_back])
    return replace(pulled, batch=replace(pulled.batch, mask=mask))


def _slower(stack: Stack) -> Stack:
    """The stack at a quarter of its speed, where joints move and their speed is free to choose."""
    experiment = stack.experiment
    return stack if experiment.rests or experiment.name == "VD.3" else _sped_up(stack, SLOW_FACTOR)


def _sped_up(stack: Stack, factor: float) -> Stack:
    """The stack with the same path at `factor` times the speed: time, velocity and acceleration are scaled."""
    x = stack.batch.x
    return _with(stack, time=x.time / factor, qd=x.qd * factor, qdd=x.qdd * factor**2)


def _with(stack: Stack, **motion) -> Stack:
    """The stack with some fields of its motion replaced."""
    x = replace(stack.batch.x, **{k: jnp.asarray(v) for k, v in motion.items()})
    return replace(stack, batch=replace(stack.batch, x=x))


def _moves(finger: Finger, q: Float[np.ndarray, "m *T"]) -> np.ndarray:
    """Whether each joint moves in a trial, (m,) or (m, B)."""
    slides = np.array(finger.prismatic)
    low, high = np.asarray(finger.limits).T
    rest = np.where(slides, MIN_MOTION * (high - low), MIN_MOTION)
    return np.ptp(q, axis=-1) > rest.reshape(-1, *[1] * (q.ndim - 2))


def _speed(qd: Float[Array | np.ndarray, "m *T"]) -> float:
    """99th percentile over the samples of the fastest joint's speed, which spikes do not move."""
    return float(np.percentile(np.abs(np.asarray(qd)).max(axis=0), 99))


# The suggestion -------------------------------------------------------------------------------------------------------
def _described(problem: Problem, stack: Stack, b: int, evidence: float, ids: tuple[str, ...]) -> NextExperiment:
    """The suggestion as data: trial number `b` of a stack, which brings `evidence` and separates the effects `ids`."""
    finger, experiment = problem.nominal.finger, stack.experiment
    trial = problem.session[stack.trials[b]]
    x = stack.batch.x
    counts = np.stack([np.asarray(m)[b] for mask in stack.batch.mask.values() for m in mask]).max(axis=0) > 0
    q, f = np.asarray(x.q)[:, b][:, counts], np.asarray(x.tension)[:, b][:, counts]
    moves = _moves(finger, q)
    postures = tuple(
        Posture(name, float(q[i].min()), float(q[i].max()), bool(moves[i]), finger.prismatic[i])
        for i, name in enumerate(finger.joint_names)
    )
    repeats = int(np.ceil(DECISIVE / evidence))
    return NextExperiment(
        experiment.name,
        experiment.name not in problem.stacks,
        trial.joint if trial.joint and experiment.name.startswith("ID") else None,
        trial.tendon if trial.tendon and experiment.held else None,
        postures,
        None if experiment.slack else float(f.max()),
        experiment.held,
        experiment.held and bool(f[:, -1].max() < 0.5 * f.max()),
        None if experiment.rests else _speed(x.qd[:, b]),
        any(finger.prismatic),
        repeats,
        repeats * evidence,
        ids,
    )
