"""True channels of a plan, before the sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .drive import Run
from .laws import Finger, Situation
from .profiles import Profile
from .protocols import FAST, Plan, sample_times


@dataclass(frozen=True)
class Channels:
    """One trial without noise, time first, SI. A channel that the experiment does not measure is None."""

    plan: Plan
    time: Float[np.ndarray, " N"]
    session: Float[np.ndarray, " N"]
    q: Float[np.ndarray, "N m"]
    tension: Float[np.ndarray, "N n"]
    excursion: Float[np.ndarray, "N n"] | None = None
    torque: Float[np.ndarray, "N m"] | None = None
    force: Float[np.ndarray, "N 3"] | None = None


@dataclass(frozen=True)
class Motion:
    """Motion and tension of the finger in a trial, time first: s, rad, N."""

    time: Float[np.ndarray, " N"]
    q: Float[np.ndarray, "N m"]
    qd: Float[np.ndarray, "N m"]
    qdd: Float[np.ndarray, "N m"]
    tension: Float[np.ndarray, "N n"]
    direction: Float[np.ndarray, "N m"]  # in which each joint slides


def commanded(plan: Plan, rate: float | None = None) -> Motion:
    """Motion that a plan commands, with the process noise of the trial's seed. `rate`: samples per second.

    Process noise makes repeats differ. Where `rate` is given, ID.2 and ID.3 also have the instants before reversals,
    which a coarse rate would miss.
    """
    rng = np.random.default_rng(plan.seed)
    t = sample_times(plan, rate)
    if rate is not None and plan.experiment.startswith(("ID.2", "ID.3")):
        for profile in plan.q if plan.joint is None else [plan.q[plan.joint]]:
            t = np.union1d(t, _reversals(profile, plan))
    warped = t * (1 + 2e-5 * rng.normal())
    q, qd, qdd = (np.stack(x, axis=1) for x in zip(*(p(warped) for p in plan.q), strict=True))
    q = q + 1e-4 * rng.normal(size=q.shape[1]) * (1 if plan.experiment != "VD.1" else 2)
    tension = np.stack([p(warped)[0] for p in plan.tension], axis=1)
    pulled = np.array([p.start > 0 or len(p.times) > 1 for p in plan.tension])
    wander = sum(
        a * np.sin(2 * np.pi * t[:, None] / p + ph)
        for a, p, ph in zip(
            rng.uniform(0.3, 0.6, (3, len(pulled))),
            rng.uniform(3, 15, (3, len(pulled))),
            rng.uniform(0, 6.28, (3, len(pulled))),
            strict=True,
        )
    )
    tension = tension + plan.wander * wander * pulled
    if not plan.wander:  # A tension controller holds a level to a fifth of a percent.
        tension = tension * (1 + 2e-3 * rng.normal(size=len(pulled)))
    return Motion(t, q, qd, qdd, tension, last_direction(qd))


def _reversals(profile: Profile, plan: Plan) -> Float[np.ndarray, " r"]:
    """Times, s, just before a profile's rate changes sign."""
    t = sample_times(plan)
    sign = last_direction(profile(t)[1][:, None])[:, 0]
    return t[1:][np.diff(sign) != 0] - 2e-3


def driven(run: Run, rate: float = FAST) -> Motion:
    """Motion of a simulated VD.3 trial at the rate of its log. Acceleration is zero, since no channel needs it."""
    direction, every = last_direction(run.qd, 1e-3), slice(None, None, round(FAST / rate))
    time, q, qd, tension, direction = (a[every] for a in (run.time, run.q, run.qd, run.tension, direction))
    return Motion(time, q, qd, np.zeros_like(q), tension, direction)


def last_direction(rate: Float[np.ndarray, "N k"], still: float = 1e-9) -> Float[np.ndarray, "N k"]:
    """Sign of the rate, kept through stops. Before the first motion it is that of the first motion."""
    sign = np.where(np.abs(rate) > still, np.sign(rate), 0.0)
    rows = np.arange(len(sign))[:, None]
    kept = np.maximum.accumulate(np.where(sign != 0, rows, 0), axis=0)
    out = np.take_along_axis(sign, kept, axis=0)
    first = np.take_along_axis(sign, np.argmax(sign != 0, axis=0)[None], axis=0)
    return np.where(out == 0, first, out)


def record(finger: Finger, plan: Plan, motion: Motion, rigid: Float[np.ndarray, "N m"] | None = None) -> Channels:
    """True channels of a trial. `rigid`: its rigid-body torque, N m, where it is known already."""
    session = plan.start + motion.time
    held = plan.experiment in ("ID.4", "VD.2")
    direction = np.zeros_like(motion.direction) if held else motion.direction
    s = Situation(
        motion.time,
        session,
        motion.q,
        motion.qd,
        motion.qdd,
        motion.tension,
        direction,
        held=held,
    )
    if not held:
        s.st = last_direction(finger.speed(s), 1e-6)
    s = finger.remember(s)
    out = Channels(plan, motion.time, session, motion.q, motion.tension)
    if plan.experiment in ("ID.2", "VD.1", "ID.4", "VD.2", "VD.3"):
        out = replace(out, excursion=finger.path(s)[0])
    if plan.experiment.startswith("ID.3"):
        torque = (rigid_torque(finger, motion) if rigid is None else rigid) + finger.passive(s) + finger.friction(s)
        out = replace(out, torque=_at_motor(finger, s, torque))
    elif held:
        arm = finger.path(s)[1]
        pull = np.einsum("tnm,tn->tm", arm, finger.delivered(s, finger.reaching_held(s)))
        torque = (finger.plant.gravity_torque(motion.q) if rigid is None else rigid) + finger.passive(s) - pull
        if plan.experiment == "ID.4":
            out = replace(out, torque=_at_motor(finger, s, torque))
        else:
            # The contact force is the least-squares solution. Static friction of the joints takes the rest.
            force = torque @ np.linalg.pinv(finger.plant.jacobian(motion.q[0]))
            for d in finger.departures:
                force = d.contact(finger, s, force)
            out = replace(out, force=force)
    return out


def needed_torque(
    finger: Finger, plan: Plan, motion: Motion, rigid: Float[np.ndarray, "N m"] | None = None
) -> Float[np.ndarray, "N m"]:
    """External torque, N m, that the finger needs to follow a motion under its tensions (VD.3)."""
    session = plan.start + motion.time
    s = Situation(motion.time, session, motion.q, motion.qd, motion.qdd, motion.tension, motion.direction)
    s.st = last_direction(finger.speed(s), 1e-6)
    s = finger.remember(s)
    pull = np.einsum("tnm,tn->tm", finger.path(s)[1], finger.delivered(s, finger.reaching_sliding(s)))
    return (rigid_torque(finger, motion) if rigid is None else rigid) + finger.passive(s) + finger.friction(s) - pull


def rigid_torque(finger: Finger, motion: Motion) -> Float[np.ndarray, "N m"]:
    """M q̈ + N + G along a motion, N m."""
    return finger.plant.inverse_dynamics(motion.q, motion.qd, motion.qdd)


def _at_motor(finger: Finger, s: Situation, torque: Float[np.ndarray, "N m"]) -> Float[np.ndarray, "N m"]:
    """Torque at the external motor's sensor, N m."""
    for d in finger.departures:
        torque = d.at_motor(finger, s, torque)
    return torque


def read(finger: Finger, channels: Channels) -> Channels:
    """Apply the departures of the sensors to the true channels. Noise is added later."""
    for d in finger.departures:
        channels = d.read(channels)
    return channels
