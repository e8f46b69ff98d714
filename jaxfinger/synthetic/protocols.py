"""The rig's programme: every trial of a session as commanded, one function an experiment."""

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
FRACTIONS = (0.3, 0.55)  # of the joints' ranges: the postures where the recipe names none
INSET = 0.08  # share of a joint's range that steps and sweeps keep away from its ends
PAUSE = 15.0  # s between trials


@dataclass(frozen=True)
class TrialPlan:
    """One trial as commanded; joint arrays (m, N), tendon arrays (n, N). In VD.3, `q` is the desired motion."""

    name: str
    experiment: str
    motion: str
    time: Float[Array, " N"]  # s
    q: Float[Array, "m N"]  # rad
    qd: Float[Array, "m N"]  # rad/s
    qdd: Float[Array, "m N"]  # rad/s²
    tension: Float[Array, "n N"]  # N
    joint: int | None = None  # moved or instrumented
    tendon: int | None = None  # pulled
    joint_direction: Int[Array, "m N"] | None = None
    tendon_direction: Int[Array, "n N"] | None = None
    hold: Int[Array, " N"] | None = None
    session_start: float = 0.0  # s

    @property
    def held(self) -> bool:
        """A fixture holds the joints: they carry no friction, and tendons move only when their loss is exceeded."""
        return self.experiment in ("ID.4", "VD.2")


def session_plan(finger: FingerDescription, trials: Trials) -> tuple[TrialPlan, ...]:
    """All trials of a session in the order in which the rig runs them, repeats side by side; without tendons, those of
    them that need none.

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
    """ID.2: the joint from one end of its range to the other and back, as slowly as a hand does it."""
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
    """ID.3-static: every hold approached from below on the way up and from above on the way down."""
    e = trials.id3_static
    for joint in range(finger.m):
        lower, upper = _inset(finger.limits[joint])
        margin = 0.5 * (lower - finger.limits[joint, 0])
        count = max(5, round((upper - lower) / np.deg2rad(e.step)) + 1)
        steps = np.linspace(lower, upper, count)
        points = [lower - margin, *steps, upper + margin, *steps[::-1]]
        turn = count + 1  # the point beyond the last hold, where nothing is held
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
    """ID.3-dynamic: the joint back and forth at constant speeds."""
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
    """ID.4: from slack up through the tensions and back down, the instrumented joint held."""
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
    """VD.2: the fingertip in the thimble, one tendon pulled in rising steps, the others slack."""
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
    """VD.1: all joints led by hand, tendons kept taut."""
    e = trials.vd1
    for k in range(e.motions):
        motion = f"VD.1-{_letter(k)}"
        rng = _rng(trials, motion)
        time = _clock(trials.rate, e.duration)
        paths = [motions.wander(time, *_inset(limits), rng, (1.0, 3.0)) for limits in finger.limits]
        yield TrialPlan(motion, "VD.1", motion, time, *_stacked(paths), tension=_taut(finger, time, e.tension, rng))


def _drives(finger: FingerDescription, trials: Trials) -> Iterator[TrialPlan]:
    """VD.3: what the tendons are to make of the finger; the tensions come of the rig's controller."""
    e = trials.vd3
    for k in range(e.motions):
        motion = f"VD.3-{_letter(k)}"
        rng = _rng(trials, motion)
        time = _clock(e.rate, e.duration)
        ranges = [(limits[0] + e.centre * np.ptp(limits), e.amplitude * np.ptp(limits)) for limits in finger.limits]
        paths = [motions.swing(time, *span, rng) for span in ranges]
        yield TrialPlan(motion, "VD.3", motion, time, *_stacked(paths), tension=_slack(finger, time))


def _moved(finger, experiment, motion, time, posture, joint, path, tension) -> TrialPlan:
    """One joint along a path, the others held at a posture."""
    q = np.repeat(posture[:, None], time.size, axis=1)
    q[joint] = path.x
    rates = [_row(finger.m, joint, x) for x in (path.v, path.a)]
    return TrialPlan(motion, experiment, motion, time, q, *rates, tension=tension, joint=joint)


def _stepped(finger, rate, experiment, motion, posture, tendon, tensions, move, dwell, joint=None) -> TrialPlan:
    """All joints held, one tendon from slack through steps of tension."""
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
    """Postures with a letter each, rad: the recipe's, or `count` at fractions of the joints' ranges."""
    if not given:
        lower, upper = finger.limits.T
        for k, fraction in enumerate(FRACTIONS[:count]):
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
    """Running index of the rests, −1 elsewhere; the point `skip` is none."""
    resting = (stairs.dwelling == 1) & (stairs.step != (-1 if skip is None else skip))
    number = stairs.step - 1 if skip is None else stairs.step - 1 - (stairs.step > skip)
    return np.where(resting, number, -1)


def _taut(finger: FingerDescription, time: Array, tension: float, rng: np.random.Generator) -> Array:
    """Every active tendon kept near one tension; the controller lets it wander by a twentieth."""
    wave = np.stack([np.sin(2 * np.pi * (rng.uniform(0.05, 0.2) * time + rng.uniform())) for _ in range(finger.n)])
    return tension * (1.0 + 0.05 * wave) * finger.active[:, None]


def _slack(finger: FingerDescription, time: Array) -> Array:
    return np.zeros((finger.n, time.size))


def _row(rows: int, row: int, values: Array) -> Array:
    """Zero but for one row."""
    table = np.zeros((rows, values.size), dtype=values.dtype)
    table[row] = values
    return table


def _stacked(paths: Sequence[motions.Path]) -> tuple[Array, Array, Array]:
    q, qd, qdd = (np.stack(parts) for parts in zip(*paths, strict=True))
    return q, qd, qdd


def _inset(limits: Array) -> tuple[float, float]:
    margin = INSET * (limits[1] - limits[0])
    return float(limits[0] + margin), float(limits[1] - margin)


def _clock(rate: float, duration: float) -> Array:
    return np.arange(max(2, round(duration * rate))) / rate


def _letter(k: int) -> str:
    return ascii_lowercase[k] if k < 26 else f"{k:03d}"


def _rng(trials: Trials, motion: str) -> np.random.Generator:
    """The same commanded motion in every session that is planned with this seed."""
    return np.random.default_rng([trials.motion_seed, zlib.crc32(motion.encode())])
