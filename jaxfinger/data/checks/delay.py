"""Check that channels are in time with the joint that turns. Laws hold at every instant, whatever the model.

1. ID.3-dynamic: the torque of the joint follows from its angle, direction, speed and acceleration.
2. ID.2: the excursion of a tendon follows from the joint's angle and direction, and from the tensions.

What turns with the direction, friction, depends on the angle too.

The left side is regressed on the right one and shifted in time until least is left over. Friction with pre-sliding and
play seem late too, but by a travel instead of a time. A shift is therefore called a delay only if

3. it stays the same beside hysteresis, which is a function of the way of q whatever the speed; and
4. it explains most of what hysteresis leaves, or is the same at slow and fast strokes.

A low-pass filter, as of a torque sensor's amplifier, does more than shift. Law 1 shows it by one more term, the rate of
the torque itself (`_time_constant`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.signals.delays import (
    LONGEST_SHARE,
    MAX_CHANGE,
    MIN_DELAY,
    MIN_GAIN,
    MIN_SAMPLES,
    MIN_SHARE,
    UNIQUE_TRAVELS,
    best_shifts,
    even,
    means,
    stops,
)
from jaxfinger.data.signals.filtering import low_pass, smooth
from jaxfinger.data.signals.motion import CUTOFF_HZ, fitting_cutoff
from jaxfinger.data.signals.sizes import SWEEP_TIME, travel_time
from jaxfinger.errors import listed

_DEGREE = 5  # of torque and excursion as polynomials of the angle, as in `checks.work`
_FRICTION_DEGREE = 1  # of friction as a polynomial of the angle; more terms would hold a part of a filter's lag
_REST_SHARE = 0.02  # of the highest speed: slower samples may be at rest, where friction takes any value.
# Longest delay that is looked for, in times that a tenth of the travel takes: 20 are two thirds of the period of a
# sine, after which it repeats.
_LONGEST_TRAVELS = 20.0
# Of the channel's rms, that a law leaves at the best shift: sensors leave 1 to 2 %. A law that leaves more is not quite
# that of the joint, as of a servo whose friction grows with load. Some shift then fits better by chance, so that the
# gain has to be larger in proportion.
_USUAL_LEFT = 0.02
# Factor by which a filter shrinks what the law leaves: it explains more than half of it.
_MIN_FILTER_GAIN = 1.5
# Of stiffness times time constant. A spring behind a damper obeys the same equation, with a damping larger than that,
# since its torque leads. That of a filtered torque is the joint's own.
_MAX_LEAD = 0.5
_PER_FILTER = 8  # samples in a mean at most, for ẏ to be free of noise
_WIDTHS = 0.003, 0.01, 0.03, 0.1, 0.3  # of the travel: from the shortest pre-sliding that the filter shows to wide play
_MIN_PACES = 1.5  # ratio of the speeds of fast and slow strokes from which they are compared
_MAX_POWER = 0.25  # of the speed, by which a shift may fall: it is 0 of a delay and 1 of a travel.


def check_delay(session: Session, report: Report) -> None:
    """Report torques (ID.3-dynamic) and excursions (ID.2) that come late, and angles that come late against them."""
    finger = session.finger
    for trial in session.select("ID.2", "ID.3-dynamic"):
        i, led = finger.joint(trial.joint), trial.experiment == "ID.2"
        if i is None:
            continue
        columns = finger.active & finger.crosses[:, i] if led else np.arange(finger.m) == i
        channel = "tendon_excursion" if led else "joint_torque"
        motion = _motion(trial, i, channel, np.flatnonzero(columns))
        if motion is None:
            continue
        delays = _delays(motion)
        say_delays(trial, channel, "q", finger.joint_names[i], finger, delays, report)
        if not delays and not led and (constant := _time_constant(motion)):
            said = f"column {trial.joint} has passed a low-pass filter of about {0.5 / (np.pi * constant):.2g} Hz"
            mend = "record it without, or filter both"
            report.warning(trial.place(channel), f"{said}, and q of {trial.joint} has not; {mend}")


class _Motion(NamedTuple):
    """A trial in which one joint turns, at even steps and filtered: columns y that follow from the motion by X."""

    trial: Trial
    columns: np.ndarray  # (k,) of the channel
    cutoff: float  # Hz, of the filter
    travel: float  # s, `travel_time`
    longest: int  # samples, delay that is looked for
    time: np.ndarray  # (N,), s
    angle: np.ndarray  # (N,), rad, not filtered
    rate: np.ndarray  # (N,), rad/s
    moves: np.ndarray  # (N,) mask of the samples that count
    X: np.ndarray  # (N, p)
    y: np.ndarray  # (k, N)

    @property
    def hysteresis(self) -> np.ndarray:
        """Stop operators of the angle (N, w), filtered as X is."""
        return low_pass(self.time, _hysteresis(self.angle), self.cutoff)


def _motion(trial: Trial, joint: int, channel: str, columns: np.ndarray) -> _Motion | None:
    """The motion of a trial, and those of the columns of `channel` that are measured; None where there is too little.

    The last columns of X are the joint's speed and acceleration where the channel is its torque.
    """
    values = getattr(trial, channel)
    if values is None or len(trial.time) < MIN_SAMPLES or not np.isfinite(trial.q[:, joint]).all():
        return None
    columns = columns[np.isfinite(values[:, columns]).all(axis=0) & (np.ptp(values[:, columns], axis=0) > 0.0)]
    travel = travel_time(trial.time, trial.q[:, [joint]])
    if not columns.size or travel <= 0.0:
        return None
    tension = trial.tendon_force if channel == "tendon_excursion" else None
    given = np.zeros((len(trial.time), 0)) if tension is None else tension[:, np.isfinite(tension).all(axis=0)]
    # The filter spans the same share of the travel on quick and slow machines.
    cutoff = CUTOFF_HZ * SWEEP_TIME / travel
    time, angle, given, y = even(cutoff, trial.time, trial.q[:, joint], given, values[:, columns])
    if len(time) < MIN_SAMPLES:
        return None
    cutoff, step = fitting_cutoff(time, cutoff), float(time[1] - time[0])
    q, rate, acceleration = smooth(time, angle, cutoff)
    powers = np.polynomial.polynomial.polyvander((q - q.mean()) / np.ptp(q), _DEGREE)
    friction = np.sign(rate)[:, None] * powers[:, : _FRICTION_DEGREE + 1]
    filtered = low_pass(time, np.column_stack([y, friction, given]), cutoff)
    y, given = filtered[:, : len(columns)], filtered[:, len(columns) :]
    longest = int(min(LONGEST_SHARE * len(time), _LONGEST_TRAVELS * travel / step))
    moves = np.abs(rate) > _REST_SHARE * np.percentile(np.abs(rate), 95)
    moves[:longest] = moves[len(time) - longest :] = False
    if moves.sum() < MIN_SAMPLES:
        return None
    X = np.column_stack([powers, given, *((rate, acceleration) if channel == "joint_torque" else ())])
    y = (y - y[moves].mean(axis=0)).T
    return _Motion(trial, columns, cutoff, travel, longest, time, angle, rate, moves, X, y)


def _delays(motion: _Motion) -> list[tuple[int, float]]:
    """Columns that are not in time with the joint's angle, and their delays, s; negative if it is late."""
    X, y, moves, longest = motion.X, motion.y, motion.moves, motion.longest
    step = float(motion.time[1] - motion.time[0])
    least = max(MIN_DELAY / motion.cutoff, float(np.median(np.diff(motion.trial.time)))) / step
    found, out = best_shifts(y, X, moves, longest), []
    late = [abs(x.samples) > least and x.gain > MIN_GAIN * max(1.0, x.left / _USUAL_LEFT) for x in found]
    if not any(late):
        return out
    beside = best_shifts(y, np.column_stack([X, motion.hysteresis]), moves, longest)
    for k in np.flatnonzero(late):
        shift = found[k].samples
        if abs(beside[k].samples - shift) < MAX_CHANGE * abs(shift) and (
            (beside[k].gain > MIN_GAIN and abs(shift) * step < UNIQUE_TRAVELS * motion.travel)
            or _same_at_every_speed(y[[k]], X, moves, motion.rate, min(longest, int(2.0 * abs(shift)) + 1))
        ):
            out.append((int(motion.columns[k]), shift * step))
    return out


