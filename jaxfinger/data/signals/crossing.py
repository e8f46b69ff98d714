"""Frequency above which a swept joint's torque of inertia is noisier than its measured torque.

An encoder's noise, differentiated twice and times an inertia, is a torque whose spectrum rises with the frequency,
while that of a torque sensor's noise is flat. Above the frequency at which they meet, a sweep tells nothing of the
inertia, and its residual is the encoder's noise wherever the joint accelerates.
"""

from __future__ import annotations

from statistics import median_low
from typing import TYPE_CHECKING

import numpy as np

from jaxfinger.data.signals.filtering import low_pass, smooth
from jaxfinger.data.signals.noise import robust_std
from jaxfinger.data.signals.quantiles import median
from jaxfinger.data.signals.spikes import without_spikes

if TYPE_CHECKING:
    from jaxtyping import Float

    from jaxfinger.data.session import Session, Trial

MAX_SAMPLES = 8192  # of a sweep that are read, from its middle. Limits the time; at 1 kHz the joint turns back twice.
CUTOFF = 5.0  # Hz, at the protocol's pace: the inertia is told by motion below it
NOISE_RATIO = 4.0  # times that cut-off: what lies above is noise, 20 Hz at the protocol's pace
ROUNDING = 1e-6  # of a column's range, as of a converter of 20 bits: less is no noise of a sensor
HIGHEST = 0.05  # of the sampling rate: leaves three fifths of the spectrum above the cut-off of noise


def crossing_of(session: Session, pace: float) -> float:
    """The frequency, Hz: the low median over all sweeps (ID.3-dynamic) of the median over a sweep's joints.

    Infinite where no sweep tells it. `pace`: duration of the sweeps over that of the protocol's.
    """
    sweeps = [t for t in session if t.experiment == "ID.3-dynamic" and len(t.time) > 3]
    found = [median(np.array(x)) for x in (_crossings(t, pace) for t in sweeps) if x]
    return median_low(found) if found else np.inf


def _crossings(trial: Trial, pace: float) -> list[float]:
    """f, Hz, with J (2π f)² σ_q = σ_τ, of each joint whose torque is measured.

    σ_q and σ_τ are standard deviations of white noise. The inertia J is what a least-squares fit of the low-passed
    torque by 1, q, sgn q̇, q̇ and q̈ finds: also that of a rotor, which nobody may know.
    """
    if trial.joint_torque is None:
        return []
    begin = max(len(trial.time) - MAX_SAMPLES, 0) // 2
    part = slice(begin, begin + MAX_SAMPLES)
    time, angles, torques = trial.time[part], without_spikes(trial.q[part]), without_spikes(trial.joint_torque[part])
    cutoff = min(CUTOFF / pace, HIGHEST / median(np.diff(time)))
    found = []
    for joint in np.flatnonzero(np.isfinite(torques).all(axis=0) & np.isfinite(angles).all(axis=0)):
        angle, torque = angles[:, joint], torques[:, joint]
        q, qd, qdd = smooth(time, angle, cutoff)
        friction, smoothed = (low_pass(time, x, cutoff) for x in (np.sign(qd), torque))
        laws = np.column_stack([np.ones_like(q), q, friction, qd, qdd])
        if not (np.isfinite(laws).all() and np.isfinite(smoothed).all()):
            continue  # damaged times or values, whose rates or sums overflow
        size = np.maximum(np.abs(laws).max(axis=0), 1e-300)  # for rounding, in whatever units
        inertia = abs(np.linalg.lstsq(laws / size, smoothed, rcond=None)[0] / size)[-1]
        of_angle, of_torque = (_noise(time, x, NOISE_RATIO * cutoff) for x in (angle, torque))
        told = of_angle > ROUNDING * np.ptp(angle) and of_torque > ROUNDING * np.ptp(torque)
        if told and inertia > 0.0:
            found.append(float(np.sqrt(of_torque / (inertia * of_angle)) / (2.0 * np.pi)))
    return found


def _noise(time: Float[np.ndarray, " N"], x: Float[np.ndarray, " N"], cutoff: float) -> float:
    """Robust standard deviation of what lies above the cut-off, high-passed three times.

    The low-pass takes (ω σ)²/2 of a motion of frequency ω, with σ its standard deviation in time: a hundredth at 3 Hz
    of one of 20 Hz, and a millionth of it after three passes.
    """
    for _ in range(3):
        x = x - low_pass(time, x, cutoff)
    return robust_std(x)
