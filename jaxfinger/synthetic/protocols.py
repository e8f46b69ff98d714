"""The trials of a simulated session as commanded, one function per experiment."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from string import ascii_lowercase

import numpy as np
from jaxtyping import Float, Int

from jaxfinger.data import FingerDescription
from jaxfinger.errors import UserError
from jaxfinger.synthetic import motions
from jaxfinger.synthetic.recipe import Postures, Trials

Array = np.ndarray
# Postures where the recipe names none, as shares of the joints' ranges: slightly and half flexed.
DEFAULT_POSTURES = (0.3, 0.55)
INSET = 0.08  # share of a joint's range that steps and sweeps keep from each end, clear of the mechanical stops
PAUSE = 15.0  # s between trials, in which an operator would prepare the next one


@dataclass(frozen=True)
class TrialPlan:
    """One trial as commanded, with joint arrays (m, N) and tendon arrays (n, N). In VD.3 `q` is the desired motion.

    Trials with the same `motion` repeat each other.
    """

    name: str
    experiment: str
    motion: str
    time: Float[Array, " N"]  # s
    q: Float[Array, "m N"]  # rad
    qd: Float[Array, "m N"]  # rad/s
    qdd: Float[Array, "m N"]  # rad/s²
    tension: Float[Array, "n N"]  # N
    joint: int | None = None  # index of the joint that is moved or instrumented
    tendon: int | None = None  # index of the tendon that is pulled
    joint_direction: Int[Array, "m N"] | None = None  # −1, 0, 1
    tendon_direction: Int[Array, "n N"] | None = None  # −1, 0, 1
    hold: Int[Array, " N"] | None = None  # index of the hold, −1 between holds
    session_start: float = 0.0  # s from the start of the session

    @property
    def held(self) -> bool:
        """Whether fixtures hold the joints. Then joints show no friction, and tendons move only beyond their loss."""
        return self.experiment in ("ID.4", "VD.2")


def session_plan(finger: FingerDescription, trials: Trials) -> tuple[TrialPlan, ...]:
    """Return all trials of a session in the order in which the rig runs them, repeats side by side.

    A finger without active tendons has only the trials of ID.3.

    Raises:
        UserError: a posture or a tendon of the recipe does not fit the finger.
    """
    programme: dict[str, tuple[int, Callable[[FingerDescription, Trials], Iterator[TrialPlan]]]] = {
        "ID.2": (trials.id2.repeats, _excursions),
        "VD.1": (trials.vd1.repeats, _free_paths),
        "ID.3-static": (trials.id3_static.repeats, _static),
        "ID.3-dynamic": (trials.id3_dynamic.repeats, _sweeps),
        "ID.4": (trials.id4.repeats, _pulls),
        "VD.2": (trials.vd2.repeats, _contacts),
        "VD.3": (trials.vd3.repeats, _drives),
    }
    plans: list[TrialPlan] = []
    clock = PAUSE
    for experiment, (repeats, planned) in programme.items():
        if experiment not in trials.experiments or not (finger.active.any() or experiment.startswith("ID.3")):
            continue
        for plan in planned(finger, trials):
            for _ in range(repeats):
                name = f"{len(plans) + 1:02d}-{plan.motion}"
                plans.append(replace(plan, name=name, session_start=clock))
                clock += float(plan.time[-1]) + PAUSE
    return tuple(plans)


def _excursions(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """ID.2: a joint moved by hand from one end of its range to the other and back."""
    e = trials.id2
    for joint in range(finger.m):
        for letter, posture in _postures(finger, e.postures, "trials.id2"):
            motion = f"ID.2-{finger.joint_names[joint]}-{letter}"
            rng = _rng(trials, motion)
            lower, upper = finger.limits[joint]
            ends = [lower if k % 2 == 0 else upper for k in range(e.strokes + 1)]
            moves = e.stroke_time * rng.uniform(0.8, 1.2, e.strokes)
            time = _clock(trials.rate, moves.sum())
            path = motions.minimum_jerk(time, ends, moves, np.zeros(e.strokes)).path
            yield _moved(finger, "ID.2", motion, time, posture, joint, path, _taut(finger, time, e.tension, rng))


def _static(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """ID.3-static: a joint held in steps. Holds are approached from below on the way up, from above on the way down."""
    e = trials.id3_static
    for joint in range(finger.m):
        lower, upper = _inset(finger.limits[joint])
        margin = 0.5 * (lower - finger.limits[joint, 0])
        count = max(5, round((upper - lower) / np.deg2rad(e.step)) + 1)
        steps = np.linspace(lower, upper, count)
        points = [lower - margin, *steps, upper + margin, *steps[::-1]]
        turn = count + 1  # index of the point beyond the last hold, which is no hold
        dwell = [e.dwell if k != turn else 0.0 for k in range(1, len(points))]
        move = [e.move] * (len(points) - 1)
        time = _clock(trials.rate, sum(move) + sum(dwell))
        stairs = motions.minimum_jerk(time, points, move, dwell)
        for letter, posture in _postures(finger, e.postures, "trials.id3_static", count=1):
            motion = f"ID.3-static-{finger.joint_names[joint]}-{letter}"
            plan = _moved(finger, "ID.3-static", motion, time, posture, joint, stairs.path, _slack(finger, time))
            yield replace(
                plan,
                joint_direction=_row(finger.m, joint, stairs.direction),
                hold=_holds(stairs, skip=turn),
            )


def _sweeps(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """ID.3-dynamic: a joint driven back and forth at constant speeds."""
    e = trials.id3_dynamic
    for joint in range(finger.m):
        path = motions.sweeps(trials.rate, *_inset(finger.limits[joint]), e.speeds, e.cycles)
        time = np.arange(path.x.size) / trials.rate
        direction = np.where(path.v > 0.0, 1, -1)
        direction[0] = 1
        for letter, posture in _postures(finger, e.postures, "trials.id3_dynamic", count=1):
            motion = f"ID.3-dynamic-{finger.joint_names[joint]}-{letter}"
            plan = _moved(finger, "ID.3-dynamic", motion, time, posture, joint, path, _slack(finger, time))
            yield replace(plan, joint_direction=_row(finger.m, joint, direction))


def _pulls(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """ID.4: a tendon pulled from slack up through the tensions and back down, with the instrumented joint held."""
    e = trials.id4
    for tendon in np.flatnonzero(finger.active):
        crossed = np.flatnonzero(finger.crosses[tendon])
        for joint in crossed[-1:] if e.joints == "distal" else crossed:
            for letter, posture in _postures(finger, e.postures, "trials.id4"):
                motion = f"ID.4-{finger.tendon_names[tendon]}-{finger.joint_names[joint]}-{letter}"
                down = e.tensions[-2::-1] if e.release else ()
                yield _stepped(
                    finger,
                    trials.rate,
                    "ID.4",
                    motion,
                    posture,
                    int(tendon),
                    (*e.tensions, *down),
                    e.move,
                    e.dwell,
                    int(joint),
                )


def _contacts(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """VD.2: the fingertip on its force sensor, one tendon pulled in rising steps, the others slack."""
    e = trials.vd2
    most = max(np.flatnonzero(finger.active), key=lambda k: finger.crosses[k].sum())
    for name in e.tendons or (finger.tendon_names[most],):
        if name not in finger.tendon_names:
            raise UserError(
                f"recipe: trials.vd2.tendons names {name!r}; the finger has {', '.join(finger.tendon_names)}"
            )
        for letter, posture in _postures(finger, e.postures, "trials.vd2", count=1):
            motion, tendon = f"VD.2-{name}-{letter}", finger.tendon_names.index(name)
            yield _stepped(finger, trials.rate, "VD.2", motion, posture, tendon, e.tensions, e.move, e.dwell)


def _free_paths(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """VD.1: all joints led by hand, with the tendons kept taut."""
    e = trials.vd1
    for k in range(e.motions):
        motion = f"VD.1-{_letter(k)}"
        rng = _rng(trials, motion)
        time = _clock(trials.rate, e.duration)
        paths = [motions.wander(time, *_inset(limits), rng, (1.0, 3.0)) for limits in finger.limits]
        yield TrialPlan(motion, "VD.1", motion, time, *_stacked(paths), tension=_taut(finger, time, e.tension, rng))


def _drives(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """VD.3: the desired motion of the free finger. Its tensions come from the rig's controller when it is run."""
    e = trials.vd3
    for k in range(e.motions):
        motion = f"VD.3-{_letter(k)}"
        rng = _rng(trials, motion)
        time = _clock(e.rate, e.duration)
        ranges = [(limits[0] + e.centre * np.ptp(limits), e.amplitude * np.ptp(limits)) for limits in finger.limits]
        paths = [motions.swing(time, *span, rng) for span in ranges]
        yield TrialPlan(motion, "VD.3", motion, time, *_stacked(paths), tension=_slack(finger, time))


