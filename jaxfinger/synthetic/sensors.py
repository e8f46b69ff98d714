"""Sensors of the simulated rig: they add offsets, coloured noise and spikes, and round to the converters' steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import lfilter

from jaxfinger.data import FingerDescription, Trial
from jaxfinger.synthetic.plant import Channels
from jaxfinger.synthetic.protocols import TrialPlan
from jaxfinger.synthetic.recipe import Cad, Sensor, Sensors

Array = np.ndarray


def record(
    plan: TrialPlan, clean: Channels, finger: FingerDescription, sensors: Sensors, rng: np.random.Generator
) -> Trial:
    """Return the trial that the rig records of clean channels, time first. Columns without a sensor are NaN.

    The clock's jitter is limited to a fifth of a sample, so that times increase.
    """
    dt = float(plan.time[1] - plan.time[0])
    channels = {
        name: _measured(clean[name].T, seen, getattr(sensors, name), sensors, dt, rng)
        for name, seen in _instrumented(plan, finger).items()
        if name in clean
    }
    jitter = np.clip(rng.normal(0.0, sensors.clock_jitter, plan.time.size), -0.2 * dt, 0.2 * dt)
    time = plan.time + jitter
    return Trial(
        plan.name,
        plan.experiment,
        time - time[0],
        q=channels["q"],
        tendon_force=channels.get("tendon_force"),
        tendon_excursion=channels.get("tendon_excursion"),
        joint_torque=channels.get("joint_torque"),
        fingertip_force=channels.get("fingertip_force"),
        joint_direction=None if plan.joint_direction is None else plan.joint_direction.T.astype(np.int8),
        tendon_direction=None if plan.tendon_direction is None else plan.tendon_direction.T.astype(np.int8),
        hold=None if plan.hold is None else plan.hold.astype(np.int32),
        joint=None if plan.joint is None else finger.joint_names[plan.joint],
        tendon=None if plan.tendon is None else finger.tendon_names[plan.tendon],
        motion=plan.motion,
        session_start=plan.session_start,
    )


def drawn_from_cad(finger: FingerDescription, cad: Cad, rng: np.random.Generator) -> FingerDescription:
    """Return the finger as ID.1 gives it: masses and centres of mass with random errors, and their standard deviations.

    A mass is at least a tenth of the true one.
    """
    mass_std = cad.mass * finger.mass
    com_std = np.full(finger.com.shape, cad.com)
    mass = np.maximum(finger.mass + mass_std * rng.standard_normal(finger.m), 0.1 * finger.mass)
    com = finger.com + com_std * rng.standard_normal(finger.com.shape)
    return replace(
        finger,
        mass=mass,
        com=com,
        mass_std=mass_std if cad.mass else finger.mass_std,
        com_std=com_std if cad.com else finger.com_std,
    )


def coloured_noise(sensor: Sensor, shape: tuple[int, int], dt: float, rng: np.random.Generator) -> Array:
    """Noise of variance std² and the given shape (N, columns).

    The share `coloured` of the variance is the stationary AR(1) process x⁺ = a x + √(1 − a²) e with
    a = exp(−dt / correlation_time); the rest is white.
    """
    white = np.sqrt(1.0 - sensor.coloured) * rng.standard_normal(shape)
    a = np.exp(-dt / sensor.correlation_time)
    start = a * rng.standard_normal((1, shape[1]))
    colour, _ = lfilter([np.sqrt(1.0 - a**2)], [1.0, -a], rng.standard_normal(shape), axis=0, zi=start)
    return sensor.std * (white + np.sqrt(sensor.coloured) * colour)


def _instrumented(plan: TrialPlan, finger: FingerDescription) -> dict[str, Bool[Array, " columns"]]:
    """Mask of the columns of each channel that have a sensor which counts in this experiment."""
    joint = np.arange(finger.m) == (-1 if plan.joint is None else plan.joint)
    pulled = finger.active & (np.arange(finger.n) == plan.tendon) if plan.held else finger.active
    return {
        "q": np.ones(finger.m, dtype=bool),
        "tendon_force": finger.active,
        "tendon_excursion": pulled,  # The encoder of a slack tendon does not measure its excursion.
        "joint_torque": joint,
        "fingertip_force": np.ones(3, dtype=bool),
    }


def _measured(
    clean: Float[Array, "N columns"],
    seen: Bool[Array, " columns"],
    sensor: Sensor,
    sensors: Sensors,
    dt: float,
    rng: np.random.Generator,
) -> Float[Array, "N columns"]:
    """Return one channel as its sensors record it; columns outside of the mask `seen` are NaN."""
    count = int(seen.sum())
    value = clean[:, seen] + sensor.offset * rng.standard_normal(count)
    value = value + coloured_noise(sensor, (len(clean), count), dt, rng)
    if sensors.outliers:
        hit = rng.random(value.shape) < sensors.outliers
        size = rng.uniform(*sensors.outlier_size, value.shape) * rng.choice((-1.0, 1.0), value.shape)
        value = value + hit * size * sensor.std
    recorded = np.full(clean.shape, np.nan, dtype=np.float32)  # The rig stores single precision.
    recorded[:, seen] = np.round(value / sensor.resolution) * sensor.resolution
    return recorded.astype(float)
