"""How large a departure's trace is once the nominal parameters have been refitted.

The nominal model is linearised here, in NumPy, around the true specimen: every parameter that a fit may move is
perturbed, and
what the departure adds to the noise-free channels is projected off those directions. Channels are weighted by the
noise of a
hold's mean, and CAD's uncertainty enters as prior rows. Severity is the rms of what is left, in the channel
(experiment, quantity, joint or tendon) where it is largest, in units of that noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from .departures.base import Departure
from .drive import planned_tension
from .laws import Finger
from .plant import Plant
from .protocols import Plan
from .record import Channels, Motion, commanded, last_direction, needed_torque, read, record, rigid_torque
from .sensors import Sensors
from .specimens import Specimen

COARSE = {250.0: 25.0, 1000.0: 60.0, 200.0: 40.0}  # Hz: enough for what survives in the mean
UNSEEN = 1e-9  # severity of what leaves no trace at all, so that its logarithm exists
SLIDING = 0.03  # rad/s: what counts as a sliding joint
TAUT = 0.3  # N


@dataclass(frozen=True)
class Look:
    """A trial at a coarse rate: its plan, the motion that nominal tensions and angles make, the rigid torque
    along it.
    """

    plan: Plan
    motion: Motion
    rigid: Float[np.ndarray, "N m"] | None


class QuietSession:
    """The noise-free session of one specimen, with the directions that a nominal fit can absorb. The length of a
    tendon that is slack for a while may count, as it does in a case's severity, or not.
    """

    def __init__(self, specimen: Specimen, plans: Sequence[Plan], sensors: Sensors, slack_counts: bool = True):
        self.specimen, self.sensors, self.slack_counts = specimen, sensors, slack_counts
        self.nominal = Finger(specimen)
        # Repeats say nothing new without noise.
        unique = {plan.motion: plan for plan in reversed(plans)}
        self.looks = [self._look(plan) for plan in unique.values()]

    def _look(self, plan: Plan) -> Look:
        rate = COARSE[plan.rate]
        if plan.experiment == "VD.3":
            t = np.arange(int(plan.duration * rate)) / rate
            q, qd, qdd = (np.stack(x, axis=1) for x in zip(*(p(t) for p in plan.q), strict=True))
            motion = Motion(t, q, qd, qdd, planned_tension(self.nominal, plan, t), last_direction(qd))
        else:
            motion = commanded(plan, rate)
        return Look(plan, motion, self._rigid(self.nominal, plan, motion))

    @staticmethod
    def _rigid(finger: Finger, plan: Plan, motion: Motion) -> Float[np.ndarray, "N m"] | None:
        if plan.experiment in ("ID.2", "VD.1"):
            return None
        return (
            finger.plant.gravity_torque(motion.q)
            if plan.experiment in ("ID.4", "VD.2")
            else rigid_torque(finger, motion)
        )

    def rows(
        self, finger: Finger, look: Look, motion: Motion, same_body: bool
    ) -> Iterator[tuple[str, str, int, np.ndarray]]:
        """(experiment, channel, column, values in units of a hold's noise) of one trial as this finger makes it."""
        plan = look.plan
        rigid = look.rigid if same_body and motion is look.motion else self._rigid(finger, plan, motion)
        channels = read(finger, self._true(finger, plan, motion, rigid))
        yield from self._rows_of(channels, look)

    def _true(self, finger: Finger, plan: Plan, motion: Motion, rigid) -> Channels:
        out = record(finger, plan, motion, rigid)
        if plan.experiment == "VD.3":
            out = replace(out, torque=needed_torque(finger, plan, motion, rigid))
        return out

    def _rows_of(self, channels: Channels, look: Look) -> Iterator[tuple[str, str, int, np.ndarray]]:
        plan, e = look.plan, look.plan.experiment
        finger = self.specimen.finger
        if channels.excursion is not None:
            taut = look.motion.tension > TAUT
            pulled = finger.active & taut.any(axis=0)
            for k in np.flatnonzero(pulled if e != "ID.4" else np.arange(finger.n) == plan.tendon):
                x = channels.excursion[:, k] / self.sensors.hold_std("tendon_excursion")
                counts = taut[:, k] | self.slack_counts
                yield e, "tendon_excursion", int(k), (x - x.mean(where=counts) if counts.any() else x) * counts
        if channels.torque is not None:
            slides = self._sliding(look.motion) if e == "VD.3" else np.ones(look.motion.q.shape)
            scale = self.sensors.hold_std("joint_torque")
            for j in range(finger.m) if plan.joint is None else [plan.joint]:
                yield e, "joint_torque", j, channels.torque[:, j] / scale * slides[:, j]
        if channels.force is not None:
            for i in range(3):
                yield e, "fingertip_force", i, channels.force[:, i] / self.sensors.hold_std("fingertip_force")

    def _sliding(self, motion: Motion) -> Float[np.ndarray, "N m"]:
        """1 where a joint and every tendon across it slide, else 0: VD.3 is judged there only."""
        joint = np.abs(motion.qd) > SLIDING
        arm = self.nominal.geometry(motion.q)[1]
        tendon = np.abs(np.einsum("tnm,tm->tn", arm, motion.qd)) > SLIDING * 5e-3
        finger = self.specimen.finger
        blocked = ~tendon @ (finger.crosses & finger.active[:, None])
        return (joint & ~blocked).astype(float)

    def trace(self, departures: Sequence[Departure]) -> tuple[np.ndarray, list[tuple[str, str, int]]]:
        """What the departures add to what the nominal model says of the reported inputs; labels by row."""
        finger = Finger(self.specimen, departures)
        same_body = finger.plant.finger is self.specimen.finger
        values, labels = [], []
        for look in self.looks:
            plan, motion = look.plan, look.motion
            rigid = look.rigid if same_body else self._rigid(finger, plan, motion)
            true = self._true(finger, plan, motion, rigid)
            if plan.experiment == "VD.3":  # the motion is the finger's own: it needs no external torque
                true = replace(true, torque=None)
            channels = read(finger, true)
            inputs = self._reported(motion, channels)
            expected = list(self.rows(self.nominal, look, inputs, True))
            if plan.experiment == "VD.3":
                own = needed_torque(finger, plan, motion, rigid)
                channels = replace(channels, torque=own)
            for (e, c, k, seen), (_, _, _, said) in zip(self._rows_of(channels, look), expected, strict=True):
                values.append(seen - said)
                labels += [(e, c, k)] * len(seen)
        return np.concatenate(values), labels

    @staticmethod
    def _reported(motion: Motion, channels: Channels) -> Motion:
        """The motion as the sensors tell it: what the model is fed."""
        if channels.q is motion.q and channels.tension is motion.tension:
            return motion
        rate = np.gradient(channels.q - motion.q, motion.time, axis=0)
        return replace(motion, q=channels.q, qd=motion.qd + rate, tension=channels.tension)

    @cached_property
    def _base(self) -> list[np.ndarray]:
        return [
            np.concatenate([x for *_, x in self.rows(self.nominal, look, look.motion, True)]) for look in self.looks
        ]

    @cached_property
    def absorbed(self) -> tuple[Float[np.ndarray, "R P"], Float[np.ndarray, " P"]]:
        """Derivatives of all rows by every nominal parameter, scaled so that 1 is a free or prior-sized change;
        prior precisions.
        """
        base = np.concatenate(self._base)
        columns, prior = [], []
        for concerns, changed, size, weight in self._neighbours():
            plant = self.nominal.plant if changed.finger is self.specimen.finger else Plant(changed.finger)
            finger = Finger(changed, (), plant)
            same = changed.finger is self.specimen.finger
            column, at = np.zeros_like(base), 0
            for look, before in zip(self.looks, self._base, strict=True):
                if concerns(look.plan):
                    moved = np.concatenate([x for *_, x in self.rows(finger, look, look.motion, same)])
                    column[at : at + len(before)] = (moved - before) / size
                at += len(before)
            columns.append(column)
            prior.append(weight)
        return np.stack(columns, axis=1), np.array(prior)

    def _neighbours(self) -> Iterator[tuple[Callable[[Plan], bool], Specimen, float, float]]:
        """Specimens one small parameter change away: (trials it concerns, specimen, size of the change, prior
        precision).
        """
        s = self.specimen
        for name, array, step, unit in (
            ("excursion", s.excursion, 1e-6, 1e-4),
            ("elastic", s.elastic, 1e-5, 1e-3),
            ("coulomb", s.coulomb, 1e-5, 1e-3),
            ("damping", s.damping, 1e-6, 1e-4),
            ("friction", s.friction, 1e-4, 1e-2),
        ):
            for index in np.ndindex(array.shape):
                if name == "excursion" and not (s.finger.crosses[index[:2]] and s.finger.active[index[0]]):
                    continue
                if name == "friction" and not s.finger.active[index[0]]:
                    continue
                moved = array.copy()
                moved[index] += step
                yield _concern(name, index[0]), replace(s, **{name: moved}), step / unit, 1e-8
        finger = s.finger
        assert finger.mass_std is not None
        assert finger.com_std is not None
        for i in range(finger.m):
            mass = finger.mass.copy()
            mass[i] += finger.mass_std[i]
            yield _concern("body", i), replace(s, finger=replace(finger, mass=mass)), 1.0, 1.0
            for axis in range(3):
                com = finger.com.copy()
                com[i, axis] += finger.com_std[i, axis]
                yield _concern("body", i), replace(s, finger=replace(finger, com=com)), 1.0, 1.0

    @cached_property
    def _solver(self):
        jac, prior = self.absorbed
        # Coarse samples of one hold share its noise: about as many as fall into a second count as one.
        gram = jac.T @ jac / COARSE[250.0] + np.diag(prior)
        return np.linalg.pinv(gram, rcond=1e-12, hermitian=True) @ jac.T / COARSE[250.0]

    def absorb(self, trace: Float[np.ndarray, " R"]) -> Float[np.ndarray, " P"]:
        """The nominal parameters' move that imitates a trace best."""
        return self._solver @ trace

    def left(self, trace: Float[np.ndarray, " R"]) -> Float[np.ndarray, " R"]:
        """What a refit of the nominal parameters leaves of a trace."""
        return trace - self.absorbed[0] @ self.absorb(trace)

    def closed_by(self, departures: Sequence[Departure]) -> list[float]:
        """Of each departure, the share of a channel's gap that it closes, added alone to a refitted nominal model, in
        the channel (experiment, quantity, joint or tendon) where that is most, among those that stand out of the noise.
        """
        if not departures:
            return []
        whole, labels = self.trace(departures)
        before = by_channel(self.left(whole), labels)
        gaps = [c for c, size in before.items() if size > 1.0]
        out = []
        for i in range(len(departures)):
            after = by_channel(self.left(self.trace([*departures[:i], *departures[i + 1 :]])[0]), labels)
            out.append(max((1.0 - (after[c] / before[c]) ** 2 for c in gaps), default=0.0))
        return out


def _concern(parameter: str, index: int) -> Callable[[Plan], bool]:
    """Whether a trial can depend on a parameter of the joint or tendon `index`; sparing the others is what
    makes this fast.
    """

    def concerns(plan: Plan) -> bool:
        if parameter in ("excursion", "friction"):
            moving = plan.experiment in ("ID.2", "VD.1") and parameter == "excursion"
            return moving or plan.experiment in ("VD.2", "VD.3") or (plan.experiment == "ID.4" and plan.tendon == index)
        if plan.experiment in ("ID.2", "VD.1"):
            return False
        if parameter == "body" or plan.joint is None:
            return True
        return plan.joint == index

    return concerns


def by_channel(
    rows: Float[np.ndarray, " R"], labels: Sequence[tuple[str, str, int]]
) -> dict[tuple[str, str, int], float]:
    """rms of the rows by (experiment, channel, column)."""
    groups: dict[tuple[str, str, int], list[float]] = {}
    for value, label in zip(rows.tolist(), labels, strict=True):
        groups.setdefault(label, []).append(value)
    return {label: float(np.sqrt(np.mean(np.square(values)))) for label, values in groups.items()}


def severity(session: QuietSession, departures: Sequence[Departure]) -> tuple[float, tuple[str, str, int]]:
    """Largest rms by channel of what is left, in units of a hold's noise, and where."""
    trace, labels = session.trace(departures)
    sizes = by_channel(session.left(trace), labels)
    where = max(sizes, key=lambda label: sizes[label])
    return max(sizes[where], UNSEEN), where


def calibrate(
    session: QuietSession, departure: Departure, target: float, attempts: int = 8
) -> tuple[Departure, float, tuple[str, str, int]]:
    """Resize a departure until its severity is `target`, within a tenth or as far as physical sizes go."""
    low = high = None  # (log size, log severity) below and above the target
    best = None
    size = departure.size
    for _ in range(attempts):
        current = departure.resized(size)
        reached, where = severity(session, [current])
        if best is None or abs(np.log(reached / target)) < abs(np.log(best[1] / target)):
            best = current, reached, where
        if abs(reached / target - 1) < 0.1 or size == (departure.largest if reached < target else departure.smallest):
            break
        point = np.log(size), np.log(reached / target)
        low, high = (point, high) if point[1] < 0 else (low, point)
        if low and high:  # false position, kept off the ends
            share = np.clip(low[1] / (low[1] - high[1]), 0.1, 0.9)
            size = float(np.exp(low[0] + share * (high[0] - low[0])))
        else:
            size = float(np.clip(size * np.clip(np.exp(-point[1]), 0.05, 20.0), departure.smallest, departure.largest))
    assert best is not None
    return best