def _moved(finger, experiment, motion, time, posture, joint, path, tension) -> TrialPlan:
    """Plan one joint along a path, with the others held at a posture."""
    q = np.repeat(posture[:, None], time.size, axis=1)
    q[joint] = path.x
    rates = [_row(finger.m, joint, x) for x in (path.v, path.a)]
    return TrialPlan(motion, experiment, motion, time, q, *rates, tension=tension, joint=joint)


def _stepped(finger, rate, experiment, motion, posture, tendon, tensions, move, dwell, joint=None) -> TrialPlan:
    """Plan one tendon from slack through steps of tension, with all joints held."""
    count = len(tensions)
    time = _clock(rate, count * (move + dwell))
    stairs = motions.minimum_jerk(time, (0.0, *tensions), (move,) * count, (dwell,) * count)
    q = np.repeat(posture[:, None], time.size, axis=1)
    return TrialPlan(
        motion,
        experiment,
        motion,
        time,
        q,
        np.zeros_like(q),
        np.zeros_like(q),
        _row(finger.n, tendon, stairs.path.x),
        joint,
        tendon,
        joint_direction=np.zeros(q.shape, dtype=int),
        tendon_direction=_row(finger.n, tendon, stairs.direction),
        hold=_holds(stairs),
    )


def _postures(finger: FingerDescription, given: Postures, key: str, count: int = 2) -> Iterator[tuple[str, Array]]:
    """Yield a letter and a posture (m,), rad, for each posture of the recipe, or for the first `count` defaults."""
    if not given:
        lower, upper = finger.limits.T
        for k, fraction in enumerate(DEFAULT_POSTURES[:count]):
            yield _letter(k), lower + fraction * (upper - lower)
    for k, degrees in enumerate(given):
        if len(degrees) != finger.m:
            raise UserError(
                f"recipe: {key}.postures has {len(degrees)} angles in one posture; give one a joint, {finger.m}"
            )
        posture = np.deg2rad(degrees)
        outside = np.flatnonzero((posture < finger.limits[:, 0]) | (posture > finger.limits[:, 1]))
        if outside.size:
            joint = finger.joint_names[outside[0]]
            raise UserError(f"recipe: {key}.postures puts {joint} beyond its limits; choose an angle within them")
        yield _letter(k), posture


