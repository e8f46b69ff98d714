"""The planar finger of the stand-in: equation (1) for joints about +y, in scalar Python, in steps of 1 ms.

Joints are fixed, coupled to the external motor, moved by hand, or free. Only free joints need forward dynamics:
impulses advance their velocities, and joint and tendon friction are impulses within bounds (projected Gauss–Seidel), so
that the finger truly sticks. This code shares nothing with `jaxfinger.model`, so recordings of it test the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jaxfinger.data.session import FingerDescription
from jaxfinger.rig.contract import Mode

DT = 1e-3  # s, one cycle of the controller


@dataclass(frozen=True)
class PlantTruth:
    """True parameters, to compare with what `identify` finds from a recording. SI units.

    `excursion[i, j, k]` multiplies q_j^(k+1) in the excursion of tendon i. `elastic` and `friction` are coefficients of
    polynomials in q from degree 0. The tension lost on the way is min(max(a0 + a1 f_t, 0), f_t).
    """

    finger: FingerDescription
    excursion: Float[np.ndarray, "n m 4"]  # m/rad^(k+1)
    elastic: Float[np.ndarray, "m 3"]  # N m/rad^p
    friction: Float[np.ndarray, "m 3"]  # N m/rad^p
    damping: Float[np.ndarray, " m"]  # N m s/rad
    a0: Float[np.ndarray, " n"]  # N
    a1: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Sensors:
    """White noise (standard deviation), resolution and offsets of the rig's sensors, SI units."""

    tension_noise: float = 0.02  # N
    torque_noise: float = 2e-4  # N m
    force_noise: float = 0.02  # N
    angle_noise: float = 1e-4  # rad
    angle_step: float = 2 * math.pi / 2**14  # rad; AA5048B, 14 bit
    excursion_noise: float = 2e-6  # m
    torque_offset: float = 3e-3  # N m, before taring
    force_offset: tuple[float, float, float] = (0.08, -0.05, 0.03)  # N, before taring


def default_truth() -> PlantTruth:
    """Return three joints and four tendons, with moment arms, elastic torque and friction like the paper's."""
    deg = math.pi / 180
    finger = FingerDescription(
        gravity=np.array([0.0, 0.0, -9.81]),
        joint_names=("MCP", "PIP", "DIP"),
        axis=np.tile([0.0, 1.0, 0.0], (3, 1)),
        origin=np.array([[0.0, 0, 0], [0.045, 0, 0], [0.028, 0, 0]]),
        limits=np.array([[-10.0, 92.0], [-8.0, 102.0], [-8.0, 82.0]]) * deg,
        mass=np.array([0.023, 0.011, 0.006]),
        com=np.array([[0.022, 0, 0], [0.013, 0, 0], [0.010, 0, 0]]),
        inertia=np.array(
            [np.diag(v) for v in ([9e-7, 3.9e-6, 3.9e-6], [4.8e-7, 9.3e-7, 9.6e-7], [2.4e-7, 3.8e-7, 3.9e-7])]
        ),
        fingertip=np.array([0.023, 0.0, 0.0]),
        tendon_names=("T1", "T2", "T3", "T4"),
        active=np.ones(4, bool),
        crosses=np.array([[1, 1, 0], [1, 1, 1], [1, 0, 0], [1, 0, 0]], bool),
    )
    mm = 1e-3
    arm = np.zeros((4, 3, 4))  # moment arm in mm, a polynomial in q from degree 0
    arm[0, 0], arm[0, 1] = [-0.9, 2.9, 0, 0], [4.3, 2.2, 0.36, 0]
    arm[1, 0], arm[1, 1], arm[1, 2] = [-5.9, -0.4, -0.45, 0], [-4.8, -2.4, 0.35, 0], [-5.8, -1.0, 0.3, 0]
    arm[2, 0], arm[3, 0] = [5.8, 1.2, 1.0, 0], [5.5, 1.5, 1.0, 0]
    return PlantTruth(
        finger=finger,
        excursion=arm * mm / np.arange(1, 5),
        elastic=np.array([[-12e-3, 46e-3, 6e-3], [-8e-3, 26e-3, 4e-3], [-18e-3, 30e-3, 2e-3]]),
        friction=np.array([[3e-3, 3e-3, 1e-3], [2e-3, 1e-3, 0.5e-3], [1.5e-3, 0.5e-3, 0.2e-3]]),
        damping=np.array([4e-4, 2e-4, 1e-4]),
        a0=np.array([0.05, 0.15, 0.2, 0.15]),
        a1=np.array([0.30, 0.18, 0.36, 0.25]),
    )


