"""Check positions for jumps that no joint or tendon makes. What a jump looks like tells its cause and its mend.

1. An encoder that wraps jumps by its period: by a whole turn, or from one end of its readings to the other.
2. Where samples or counts are lost, readings jump by any size, and go on from there.

Values that stand for a missing one, and spikes, jump away and back again. They have checks of their own.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.session import FingerDescription, Trial
from jaxfinger.data.signals.motion import still_spans
from jaxfinger.data.signals.quantiles import median, quantile
from jaxfinger.data.signals.spikes import longest_spike
from jaxfinger.data.signals.unmeasured import placeholder
from jaxfinger.errors import counted

_TURN = 2.0 * np.pi
_MIN_SAMPLES = 20  # Fewer samples show no typical step.
_MIN_JUMP = 0.5  # of a column's range: no motion passes half of it between two samples,
_MAX_STEP = 0.1  # where nine in ten of its steps are shorter than a tenth of it.
_MAX_SPREAD = 0.1  # of a period: jumps over the end of one range differ by what is moved in the meantime.
_MIN_TRAVEL = 0.2  # of a period: a column that travels less once it is unwrapped may as well switch between two values.
_MIN_ALIKE = 0.9  # of the jumps are as large as the period: the others are spikes.
_MIN_RETURNS = 6  # jumps, where none lasts: three times there and back. Fewer are as well spikes as large as a turn.
_MAX_WAIT = 5.0  # usual intervals between two samples: in a longer one a joint may move far.


def check_jumps(trial: Trial, finger: FingerDescription, report: Report) -> None:
    """Report joints and tendons whose position jumps."""
    if len(trial.time) < _MIN_SAMPLES or not np.all(np.diff(trial.time) > 0.0):
        return
    steps = np.diff(trial.time)
    found = [
        (channel, name, x, turns, _jumps(x, turns, least))
        for channel, name, x, turns, least in _positions(trial, finger)
    ]
    places, count = np.unique(np.concatenate([np.zeros(0, int), *(jumps for *_, jumps in found)]), return_counts=True)
    for channel, name, x, turns, jumps in found:
        if not len(jumps):
            continue
        lasting = _lasting(x, jumps, longest_spike(median(steps)))
        # Encoders do not wrap together. Where all jump at once, samples are lost or repeated.
        together = bool(np.isin(jumps, places[count > 1]).all())
        period = None if together else _period(x, jumps, lasting, turns)
        if turns and period == _TURN:
            said, mend = "a whole turn", "the encoder wraps; unwrap it (`unwrap = true` in a mapping)"
        elif period is not None:
            said = f"{period:.3g} {'rad' if turns else 'm'}, from one end of its readings to the other,"
            own = "4096 for the counts of an encoder with 4096 a turn, 360 for its degrees"
            mend = f"the encoder wraps; unwrap it by the variable's own period (`unwrap` in a mapping: {own})"
        elif channel == "q":
            jumps = lasting[steps[lasting] < _MAX_WAIT * median(steps)]
            said = f"{np.max(np.abs(np.diff(x)[jumps]), initial=0.0):.3g} {'rad' if turns else 'm'}"
            mend = "samples or counts are lost there; cut these places out (`span` or `where` in a mapping)"
        else:
            continue  # A tendon may slip far between two samples.
        if len(jumps):
            where = f"at {counted(len(jumps), 'place')}, first at {trial.time[jumps[0]]:.6g} s"
            report.warning(trial.place(channel), f"column {name} jumps by {said} between two samples {where}: {mend}")


def _positions(trial: Trial, finger: FingerDescription) -> Iterator[tuple[str, str, np.ndarray, bool, float]]:
    """Every column of positions: channel, name, values, whether they are angles, and the travel below which it stands
    still."""
    names = finger.joint_names
    for name, x, slides, least in zip(names, trial.q.T, finger.prismatic, still_spans(finger), strict=True):
        yield "q", name, x, not slides, float(least)
    if trial.tendon_excursion is not None:
        for name, x, active in zip(finger.tendon_names, trial.tendon_excursion.T, finger.active, strict=True):
            if active:
                yield "tendon_excursion", name, x, False, 0.0


def _jumps(x: np.ndarray, turns: bool, least: float) -> np.ndarray:
    """Indices of the samples after which a column jumps: over half of its range, where its usual steps are short."""
    steps = np.abs(np.diff(x))
    span = np.nanmax(x) - np.nanmin(x) if np.isfinite(x).any() else 0.0
    jumps = np.flatnonzero(steps > max(_MIN_JUMP * span, least))
    if not len(jumps) or placeholder(x) is not None:
        return jumps[:0]
    if turns and np.all(np.abs(steps[jumps] / _TURN - 1.0) < _MAX_SPREAD):
        return jumps  # A joint that rests at the end of the encoder's range jumps at every other sample.
    usual = steps[steps > 0.0]  # not of an encoder that rests, nor of samples that repeat the one before
    return jumps if quantile(usual, 0.9) < _MAX_STEP * span else jumps[:0]


def _lasting(x: np.ndarray, jumps: np.ndarray, longest: int) -> np.ndarray:
    """Those of the jumps that do not come back within `longest` samples, as spikes do."""
    up = np.sign(x[jumps + 1] - x[jumps])
    back = (np.diff(jumps) <= longest) & (up[1:] == -up[:-1])
    return jumps[~(np.append(back, False) | np.append(False, back))]


def _period(x: np.ndarray, jumps: np.ndarray, lasting: np.ndarray, turns: bool) -> float | None:
    """Period of an encoder, in units of the column, if the column jumps as one that wraps; None otherwise."""
    steps = np.diff(x)
    usual = np.nan_to_num(steps)
    usual[jumps] = 0.0
    beside = 0.5 * (usual[np.maximum(jumps - 1, 0)] + usual[np.minimum(jumps + 1, len(usual) - 1)])
    sizes = np.abs(steps[jumps] - beside)  # without the motion between the two samples
    period = median(sizes)
    alike = np.mean(np.abs(sizes / period - 1.0) < _MAX_SPREAD) >= _MIN_ALIKE
    if not alike or (not len(lasting) and len(jumps) < _MIN_RETURNS):
        return None
    if turns and abs(period / _TURN - 1.0) < _MAX_SPREAD:
        return _TURN
    good = x[np.isfinite(x)]
    wide = np.ptp(good) < (1.0 + _MAX_SPREAD) * period
    travel = np.ptp(np.unwrap(good, period=period))
    return period if len(lasting) and wide and travel > _MIN_TRAVEL * period else None
