"""The experiments of a session: commands of its trials, drawn from a seed.

A session has about forty trials. A file of fresh trials has other postures, speeds and tensions, and no repeats.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .profiles import Builder, Profile
from .specimens import Specimen

SLOW, FAST = 250.0, 1000.0  # samples per second of experiments at rest or by hand, and of driven ones
LOGGED = 200.0  # samples per second of a bench whose logger has one rate for all


@dataclass(frozen=True)
class Plan:
    """One commanded trial, with a profile for each joint and tendon. Holds are (begin, end, direction)."""

    name: str
    motion: str
    experiment: str
    start: float
    duration: float
    rate: float
    q: tuple[Profile, ...]
    tension: tuple[Profile, ...]
    joint: int | None = None
    tendon: int | None = None
    holds: tuple[tuple[float, float, int], ...] = ()
    least: float = 2.0  # N, lowest tension of every tendon in VD.3
    wander: float = 0.0  # N, slow wander of a tension that is held by hand or weight
    seed: int = 0  # of the trial's process noise


@dataclass(frozen=True)
class Style:
    """Settings of one bench's experiments."""

    holds: int  # of ID.3-static, in each direction
    hold_time: float  # s
    levels: int  # of tension in ID.4, upwards
    top: float  # N, highest tension in ID.4
    speeds: tuple[float, ...]  # rad/s, of ID.3-dynamic
    repeat: float  # probability that a trial is repeated
    unload: bool  # ID.4 and VD.2 also step down.
    missing: str  # An experiment that this session lacks, or "".
    postures: int  # of ID.2 and ID.4
    base_tension: float  # N, of ID.2 and VD.1
    slow: float = SLOW  # samples per second
    fast: float = FAST  # samples per second
    together: bool = False  # ID.3-dynamic moves all joints at once.


def draw_style(rng: np.random.Generator, foreign: bool = False) -> Style:
    """Draw the settings of one bench. A `foreign` one logs at one rate and drives all joints at once."""
    speeds = np.sort(rng.choice([0.3, 0.5, 0.7, 1.0, 1.4, 1.8, 2.3], size=int(rng.integers(3, 5)), replace=False))
    return Style(
        holds=int(rng.integers(7, 11)),
        hold_time=float(rng.uniform(0.9, 1.3)),
        levels=int(rng.integers(5, 8)),
        top=float(rng.uniform(10.0, 14.0)),
        speeds=tuple(speeds.tolist()),
        repeat=float(rng.uniform(0.2, 0.35)),
        unload=bool(rng.random() < 0.75),
        missing=str(rng.choice(["", "", "", "", "", "VD.1", "VD.2", "ID.3-dynamic"])),
        postures=2,
        base_tension=float(rng.uniform(1.9, 2.2)),
        slow=LOGGED if foreign else SLOW,
        fast=LOGGED if foreign else FAST,
        together=foreign,
    )


def session_plans(specimen: Specimen, style: Style, rng: np.random.Generator, fresh: bool = False) -> list[Plan]:
    """Draw all trials of a session in order, or those of a `fresh` file."""
    protocol = _Protocol(specimen, style, rng, fresh)
    plans: list[Plan] = []
    for experiment, draft in protocol.drafts():
        if experiment == style.missing and not fresh:
            continue
        again = not fresh and (rng.random() < style.repeat or (experiment == "VD.3" and draft.motion.endswith("b")))
        plans += [draft, draft] if again else [draft]
    start, numbered = 20.0, []
    for i, plan in enumerate(plans, start=1):
        suffix = "-x" if fresh else ""
        numbered.append(
            replace(
                plan,
                name=f"{i:02d}-{plan.motion}",
                motion=plan.motion + suffix,
                start=start,
                seed=int(rng.integers(2**31)),
            )
        )
        start += plan.duration + rng.uniform(5.0, 18.0)
    return numbered


