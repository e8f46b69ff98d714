"""Check that the channels of a trial are in time with each other. Laws hold at every instant, whatever the model.

1. ID.3-dynamic: the torque of the joint that turns follows from its angle, direction, speed and acceleration.
2. ID.2: the excursion of a tendon follows from the angle of the joint that turns, its direction and the tensions.
3. ID.4: the torque that holds a joint follows from the tension of the tendon that is pulled, and from the way of it.
4. VD.2: so does the force at the fingertip.

The left side is regressed on the right one and shifted in time until least is left over. Friction with pre-sliding and
play seem late too, but by a travel instead of a time. A shift is therefore called a delay only if

5. it stays the same beside hysteresis, which is a function of the way of q (or of the tension) whatever the speed; and
6. it explains most of what hysteresis leaves, or is the same at slow and fast strokes.

Where a joint is held, the tension rests between its steps: what is late then still moves, and hysteresis does not.

A low-pass filter, as of a torque sensor's amplifier, does more than shift. Law 1 shows it by one more term, the rate of
the torque itself (`_time_constant`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from jaxfinger.data.filtering import fourier_length, low_pass, smooth, uniform_grid
from jaxfinger.data.findings import Report
from jaxfinger.data.motion import CUTOFF_HZ, HOLD_CUTOFF_HZ, fitting_cutoff
from jaxfinger.data.schema import CHANNELS
from jaxfinger.data.session import FingerDescription, Session, Trial
from jaxfinger.data.sizes import MAX_SAMPLES, SWEEP_TIME, travel_time
from jaxfinger.errors import listed

_DEGREE = 5  # of torque and excursion as polynomials of the angle, as in `check_work`
_PULL_DEGREE = 2  # likewise of the tension, beside its hysteresis: friction and stiffness change a little with load
_PER_PERIOD = 8  # samples in a period of the cut-off: the filter passes 0.4 % at half of that rate.
_REST_SHARE = 0.02  # of the highest speed: slower samples may be at rest, where friction takes any value.
_MIN_SAMPLES = 100  # ten for each regressor
# The longest delay that is looked for. As a share of the trial: a longer one leaves too little that both channels
# cover. In times that a tenth of the travel takes: 20 are two thirds of the period of a sine, after which it repeats.
_LONGEST_SHARE, _LONGEST_TRAVELS = 0.1, 20.0
_UNIQUE_TRAVELS = 8.0  # likewise: a quarter of the period. Where all strokes are alike, longer shifts are ambiguous.
_MIN_DELAY = 0.05  # of the cut-off's period, 5 ms at the protocol's pace: a shorter one changes damping by a third.
_MIN_GAIN = 2.0  # factor by which a shift shrinks the residual: a delay explains three quarters of its variance.
# Of the channel's rms, that a law leaves at the best shift: sensors leave 1 to 2 %. A law that leaves more is not quite
# that of the joint, as of a servo whose friction grows with load. Some shift then fits better by chance, so that the
# gain has to be larger in proportion.
_USUAL_LEFT = 0.02
_MIN_SHARE = 1e-8  # of the channel's square, in a residual: a ten-thousandth is below any sensor's noise.
# Factor by which a filter shrinks what the law leaves: it explains more than half of it.
_MIN_FILTER_GAIN = 1.5
# Of stiffness times time constant. A spring behind a damper obeys the same equation, with a damping larger than that,
# since its torque leads. That of a filtered torque is the joint's own.
_MAX_LEAD = 0.5
_WIDTHS = 0.003, 0.01, 0.03, 0.1, 0.3  # of the travel: from the shortest pre-sliding that the filter shows to wide play
# Where columns are shifted alike, each may gain less. Without a delay, the median of a session gains up to a sixth.
_MIN_COLUMNS, _MIN_USUAL_GAIN = 4, 1.25
_PULL_WIDTHS = 0.01, 0.05, 0.2, 0.4, 0.7  # of the highest tension: routed tendons lose up to two thirds of it
_MAX_CHANGE = 0.2  # of a delay, where hysteresis is allowed for: what is hysteresis loses its delay or turns it round.
_MIN_PACES = 1.5  # ratio of the speeds of fast and slow strokes from which they are compared
_MAX_POWER = 0.25  # of the speed, by which a shift may fall: it is 0 of a delay and 1 of a travel.


class Shift(NamedTuple):
    """The shift in time with which a law fits best."""

    samples: float
    gain: float  # factor by which it shrinks what the law leaves
    left: float  # what the law then leaves, of the channel's rms


def check_delay(session: Session, report: Report) -> None:
    """Report columns that come late, each with the columns that it was compared with."""
    _check_motions(session, report)
    _check_pulls(session, report)


def _check_motions(session: Session, report: Report) -> None:
    """Compare torques (ID.3-dynamic) and excursions (ID.2) with the angle of the joint that turns."""
    finger = session.finger
    for trial in session.select("ID.2", "ID.3-dynamic"):
        if trial.joint not in finger.joint_names:
            continue
        i, led = finger.joint_names.index(trial.joint), trial.experiment == "ID.2"
        columns = finger.active & finger.crosses[:, i] if led else np.arange(finger.m) == i
        channel = "tendon_excursion" if led else "joint_torque"
        motion = _motion(trial, i, channel, np.flatnonzero(columns))
        if motion is None:
            continue
        delays = _delays(motion)
        _say(trial, channel, "q", trial.joint, finger, delays, report)
        if not delays and not led and (constant := _time_constant(motion)):
            said = f"column {trial.joint} has passed a low-pass filter of about {0.5 / (np.pi * constant):.2g} Hz"
            mend = "record it without, or filter both"
            report.warning(f"/trials/{trial.name}/{channel}", f"{said}, and q of {trial.joint} has not; {mend}")


def _check_pulls(session: Session, report: Report) -> None:
    """Compare torques (ID.4) and fingertip forces (VD.2) with the tension of the tendon that is pulled."""
    finger = session.finger
    pulls = [pull for trial in session.select("ID.4", "VD.2") if (pull := _pull(trial, finger)) is not None]
    hysteresis = _hysteresis_of([pull.tension for pull in pulls])
    found = [pull.delays(of) for pull, of in zip(pulls, hysteresis, strict=True)]
    is_sure = _sure([delay for delays in found for delay in delays])
    for pull, delays in zip(pulls, found, strict=True):
        late = [(delay.column, delay.time) for delay in delays if abs(delay.time) > pull.least and is_sure(delay)]
        _say(pull.trial, pull.channel, "tendon_force", str(pull.trial.tendon), finger, late, report)


def _say(
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
        report.warning(f"/trials/{trial.name}/{channel}", f"{said}; {mend}")
    if early := [k for k, delay in by_name.items() if delay < 0.0]:
        said = f"column {name} comes {-1e3 * np.median([by_name[k] for k in early]):.0f} ms after"
        of = listed([names[k] for k in early])
        report.warning(f"/trials/{trial.name}/{cause}", f"{said} {channel} of {of}; {mend}")


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
    if values is None or len(trial.time) < _MIN_SAMPLES or not np.isfinite(trial.q[:, joint]).all():
        return None
    columns = columns[np.isfinite(values[:, columns]).all(axis=0) & (np.ptp(values[:, columns], axis=0) > 0.0)]
    travel = travel_time(trial.time, trial.q[:, [joint]])
    if not columns.size or travel <= 0.0:
        return None
    tension = trial.tendon_force if channel == "tendon_excursion" else None
    given = np.zeros((len(trial.time), 0)) if tension is None else tension[:, np.isfinite(tension).all(axis=0)]
    # The filter spans the same share of the travel on quick and slow machines.
    cutoff = CUTOFF_HZ * SWEEP_TIME / travel
    time, angle, given, y = _even(cutoff, trial.time, trial.q[:, joint], given, values[:, columns])
    if len(time) < _MIN_SAMPLES:
        return None
    cutoff, step = fitting_cutoff(time, cutoff), float(time[1] - time[0])
    q, rate, acceleration = smooth(time, angle, cutoff)
    filtered = low_pass(time, np.column_stack([y, np.sign(rate), given]), cutoff)
    y, given = filtered[:, : len(columns)], filtered[:, len(columns) :]
    longest = int(min(_LONGEST_SHARE * len(time), _LONGEST_TRAVELS * travel / step))
    moves = np.abs(rate) > _REST_SHARE * np.percentile(np.abs(rate), 95)
    moves[:longest] = moves[len(time) - longest :] = False
    if moves.sum() < _MIN_SAMPLES:
        return None
    powers = np.polynomial.polynomial.polyvander((q - q.mean()) / np.ptp(q), _DEGREE)
    X = np.column_stack([powers, given, *((rate, acceleration) if channel == "joint_torque" else ())])
    y = (y - y[moves].mean(axis=0)).T
    return _Motion(trial, columns, cutoff, travel, longest, time, angle, rate, moves, X, y)


def _delays(motion: _Motion) -> list[tuple[int, float]]:
    """Columns that are not in time with the joint's angle, and their delays, s; negative if it is late."""
    X, y, moves, longest = motion.X, motion.y, motion.moves, motion.longest
    step = float(motion.time[1] - motion.time[0])
    least = max(_MIN_DELAY / motion.cutoff, float(np.median(np.diff(motion.trial.time)))) / step
    found, out = _shifts(y, X, moves, longest), []
    late = [abs(x.samples) > least and x.gain > _MIN_GAIN * max(1.0, x.left / _USUAL_LEFT) for x in found]
    if not any(late):
        return out
    beside = _shifts(y, np.column_stack([X, motion.hysteresis]), moves, longest)
    for k in np.flatnonzero(late):
        shift = found[k].samples
        if abs(beside[k].samples - shift) < _MAX_CHANGE * abs(shift) and (
            (beside[k].gain > _MIN_GAIN and abs(shift) * step < _UNIQUE_TRAVELS * motion.travel)
            or _same_at_every_speed(y[[k]], X, moves, motion.rate, min(longest, int(2.0 * abs(shift)) + 1))
        ):
            out.append((int(motion.columns[k]), shift * step))
    return out


