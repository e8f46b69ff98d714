"""Predictions of a model for every sample of a session, trial by trial, as in the format's table "Predictions"."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxfinger.compilation import quick_jit
from jaxfinger.data import FingerDescription, Session, Trial, joints_of, low_pass
from jaxfinger.errors import UserError, chosen, counted, require
from jaxfinger.experiments import SAMPLES, Stack, padded, padded_size, predict_compiled, prepare
from jaxfinger.identify.fit import Fit
from jaxfinger.model import Finger, Model, Motion, simulate
from jaxfinger.progress import Progress

# Longest time step of a forward simulation, in s at the protocol's pace. Steps a quarter as long change angles
# predicted half a second ahead by less than an encoder's resolution (tests/identify/test_shooting.py).
MAX_TIME_STEP = 5e-4
# Distance of two places of one joint over the fingers' length, and angle, rad, between two axes of it. CAD and a ruler
# know both ten times better, so that joints further apart are those of two fingers.
MAX_SHARE_APART, MAX_TILT = 0.1, 0.2


def predict_session(
    fit: Fit | Model,
    session: Session,
    names: str | Sequence[str] | None = None,
    progress: Progress = lambda message: None,
) -> dict[str, dict[str, Float[np.ndarray, "_N _columns"]]]:
    """Predict the channels of the named trials, one or more: `{trial: {channel: (N, columns)}}`, in SI units.

    `names`: by default all trials.

    Channels are those of the format's table. Columns without a sensor are NaN: the torque of a joint where it was not
    measured, and the excursion of a passive tendon. A trial of fewer than two samples is left out.

    >>> import jaxfinger as jf
    >>> predicted = jf.predict(jf.load("fit.json"), jf.read("session.h5"))
    >>> predicted["01-ID3-dynamic-axis"]["joint_torque"].shape
    (24841, 1)

    Raises:
        UserError: the model's joints or tendons are not those of the session, or it has no trial of that name.
    """
    require((Fit, Model), fit=fit)
    require(Session, session=session)
    model = model_for(fit, session)
    names = None if names is None else [*chosen(names, session.trials, "trial")]
    out: dict[str, dict[str, np.ndarray]] = {}
    for experiment, stack in prepare(session, names, reduced=False).items():
        progress(f"predicting {counted(len(stack.trials), 'trial')} of {experiment}")
        driven = experiment == "VD.3" and session.finger.n > 0
        free = simulate_trials([model] * len(stack.trials), session, stack) if driven else {}
        T = stack.batch.x.time.shape[-1]
        wide = padded(stack.batch.x, 0, padded_size(T, SAMPLES) - T)  # for a common shape
        for b, name in enumerate(stack.trials):
            N = len(session[name].time)
            x = jax.tree.map(lambda a, b=b: a[..., b : b + 1, :], wide)
            values = predict_compiled(model, x, stack.experiment.channels)
            channels = {c: np.array(v[:, 0, :N]).T for c, v in values.items()}
            if experiment == "VD.3":
                # No measured channel stands beside it, and above the cut-off it holds only noise of q̈ and tension.
                time = session[name].time
                cutoff = stack.experiment.cutoff_at(float(np.median(np.diff(time))))
                channels["joint_torque"] = low_pass(time, channels["joint_torque"], cutoff)
            out[name] = _only_measurable(channels, session[name], session) | free.get(name, {})
    return {t.name: out[t.name] for t in session if t.name in out}


def model_for(fit: Fit | Model, session: Session) -> Model:
    """Model of the fit with the session's `gravity`, which belongs to the rig and not to the finger.

    Raises:
        UserError: the model's finger is not that of the session, by its joints or tendons, their names or places.
    """
    model = fit.model if isinstance(fit, Fit) else fit
    finger, file = session.finger, session.file or "the session"
    for kind, ours, theirs in (
        ("joints", model.finger.joint_names, finger.joint_names),
        ("tendons", model.finger.tendon_names, finger.tendon_names),
    ):
        if ours != tuple(theirs):
            raise UserError(
                f"{file}: /finger/{kind}: has {', '.join(theirs) or 'none'} where the fit has "
                f"{', '.join(ours) or 'none'}; give a session of the finger that was identified"
            )
    for what, where in _differences(model.finger, finger):
        raise UserError(
            f"{file}: /finger/{where}: {what} than in the fit; give a session of the finger that was identified, or "
            "identify this one"
        )
    if not np.any(model.finger.gravity):
        return model  # the recipe leaves gravity out
    return eqx.tree_at(lambda m: m.finger.gravity, model, jnp.asarray(finger.gravity, dtype=float))


def _differences(ours: Finger, theirs: FingerDescription) -> Iterator[tuple[str, str]]:
    """What tells the session's finger from that of the fit, and the dataset that says so. Links may be weighed anew."""
    origins = np.stack([np.asarray(ours.origin), theirs.origin])
    apart = np.linalg.norm(origins[1] - origins[0], axis=-1)
    length = np.linalg.norm(origins, axis=-1).max(initial=0.0)
    along = np.sum(np.asarray(ours.axis) * theirs.axis, axis=-1)
    for i, name in enumerate(theirs.joint_names):
        if ours.prismatic[i] != theirs.prismatic[i]:
            yield f"joint {name} is of another type", "joints/type"
        if along[i] < np.cos(MAX_TILT):
            yield f"joint {name} has another axis", "joints/axis"
        if i and apart[i] > MAX_SHARE_APART * length:  # the first joint's place is that of the finger in its rig
            yield f"joint {name} is elsewhere", "joints/origin"
    for k, i in np.argwhere(np.array(ours.crosses, bool).reshape(theirs.crosses.shape) != theirs.crosses):
        crosses = "crosses" if theirs.crosses[k, i] else "does not cross"
        yield f"tendon {theirs.tendon_names[k]} {crosses} joint {theirs.joint_names[i]}, other", "tendons/crosses"