def _holds(stairs: motions.Staircase, skip: int | None = None) -> Array:
    """Running index of the dwells, −1 between them. The dwell at point `skip` does not count."""
    resting = (stairs.dwelling == 1) & (stairs.step != (-1 if skip is None else skip))
    number = stairs.step - 1 if skip is None else stairs.step - 1 - (stairs.step > skip)
    return np.where(resting, number, -1)


def _taut(finger: FingerDescription, time: Array, tension: float, rng: np.random.Generator) -> Array:
    """Tensions (n, N), N, of active tendons that a controller keeps near one value, within a twentieth of it."""
    wave = np.stack([np.sin(2 * np.pi * (rng.uniform(0.05, 0.2) * time + rng.uniform())) for _ in range(finger.n)])
    return tension * (1.0 + 0.05 * wave) * finger.active[:, None]


def _slack(finger: FingerDescription, time: Array) -> Array:
    """Tensions (n, N) of slack tendons."""
    return np.zeros((finger.n, time.size))


def _row(rows: int, row: int, values: Array) -> Array:
    """Return an array of zeros with one row of values."""
    table = np.zeros((rows, values.size), dtype=values.dtype)
    table[row] = values
    return table


def _stacked(paths: Sequence[motions.Path]) -> tuple[Array, Array, Array]:
    """Return q, q̇ and q̈, each (m, N), of the joints' paths."""
    q, qd, qdd = (np.stack(parts) for parts in zip(*paths, strict=True))
    return q, qd, qdd


def _inset(limits: Array) -> tuple[float, float]:
    """Joint limits moved inward by INSET of the range, rad."""
    margin = INSET * (limits[1] - limits[0])
    return float(limits[0] + margin), float(limits[1] - margin)


def _clock(rate: float, duration: float) -> Array:
    return np.arange(max(2, round(duration * rate))) / rate


def _letter(k: int) -> str:
    return ascii_lowercase[k] if k < 26 else f"{k:03d}"


def _rng(trials: Trials, motion: str) -> np.random.Generator:
    """Random generator of one motion: it depends only on the motion's name and `motion_seed`."""
    return np.random.default_rng([trials.motion_seed, zlib.crc32(motion.encode())])
