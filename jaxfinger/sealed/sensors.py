"""Errors of the sensors: partly coloured noise, quantisation, tares, and excursions zeroed by hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxfinger.data import Trial

from .record import Channels, last_direction
from .specimens import Specimen

WHITE = 0.7  # share of the variance that is white; the rest is a first-order process
CORRELATION = 0.012  # s, correlation time of that process
UNITS = {"q": "rad", "tendon_force": "N", "tendon_excursion": "m", "joint_torque": "N m", "fingertip_force": "N"}
STD = {"q": 2e-4, "tendon_force": 0.02, "tendon_excursion": 1e-5, "joint_torque": 3e-4, "fingertip_force": 0.02}
RESOLUTION = {
    "q": 2 * np.pi / 2**14,
    "tendon_force": 50 / 2**12,
    "tendon_excursion": 2.0**-20,
    "joint_torque": 2.0**-16,
    "fingertip_force": 2.0**-10,
}


@dataclass(frozen=True)
class Sensors:
    """Noise of one bench: standard deviations by channel, before quantisation."""

    std: dict[str, float]

    def hold_std(self, channel: str, duration: float = 1.0, rate: float = 250.0) -> float:
        """Standard deviation of a channel's mean over a hold of `duration` s, from the autocovariance of the noise."""
        count = int(duration * rate)
        lag = np.arange(count)
        covariance = (1 - WHITE) * np.exp(-lag / (rate * CORRELATION)) + WHITE * (lag == 0)
        weight = np.where(lag == 0, 1.0, 2.0) * (1 - lag / count)
        return self.std[channel] * float(np.sqrt(np.sum(weight * covariance) / count))


def draw_sensors(rng: np.random.Generator) -> Sensors:
    """Draw a bench whose noise is within a third of `STD`."""
    return Sensors({name: std * float(rng.uniform(0.75, 1.33)) for name, std in STD.items()})


def noise(shape: tuple[int, int], dt: float, std: float, rng: np.random.Generator) -> Float[np.ndarray, "N k"]:
    """Draw stationary noise: a share `WHITE` of the variance is white, the rest an Ornstein–Uhlenbeck process."""
    from scipy.signal import lfilter

    phi = np.exp(-dt / CORRELATION)
    drive = rng.normal(size=shape) * np.sqrt(1 - phi**2)
    drive[0] /= np.sqrt(1 - phi**2)
    coloured = lfilter([1.0], [1.0, -phi], drive, axis=0)
    return std * (np.sqrt(WHITE) * rng.normal(size=shape) + np.sqrt(1 - WHITE) * coloured)


def measure(
    channels: Channels, specimen: Specimen, sensors: Sensors, zero: Float[np.ndarray, " n"], rng: np.random.Generator
) -> Trial:
    """Measure a trial as the bench records it. `zero`: excursion offsets of the session, m."""
    plan, finger = channels.plan, specimen.finger
    dt = 1.0 / plan.rate
    jitter = np.clip(rng.normal(0, 3e-5, len(channels.time)), -0.2 * dt, 0.2 * dt)
    time = channels.time + jitter
    time = time - time[0]

    def sense(name: str, values: np.ndarray) -> np.ndarray:
        noisy = values + noise(values.shape, dt, sensors.std[name], rng)
        step = RESOLUTION[name]
        return (np.round(noisy / step) * step).astype(np.float32)

    # NaN marks columns that the experiment does not measure.
    slack = ~finger.active | (np.abs(channels.tension).max(axis=0) < 0.3)
    tension = np.where(finger.active, channels.tension, np.nan)
    excursion = torque = force = None
    if channels.excursion is not None:
        lost = slack if plan.experiment != "ID.4" else np.arange(finger.n) != plan.tendon
        values = channels.excursion + zero + rng.normal(0, 3e-5, finger.n)
        excursion = sense("tendon_excursion", np.where(lost, np.nan, values))
    if channels.torque is not None:
        tare = rng.normal(0, sensors.hold_std("joint_torque", duration=10.0))
        motorised = (np.arange(finger.m) == plan.joint) | (plan.joint is None)
        torque = sense("joint_torque", np.where(motorised, channels.torque - tare, np.nan))
    if channels.force is not None:
        force = sense("fingertip_force", channels.force)
    hold, joint_direction, tendon_direction = _protocol_channels(channels, finger.active)
    return Trial(
        name=plan.name,
        experiment=plan.experiment,
        time=time,
        q=sense("q", channels.q),
        tendon_force=sense("tendon_force", tension),
        tendon_excursion=excursion,
        joint_torque=torque,
        fingertip_force=force,
        joint_direction=joint_direction,
        tendon_direction=tendon_direction,
        hold=hold,
        joint=None if plan.joint is None else finger.joint_names[plan.joint],
        tendon=None if plan.tendon is None else finger.tendon_names[plan.tendon],
        motion=plan.motion,
        session_start=plan.start,
    )


def _protocol_channels(channels: Channels, active: np.ndarray):
    """Hold index and commanded directions of joints and tendons; None where the experiment has none."""
    plan, t = channels.plan, channels.time
    if not plan.holds:
        return None, None, None
    hold = np.full(len(t), -1, dtype=np.int32)
    for i, (begin, end, _) in enumerate(plan.holds):
        hold[(t >= begin) & (t < end)] = i
    joint = np.zeros(channels.q.shape, dtype=np.int8)
    tendon = np.zeros(channels.tension.shape, dtype=np.int8)
    if plan.experiment == "ID.3-static":
        assert plan.joint is not None
        rate = plan.q[plan.joint](t)[1]
        joint[:, plan.joint] = last_direction(rate[:, None])[:, 0]
        return hold, joint, None
    rates = np.stack([p(t)[1] for p in plan.tension], axis=1)
    tendon[:] = np.where(active, last_direction(rates), 0)
    return hold, joint, tendon