def _only_measurable(channels: dict[str, np.ndarray], trial: Trial, session: Session) -> dict[str, np.ndarray]:
    """Set columns without a sensor to NaN: passive tendons, and joints without a torque sensor."""
    finger = session.finger
    if "tendon_excursion" in channels:
        channels["tendon_excursion"][:, ~finger.active] = np.nan
    if "joint_torque" in channels and trial.experiment != "VD.3":
        if trial.joint_torque is not None and np.isfinite(trial.joint_torque).any():
            measured = np.isfinite(trial.joint_torque).any(axis=0)
        else:
            measured = np.array([name in joints_of(trial, finger) for name in finger.joint_names])
        channels["joint_torque"][:, ~measured] = np.nan
    return channels


def simulate_trials(
    models: Sequence[Model], session: Session, stack: Stack
) -> dict[str, dict[str, Float[np.ndarray, "_N m"]]]:
    """Simulate q, rad, of each VD.3 trial of a full-rate stack from its first sample under the measured tension.

    `models`: one for each trial, of one structure.

    Raises:
        UserError: the finger has no tendons, so nothing drives it.
    """
    if not session.finger.n:
        raise UserError(
            f"{session.file}: /finger/tendons: is empty, so nothing drives a simulation of VD.3; call these trials "
            "ID.3-dynamic, of which the torques are judged"
        )
    # NumPy stacks and picks: outside of a compiled function each operation of JAX's would be compiled by itself.
    model = jax.tree.map(lambda *a: np.stack(a), *models)
    x = jax.tree.map(np.asarray, _true_motions(jax.device_put(model), stack.batch.x))
    steps = np.array([np.median(np.diff(session[name].time)) for name in stack.trials])
    # The simulation takes even steps: each trial gets its own uniform instants, all trials the same number of them.
    longest = max(session[name].duration / step for name, step in zip(stack.trials, steps, strict=True))
    grid = steps[:, None] * np.arange(padded_size(int(np.ceil(longest)) + 1, 512))
    times = _times(stack)
    even = np.stack(
        [[np.interp(g, t, f) for f in x.tension[:, b]] for b, (g, t) in enumerate(zip(grid, times, strict=True))]
    ).reshape(len(steps), session.finger.n, -1)
    starts = (x.session_time - x.time)[:, 0]
    substeps = max(1, int(np.ceil(steps.max() / (MAX_TIME_STEP * stack.experiment.pace) - 1e-6)))
    # Pad to a common shape with the last trial.
    wide = np.minimum(np.arange(padded_size(len(models), 2)), len(models) - 1)
    each = jax.tree.map(lambda a: a[wide], (model, grid, even, x.q[..., 0].T, x.qd[..., 0].T, starts))
    q = np.asarray(_simulate(*jax.device_put(each), substeps))[: len(models)]
    # A simulation that diverges may overflow; it is clipped where it leaves the range by the range's whole width.
    low, high = session.finger.limits.T[:, :, None]
    span = np.where(np.isfinite(high - low), high - low, 2 * np.pi)
    q = np.clip(np.nan_to_num(q, nan=np.inf), low - span, high + span)
    out = {}
    for b, name in enumerate(stack.trials):
        time = np.asarray(session[name].time)
        path = np.stack([np.interp(time, grid[b], row) for row in q[b]])
        N = len(time)
        path, moved = jax.device_put((path, jax.tree.map(lambda a, b=b, N=N: a[..., b, :N], x)))
        out[name] = {"q": np.array(models[b].reading("q", moved, path)).T}
    return out


@quick_jit
def _true_motions(models: Model, x: Motion) -> Motion:
    """Motion of each trial as its model takes it to be; every leaf of `models` has the trials first."""
    return jax.vmap(lambda model, x: model.true_motion(x), in_axes=(0, -2), out_axes=-2)(models, x)


def _times(stack: Stack) -> list[np.ndarray]:
    """Times of each trial from its first sample, s; the padding repeats the last one."""
    time = np.asarray(stack.batch.x.time)
    return [row - row[0] for row in time]


@quick_jit
def _simulate(
    model: Model,  # every leaf with the trials first
    time: Float[Array, "B T"],
    tension: Float[Array, "B n T"],
    q0: Float[Array, "B m"],
    qd0: Float[Array, "B m"],
    start: Float[Array, " B"],
    substeps: int,
) -> Float[Array, "B m T"]:
    def one(model, t, f, q, qd, s):
        return simulate(model, t, f, q, qd, session_start=s, substeps=substeps)[0]

    return jax.vmap(one)(model, time, tension, q0, qd0, start)
