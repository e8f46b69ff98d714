"""Trials in which joint MCP is swept or led, with laws that stand for a real finger."""

from dataclasses import dataclass

import numpy as np

from jaxfinger.data import Session, Trial


@dataclass(frozen=True)
class Sweep:
    """Sines of 1 rad at the given frequencies, Hz, one after the other, `lasts` s each, at `rate` samples a second."""

    frequencies: tuple[float, ...] = (0.25, 0.6, 1.2)
    rate: float = 200.0
    lasts: float = 6.0

    @property
    def time(self):
        return np.arange(int(self.lasts * len(self.frequencies) * self.rate)) / self.rate

    @property
    def q(self):
        each = int(self.lasts * self.rate)
        return 0.6 - 0.5 * np.cos(2.0 * np.pi * np.cumsum(np.repeat(self.frequencies, each)) / self.rate)

    def torque(self, friction=None):
        """Torque, N m, that moves the joint. `friction` is in [-1, 1]; by default it has the sign of the speed."""
        rate = np.gradient(self.q, self.time)
        friction = np.tanh(rate / 0.01) if friction is None else friction
        inertia = 2e-5 * np.gradient(rate, self.time)
        return -0.01 * np.cos(self.q) + 0.02 * (self.q - 0.5) + 0.004 * friction + 0.001 * rate + inertia

    def excursion(self):
        return 0.008 * self.q + 0.001 * self.q**2


def pre_sliding(q, reach):
    """Friction that turns round over a travel of some `reach`, rad: Dahl's law."""
    out = np.zeros(len(q))
    for k, way in enumerate(np.diff(q), 1):
        out[k] = np.clip(out[k - 1] + way / reach * (1.0 - np.sign(way) * out[k - 1]), -1.0, 1.0)
    return out


def play(q, half):
    """Angle behind a play of ± `half`, rad."""
    out = q.copy()
    for k in range(1, len(q)):
        out[k] = np.clip(out[k - 1], q[k] - half, q[k] + half)
    return out


def late(sweep, x, delay):
    return np.interp(sweep.time - delay, sweep.time, x)


def swept(sweep, q, torque, noise=1.0) -> Trial:
    """ID.3-dynamic. `noise` is a multiple of 0.2 mrad and 0.3 N mm, the standard deviations of usual sensors."""
    rng = np.random.default_rng(0)
    angles, unmeasured = _angles(rng, q, noise)
    torque = torque + 3e-4 * noise * rng.standard_normal(len(q))
    return Trial(
        "sweep",
        "ID.3-dynamic",
        sweep.time,
        angles,
        joint_torque=np.column_stack([torque, unmeasured]),
        joint="MCP",
    )


def led(sweep, q, excursion, noise=1.0) -> Trial:
    """ID.2. `noise` is a multiple of 0.2 mrad and 10 µm. The tension depends on the direction, as friction makes it."""
    rng = np.random.default_rng(0)
    angles, unmeasured = _angles(rng, q, noise)
    tension = 2.0 + 0.3 * np.sign(np.gradient(sweep.q)) + 0.02 * rng.standard_normal(len(q))
    excursion = excursion + 1e-5 * noise * rng.standard_normal(len(q))
    return Trial(
        "lead",
        "ID.2",
        sweep.time,
        angles,
        np.column_stack([tension, tension, unmeasured]),
        np.column_stack([excursion, -excursion, unmeasured]),
        joint="MCP",
    )


def _angles(rng, q, noise):
    """Angles of both joints, of which the second is held, and a column that is not measured."""
    other = 0.4 + 1e-4 * rng.standard_normal(len(q))
    return np.column_stack([q + 2e-4 * noise * rng.standard_normal(len(q)), other]), np.full(len(q), np.nan)


def alone(session, trial) -> Session:
    """Session with this trial only."""
    return Session("test finger", session.finger, {trial.name: trial}, "tests", "2026-01-01T00:00:00+00:00")


def tendon(f, constant=0.05, share=0.1):
    """Tension that arrives behind a tendon's friction, which sticks until its loss is exceeded."""
    out = np.zeros(len(f))
    for k in range(1, len(f)):
        loss = min(constant + share * f[k], f[k])
        out[k] = np.clip(out[k - 1], f[k] - loss, f[k] + loss)
    return out


def pulled(rate=100.0, late_tension=0.0, late_torque=0.0, share=0.1, noise=1.0, seed=0) -> Trial:
    """ID.4 of T1 at MCP, up and down in steps of 1 s. `noise` is a multiple of 0.02 N and 0.2 N mm."""
    rng = np.random.default_rng(seed)
    time = np.arange(int(22.0 * rate)) / rate
    levels = np.array([0.0, 4.0, 8.0, 12.0, 8.0, 4.0, 0.0])

    def steps(delay):
        step, at = np.divmod(np.maximum(time - delay, 0.0), 3.0)
        k = np.minimum(step.astype(int), len(levels) - 2)
        at = np.where(step > k, 3.0, at)
        return levels[k] + np.diff(levels)[k] * (1.0 - np.cos(np.pi * np.clip(at - 1.0, 0.0, 1.0))) / 2.0

    n = len(time)
    torque = -0.008 * tendon(steps(late_torque), share=share) + 2e-4 * noise * rng.standard_normal(n)
    f = steps(late_tension) + 0.02 * noise * rng.standard_normal(n)
    slack, unmeasured = 0.02 * noise * rng.standard_normal(n), np.full(n, np.nan)
    q = 0.4 + 1e-4 * rng.standard_normal((n, 2))
    return Trial(
        "pull",
        "ID.4",
        time,
        q,
        np.column_stack([f, slack, unmeasured]),
        joint_torque=np.column_stack([torque, unmeasured]),
        joint="MCP",
        tendon="T1",
    )
