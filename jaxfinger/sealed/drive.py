"""VD.3, the tendons drive the free finger: forward simulation in MuJoCo with dry friction under a tracking controller.

The controller uses the nominal specimen only. Tension lags its command, and the finger moves as its plant does.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's compiled module has no types.)
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from .departures.base import Memory
from .laws import Finger, Situation
from .profiles import Builder, Profile
from .protocols import Plan, sample_times

MAX_TENSION = 16.0  # N, largest commanded tension
STEP = 5e-4  # s
CONTROL = 2  # steps per control cycle: 1 kHz, the rate of the record
LAG = 1.5e-3  # s, time constant of the drives


@dataclass(frozen=True)
class Run:
    """A simulated trial, time first at 1 kHz: time s, q rad, q̇, tension N."""

    time: Float[np.ndarray, " N"]
    q: Float[np.ndarray, "N m"]
    qd: Float[np.ndarray, "N m"]
    tension: Float[np.ndarray, "N n"]


def desired_trajectory(nominal: Finger, plan: Plan, rng: np.random.Generator) -> tuple[Profile, ...]:
    """Draw a trajectory between postures that tensions can hold. Each joint starts and stops at times of its own."""
    count = int(plan.duration / 1.6)
    postures = _reachable(nominal, plan.least, count + 1, rng)
    profiles = []
    for j in range(nominal.m):
        b = Builder(float(postures[0][j])).rest(0.25)
        slot = (plan.duration - 0.4) / count
        for i in range(count):
            to = float(postures[i + 1][j])
            b = b.rest(rng.uniform(0.02, 0.25) * slot).move(to, 0.65 * slot)
            b = b.rest(max((i + 1) * slot + 0.25 - b.now, 1e-3))
        profiles.append(b.profile())
    return tuple(profiles)


def _reachable(nominal: Finger, least: float, count: int, rng: np.random.Generator) -> Float[np.ndarray, "count m"]:
    """Draw postures that tensions within bounds can hold, with joint friction of either sign."""
    low, high = nominal.specimen.finger.limits.T
    q = low + (high - low) * rng.uniform(0.12, 0.8, (1500, nominal.m))
    zero = np.zeros_like(q)
    c = nominal.specimen.elastic
    torque = nominal.plant.inverse_dynamics(q, zero, zero) + c[:, 0] + c[:, 1] * q + c[:, 2] * q**2
    s = Situation(zero[:, 0], zero[:, 0], q, zero, zero, np.zeros((len(q), nominal.n)), zero)
    margin = nominal.coulomb(s)[0]
    allocate = Allocator(nominal, least)
    still = np.zeros(nominal.n)
    miss = np.zeros(len(q))
    for i, arm in enumerate(nominal.geometry(q)[1]):
        for sign in (-1.5, 1.5):
            demanded = torque[i] + sign * margin[i]
            f = allocate(arm, demanded, still)
            miss[i] = max(miss[i], np.abs(arm.T @ f - demanded).max() + 1e-3 * max(f.max() - 9.0, 0.0))
    best = np.argsort(miss)[: max(3 * count, int(np.sum(miss < 2e-4)))]
    return q[rng.choice(best, count, replace=False)]


def feedforward(
    nominal: Finger, q: Float[np.ndarray, "N m"], qd: Float[np.ndarray, "N m"], qdd: Float[np.ndarray, "N m"]
):
    """Joint torque of the nominal finger along a trajectory, N m, and the tendons' directions.

    Friction is included. It and the directions are smooth in velocity.
    """
    zero = np.zeros(len(q))
    s = Situation(zero, zero, q, qd, qdd, np.zeros((len(q), nominal.n)), np.tanh(qd / 0.02))
    torque = nominal.plant.inverse_dynamics(q, qd, qdd) + nominal.passive(s) + nominal.friction(s)
    return torque, np.tanh(nominal.speed(s) / 5e-4)


class Allocator:
    """Map joint torques to small tensions at the actuators, none below `least`, N."""

    def __init__(self, nominal: Finger, least: float):
        self.least = least
        self.active = np.flatnonzero(nominal.specimen.finger.active)
        self.friction = nominal.specimen.friction[self.active]
        self.n = nominal.n
        self._small = 2e-4 * np.eye(len(self.active))

    def __call__(
        self, arm: Float[np.ndarray, "n m"], torque: Float[np.ndarray, " m"], direction: Float[np.ndarray, " n"]
    ):
        arm, s = arm[self.active], direction[self.active]
        a0, a1 = self.friction.T
        gain, offset = 1 - s * a1, -s * a0
        matrix = (arm * gain[:, None]).T
        rest = torque - arm.T @ offset - matrix @ np.full(len(self.active), self.least)
        extra, _ = nnls(np.vstack([matrix, self._small]), np.concatenate([rest, np.zeros(len(self.active))]))
        tension = np.zeros(self.n)
        tension[self.active] = np.minimum(self.least + extra, MAX_TENSION)
        return tension


def planned_tension(nominal: Finger, plan: Plan, t: Float[np.ndarray, " N"]) -> Float[np.ndarray, "N n"]:
    """Tension that would drive the desired trajectory open loop, N."""
    q, qd, qdd = (np.stack(x, axis=1) for x in zip(*(p(t) for p in plan.q), strict=True))
    torque, direction = feedforward(nominal, q, qd, qdd)
    arms = nominal.geometry(q)[1]
    allocate = Allocator(nominal, plan.least)
    return np.stack([allocate(*row) for row in zip(arms, torque, direction, strict=True)])


class Controller:
    """Track one plan: the nominal finger's torque, and a spring and a damper towards the desired motion."""

    def __init__(self, nominal: Finger, plan: Plan, time: Float[np.ndarray, " K"]):
        self.q, self.qd, qdd = (np.stack(x, axis=1) for x in zip(*(p(time) for p in plan.q), strict=True))
        self._torque, self._direction = feedforward(nominal, self.q, self.qd, qdd)
        self._nominal, self._allocate = nominal, Allocator(nominal, plan.least)

    def __call__(
        self,
        cycle: int,
        q: Float[np.ndarray, " m"],
        qd: Float[np.ndarray, " m"],
        stiff: Float[np.ndarray, " m"],
        damp: Float[np.ndarray, " m"],
    ) -> Float[np.ndarray, " n"]:
        """Tension to command in a cycle, N, with a spring `stiff`, N m/rad, and a damper `damp`, N m s/rad."""
        torque = self._torque[cycle] + stiff * (self.q[cycle] - q) + damp * (self.qd[cycle] - qd)
        return self._allocate(self._nominal.geometry(q)[1], torque, self._direction[cycle])


