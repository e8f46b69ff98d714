"""Severity of a departure: the size of its trace after a refit of the nominal parameters.

A trace is what departures change in the noise-free channels, as residuals of the nominal model. Channels are in units
of the noise of a hold's mean. The nominal model is linearised in NumPy around the true specimen, by perturbing every
parameter that a fit may move; CAD's uncertainty enters as prior precisions. A refit projects the trace off these
directions. Severity is the rms of the rest in the channel (experiment, quantity, column) where it is largest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from .closure import TYPICAL_ARM, sliding_with_tendons
from .departures.base import Departure
from .drive import planned_tension
from .laws import Finger
from .plant import Plant
from .protocols import Plan
from .record import Channels, Motion, commanded, last_direction, needed_torque, read, record, rigid_torque
from .sensors import Sensors
from .specimens import Specimen

COARSE = {250.0: 25.0, 1000.0: 60.0, 200.0: 40.0}  # Hz by a log's rate: enough for an rms over a trial
MIN_SEVERITY = 1e-9  # of a departure without any trace: its logarithm has to exist
SLIDING_SPEED = (
    0.03  # rad/s, a tenth of the slowest sweep of `protocols`. Speeds carry no noise here, as they do in `closure`.
)
MAX_RESIZES = 8  # steps of the search for a departure's size, which bound its time; the nearest one reached is taken
TAUT_TENSION = 0.3  # N, above which a tendon counts as taut: 15 times the noise of its sensor


@dataclass(frozen=True)
class CoarseTrial:
    """A trial at a coarse rate: plan, motion of the nominal finger, and rigid-body torque along it, N m."""

    plan: Plan
    motion: Motion
    rigid: Float[np.ndarray, "N m"] | None


class NoiseFreeSession:
    """The noise-free session of one specimen, and the directions that a nominal fit can absorb.

    `slack_counts`: whether the excursion of a tendon counts while it is slack, as it does in a case's severity.
    """

    def __init__(self, specimen: Specimen, plans: Sequence[Plan], sensors: Sensors, slack_counts: bool = True):
        self.specimen, self.sensors, self.slack_counts = specimen, sensors, slack_counts
        self.nominal = Finger(specimen)
        # Without noise repeats are equal.
        unique = {plan.motion: plan for plan in reversed(plans)}
        self.trials = [self._coarse_trial(plan) for plan in unique.values()]

    def _coarse_trial(self, plan: Plan) -> CoarseTrial:
        rate = COARSE[plan.rate]
        if plan.experiment == "VD.3":
            t = np.arange(int(plan.duration * rate)) / rate
            q, qd, qdd = (np.stack(x, axis=1) for x in zip(*(p(t) for p in plan.q), strict=True))
            motion = Motion(t, q, qd, qdd, planned_tension(self.nominal, plan, t), last_direction(qd))
        else:
            motion = commanded(plan, rate)
        return CoarseTrial(plan, motion, self._rigid(self.nominal, plan, motion))

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
        self, finger: Finger, coarse: CoarseTrial, motion: Motion, same_body: bool
    ) -> Iterator[tuple[str, str, int, np.ndarray]]:
        """Yield (experiment, channel, column, values in units of a hold's noise) of one trial of a finger.

        `same_body`: whether its rigid body is the nominal one.
        """
        plan = coarse.plan
        rigid = coarse.rigid if same_body and motion is coarse.motion else self._rigid(finger, plan, motion)
        channels = read(finger, self._true(finger, plan, motion, rigid))
        yield from self._rows_of(channels, coarse)

    def _true(self, finger: Finger, plan: Plan, motion: Motion, rigid) -> Channels:
        """True channels; VD.3 has the external torque that its motion needs."""
        out = record(finger, plan, motion, rigid)
        if plan.experiment == "VD.3":
            out = replace(out, torque=needed_torque(finger, plan, motion, rigid))
        return out

    def _rows_of(self, channels: Channels, coarse: CoarseTrial) -> Iterator[tuple[str, str, int, np.ndarray]]:
        plan, e = coarse.plan, coarse.plan.experiment
        finger = self.specimen.finger
        if channels.excursion is not None:
            taut = coarse.motion.tension > TAUT_TENSION
            pulled = finger.active & taut.any(axis=0)
            for k in np.flatnonzero(pulled if e != "ID.4" else np.arange(finger.n) == plan.tendon):
                x = channels.excursion[:, k] / self.sensors.hold_std("tendon_excursion")
                counts = taut[:, k] | self.slack_counts
                yield e, "tendon_excursion", int(k), (x - x.mean(where=counts) if counts.any() else x) * counts
        if channels.torque is not None:
            slides = self._sliding(coarse.motion) if e == "VD.3" else np.ones(coarse.motion.q.shape)
            scale = self.sensors.hold_std("joint_torque")
            for j in range(finger.m) if plan.joint is None else [plan.joint]:
                yield e, "joint_torque", j, channels.torque[:, j] / scale * slides[:, j]
        if channels.force is not None:
            for i in range(3):
                yield e, "fingertip_force", i, channels.force[:, i] / self.sensors.hold_std("fingertip_force")

    def _sliding(self, motion: Motion) -> Float[np.ndarray, "N m"]:
        """Mask: 1 where a joint and every tendon across it slide, else 0."""
        joint = np.abs(motion.qd) > SLIDING_SPEED
        arm = self.nominal.geometry(motion.q)[1]
        tendon = np.abs(np.einsum("tnm,tm->tn", arm, motion.qd)) > SLIDING_SPEED * TYPICAL_ARM
        return sliding_with_tendons(joint, tendon, self.specimen.finger).astype(float)

    def trace(self, departures: Sequence[Departure]) -> tuple[np.ndarray, list[tuple[str, str, int]]]:
        """Residuals of the nominal model on data with departures, in units of a hold's noise, and labels by row.

        The nominal model predicts from the angles and tensions that the sensors report.
        """
        finger = Finger(self.specimen, departures)
        same_body = finger.plant.finger is self.specimen.finger
        values, labels = [], []
        for coarse in self.trials:
            plan, motion = coarse.plan, coarse.motion
            rigid = coarse.rigid if same_body else self._rigid(finger, plan, motion)
            true = self._true(finger, plan, motion, rigid)
            if plan.experiment == "VD.3":  # The free finger needs no external torque.
                true = replace(true, torque=None)
            channels = read(finger, true)
            inputs = self._reported(motion, channels)
            expected = list(self.rows(self.nominal, coarse, inputs, True))
            if plan.experiment == "VD.3":
                own = needed_torque(finger, plan, motion, rigid)
                channels = replace(channels, torque=own)
            for (e, c, k, measured), (_, _, _, predicted) in zip(
                self._rows_of(channels, coarse), expected, strict=True
            ):
                values.append(measured - predicted)
                labels += [(e, c, k)] * len(measured)
        return np.concatenate(values), labels

    @staticmethod
    def _reported(motion: Motion, channels: Channels) -> Motion:
        """Motion as the sensors report it, the input of the model."""
        if channels.q is motion.q and channels.tension is motion.tension:
            return motion
        rate = np.gradient(channels.q - motion.q, motion.time, axis=0)
        return replace(motion, q=channels.q, qd=motion.qd + rate, tension=channels.tension)

    @cached_property
    def _base(self) -> list[np.ndarray]:
        """Rows of the nominal finger by trial."""
        return [
            np.concatenate([x for *_, x in self.rows(self.nominal, coarse, coarse.motion, True)])
            for coarse in self.trials
        ]

    @cached_property
    def absorbed(self) -> tuple[Float[np.ndarray, "R P"], Float[np.ndarray, " P"]]:
        """Derivatives of all rows by the nominal parameters, and prior precisions.

        A change of 1 is one prior standard deviation of CAD's parameters, and a typical change of the others.
        """
        base = np.concatenate(self._base)
        columns, prior = [], []
        for concerns, changed, size, weight in self._neighbours():
            plant = self.nominal.plant if changed.finger is self.specimen.finger else Plant(changed.finger)
            finger = Finger(changed, (), plant)
            same = changed.finger is self.specimen.finger
            column, at = np.zeros_like(base), 0
            for coarse, before in zip(self.trials, self._base, strict=True):
                if concerns(coarse.plan):
                    moved = np.concatenate([x for *_, x in self.rows(finger, coarse, coarse.motion, same)])
                    column[at : at + len(before)] = (moved - before) / size
                at += len(before)
            columns.append(column)
            prior.append(weight)
        return np.stack(columns, axis=1), np.array(prior)

    def _neighbours(self) -> Iterator[tuple[Callable[[Plan], bool], Specimen, float, float]]:
        """Yield specimens with one parameter changed: (trials concerned, specimen, size of the change, precision)."""
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
        """Matrix that maps a trace to the least-squares change of the nominal parameters."""
        jac, prior = self.absorbed
        # Severities are in units of the noise of a hold, about a second long: the rows of one second count once.
        gram = jac.T @ jac / COARSE[250.0] + np.diag(prior)
        return np.linalg.pinv(gram, rcond=1e-12, hermitian=True) @ jac.T / COARSE[250.0]

    def absorb(self, trace: Float[np.ndarray, " R"]) -> Float[np.ndarray, " P"]:
        """Change of the nominal parameters that explains a trace best."""
        return self._solver @ trace

    def refitted(self, trace: Float[np.ndarray, " R"]) -> Float[np.ndarray, " R"]:
        """Rest of a trace after a refit of the nominal parameters."""
        return trace - self.absorbed[0] @ self.absorb(trace)

    def closed_by(self, departures: Sequence[Departure]) -> list[float]:
        """Share of a channel's gap that each departure closes, in the channel where the share is largest.

        The share is 1 − (rms without the departure / rms of all)², both after a refit of the nominal parameters. Only
        channels whose rms exceeds a hold's noise count.
        """
        if not departures:
            return []
        whole, labels = self.trace(departures)
        before = by_channel(self.refitted(whole), labels)
        gaps = [c for c, size in before.items() if size > 1.0]
        out = []
        for i in range(len(departures)):
            after = by_channel(self.refitted(self.trace([*departures[:i], *departures[i + 1 :]])[0]), labels)
            out.append(max((1.0 - (after[c] / before[c]) ** 2 for c in gaps), default=0.0))
        return out


def _concern(parameter: str, index: int) -> Callable[[Plan], bool]:
    """Predicate of the plans that depend on a parameter of joint or tendon `index`. The others need no evaluation."""

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
    """rms of rows by label (experiment, channel, column)."""
    groups: dict[tuple[str, str, int], list[float]] = {}
    for value, label in zip(rows.tolist(), labels, strict=True):
        groups.setdefault(label, []).append(value)
    return {label: float(np.sqrt(np.mean(np.square(values)))) for label, values in groups.items()}


def severity(session: NoiseFreeSession, departures: Sequence[Departure]) -> tuple[float, tuple[str, str, int]]:
    """Severity of departures in units of a hold's noise, and the label of the channel where it is reached."""
    trace, labels = session.trace(departures)
    sizes = by_channel(session.refitted(trace), labels)
    where = max(sizes, key=lambda label: sizes[label])
    return max(sizes[where], MIN_SEVERITY), where


def calibrate(
    session: NoiseFreeSession, departure: Departure, target: float
) -> tuple[Departure, float, tuple[str, str, int]]:
    """Resize a departure until its severity is within a tenth of `target`, or its size at a physical limit.

    Return the departure, the severity reached, and the label of the channel where it is reached.
    """
    low = high = None  # (log size, log severity) below and above the target
    best = None
    size = departure.size
    for _ in range(MAX_RESIZES):
        current = departure.resized(size)
        reached, where = severity(session, [current])
        if best is None or abs(np.log(reached / target)) < abs(np.log(best[1] / target)):
            best = current, reached, where
        if abs(reached / target - 1) < 0.1 or size == (departure.largest if reached < target else departure.smallest):
            break
        point = np.log(size), np.log(reached / target)
        low, high = (point, high) if point[1] < 0 else (low, point)
        if low and high:  # False position, at least a tenth of the interval off its ends.
            share = np.clip(low[1] / (low[1] - high[1]), 0.1, 0.9)
            size = float(np.exp(low[0] + share * (high[0] - low[0])))
        else:
            size = float(np.clip(size * np.clip(np.exp(-point[1]), 0.05, 20.0), departure.smallest, departure.largest))
    assert best is not None
    return best