def _time_constant(motion: _Motion) -> float:
    """Time constant, s, of the low-pass that the torque has passed and the angle has not; 0 where there is none.

    Behind a filter of first order with the time constant T, y + T ẏ = X β, so that ẏ adds what the law leaves.
    """
    size = max(1, min(_PER_PERIOD, len(motion.time) // (3 * _MIN_SAMPLES)))  # ẏ is to be free of noise.
    time, X, y = (_means(x, size) for x in (motion.time, motion.X, motion.y[0]))
    moves, change = _means(motion.moves, size) == 1.0, np.gradient(y, time)
    if moves.sum() < _MIN_SAMPLES:
        return 0.0
    filtered = np.column_stack([X, change])
    before, (after, beta) = _fit(X, y, moves)[0], _fit(filtered, y, moves)
    if before <= _MIN_FILTER_GAIN * max(after, np.sqrt(_MIN_SHARE) * float(np.std(y))):
        return 0.0
    constant, hysteresis = -float(beta[-1]), _means(motion.hysteresis, size)
    before, after = (_fit(np.column_stack([x, hysteresis]), y, moves)[0] for x in (X, filtered))
    # The torque's slope over the angle, between the ends of the motion.
    low, high = X[[np.argmin(X[:, 1]), np.argmax(X[:, 1])], : _DEGREE + 1] @ beta[: _DEGREE + 1]
    leads = beta[-3] > _MAX_LEAD * constant * (high - low) / np.ptp(motion.angle)
    return constant if before > _MIN_FILTER_GAIN * after and constant > 0.0 and not leads else 0.0


def _fit(X: np.ndarray, y: np.ndarray, where: np.ndarray) -> tuple[float, np.ndarray]:
    """Root mean square that is left of y by least squares, and the coefficients."""
    beta = np.linalg.lstsq(X[where], y[where], rcond=1e-9)[0]
    return float(np.sqrt(np.mean((y[where] - X[where] @ beta) ** 2))), beta


class _Pull(NamedTuple):
    """A trial in which one tendon is pulled while all joints are held, at even steps.

    What the tendon pulls on then follows the tension, with the hysteresis of the tendon's friction.
    """

    trial: Trial
    channel: str  # of what the tendon pulls on
    columns: np.ndarray  # (k,) of the channel
    cutoff: float  # Hz, of the filter
    longest: int  # samples, delay that is looked for
    time: np.ndarray  # (N,), s
    tension: np.ndarray  # (N,), N
    values: np.ndarray  # (N, k), N m or N

    @property
    def least(self) -> float:
        """Shortest delay, s, that is reported."""
        return max(_MIN_DELAY / self.cutoff, float(np.median(np.diff(self.trial.time))))

    def delays(self, hysteresis: np.ndarray) -> list[_Delay]:
        """Delay of each column by which it follows best from the tension and its `hysteresis` (N, w)."""
        step, f = float(self.time[1] - self.time[0]), self.tension
        X = np.column_stack([np.polynomial.polynomial.polyvander((f - f.mean()) / np.ptp(f), _PULL_DEGREE), hysteresis])
        inner = np.zeros(len(f), bool)
        inner[self.longest : len(f) - self.longest] = True
        found = _shifts((self.values - self.values[inner].mean(axis=0)).T, X, inner, self.longest)
        return [_Delay(int(k), x.samples * step, x.gain) for k, x in zip(self.columns, found, strict=True)]


class _Delay(NamedTuple):
    """Delay of a column against a tension."""

    column: int
    time: float  # s, negative if the tension is late
    gain: float  # factor by which the delay shrinks what the law leaves


def _sure(delays: Sequence[_Delay]) -> Callable[[_Delay], bool]:
    """Which delays of a session are sure: those that gain much, or are the usual one where most columns show the same.

    Noise, and hysteresis that the law lacks, shift each column by another time.
    """
    if len(delays) < _MIN_COLUMNS:
        return lambda delay: delay.gain > _MIN_GAIN
    low, usual, high = np.percentile([delay.time for delay in delays], (25, 50, 75))
    gains = float(np.median([delay.gain for delay in delays])) > _MIN_USUAL_GAIN
    shared = gains and high - low < _MAX_CHANGE * abs(usual)
    return lambda delay: delay.gain > _MIN_GAIN or (shared and abs(delay.time - usual) < _MAX_CHANGE * abs(usual))


def _pull(trial: Trial, finger: FingerDescription) -> _Pull | None:
    """The pull of an ID.4 or a VD.2; None where channels are missing or too short to tell."""
    channel = "joint_torque" if trial.experiment == "ID.4" else "fingertip_force"
    values, tension = getattr(trial, channel), trial.tendon_force
    if values is None or tension is None or trial.tendon not in finger.tendon_names or len(trial.time) < _MIN_SAMPLES:
        return None
    f = tension[:, finger.tendon_names.index(trial.tendon)]
    columns = np.flatnonzero(np.isfinite(values).all(axis=0) & (np.ptp(values, axis=0) > 0.0))
    some = slice(None, None, max(1, len(f) // MAX_SAMPLES))  # A step takes a good part of the trial.
    travel = travel_time(trial.time[some], f[some, None]) if np.isfinite(f).all() else 0.0
    if not columns.size or travel <= 0.0:
        return None
    cutoff = HOLD_CUTOFF_HZ * SWEEP_TIME / travel
    time, f, y = _even(cutoff, trial.time, f, values[:, columns])
    if len(time) < _MIN_SAMPLES:
        return None
    longest = int(min(_LONGEST_SHARE * len(time), _UNIQUE_TRAVELS * travel / float(time[1] - time[0])))
    return _Pull(trial, channel, columns, fitting_cutoff(time, cutoff), longest, time, f, y)


def _even(cutoff: float, time: np.ndarray, *channels: np.ndarray) -> list[np.ndarray]:
    """Time and channels at even steps, as means over as many samples as a filter at the cut-off, Hz, allows."""
    grid = uniform_grid(time)
    size = max(1, int(1.0 / (_PER_PERIOD * cutoff * (grid[1] - grid[0]))))
    out = []
    for x in (grid, *channels):
        if grid is not time and x is not grid:
            columns = [np.interp(grid, time, column) for column in x.reshape(len(time), -1).T]
            x = np.reshape(np.transpose(columns), (len(grid), *x.shape[1:]))
        out.append(_means(x, size))
    return out


def _means(x: np.ndarray, size: int) -> np.ndarray:
    """Means over `size` samples each."""
    count = len(x) // size
    return x[: count * size].reshape(count, size, *x.shape[1:]).mean(axis=1)


def _shifts(y: np.ndarray, X: np.ndarray, where: np.ndarray, longest: int) -> list[Shift]:
    """Best shift of each row of y.

    y(t + L) is regressed on X(t) for L from -longest to longest. With an orthonormal basis Q of X the square of the
    residual is |y|² − |Qᵀy|². Over all shifts both terms are circular correlations, of which negative shifts are at the
    end. Up to `longest` they do not wrap, since `where` leaves out as many samples at either end.
    """
    Q, R = np.linalg.qr(X[where])
    size, length = np.abs(np.diag(R)), fourier_length(len(X))
    left = np.zeros((X.shape[1] + 1, len(X)))
    left[:-1, where] = (Q * (size > 1e-9 * size.max())).T  # A column of X that adds nothing has an arbitrary Q.
    left[-1, where] = 1.0
    turned = np.fft.rfft(left, length).conj()
    explained = np.fft.irfft(turned[:-1] * np.fft.rfft(y, length)[:, None], length)
    square = np.fft.irfft(turned[-1] * np.fft.rfft(y * y, length), length)
    out = []
    for share in (1.0 - (explained**2).sum(axis=1) / square)[:, np.arange(-longest, longest + 1)]:
        k = int(np.argmin(share))
        if not 0 < k < 2 * longest:
            out.append(Shift(0.0, 1.0, 1.0))  # The best shift is further away, or there is none.
            continue
        before, least, after = share[k - 1 : k + 2]
        between = 0.5 * (before - after) / (before - 2.0 * least + after)
        gain = np.sqrt(share[longest] / max(least, _MIN_SHARE))
        out.append(Shift(k - longest + float(between), float(gain), float(np.sqrt(least))))
    return out


def _hysteresis(q: np.ndarray) -> np.ndarray:
    """Stop operators of q (N,), a column for each of `_WIDTHS`: springs that slide where they are deflected by the
    width.

    Their weighted sums are the hysteresis of Prandtl and Ishlinskii, which depends on the way of q alone.
    """
    return _stops(q[:, None], np.ptp(q) * np.array(_WIDTHS))


def _hysteresis_of(tensions: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Stop operators of several tensions at once (N, w), with the widths `_PULL_WIDTHS`."""
    lengths = [len(f) for f in tensions]
    padded = np.zeros((max(lengths, default=0), len(tensions), 1))
    for k, f in enumerate(tensions):
        padded[: len(f), k, 0] = f
    widths = np.reshape([np.ptp(f) for f in tensions], (-1, 1)) * np.array(_PULL_WIDTHS)
    return [out[:length] for length, out in zip(lengths, np.swapaxes(_stops(padded, widths), 0, 1), strict=True)]


def _stops(x: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Deflections, as samples go on along the first axis, of springs that slide beyond ± widths."""
    steps = np.diff(x, axis=0)
    out = np.zeros((len(x), *widths.shape))
    for k, way in enumerate(steps, 1):
        out[k] = np.minimum(np.maximum(out[k - 1] + way, -widths), widths)  # `np.clip` takes four times as long.
    return out


def _same_at_every_speed(y: np.ndarray, X: np.ndarray, moves: np.ndarray, rate: np.ndarray, longest: int) -> bool:
    """Whether the slow and the fast half of all strokes show one shift; false where their speeds are alike."""
    stroke = np.cumsum(np.diff(np.sign(rate), prepend=0.0) != 0.0)
    speed = (np.bincount(stroke, moves * np.abs(rate)) / np.maximum(np.bincount(stroke, moves), 1))[stroke]
    slow = moves & (speed <= np.median(speed[moves]))
    fast = moves & ~slow
    if min(slow.sum(), fast.sum()) < _MIN_SAMPLES:
        return False
    paces = speed[fast].mean() / speed[slow].mean()
    a, b = (_shifts(y, X, part, longest)[0].samples for part in (slow, fast))
    return bool(paces > _MIN_PACES and a * b > 0.0 and abs(np.log(a / b)) < _MAX_POWER * np.log(paces))