def _gains(nominal: Finger, q: Float[np.ndarray, " m"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Spring and damper of each joint: at posture q every joint is damped to 0.6 of the critical damping.

    A very light joint, below 2e-6 kg m², has the damper of one that heavy.
    """
    inertia = np.diag(nominal.plant.mass_matrix(q))
    stiff = 0.03 + 0.05 * inertia / inertia.max()
    return stiff, 1.2 * np.sqrt(stiff * np.maximum(inertia, 2e-6))


def simulate(finger: Finger, nominal: Finger, plans: Sequence[Plan]) -> list[Run]:
    """Simulate the VD.3 trials together. All must have the same duration. Gains of the first posture serve all."""
    if not plans:
        return []
    model = finger.plant.model
    active = np.flatnonzero(finger.specimen.finger.active)
    batch, m, n = len(plans), finger.m, finger.n
    fine = sample_times(plans[0], 1 / (STEP * CONTROL))
    noises = np.stack([_wander(np.random.default_rng(plan.seed), len(fine), n, STEP * CONTROL) for plan in plans])
    controllers = [Controller(nominal, plan, fine) for plan in plans]
    gains = _gains(nominal, controllers[0].q[0])

    data = [mujoco.MjData(model) for _ in plans]
    for d, c in zip(data, controllers, strict=True):
        d.qpos = c.q[0]
    f = np.stack([c(0, c.q[0], c.qd[0], *gains) for c in controllers])
    command, starts = f.copy(), np.array([plan.start for plan in plans])
    q = np.stack([d.qpos.copy() for d in data])
    qd = np.zeros_like(q)
    memories = [d for d in finger.departures if isinstance(d, Memory)]
    memory, driven = {}, {}
    keep_q, keep_qd, keep_f = (np.empty((len(fine), batch, size)) for size in (m, m, n))

    for i in range(len(fine) * CONTROL):
        if i % CONTROL == 0:
            k = i // CONTROL
            command = np.stack([c(k, q[b], qd[b], *gains) for b, c in enumerate(controllers)])
            # The commanded tension wanders by 0.4 % and 0.02 N about that.
            command = command * (1 + 0.004 * noises[:, k]) + 0.02 * noises[:, k] * (command > 0)
        f = f + (command - f) * (STEP / LAG)
        t = np.full(batch, i * STEP)
        s = Situation(t, starts + t, q, qd, np.zeros_like(q), f, np.sign(qd), memory=memory)
        s.st = np.tanh(finger.speed(s) / 1e-4)
        for d in memories:
            u = d.inputs(finger, s)
            z = d.start(u[None]) if i == 0 else d.step(memory[id(d)], driven[id(d)], u, STEP)
            memory[id(d)], driven[id(d)] = z, u
        if i % CONTROL == 0:
            keep_q[k], keep_qd[k], keep_f[k] = q, qd, f
        q, qd = _advance(finger, s, data, active)
    return [Run(fine, keep_q[:, b], keep_qd[:, b], keep_f[:, b]) for b in range(batch)]


def replay(finger: Finger, q: Float[np.ndarray, " m"], tension: Float[np.ndarray, "N n"]) -> Float[np.ndarray, "N m"]:
    """Simulate angles from rest at q under tensions recorded at 1 kHz, without a controller.

    The difference from the recorded angles bounds how well any model can predict the motion.
    """
    data, active = mujoco.MjData(finger.plant.model), np.flatnonzero(finger.specimen.finger.active)
    data.qpos = q
    angle, rate = q[None].copy(), np.zeros((1, len(q)))
    out = []
    for k, f in enumerate(np.repeat(tension, CONTROL, axis=0)):
        if k % CONTROL == 0:
            out.append(angle[0])
        t = np.full(1, k * STEP)
        s = Situation(t, t, angle, rate, np.zeros_like(angle), f[None], np.sign(rate))
        s.st = np.tanh(finger.speed(s) / 1e-4)
        angle, rate = _advance(finger, s, [data], active)
    return np.array(out)


def _advance(finger: Finger, s: Situation, data: list, active: np.ndarray):
    """Advance every trial by a MuJoCo step: smooth forces are applied, dry friction is left to its solver."""
    model = finger.plant.model
    _, arm = finger.path(s)
    limit, decided = finger.coulomb(s)
    loss, lost = finger.loss(s)
    assert s.st is not None
    sliding = s.st * loss
    # The solver subtracts `sliding` through the fixed tendons. What a departure adds to the delivered tension stays.
    delivered = finger.delivered(s, s.f - lost - sliding) + sliding
    applied = np.einsum("bnm,bn->bm", arm, delivered) - finger.passive(s) - decided
    limit, loss = np.maximum(limit, 1e-9), np.maximum(loss, 1e-9)
    for b, d in enumerate(data):
        model.dof_frictionloss = limit[b]
        model.tendon_frictionloss = loss[b, active]
        model.wrap_prm = arm[b, active].ravel()
        d.qfrc_applied = applied[b]
        mujoco.mj_step(model, d)
    return np.stack([d.qpos.copy() for d in data]), np.stack([d.qvel.copy() for d in data])


def _wander(rng: np.random.Generator, count: int, n: int, dt: float) -> Float[np.ndarray, "K n"]:
    """Slow noise of unit size, correlated over half a second."""
    knots = rng.normal(size=(int(count * dt / 0.5) + 3, n))
    at = np.arange(count) * dt / 0.5
    return np.stack([np.interp(at, np.arange(len(knots)), column) for column in knots.T], axis=1)
