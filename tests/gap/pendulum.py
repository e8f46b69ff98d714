"""A pendulum with a geared motor, from textbook equations, as a bench records it: motions alone, at 100 Hz.

I q̈ = τ − m g c sin q − d q̇ − f (1 + a exp(−(q̇/v)²)) sign q̇
"""

import numpy as np

from jaxfinger.data import FingerDescription, Session, Trial

MASS, COM, INERTIA, ROTOR, GRAVITY = 0.52, 0.115, 2.3e-3, 0.01, 9.81  # kg, m, kg m² (about the joint less m c²), m/s²
FRICTION, DAMPING = 0.14, 0.09  # N m, N m s/rad
STEP, EVERY = 5e-4, 20  # s; samples of the simulation for each of the recording
SPEED = 0.15  # v, rad/s
SWEEPS = (0.1, 0.3, 0.6)  # Hz
SINES = np.array([0.5, 0.3, 0.3, 0.2, 0.1, 0.05])  # rad
SINES_FROM = {"a": 1 / 12, "b": 1 / 8, "c": 1 / 6}  # Hz, the lowest of a trial's sines
NOISE_TORQUE, NOISE_ANGLE, COUNT = 0.01, 3e-4, 2.0 * np.pi / 4096  # N m, rad, rad


def _moved(reference, stribeck: float):
    """Angle and torque of a motor under a PD controller, by steps that stop where friction would reverse the motion."""
    inertia, weight = INERTIA + MASS * COM**2 + ROTOR, MASS * GRAVITY * COM
    speed = np.gradient(reference) / STEP
    q, v, out = reference[0], 0.0, np.empty((len(reference), 2))
    for k, (r, rd) in enumerate(zip(reference, speed, strict=True)):
        torque = 60.0 * (r - q) + 3.0 * (rd - v) + weight * np.sin(q)
        free = v + STEP / inertia * (torque - weight * np.sin(q) - DAMPING * v)
        stops = STEP / inertia * FRICTION * (1.0 + stribeck * np.exp(-((v / SPEED) ** 2)))
        v = 0.0 if abs(free) <= stops else free - np.sign(free) * stops
        out[k] = q, torque
        q += v * STEP
    return out.T


def pendulum(stribeck: float = 0.0, seed: int = 0) -> Session:
    """A session of a sweep and of sums of sines, one of which is repeated."""
    rng, time = np.random.default_rng(seed), np.arange(0.0, 24.0, STEP)
    finger = FingerDescription(
        gravity=np.array([GRAVITY, 0.0, 0.0]),
        joint_names=("shoulder",),
        axis=np.array([[0.0, 1.0, 0.0]]),
        origin=np.zeros((1, 3)),
        limits=np.array([[-2.0, 2.0]]),
        mass=np.array([MASS]),
        com=np.array([[COM, 0.0, 0.0]]),
        inertia=np.diag([1e-4, INERTIA, INERTIA])[None],
        rotor_inertia=np.array([ROTOR]),
        fingertip=np.array([0.25, 0.0, 0.0]),
        tendon_names=(),
        active=np.zeros(0, bool),
        crosses=np.zeros((0, 1), bool),
    )
    lead = np.clip(np.minimum(time, time[-1] - time), 0.0, 1.0)
    motions = {"sweep": np.concatenate([1.3 * np.cos(2 * np.pi * f * np.arange(0.0, 3.0 / f, STEP)) for f in SWEEPS])}
    for name, base in SINES_FROM.items():
        phases = np.random.default_rng(ord(name)).uniform(0.0, 2.0 * np.pi, len(SINES))
        angles = 2.0 * np.pi * base * np.arange(1, len(SINES) + 1)[:, None] * time + phases[:, None]
        motions[name] = lead**2 * (3.0 - 2.0 * lead) * (SINES @ np.sin(angles))
    trials = {}
    for name in (*motions, "c again"):
        q, torque = _moved(motions[name[:1] if name == "c again" else name], stribeck)[:, ::EVERY]
        q = np.round((q + NOISE_ANGLE * rng.standard_normal(q.size)) / COUNT) * COUNT
        torque = torque + NOISE_TORQUE * rng.standard_normal(q.size)
        trials[name] = Trial(
            name,
            "ID.3-dynamic",
            EVERY * STEP * np.arange(q.size),
            q[:, None],
            joint="shoulder",
            joint_torque=torque[:, None],
            motion="c" if name[0] == "c" else None,
        )
    return Session("pendulum", finger, trials)