def _poly(coefficients, x: float) -> float:
    """Σ_p coefficients[p] x^p."""
    value = 0.0
    for c in reversed(coefficients):
        value = value * x + c
    return value


@dataclass
class Plant:
    """The finger with its state; `step` advances it by 1 ms.

    The state: angles `q` (rad), velocities `qd` (rad/s), tensions `transmitted` (N) that reach the joints. `step` also
    sets `external_torque` (N m) and `tip_force` (N, base frame).
    """

    truth: PlantTruth = field(default_factory=default_truth)
    stop_stiffness: float = 2.0  # N m/rad of the mechanical limits of a free joint

    def __post_init__(self):
        t, f = self.truth, self.truth.finger
        self.m, self.n = f.m, f.n
        self.q = [0.0] * self.m
        self.qd = [0.0] * self.m
        self.transmitted = [0.0] * self.n  # f_j: tension at the joints
        self.mode = [Mode.FIXED] * self.m
        self.pose = [0.0] * self.m  # angles at which fixtures hold the joints
        self.contact = False
        self.external_torque = 0.0
        self.tip_force = [0.0, 0.0, 0.0]
        self._clock = 0.0
        self._impulses: dict[tuple[str, int], float] = {}  # friction impulses of the last step
        self._approach = 0.0  # direction in which the external motor last moved its joint
        self._length = [*f.origin[1:, 0].tolist(), float(f.fingertip[0])]
        self._com = f.com[:, 0].tolist()
        self._mass, self._inertia = f.mass.tolist(), f.inertia[:, 1, 1].tolist()
        self._gx, self._gz = float(f.gravity[0]), float(f.gravity[2])
        self._limits = f.limits.tolist()
        self._excursion = [[[0.0, *c] for c in row] for row in t.excursion.tolist()]
        self._arm = (t.excursion * np.arange(1, 5)).tolist()
        self._crossed = [np.flatnonzero(row).tolist() for row in f.crosses]
        self._elastic, self._friction = t.elastic.tolist(), t.friction.tolist()
        self._damping, self._a0, self._a1 = t.damping.tolist(), t.a0.tolist(), t.a1.tolist()

    # statics ----------------------------------------------------------------------------------------------------
    def excursion(self) -> list[float]:
        """Tendon excursion f(q) in m, zero at q = 0."""
        return [sum(_poly(self._excursion[i][j], self.q[j]) for j in self._crossed[i]) for i in range(self.n)]

    def moment_arms(self) -> list[list[float]]:
        """C(q), (n, m), m/rad."""
        return [
            [_poly(self._arm[i][j], self.q[j]) if j in self._crossed[i] else 0.0 for j in range(self.m)]
            for i in range(self.n)
        ]

    def _points(self):
        """Return (x, z) of each joint, the direction (cos, sin) of each link, and (x, z) of the tip."""
        angle = x = z = 0.0
        joints, directions = [], []
        for length, q in zip(self._length, self.q, strict=True):
            angle += q
            c, s = math.cos(angle), math.sin(angle)
            joints.append((x, z))
            directions.append((c, s))
            x, z = x + length * c, z - length * s
        return joints, directions, (x, z)

    def gravity_torque(self) -> list[float]:
        """G(q) = −Σ m_k g·∂p_k/∂q_i with ∂p/∂q = y × r: flexing about +y carries the tip toward −z."""
        joints, directions, _ = self._points()
        torque = []
        for i in range(self.m):
            total = 0.0
            for k in range(i, self.m):
                rx = joints[k][0] + self._com[k] * directions[k][0] - joints[i][0]
                rz = joints[k][1] - self._com[k] * directions[k][1] - joints[i][1]
                total -= self._mass[k] * (self._gx * rz - self._gz * rx)
            torque.append(total)
        return torque

    def _loss(self, i: int, tension: float) -> float:
        """Tension lost along tendon i where it slides, N."""
        return min(max(self._a0[i] + self._a1[i] * tension, 0.0), max(tension, 0.0))

    def mass_matrix(self) -> Float[np.ndarray, "m m"]:
        """M(q) of the planar chain, kg m²."""
        joints, directions, _ = self._points()
        matrix = np.zeros((self.m, self.m))
        for k in range(self.m):
            px = joints[k][0] + self._com[k] * directions[k][0]
            pz = joints[k][1] - self._com[k] * directions[k][1]
            column = np.zeros((2, self.m))
            for i in range(k + 1):
                column[:, i] = pz - joints[i][1], -(px - joints[i][0])
            turn = np.arange(self.m) <= k
            matrix += self._mass[k] * column.T @ column + self._inertia[k] * np.outer(turn, turn)
        return matrix

    def coriolis(self) -> Float[np.ndarray, " m"]:
        """N(q, q̇), N m: the links' centripetal accelerations −ω² r, projected on the joints."""
        joints, directions, _ = self._points()
        torque, ax, az, omega = np.zeros(self.m), 0.0, 0.0, 0.0
        for k in range(self.m):
            omega += self.qd[k]
            c, s = directions[k]
            cx, cz = ax - omega**2 * self._com[k] * c, az + omega**2 * self._com[k] * s
            px, pz = joints[k][0] + self._com[k] * c, joints[k][1] - self._com[k] * s
            for i in range(k + 1):
                torque[i] += self._mass[k] * ((pz - joints[i][1]) * cx - (px - joints[i][0]) * cz)
            ax, az = ax - omega**2 * self._length[k] * c, az + omega**2 * self._length[k] * s
        return torque

    # motion -----------------------------------------------------------------------------------------------------
    def prepare(self, mode: list[Mode], pose: list[float], contact: bool) -> None:
        """Set how each joint is held and at which angle, and whether the fingertip rests on its sensor."""
        self.mode, self.pose, self.contact = list(mode), list(pose), contact
        self._clock, self._approach, self._impulses = 0.0, 0.0, {}

    def step(self, tension: list[float], motor: tuple[float, float, float] | None) -> None:
        """Advance by 1 ms under tensions (N); `motor` is the external motor's angle, velocity and acceleration."""
        self._clock += DT
        before = self.q[:]
        limp = Mode.MOTOR if motor is None else Mode.FREE  # An external motor without torque holds nothing.
        free = [j for j in range(self.m) if self.mode[j] in (Mode.FREE, limp) and not self.contact]
        acceleration = [0.0] * self.m
        for j in range(self.m):
            if self.mode[j] is Mode.MOTOR and motor is not None:
                self.q[j], self.qd[j], acceleration[j] = motor
            elif self.mode[j] is Mode.HAND:
                self._follow(j, self._hand(j), 2.5)
            elif j not in free:
                self._follow(j, self.pose[j], 1.5)
        if free:
            self._fall(free, tension)
        self._transmit(tension, before)
        self._react(tension, motor, acceleration)

    def _hand(self, j: int) -> float:
        """Angle at which the hand holds joint j: a slow sweep of the joint's range.

        Several joints have periods whose ratios differ, so that their motion does not soon repeat.
        """
        low, high = self._limits[j]
        low, high = low + 0.06 * (high - low), low + 0.92 * (high - low)
        period = 4.0 * (1.0 + 0.37 * j if self.mode.count(Mode.HAND) > 1 else 1.0)
        return low + (high - low) * 0.5 * (1 - math.cos(2 * math.pi * self._clock / period))

    def _follow(self, j: int, target: float, speed: float) -> None:
        """Move joint j toward an angle at no more than `speed`, rad/s."""
        move = min(max(target - self.q[j], -speed * DT), speed * DT)
        self.q[j] += move
        self.qd[j] = move / DT

    def _fall(self, free: list[int], tension: list[float]) -> None:
        """Advance the free joints: M Δq̇ = Δt (Cᵀ f_t − N − G − h) + friction impulses, each within ± its bound.

        Here h is without joint friction: it and the tendon friction f_f are the impulses.
        """
        arms = self.moment_arms()
        gravity, coriolis = self.gravity_torque(), self.coriolis()
        matrix = self.mass_matrix()[np.ix_(free, free)]
        letting_go = 1e-2 * max(1.0 - self._clock / 0.6, 0.0)  # N m s/rad, damping by the hand that lets the finger go
        drive = []
        for j in free:
            torque = sum(arms[i][j] * tension[i] for i in range(self.n)) - gravity[j] - coriolis[j]
            torque -= _poly(self._elastic[j], self.q[j]) + (self._damping[j] + letting_go) * self.qd[j]
            low, high = self._limits[j]
            beyond = max(low - self.q[j], 0.0) - max(self.q[j] - high, 0.0)
            torque += self.stop_stiffness * beyond
            # Damping and the stop's spring are taken implicitly: for links of a few grams they are stiff at 1 ms.
            stop = DT**2 * self.stop_stiffness + DT * 5e-3 if beyond else 0.0
            matrix[len(drive), len(drive)] += DT * (self._damping[j] + letting_go) + stop
            drive.append(torque)
        inverse = np.linalg.inv(matrix)
        velocity = np.array([self.qd[j] for j in free]) + DT * inverse @ np.array(drive)
        constraints = {}  # name: (direction in joint space, bound on the impulse)
        for a, j in enumerate(free):
            constraints["joint", j] = (np.eye(len(free))[a], DT * max(_poly(self._friction[j], self.q[j]), 0.0))
        for i in range(self.n):
            direction = np.array([arms[i][j] for j in free])
            if direction.any() and (loss := self._loss(i, tension[i])) > 0:
                constraints["tendon", i] = (direction, DT * loss)
        impulses = {}
        rows = []
        for name, (direction, bound) in constraints.items():
            response = inverse @ direction
            start = min(
                max(self._impulses.get(name, 0.0), -bound), bound
            )  # The last step's impulse: sticking converges.
            velocity = velocity + response * start
            impulses[name] = start
            rows.append((name, direction, bound, response, float(direction @ response)))
        for _ in range(12):
            for name, direction, bound, response, weight in rows:
                new = min(max(impulses[name] - float(direction @ velocity) / weight, -bound), bound)
                velocity = velocity + response * (new - impulses[name])
                impulses[name] = new
        self._impulses = impulses
        for a, j in enumerate(free):
            self.qd[j] = float(velocity[a])
            self.q[j] += DT * self.qd[j]

    def _transmit(self, tension: list[float], before: list[float]) -> None:
        """Update f_j. A tendon that slides loses tension against its direction. At held joints f_j stays within ± the
        loss of f_t.
        """
        for i in range(self.n):
            slide = sum(_poly(self._arm[i][j], self.q[j]) * (self.q[j] - before[j]) for j in self._crossed[i])
            loss = self._loss(i, tension[i])
            if abs(slide) > 1e-9:
                self.transmitted[i] = tension[i] - math.copysign(loss, slide)
            else:
                self.transmitted[i] = min(max(self.transmitted[i], tension[i] - loss), tension[i] + loss)

    def _react(self, tension: list[float], motor, acceleration: list[float]) -> None:
        """Compute the external motor's torque and the force on the fingertip from (1)."""
        self.external_torque, self.tip_force = 0.0, [0.0, 0.0, 0.0]
        if Mode.MOTOR in self.mode and motor is not None:
            j = self.mode.index(Mode.MOTOR)
            gravity = self.gravity_torque()[j]
            torque = gravity + _poly(self._elastic[j], self.q[j])
            torque -= sum(
                _poly(self._arm[i][j], self.q[j]) * self.transmitted[i] for i in range(self.n) if j in self._crossed[i]
            )
            direction = self._motor_direction(motor[1])
            torque += direction * max(_poly(self._friction[j], self.q[j]), 0.0) + self._damping[j] * self.qd[j]
            if acceleration[j]:
                torque += self.mass_matrix()[j, j] * acceleration[j]
            self.external_torque = torque
        if self.contact:
            arms, gravity = self.moment_arms(), self.gravity_torque()
            joints, _, tip = self._points()
            need = [
                gravity[j]
                + _poly(self._elastic[j], self.q[j])
                - sum(arms[i][j] * self.transmitted[i] for i in range(self.n))
                for j in range(self.m)
            ]
            jacobian = np.array([[tip[1] - z, -(tip[0] - x)] for x, z in joints])  # Jᵀ, (m, 2): y × r
            force = np.linalg.lstsq(jacobian, np.array(need), rcond=None)[0]
            self.tip_force = [float(force[0]), 0.0, float(force[1])]

    def _motor_direction(self, velocity: float) -> float:
        """Sign of joint friction on the motor: the direction in which it last moved the joint, 0 if it never did."""
        if velocity:
            self._approach = math.copysign(1.0, velocity)
        return self._approach
