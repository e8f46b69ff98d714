"""Compare the sampling rate that a mapping states with the clocks of the recording itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxfinger.data.findings import Report
from jaxfinger.data.importing.columns import Clock
from jaxfinger.data.importing.recording import Recording
from jaxfinger.data.importing.survey import MIN_GAP, columns_of
from jaxfinger.data.toml import Place
from jaxfinger.data.units import TO_SI, unit_name
from jaxfinger.errors import counted

_MAX_ERROR = 0.05  # of a rate: oscillators are right to a ten-thousandth, and round numbers of rates to some per cent.
_MIN_STEPS = 20  # Fewer show no usual step.


def compare_rate(rate: float, clock: Clock, recording: Recording, where: Place, report: Report) -> None:
    """Warn where a clock of the recording contradicts the rate, Hz, by which a trial's samples are counted.

    A clock without stated units contradicts it only if it does so in each of them.
    """
    for name, time in _clocks(clock, recording):
        unit = unit_name(recording.variables[name].units)
        factors = [TO_SI[unit].factor] if unit else [u.factor for u in TO_SI.values() if u.si == "s"]
        steps = np.diff(time) / np.diff(clock.rows)
        usual, mean = float(np.median(steps)), float((time[-1] - time[0]) / (clock.rows[-1] - clock.rows[0]))
        # Coarse stamps have no usual step, and gaps lengthen the mean one.
        error = _MAX_ERROR if usual else _MAX_ERROR + float(steps.max() / mean) / len(steps)
        agrees = [any(abs(np.log(rate * step * f)) < error for step in (usual, mean) if step) for f in factors]
        mend = f"name it as `time` in place of rate_hz = {rate:g}"
        gaps = (steps > MIN_GAP * usual) & (usual > 0.0)
        if not any(agrees):
            step = usual or mean
            runs = (
                f"runs at {1.0 / (step * factors[0]):.4g} Hz" if unit else f"goes on by {step:.4g}, which no unit fits"
            )
            report.warning(where.key, f"the recording's own clock {name!r} {runs}; {mend}, or correct the rate")
        elif gaps.any():
            lost = counted(int(gaps.sum()), "gap")
            report.warning(where.key, f"the recording's own clock {name!r} has {lost}, which the rate closes; {mend}")


def _clocks(clock: Clock, recording: Recording) -> Iterator[tuple[str, np.ndarray]]:
    """Clocks of the recording that run through a trial's samples: name, and times in their own units."""
    if len(clock.rows) <= _MIN_STEPS:
        return
    for seen in columns_of(recording):
        if seen.meaning != "time" or seen.samples != clock.total:
            continue
        time = np.ravel(recording.variables[seen.name].values)[clock.rows]
        steps = np.diff(time)
        counts = (steps == np.diff(clock.rows)).all()  # A count of samples, in no unit of time.
        if np.isfinite(time).all() and steps.min() >= 0.0 and steps.any() and (seen.stated or not counts):
            yield seen.name, time