class _Protocol:
    """Drafts of a session's trials."""

    def __init__(self, specimen: Specimen, style: Style, rng: np.random.Generator, fresh: bool):
        self.specimen, self.style, self.rng, self.fresh = specimen, style, rng, fresh
        self.finger = specimen.finger
        self.m, self.n = self.finger.m, self.finger.n
        self.low, self.high = self.finger.limits.T
        self.active = np.flatnonzero(self.finger.active)
        self.letters = "a" if fresh else "abcdefg"[: style.postures]

    def drafts(self):
        """Yield (experiment, plan) in the order of a session, before repeats and numbering."""
        for j in range(self.m):
            for letter in () if self.fresh else self.letters:
                yield "ID.2", self.id2(j, letter)
        for letter in "ab" if self.fresh else "abc":
            yield "VD.1", self.vd1(letter)
        for j in range(self.m):
            for letter in "ab" if j < 2 and not self.fresh else "a":
                yield "ID.3-static", self.static(j, letter)
        if self.style.together:
            for letter in "a" if self.fresh else "abcd":
                yield "ID.3-dynamic", self.dynamic_together(letter)
        for j in range(0 if self.style.together else self.m):
            for letter in "ab" if j < 1 and not self.fresh else "a":
                yield "ID.3-dynamic", self.dynamic(j, letter)
        for k in self.active:
            for j in self._arms(int(k)):
                for letter in self.letters:
                    yield "ID.4", self.id4(int(k), int(j), letter)
        for k in self.active[: 3 if self.n < 6 else 4]:
            yield "VD.2", self.vd2(int(k))
        for letter in "ab":
            yield "VD.3", self.vd3(letter)

    def _arms(self, k: int):
        """Joints at which ID.4 measures the tendon: two or three largest moment arms above 1.5 mm."""
        arm = np.abs(self.specimen.excursion[k, :, 0])
        joints = [j for j in np.argsort(-arm) if self.finger.crosses[k, j] and arm[j] > 1.5e-3]
        return sorted(joints[:3] if self.m < 5 else joints[:2])

    def posture(self, low: float = 0.08, high: float = 0.7) -> Float[np.ndarray, " m"]:
        """Draw a posture within a part of the joints' ranges."""
        return self.low + (self.high - self.low) * self.rng.uniform(low, high, self.m)

    def _rest(self, values) -> list[Profile]:
        """Constant profiles."""
        return [Builder(float(v)).profile() for v in values]

    def _ends(self, j: int) -> tuple[float, float]:
        """Draw the ends of a joint's motion, rad."""
        span = self.high[j] - self.low[j]
        a, b = (0.12, 0.85) if self.fresh else (0.1, 0.95)
        return (
            self.low[j] + span * (a + self.rng.uniform(-0.02, 0.05)),
            self.low[j] + span * (b + self.rng.uniform(-0.05, 0.02)),
        )

    def _tensions(self, value: float) -> tuple[Profile, ...]:
        """Constant tension of the active tendons, N."""
        return tuple(self._rest(np.where(self.finger.active, value, 0.0)))

    def id2(self, j: int, letter: str) -> Plan:
        """ID.2: tendons at about 2 N; one joint moves through its range and back, then through a part of it."""
        low, high = self._ends(j)
        q = self._rest(self.posture())
        pace = self.rng.uniform(4.5, 6.0)
        b = Builder(low).rest(0.5).move(high, pace).rest(0.4).move(low, pace).rest(0.4)
        middle = low + (high - low) * self.rng.uniform(0.4, 0.9)
        b = b.move(middle, 0.8 * pace).rest(0.3).move(low, 0.8 * pace).rest(0.5)
        q[j] = b.profile()
        name = f"ID.2-{self.finger.joint_names[j]}-{letter}"
        return Plan(
            name,
            name,
            "ID.2",
            0,
            b.now,
            self.style.slow,
            tuple(q),
            self._tensions(self.style.base_tension),
            j,
            wander=0.15,
        )

    def vd1(self, letter: str) -> Plan:
        """VD.1: all joints are moved by hand along a free path."""
        q, duration = [], self.rng.uniform(18.0, 24.0)
        for j in range(self.m):
            b = Builder(self.low[j] + 0.15 * (self.high[j] - self.low[j]))
            while b.now < duration - 4.0:
                if self.rng.random() < 0.3:
                    b = b.rest(self.rng.uniform(0.3, 1.0))
                to = self.low[j] + (self.high[j] - self.low[j]) * self.rng.uniform(0.08, 0.92)
                b = b.move(to, self.rng.uniform(1.3, 3.5))
            q.append(b.profile())
        name = f"VD.1-{letter}"
        return Plan(
            name,
            name,
            "VD.1",
            0,
            duration,
            self.style.slow,
            tuple(q),
            self._tensions(self.style.base_tension),
            wander=0.2,
        )

    def static(self, j: int, letter: str) -> Plan:
        """ID.3-static: tendons slack; one joint steps through holds, up and back."""
        low, high = self._ends(j)
        count = self.style.holds - (2 if self.fresh else 0)
        up = np.linspace(low, high, count) + self.rng.uniform(-0.01, 0.01, count)
        b, holds, way = Builder(float(up[0]) - 0.06), [], 0.5
        for direction, targets in ((1, up), (-1, up[::-1][1:] - 0.02)):
            for to in targets:
                b = b.move(float(to), max(way, abs(to - b.here) / 0.25))
                holds.append((b.now + 0.15, b.now + 0.15 + self.style.hold_time, direction))
                b = b.rest(self.style.hold_time + 0.2)
        q = self._rest(self.posture())
        q[j] = b.profile()
        name = f"ID.3-static-{self.finger.joint_names[j]}-{letter}"
        return Plan(
            name, name, "ID.3-static", 0, b.now, self.style.slow, tuple(q), self._tensions(0.0), j, holds=tuple(holds)
        )

    def dynamic(self, j: int, letter: str) -> Plan:
        """ID.3-dynamic: tendons slack; one joint sweeps back and forth at several speeds, then in a small loop."""
        low, high = self._ends(j)
        speeds = np.array(self.style.speeds) * (0.8 if self.fresh else 1.0) * self.rng.uniform(0.95, 1.05)
        b = Builder(low).rest(0.3)
        for speed in speeds:
            turn = float(np.clip(0.06 / speed, 0.04, 0.15))
            b = b.sweep(high, float(speed), turn).sweep(low, float(speed), turn)
        inner = low + (high - low) * self.rng.uniform(0.4, 0.6)
        b = (
            b.sweep(inner, float(speeds[0]), 0.12)
            .sweep(inner - 0.12, float(speeds[0]), 0.12)
            .sweep(high, float(speeds[0]), 0.12)
        )
        q = self._rest(self.posture())
        q[j] = b.profile()
        name = f"ID.3-dynamic-{self.finger.joint_names[j]}-{letter}"
        return Plan(name, name, "ID.3-dynamic", 0, b.now + 0.2, self.style.fast, tuple(q), self._tensions(0.0), j)

    def dynamic_together(self, letter: str) -> Plan:
        """ID.3-dynamic: tendons slack; all joints sweep at once, each to its own ends at its own speeds."""
        pace = 0.8 if self.fresh else 1.0
        q, duration = [], self.rng.uniform(14.0, 18.0)
        for j in range(self.m):
            low, high = self._ends(j)
            b, ends = Builder(low).rest(self.rng.uniform(0.2, 0.6)), (high, low)
            for turn in range(1000):
                speed = pace * float(self.rng.choice(self.style.speeds))
                if b.now + abs(ends[turn % 2] - b.here) / speed > duration - 0.3:
                    break
                b = b.sweep(ends[turn % 2], speed, float(np.clip(0.06 / speed, 0.04, 0.15)))
            q.append(b.profile())
        name = f"ID.3-dynamic-{letter}"
        return Plan(name, name, "ID.3-dynamic", 0, duration, self.style.fast, tuple(q), self._tensions(0.0))

    def _steps(self, levels, hold: float) -> tuple[Builder, list[tuple[float, float, int]]]:
        """Steps through levels, each held for `hold` s, and the holds."""
        b, holds = Builder(0.0).rest(0.15), []
        for level in levels:
            direction = 1 if level > b.here else -1
            b = b.move(float(level), 0.35)
            holds.append((b.now + 0.1, b.now + 0.1 + hold, direction))
            b = b.rest(hold + 0.15)
        return b, holds

    def id4(self, k: int, j: int, letter: str) -> Plan:
        """ID.4: the torque sensor holds the joint; the tension of one tendon steps up and, with `unload`, down."""
        top = self.style.top * (0.85 if self.fresh else 1.0)
        up = np.linspace(2.0, top, self.style.levels) + (self.rng.uniform(0.2, 0.6) if self.fresh else 0.0)
        down = np.array([0.68, 0.42, 0.2]) * top if self.style.unload else np.array([])
        b, holds = self._steps(np.concatenate([up, down]), self.style.hold_time * 0.8)
        posture = self.posture() if letter == "a" else self.posture(0.45, 0.92)
        tension = self._rest(np.zeros(self.n))
        tension[k] = b.profile()
        name = f"ID.4-{self.finger.tendon_names[k]}-{self.finger.joint_names[j]}-{letter}"
        return Plan(
            name,
            name,
            "ID.4",
            0,
            b.now,
            self.style.slow,
            tuple(self._rest(posture)),
            tuple(tension),
            j,
            k,
            tuple(holds),
        )

    def vd2(self, k: int) -> Plan:
        """VD.2: the fingertip presses the force sensor; one tendon steps up to 15 N, others are constant or slack."""
        up = np.arange(4.0, 15.1, 1.0 if not self.fresh else 1.4)
        down = np.array([11.0, 7.0]) if self.style.unload else np.array([])
        b, holds = self._steps(np.concatenate([up, down]), self.style.hold_time * 0.75)
        tension = []
        for i in range(self.n):
            level = self.rng.uniform(3.0, 6.0) if self.finger.active[i] and self.rng.random() < 0.5 else 0.0
            tension.append(Builder(0.0).move(level, 0.14).profile() if level else Builder(0.0).profile())
        tension[k] = b.profile()
        name = f"VD.2-{self.finger.tendon_names[k]}"
        posture = self.posture(0.3, 0.75)
        return Plan(
            name,
            name,
            "VD.2",
            0,
            b.now,
            self.style.slow,
            tuple(self._rest(posture)),
            tuple(tension),
            None,
            k,
            tuple(holds),
        )

    def vd3(self, letter: str) -> Plan:
        """VD.3: the tendons drive the free finger. `drive` draws the trajectory and finds the tensions."""
        return Plan(
            f"VD.3-{letter}",
            f"VD.3-{letter}",
            "VD.3",
            0,
            8.0,
            self.style.fast,
            (),
            (),
            least=float(self.rng.uniform(1.2, 2.2)),
        )


def sample_times(plan: Plan, rate: float | None = None) -> Float[np.ndarray, " N"]:
    """Sampling times, s, at the plan's rate or another."""
    return np.arange(int(plan.duration * (rate or plan.rate))) / (rate or plan.rate)