def _time_constant(motion: _Motion) -> float:
    """Time constant, s, of the low-pass that the torque has passed and the angle has not; 0 where there is none.

    Behind a filter of first order with the time constant T, y + T ẏ = X β, so that ẏ adds what the law leaves.
    """
    size = max(1, min(_PER_FILTER, len(motion.time) // (3 * MIN_SAMPLES)))  # ẏ is to be free of noise.
    time, X, y = (means(x, size) for x in (motion.time, motion.X, motion.y[0]))
    moves, change = means(motion.moves, size) == 1.0, np.gradient(y, time)
    if moves.sum() < MIN_SAMPLES:
        return 0.0
    filtered = np.column_stack([X, change])
    before, (after, beta) = _fit(X, y, moves)[0], _fit(filtered, y, moves)
    if before <= _MIN_FILTER_GAIN * max(after, np.sqrt(MIN_SHARE) * float(np.std(y))):
        return 0.0
    constant, hysteresis = -float(beta[-1]), means(motion.hysteresis, size)
    before, after = (_fit(np.column_stack([x, hysteresis]), y, moves)[0] for x in (X, filtered))
    # The torque's slope over the angle, between the ends of the motion.
    low, high = X[[np.argmin(X[:, 1]), np.argmax(X[:, 1])], : _DEGREE + 1] @ beta[: _DEGREE + 1]
    leads = beta[-3] > _MAX_LEAD * constant * (high - low) / np.ptp(motion.angle)
    return constant if before > _MIN_FILTER_GAIN * after and constant > 0.0 and not leads else 0.0


def _fit(X: np.ndarray, y: np.ndarray, where: np.ndarray) -> tuple[float, np.ndarray]:
    """Root mean square that is left of y by least squares, and the coefficients."""
    beta = np.linalg.lstsq(X[where], y[where], rcond=1e-9)[0]
    return float(np.sqrt(np.mean((y[where] - X[where] @ beta) ** 2))), beta


def _hysteresis(q: np.ndarray) -> np.ndarray:
    """Stop operators of q (N,), a column for each of `_WIDTHS`: springs that slide where they are deflected by the
    width.

    Their weighted sums are the hysteresis of Prandtl and Ishlinskii, which depends on the way of q alone.
    """
    return stops(q[:, None], np.ptp(q) * np.array(_WIDTHS))


def _same_at_every_speed(y: np.ndarray, X: np.ndarray, moves: np.ndarray, rate: np.ndarray, longest: int) -> bool:
    """Whether the slow and the fast half of all strokes show one shift; false where their speeds are alike."""
    stroke = np.cumsum(np.diff(np.sign(rate), prepend=0.0) != 0.0)
    speed = (np.bincount(stroke, moves * np.abs(rate)) / np.maximum(np.bincount(stroke, moves), 1))[stroke]
    slow = moves & (speed <= np.median(speed[moves]))
    fast = moves & ~slow
    if min(slow.sum(), fast.sum()) < MIN_SAMPLES:
        return False
    paces = speed[fast].mean() / speed[slow].mean()
    a, b = (best_shifts(y, X, part, longest)[0].samples for part in (slow, fast))
    return bool(paces > _MIN_PACES and a * b > 0.0 and abs(np.log(a / b)) < _MAX_POWER * np.log(paces))


def say_delays(
    trial: Trial,
    channel: str,
    cause: str,
    name: str,
    finger: FingerDescription,
    delays: Iterable[tuple[int, float]],
    report: Report,
) -> None:
    """Report the columns of `channel` that come before or after column `name` of the channel `cause`, delays in s."""
    names, by_name = CHANNELS[channel].columns(finger), dict(delays)
    mend = "take both from one clock (`time` of a column in a mapping), and filter both or neither"
    if late := [k for k, delay in by_name.items() if delay > 0.0]:
        columns = [names[k] for k in late]
        said = f"column {columns[0]} comes" if len(late) == 1 else f"columns {listed(columns)} come"
        said = f"{said} {1e3 * np.median([by_name[k] for k in late]):.0f} ms after {cause} of {name}"
        report.warning(trial.place(channel), f"{said}; {mend}")
    if early := [k for k, delay in by_name.items() if delay < 0.0]:
        said = f"column {name} comes {-1e3 * np.median([by_name[k] for k in early]):.0f} ms after"
        of = listed([names[k] for k in early])
        report.warning(trial.place(cause), f"{said} {channel} of {of}; {mend}")
