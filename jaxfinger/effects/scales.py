"""Sizes of a specimen's signals, which scale the sizes that its effects may have.

The same physics in other units then has the same catalogue.
"""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float

from jaxfinger.model import Finger, Motion

# Percentile of |signal| that counts as its size. The maximum would be that of spikes and of filters' edges.
SIZE_PERCENTILE = 95.0


@runtime_checkable
class Recorded(Protocol):
    """Trials of one experiment: motion, measured channels, and masks that are zero where samples do not count."""

    @property
    def x(self) -> Motion: ...

    @property
    def y(self) -> Mapping[str, Float[Array, "_columns *T"]]: ...

    @property
    def mask(self) -> Mapping[str, Float[Array, "_columns *T"]]: ...


@dataclass(frozen=True)
class Scales:
    """Sizes of a specimen's signals by joint and tendon, SI. Prismatic joints have N and m for N m and rad."""

    torque: Float[np.ndarray, " m"]  # N m, measured; that of the links' weight where nothing was
    angle: Float[np.ndarray, " m"]  # rad, range of the motion
    turn: Float[np.ndarray, " m"]  # rad, 1: a turn over 2π; of a prismatic joint its range over 2π
    speed: Float[np.ndarray, " m"]  # rad/s
    acceleration: Float[np.ndarray, " m"]  # rad/s²
    mass: Float[np.ndarray, " m"]  # kg, of the link
    tension: Float[np.ndarray, " n"]  # N
    excursion: Float[np.ndarray, " n"]  # m
    pull: Float[np.ndarray, " n"]  # m/s, speed of the excursion
    length: float  # m, of the whole chain
    trial: float  # s, of the longest trial
    session: float  # s, from its start to the end of the last trial
    joints: tuple[str, ...]
    tendons: tuple[str, ...]

    @classmethod
    def of(cls, finger: Finger, recorded: Iterable[Recorded] = ()) -> "Scales":
        """Read the scales from trials, and from the finger's description where the trials show nothing."""
        recorded = list(recorded)
        m, n = finger.m, finger.n
        low, high = np.asarray(finger.limits).reshape(m, 2).T
        length = float(np.linalg.norm([*np.asarray(finger.origin)[1:], np.asarray(finger.fingertip)], axis=1).sum())
        length = length or 1.0
        time = [np.asarray(r.x.time) for r in recorded]
        trial = max((float(t.max()) for t in time if t.size), default=0.0) or 1.0
        session = max((float(np.asarray(r.x.session_time).max()) for r in recorded), default=0.0)
        session = max(session, trial)

        def each(count: int, values) -> Float[np.ndarray, " count"]:
            """Largest of the experiments' values, by column."""
            found = [np.asarray(v) for v in values]
            return np.max(found, axis=0) if found else np.zeros(count)

        travel = each(m, (_range(r.x.q) for r in recorded))
        angle = _filled(travel, high - low)
        turn = np.where(finger.prismatic, angle / (2.0 * np.pi), 1.0)
        speed = _filled(each(m, (_size(r.x.qd) for r in recorded)), angle / min(trial, 1.0))
        acceleration = _filled(each(m, (_size(r.x.qdd) for r in recorded)), speed**2 / angle)
        mass = _filled(np.asarray(finger.mass), np.ones(m))
        weight = float(mass.sum() * (np.linalg.norm(np.asarray(finger.gravity)) or length / trial**2) * length)
        measured = each(m, (_counted(r, "joint_torque", m) for r in recorded))
        torque = _filled(measured, np.full(m, weight))
        tension = _filled(each(n, (_size(r.x.tension) for r in recorded)), np.full(n, torque.max(initial=0.0) / length))
        pulled = each(n, (_counted(r, "tendon_excursion", n, _range) for r in recorded))
        excursion = _filled(pulled, np.full(n, 0.1 * length))
        pull = excursion * float(np.max(speed / angle, initial=0.0))
        return cls(
            torque, angle, turn, speed, acceleration, mass, tension, excursion, pull,
            length, trial, session, finger.joint_names, finger.tendon_names,
        )  # fmt: skip

    def __call__(self, of: str, site: tuple[str, ...] = ()) -> float:
        """Evaluate a product of scales at a site, such as `torque/speed` or `mass*length`.

        A pair has the smaller of its two values, since its effect has to matter at both. A site that is neither joint
        nor tendon has the largest of all joints or tendons.
        """
        value = 1.0
        for sign, name in re.findall(r"([*/]?)([a-z]+)", "" if of == "1" else of):
            value *= self._at(name, site) ** (-1 if sign == "/" else 1)
        return value

    def _at(self, name: str, site: tuple[str, ...]) -> float:
        values = getattr(self, name)
        if isinstance(values, float):
            return values
        names = self.joints if len(values) == len(self.joints) and name in _OF_JOINTS else self.tendons
        here = [float(v) for k, v in zip(names, values, strict=True) if k in site]
        return min(here) if here else float(np.max(values, initial=0.0)) or 1.0


def refuse_unknown_scale(of: str) -> None:
    """Refuse a text that is no product of scales, such as `torque/speed`, `1/tension` or `1`.

    Raises:
        ValueError: it names no scale, or holds more than names, `*` and `/`.
    """
    known = [f.name for f in fields(Scales) if f.name not in ("joints", "tendons")]
    if not re.fullmatch(r"(1|[a-z]+)([*/][a-z]+)*", of) or set(re.findall("[a-z]+", of)) - set(known):
        raise ValueError(f"{of!r} is no product of scales such as torque/speed; scales are {', '.join(known)}")


_OF_JOINTS = ("torque", "angle", "turn", "speed", "acceleration", "mass")


def _filled(found: np.ndarray, otherwise: np.ndarray) -> np.ndarray:
    """Replace values below a thousandth of the largest by the median of the rest, or by `otherwise` if all are zero."""
    shows = found > 1e-3 * found.max(initial=0.0)
    return np.where(shows, found, np.median(found[shows]) if shows.any() else otherwise).astype(float)


def _size(values) -> np.ndarray:
    """Size of each row: a high percentile of its absolute values."""
    flat = np.abs(np.asarray(values)).reshape(len(values), math.prod(np.shape(values)[1:]))
    return np.percentile(flat, SIZE_PERCENTILE, axis=1) if flat.size else np.zeros(len(flat))


def _range(values) -> np.ndarray:
    """Range of each row between its low and high percentile."""
    flat = np.asarray(values).reshape(len(values), math.prod(np.shape(values)[1:]))
    return (
        np.ptp(np.percentile(flat, [100.0 - SIZE_PERCENTILE, SIZE_PERCENTILE], axis=1), axis=0)
        if flat.size
        else np.zeros(len(flat))
    )


def _counted(r: Recorded, channel: str, columns: int, measure=_size) -> np.ndarray:
    """Size of a channel's samples that count, by column."""
    if channel not in r.y:
        return np.zeros(columns)
    y, mask = np.asarray(r.y[channel]), np.asarray(r.mask[channel]) > 0
    return np.array([measure(a[k][None])[0] if k.any() else 0.0 for a, k in zip(y, mask, strict=True)])
