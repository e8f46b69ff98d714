"""Check that the channels of a trial are in time with each other. Two laws hold at every instant, whatever the model.

1. ID.3-dynamic: the torque of the joint that turns follows from its angle, direction, speed and acceleration.
2. ID.2: the excursion of a tendon follows from the angle of the joint that turns, its direction and the tensions.

The left side is regressed on the right one and shifted in time until least is left over. Friction with pre-sliding and
play seem late too, but by a travel instead of a time. A shift is therefore called a delay only if

3. it stays the same beside hysteresis, which is a function of the way of q whatever the speed; and
4. it explains most of what hysteresis leaves, or is the same at slow and fast strokes.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxfinger.data.filtering import fourier_length, low_pass, smooth, uniform_grid
from jaxfinger.data.findings import Report
from jaxfinger.data.motion import CUTOFF_HZ, fitting_cutoff
from jaxfinger.data.session import Session, Trial
from jaxfinger.data.sizes import SWEEP_TIME, travel_time
from jaxfinger.errors import listed

_DEGREE = 5  # of torque and excursion as polynomials of the angle, as in `check_work`
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
_WIDTHS = 0.003, 0.01, 0.03, 0.1, 0.3  # of the travel: from the shortest pre-sliding that the filter shows to wide play
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
    finger = session.finger
    for trial in session.select("ID.2", "ID.3-dynamic"):
        if trial.joint not in finger.joint_names:
            continue
        i = finger.joint_names.index(trial.joint)
        if trial.experiment == "ID.2":
            channel, names, columns = "tendon_excursion", finger.tendon_names, finger.active & finger.crosses[:, i]
        else:
            channel, names, columns = "joint_torque", finger.joint_names, np.arange(finger.m) == i
        delays = {names[k]: delay for k, delay in _delays(trial, i, channel, np.flatnonzero(columns))}
        mend = "take both from one clock (`time` of a column in a mapping), and filter both or neither"
        if late := [name for name, delay in delays.items() if delay > 0.0]:
            said = f"column {late[0]} comes" if len(late) == 1 else f"columns {listed(late)} come"
            said = f"{said} {1e3 * np.median([delays[name] for name in late]):.0f} ms after q of {trial.joint}"
            report.warning(f"/trials/{trial.name}/{channel}", f"{said}; {mend}")
        if early := [name for name, delay in delays.items() if delay < 0.0]:
            said = f"column {trial.joint} comes {-1e3 * np.median([delays[name] for name in early]):.0f} ms after"
            report.warning(f"/trials/{trial.name}/q", f"{said} {channel} of {listed(early)}; {mend}")


def _delays(trial: Trial, joint: int, channel: str, columns: np.ndarray) -> Iterator[tuple[int, float]]:
    """Columns of a channel that are not in time with the joint's angle, and their delays, s; negative if it is late."""
    values = getattr(trial, channel)
    if values is None or len(trial.time) < _MIN_SAMPLES or not np.isfinite(trial.q[:, joint]).all():
        return
    columns = columns[np.isfinite(values[:, columns]).all(axis=0) & (np.ptp(values[:, columns], axis=0) > 0.0)]
    travel = travel_time(trial.time, trial.q[:, [joint]])
    if not columns.size or travel <= 0.0:
        return
    tension = trial.tendon_force if channel == "tendon_excursion" else None
    given = np.zeros((len(trial.time), 0)) if tension is None else tension[:, np.isfinite(tension).all(axis=0)]
    # The filter spans the same share of the travel on quick and slow machines.
    cutoff = CUTOFF_HZ * SWEEP_TIME / travel
    time, angle, given, y = _even(cutoff, trial.time, trial.q[:, joint], given, values[:, columns])
    if len(time) < _MIN_SAMPLES:
        return
    cutoff, step = fitting_cutoff(time, cutoff), float(time[1] - time[0])
    q, rate, acceleration = smooth(time, angle, cutoff)
    filtered = low_pass(time, np.column_stack([y, np.sign(rate), given]), cutoff)
    y, given = filtered[:, : len(columns)], filtered[:, len(columns) :]
    longest = int(min(_LONGEST_SHARE * len(time), _LONGEST_TRAVELS * travel / step))
    moves = np.abs(rate) > _REST_SHARE * np.percentile(np.abs(rate), 95)
    moves[:longest] = moves[len(time) - longest :] = False
    if moves.sum() < _MIN_SAMPLES:
        return
    powers = np.polynomial.polynomial.polyvander((q - q.mean()) / np.ptp(q), _DEGREE)
    X = np.column_stack([powers, given, *((rate, acceleration) if channel == "joint_torque" else ())])
    y = (y - y[moves].mean(axis=0)).T
    least = max(_MIN_DELAY / cutoff, float(np.median(np.diff(trial.time)))) / step
    found = _shifts(y, X, moves, longest)
    late = [abs(x.samples) > least and x.gain > _MIN_GAIN * max(1.0, x.left / _USUAL_LEFT) for x in found]
    if not any(late):
        return
    beside = _shifts(y, np.column_stack([X, low_pass(time, _hysteresis(angle), cutoff)]), moves, longest)
    for k in np.flatnonzero(late):
        shift = found[k].samples
        if abs(beside[k].samples - shift) < _MAX_CHANGE * abs(shift) and (
            (beside[k].gain > _MIN_GAIN and abs(shift) * step < _UNIQUE_TRAVELS * travel)
            or _same_at_every_speed(y[[k]], X, moves, rate, min(longest, int(2.0 * abs(shift)) + 1))
        ):
            yield int(columns[k]), shift * step


def _even(cutoff: float, time: np.ndarray, *channels: np.ndarray) -> list[np.ndarray]:
    """Time and channels at even steps, as means over as many samples as a filter at the cut-off, Hz, allows."""
    grid = uniform_grid(time)
    size = max(1, int(1.0 / (_PER_PERIOD * cutoff * (grid[1] - grid[0]))))
    out, count = [], len(grid) // size
    for x in (grid, *channels):
        if grid is not time and x is not grid:
            columns = [np.interp(grid, time, column) for column in x.reshape(len(time), -1).T]
            x = np.reshape(np.transpose(columns), (len(grid), *x.shape[1:]))
        out.append(x[: count * size].reshape(count, size, *x.shape[1:]).mean(axis=1))
    return out


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
    """Stop operators of q, a column for each of `_WIDTHS`: springs that slide where they are deflected by the width.

    Their weighted sums are the hysteresis of Prandtl and Ishlinskii, which depends on the way of q alone.
    """
    widths = np.ptp(q) * np.array(_WIDTHS)
    out = np.zeros((len(q), len(widths)))
    for k, way in enumerate(np.diff(q), 1):
        out[k] = np.clip(out[k - 1] + way, -widths, widths)
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
